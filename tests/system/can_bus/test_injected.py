"""Faults on request through the driver: its emulators get theirs, and a virtual bus fails as a kernel's does.

What real interfaces do stands in tests/system/can/test_bus_faults.py; the rows here are the same.
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
    FaultyBackend(run.backend).inject(parse_injection(f"{text}@0"), begins=begins)


# --- modules -------------------------------------------------------------------------------------------------


def test_what_a_module_cannot_know_the_host_makes() -> None:
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
    ("settings", "text"),
    [
        (CanSettings(), "diverge:simulator@1"),
        (CanSettings(), "cut:bus_2@1"),
        (CanSettings(channels=["vcan0"]), "leak:joint_1@1"),
        (CanSettings(channels=["vcan0"], emulators="process"), "full:bus_1@1"),
    ],
)
def test_what_cannot_be_had_is_refused_before_anything_is_opened(
    settings: CanSettings, text: str
) -> None:
    with raises_error(ConfigError, code=("injection/not-supported", "injection/unknown-target")):
        CanBackend.check(make_can_config(faults=[text]), settings)


def test_injection_allows_everything_emulators_and_virtual_bus_support() -> None:
    texts = [f"{kind}:joint_1@1" for kind in (*FAULT_DESCRIPTIONS, "wrong", "nan")]
    texts += [f"{kind}:bus_1@1" for kind in ("cut", "bus_off", "error_passive", "overflow", "full")]
    assert CanBackend.check(make_can_config(faults=texts), CanSettings()) == (
        "lockstep",
        "realtime",
    )


# --- the bus -------------------------------------------------------------------------------------------------


SILENT, WATCHDOG = ["module_silent"] * 4, ["module_watchdog"] * 4
BUS_FAULTS = [
    # asked for, told after so many periods, then and while it lasts, when it ends, and what is only counted
    ("cut", 0, ["interface_down"], WATCHDOG, {"interface_up"}),
    ("bus_off", 0, ["bus_off", *SILENT], ["restarted", *WATCHDOG], set()),
    ("full", 2, ["bus_stuck"], WATCHDOG, {"queue_full"}),
    ("error_passive", 0, ["error_passive"], [], set()),
    ("overflow", 0, ["receive_overflow"], [], set()),
]


@pytest.mark.parametrize(
    ("kind", "after", "what", "then", "counted"), BUS_FAULTS, ids=[row[0] for row in BUS_FAULTS]
)
def test_a_bus_that_fails_stops_the_joints_and_comes_back(
    kind: str, after: int, what: list[str], then: list[str], counted: set[str]
) -> None:
    with open_driver_loop() as run:
        arm_and_wave(run)
        inject(run, f"{kind}:bus_1")
        start = run.tick
        run.run(13, run.wave_joints)
        assert [fault.what for fault in run.faults] == what
        assert run.faults[0].tick - start == after
        assert run.lifecycle == "fault"
        inject(run, f"{kind}:bus_1", begins=False)
        run.run(10)
        assert [fault.what for fault in run.faults] == what + then
        assert run.backend.modules.monitor.minor_error_counts.keys() == counted
        assert run.states() == [ModuleState.FAULT if then else ModuleState.DISARMED] * 4
        reset_and_arm_again(run)


def test_one_end_of_a_virtual_bus() -> None:
    here, there = VirtualWire("wire-faults"), VirtualWire("wire-faults")
    try:
        frame = CanFrame(0x105, b"1")
        assert here.send(frame)
        assert there.receive() == [frame]
        assert here.errors() == []
        for kind, taken in (("cut", False), ("bus_off", True), ("full", False)):
            here.inject(kind, begins=True)
            assert here.send(frame) is taken
            assert there.receive() == []
            there.send(frame)
            assert here.receive() == ([frame] if kind == "full" else [])
            here.inject(kind, begins=False)
            assert here.send(frame)
            assert there.receive() == [frame]
        here.inject("overflow", begins=True)
        there.send(frame)
        there.send(frame)
        assert here.receive() == []
        there.send(frame)
        assert here.receive() == [frame]
        said = [(error.kind, error.detail) for error in here.errors()]
        assert said == [
            ("interface_down", "the interface is down"),
            ("interface_up", "the interface is up again"),
            ("bus_off", "transmit errors 255, receive errors 0"),
            ("restarted", "transmit errors 0, receive errors 0"),
            ("queue_full", "the transmit queue is full"),
            ("receive_overflow", "the kernel dropped 2 frames: this process reads too slowly"),
        ]
        here.inject("cut", begins=True)
        here.inject("cut", begins=True)
        assert here.errors() == [BusError("interface_down", "wire-faults", "the interface is down")]
    finally:
        here.close()
        there.close()


@pytest.mark.parametrize(
    "given",
    [
        ("lo0", "full"),
        ("nothere0", "cut"),
        ("can7", "bus_off"),
    ],
)
def test_what_cannot_be_done_to_an_interface_is_told(given: Any) -> None:
    channel, kind = given
    with raises_error(ConfigError, code=("injection/not-supported", "machine/not-permitted")):
        inject_into_interface(channel, kind, begins=True)
