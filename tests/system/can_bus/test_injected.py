"""The driver injects requested faults into its emulated modules, and into a virtual bus, which fails as a real one.

tests/system/can/test_bus_faults.py injects the same faults into interfaces of the kernel.
"""

from typing import Any

import pytest

from snakesim_can_backend.bus.bus import VirtualWire
from snakesim_can_backend.bus.bus_errors import BusError
from snakesim_can_backend.bus.bus_faults import inject_into_interface
from snakesim_can_backend.driver.backend import CanBackend
from snakesim_can_backend.emulator.faults import FAULT_DESCRIPTIONS
from snakesim_can_backend.protocol.definitions import CanFrame, ModuleState
from snakesim_can_backend.settings import CanSettings
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.faults.faulty_backend import FaultyBackend
from snakesim_hal.model.fault_kinds import parse_injection
from snakesim_testing.can.driver_loop import (
    DriverLoop,
    arm_and_wave,
    make_can_config,
    open_driver_loop,
    reset_and_arm_again,
)
from snakesim_testing.messages import raises_error


def inject(run: DriverLoop, text: str, *, begins: bool = True) -> None:
    """Begin or end a fault, given as KIND:TARGET."""
    FaultyBackend(run.backend).inject(parse_injection(f"{text}@0"), begins=begins)


# --- modules -----------------------------------------------------------------------------------------------------


def test_host_injects_measurement_errors_that_modules_cannot() -> None:
    with open_driver_loop() as run:
        run.run(3)
        faulty = FaultyBackend(run.backend)
        faulty.inject(parse_injection("wrong:joint_2@0=0.4"), begins=True)
        reported = faulty.sample(3, 3 * run.config.period_ns).joints.angle_rad
        assert reported == pytest.approx([0.0, 0.4, 0.0, 0.0], abs=0.02)
        with raises_error(ConfigError, code="injection/unknown-target", field="joint_9"):
            faulty.inject(parse_injection("leak:joint_9@0"), begins=True)
        with raises_error(ConfigError, code="injection/unknown-target", field="bus_2"):
            faulty.inject(parse_injection("cut:bus_2@0"), begins=True)


@pytest.mark.parametrize(
    ("settings", "fault"),
    [
        (CanSettings(), "diverge:simulator@1"),
        (CanSettings(), "cut:bus_2@1"),
        (CanSettings(channels=["vcan0"]), "leak:joint_1@1"),
        (CanSettings(channels=["vcan0"], emulators="process"), "full:bus_1@1"),
    ],
)
def test_injection_that_is_not_supported_is_refused_before_opening(
    settings: CanSettings, fault: str
) -> None:
    with raises_error(ConfigError, code=("injection/not-supported", "injection/unknown-target")):
        CanBackend.check(make_can_config(faults=[fault]), settings)


def test_injection_allows_everything_emulators_and_virtual_bus_support() -> None:
    faults = [f"{kind}:joint_1@1" for kind in (*FAULT_DESCRIPTIONS, "wrong", "nan")]
    faults += [
        f"{kind}:bus_1@1" for kind in ("cut", "bus_off", "error_passive", "overflow", "full")
    ]
    assert CanBackend.check(make_can_config(faults=faults), CanSettings()) == (
        "lockstep",
        "realtime",
    )


# --- the bus -----------------------------------------------------------------------------------------------------


SILENT = ["module_silent"] * 4
WATCHDOG = ["module_watchdog"] * 4
BUS_FAULTS = [
    # The injected fault, the period in which it is reported, the faults while it lasts, the faults that follow
    # when it ends, and the minor errors that are only counted.
    ("cut", 0, ["interface_down"], WATCHDOG, {"interface_up"}),
    ("bus_off", 0, ["bus_off", *SILENT], ["restarted", *WATCHDOG], set()),
    ("full", 2, ["bus_stuck"], WATCHDOG, {"queue_full"}),
    ("error_passive", 0, ["error_passive"], [], set()),
    ("overflow", 0, ["receive_overflow"], [], set()),
]


@pytest.mark.parametrize(
    ("kind", "delay_ticks", "first_faults", "later_faults", "minor_errors"),
    BUS_FAULTS,
    ids=[row[0] for row in BUS_FAULTS],
)
def test_bus_fault_stops_the_joints_and_bus_recovers(
    kind: str,
    delay_ticks: int,
    first_faults: list[str],
    later_faults: list[str],
    minor_errors: set[str],
) -> None:
    with open_driver_loop() as run:
        arm_and_wave(run)
        inject(run, f"{kind}:bus_1")
        start = run.tick
        run.run(13, run.wave_joints)
        assert [fault.what for fault in run.faults] == first_faults
        assert run.faults[0].tick - start == delay_ticks
        assert run.lifecycle == "fault"
        inject(run, f"{kind}:bus_1", begins=False)
        run.run(10)
        assert [fault.what for fault in run.faults] == first_faults + later_faults
        assert run.backend.modules.monitor.minor_error_counts.keys() == minor_errors
        assert run.states() == [ModuleState.FAULT if later_faults else ModuleState.DISARMED] * 4
        reset_and_arm_again(run)


def test_virtual_bus_end_with_fault_reports_it_and_recovers() -> None:
    near = VirtualWire("wire-faults")
    far = VirtualWire("wire-faults")
    try:
        frame = CanFrame(0x105, b"1")
        assert near.send(frame)
        assert far.receive() == [frame]
        assert near.errors() == []
        for kind, accepts_frame in (("cut", False), ("bus_off", True), ("full", False)):
            near.inject(kind, begins=True)
            assert near.send(frame) is accepts_frame
            assert far.receive() == []
            far.send(frame)
            assert near.receive() == ([frame] if kind == "full" else [])
            near.inject(kind, begins=False)
            assert near.send(frame)
            assert far.receive() == [frame]
        near.inject("overflow", begins=True)
        far.send(frame)
        far.send(frame)
        assert near.receive() == []
        far.send(frame)
        assert near.receive() == [frame]
        errors = [(error.kind, error.detail) for error in near.errors()]
        assert errors == [
            ("interface_down", "the interface is down"),
            ("interface_up", "the interface is up again"),
            ("bus_off", "transmit errors 255, receive errors 0"),
            ("restarted", "transmit errors 0, receive errors 0"),
            ("queue_full", "the transmit queue is full"),
            ("receive_overflow", "the kernel dropped 2 frames: this process reads too slowly"),
        ]
        near.inject("cut", begins=True)
        near.inject("cut", begins=True)
        assert near.errors() == [BusError("interface_down", "wire-faults", "the interface is down")]
    finally:
        near.close()
        far.close()


@pytest.mark.parametrize(
    "channel_and_fault",
    [
        ("lo0", "full"),
        ("nothere0", "cut"),
        ("can7", "bus_off"),
    ],
)
def test_interface_fault_that_is_impossible_is_refused(channel_and_fault: Any) -> None:
    channel, kind = channel_and_fault
    with raises_error(ConfigError, code=("injection/not-supported", "machine/not-permitted")):
        inject_into_interface(channel, kind, begins=True)
