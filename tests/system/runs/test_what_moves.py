"""Every drive type declares whether it moves real motors, and a run prints this at its start and at its end."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest

from snakesim_can_backend.can_drives import backend as can_family
from snakesim_can_backend.driver import modules
from snakesim_drivers.kit.bus import BusSpec
from snakesim_drivers.kit.buses import RobotBuses
from snakesim_drivers.kit.drive_backend import DriverClock
from snakesim_drivers.kit.drive_type import DriverTypeContext
from snakesim_drivers.kit.readings import DriveReadings
from snakesim_hal.model.plugins import BACKENDS, load_plugin
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.programs.preflight import decode_backend_settings
from snakesim_serial_backend import servo_backend
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.runs.in_process_command import run_to_summary

MIXED_ROBOT = {
    "robot__drive": {"driver": "odrive"},
    "robot__joints": {"joint_3": {"driver": "dynamixel"}, "joint_4": {"driver": "dynamixel"}},
}


def make_four_joint_config(backend: str, **sections: Any) -> RunConfig:
    """Make a run of four joints whose emulated drives move only the inertia of the body.

    Args:
        backend: name of the backend.
        **sections: settings by backend, such as the buses. With settings, the run is in real time.
    """
    robot_keys = MIXED_ROBOT if backend == "mixed" else {}
    own_section = {"physics_model": "inertia"} | sections.pop(backend, {})
    has_buses = bool(sections) or len(own_section) > 1
    return make_run_config(
        backend=backend,
        robot__chain__modules=4,
        rate_hz=100,
        clock_mode="realtime" if has_buses else "lockstep",
        backends={backend: own_section, **sections},
        **robot_keys,
    )


def open_backend(config: RunConfig) -> Any:
    """Create the backend of a run."""
    factory = load_plugin(BACKENDS, config.backend)
    return factory(config, decode_backend_settings(config, factory))


@pytest.mark.parametrize("backend", ["can", "odrive", "moteus", "cia402", "dynamixel", "mixed"])
def test_backend_without_bus_declares_itself_emulated(backend: str) -> None:
    robot = open_backend(make_four_joint_config(backend))
    try:
        assert (
            describe_what_moves(robot.describe())
            == f"EMULATED: nothing real moves (backend {backend})"
        )
    finally:
        robot.close()


@pytest.mark.parametrize(
    ("backend", "buses", "emulated"),
    [
        ("odrive", {"odrive": ["can0"]}, False),
        ("odrive", {"odrive": ["vcan0"]}, True),
        ("odrive", {"odrive": ["vcan0", "can0"]}, False),
        ("moteus", {"moteus": ["can0"]}, False),
        ("moteus", {"moteus": ["udp_multicast:239.74.163.2"]}, True),
        ("dynamixel", {"dynamixel": ["/dev/ttyUSB0"]}, False),
        ("dynamixel", {"dynamixel": ["/dev/pts/7"]}, True),
        ("mixed", {"odrive": ["vcan0"], "dynamixel": ["/dev/pts/7"]}, True),
        ("mixed", {"odrive": ["vcan0"], "dynamixel": ["/dev/ttyUSB0"]}, False),
        ("mixed", {"odrive": ["can0"], "dynamixel": ["/dev/pts/7"]}, False),
    ],
)
def test_backend_is_emulated_only_without_real_buses(
    monkeypatch: pytest.MonkeyPatch, backend: str, buses: dict[str, list[str]], emulated: bool
) -> None:
    monkeypatch.setattr(
        can_family, "open_wire", lambda channel, *_rates: SimpleNamespace(channel=channel)
    )
    monkeypatch.setattr(
        servo_backend, "SerialWire", lambda port, *_: SimpleNamespace(port=port, latency_s=0.0)
    )
    sections = {
        name: {"ports" if name == "dynamixel" else "channels": bus_names}
        for name, bus_names in buses.items()
    }
    config = make_four_joint_config(backend, **sections)
    factory = load_plugin(BACKENDS, backend)
    clock = DriverClock(config)
    opened_buses: list[BusSpec] = []
    for part in factory.group_joints_by_driver_type(
        config, decode_backend_settings(config, factory)
    ):
        context = DriverTypeContext(config, part.settings, part.joints, clock, None)
        opened_buses += part.driver_type.plan_buses(context)
    without_threads = msgspec.structs.replace(config, clock_mode="lockstep")
    readings = DriveReadings(config.robot.joint_table, clock.now_ns)
    robot_buses = RobotBuses(without_threads, readings, opened_buses, clock.now_ns)
    assert robot_buses.emulated == emulated


def test_robot_with_one_real_joint_module_is_real(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each joint module reports in its Identity whether it is emulated."""
    find_modules = modules.find_modules

    def find_modules_with_real_first(*arguments: Any) -> Any:
        first, *others = find_modules(*arguments)
        return [dataclasses.replace(first, is_emulated=False), *others]

    monkeypatch.setattr(modules, "find_modules", find_modules_with_real_first)
    robot = open_backend(make_four_joint_config("can"))
    try:
        assert describe_what_moves(robot.describe()) == "REAL: motors move (backend can)"
    finally:
        robot.close()


def test_run_states_emulation_at_start_and_end(tmp_path: Path) -> None:
    result, summary = run_to_summary(
        tmp_path / "run", "triplet", "--backend", "odrive", "--duration", "0.1"
    )
    assert summary.emulated
    first_line, second_line, *other_lines = result.out.splitlines()
    assert first_line.startswith("triplet: planar13")
    assert second_line == "EMULATED: nothing real moves (backend odrive)"
    assert "  EMULATED              nothing real moved (backend odrive)" in other_lines
    assert "EMULATED: nothing real moved" in (tmp_path / "run" / "report.html").read_text()
