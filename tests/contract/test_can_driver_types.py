"""Drivers of every driver type against emulated drives in lockstep, with the robot's lifecycle as the host has it.

Dynamixel, on serial ports, is among them: what only its servos do is in `tests/unit/serial_backend/dynamixel`.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import can
import pytest

from snakesim_can_backend.cia402.backend import Cia402Backend
from snakesim_can_backend.cia402.state_machine import PowerState
from snakesim_can_backend.moteus.backend import MoteusBackend
from snakesim_can_backend.moteus.protocol import MoteusMode
from snakesim_can_backend.odrive.backend import OdriveBackend
from snakesim_can_backend.odrive.protocol import AxisState
from snakesim_drivers.kit.drive_type import DriverTypeBackend
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.programs.preflight import apply_backend_modes
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.backend import DynamixelBackend
from snakesim_serial_backend.feetech import registers as feetech
from snakesim_serial_backend.feetech.backend import FeetechBackend
from snakesim_testing.benches.emulated_drives import DrivesOfAnyType
from snakesim_testing.drivers.drive_rig import DriveRig, drives_of
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.messages import raises_error

JOINTS = 4
SHOWN = 20  # ticks in which a fault shows: a heartbeat takes ten
CLEARED = 80  # and in which drives are reset, some by a restart


@dataclass(frozen=True)
class Family:
    """What a test knows of one."""

    backend: type[DriverTypeBackend]
    drives: Callable[[Any], list[Any]]  # of an emulator
    follows: Callable[[Any], bool]  # one of them
    settings: Callable[[Any, int], object]  # that the drive of a joint of an emulator has in force
    expired: str  # what the fault of an expired watchdog says
    overheated: str
    serial: str = ""  # of the drive with this number
    firmware: str = ""
    unheard: str = ""
    too_fast_hz: float = 0.0
    bring_up_s: float = 0.5


def law_of(emulator: Any, joint: int) -> tuple[float, float]:
    """The stiffness and the torque limit of a motor."""
    return emulator.body.motors._kp[joint], emulator.body.motors._limit[joint]


FAMILIES = {
    "odrive": Family(
        OdriveBackend,
        lambda emulator: emulator.axes,
        lambda axis: axis.state == AxisState.CLOSED_LOOP,
        law_of,
        "watchdog_timer_expired",
        "motor_over_temp",
        "38550000000{}",
        "0.6.11",
        "does not report its version: .*another id",
        500,
    ),
    "moteus": Family(
        MoteusBackend,
        lambda emulator: emulator.controllers,
        lambda controller: controller.mode == MoteusMode.POSITION,
        law_of,
        "its watchdog expired",
        "fault 38, over-temperature",
        "3033363665115510{:08X}",
        "",
        "does not report its register map: .*another id",
        2000,
    ),
    "cia402": Family(
        Cia402Backend,
        lambda emulator: emulator.drives,
        lambda drive: drive.state == PowerState.ENABLED,
        law_of,
        "error 0x8130, communication: no heartbeat of the host: its watchdog expired",
        "error 0x4210, temperature",
        "00000000-00000402-4020000{}",
        "1.0",
        "does not answer SDO requests: .*another node id",
        500,
        bring_up_s=3.0,  # a hundred SDO transfers for each drive
    ),
    "dynamixel": Family(
        DynamixelBackend,
        lambda emulator: emulator.servos,
        lambda servo: servo.is_torque_on and servo.table[at.WATCHDOG] != at.TRIPPED,
        lambda emulator, joint: (
            emulator.servos[joint].table[at.GAINS : at.GAINS + 6],
            emulator.servos[joint].table[at.WATCHDOG],
        ),
        "stopped by its bus watchdog",
        "overheating",
    ),
    "feetech": Family(
        FeetechBackend,
        lambda emulator: emulator.servos,
        lambda servo: servo.is_torque_on,
        lambda emulator, joint: emulator.servos[joint].table[feetech.TORQUE_ENABLE : feetech.GOALS],
        "held its last angle",
        "overheating",
        firmware="3.10",
    ),
}
on_can = pytest.mark.parametrize("driver_type", ["odrive", "moteus", "cia402"], indirect=True)


class Robot(DriveRig):
    """A backend of a driver type, and its drives."""

    def __init__(self, driver_type: Family, **settings: Any) -> None:
        self.driver_type = driver_type
        config = make_run_config(
            backend=driver_type.backend.name, robot__chain__modules=JOINTS, rate_hz=100
        )
        config = apply_backend_modes(config, driver_type.backend)
        fixed: dict[str, Any] = {
            "physics_model": "inertia",
            "bring_up_limit_s": driver_type.bring_up_s,
        }
        super().__init__(
            config, driver_type.backend(config, driver_type.backend.Settings(**fixed | settings))
        )

    @property
    def emulator(self) -> Any:
        return drives_of(self.backend)._emulator

    def freeze_host(self, seconds: float) -> None:
        """Time passes at the drives, and the driver does nothing meanwhile."""
        DrivesOfAnyType(self.backend).freeze_driver(seconds, lambda _seconds: None)
        self.tick += round(seconds * self.config.rate_hz)

    def following(self) -> list[bool]:
        return [self.driver_type.follows(drive) for drive in self.driver_type.drives(self.emulator)]


@pytest.fixture(params=FAMILIES)
def driver_type(request: pytest.FixtureRequest) -> Family:
    return FAMILIES[request.param]


@pytest.fixture
def with_watchdog(driver_type: Family) -> None:
    """Only for driver types whose drives stop by themselves."""
    if not driver_type.backend.has_watchdog:
        pytest.skip(
            f"the driver type {driver_type.backend.name} declares that its drives have no watchdog"
        )


@pytest.fixture
def robot(driver_type: Family) -> Iterator[Robot]:
    one = Robot(driver_type)
    yield one
    one.backend.close()


def test_driver_describes_the_drives_where_they_report_themselves(robot: Robot) -> None:
    joints = robot.backend.describe().joints
    assert [joint.serial for joint in joints] == [
        robot.driver_type.serial.format(i + 1) for i in range(JOINTS)
    ]
    assert {joint.firmware for joint in joints} == {robot.driver_type.firmware}


def test_drive_error_persists_until_reset_and_is_reported_again(
    robot: Robot,
) -> None:
    assert robot.run(30, "disarmed") == []
    assert robot.run(30, "armed") == []
    robot.go_wrong("overheat:joint_2@0-9")
    fault = robot.run(SHOWN, "armed")[0]
    assert fault.what == "drive_fault"
    assert fault.joint == "joint_2"
    assert robot.driver_type.overheated in fault.cause
    assert robot.run(50, "fault") == []
    assert robot.run(50, "estop") == []
    assert robot.following() == [False] * JOINTS
    assert [fault.joint for fault in robot.run(CLEARED, "disarmed")] == ["joint_2"], (
        "reset while it was still hot"
    )
    robot.go_wrong("overheat:joint_2@0-9", begins=False)
    robot.emulator.body.thermal.winding_temperature_c[:] = 20.0
    robot.run(5, "fault")
    assert robot.run(CLEARED, "disarmed") == []
    assert robot.run(60, "armed") == []
    assert robot.joints is not None
    assert robot.joints.angle_rad == pytest.approx([0.1] * JOINTS, abs=0.02)


def test_drive_restarted_in_motion_stays_off_until_reset(robot: Robot) -> None:
    robot.run(20, "armed")
    robot.go_wrong("reboot:joint_3@0")
    faults = robot.run(80, "armed")
    assert faults[0].what == "drive_silent"
    assert faults[0].joint == "joint_3"
    assert not faults[1:]
    assert robot.following() == [False] * JOINTS
    assert robot.run(10, "fault") == []
    assert robot.run(10, "disarmed") == []
    robot.run(40, "armed")
    assert robot.following() == [True] * JOINTS
    assert robot.joints is not None
    assert robot.joints.angle_rad == pytest.approx([0.1] * JOINTS, abs=0.02)
    settings = [robot.driver_type.settings(robot.emulator, joint) for joint in range(JOINTS)]
    assert settings[2] == settings[0]
    assert law_of(robot.emulator, 2)[1] == pytest.approx(1.0, abs=0.01)


def test_drive_restarted_between_ticks_does_not_continue(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("snakesim_drivers.emulation.emulated_body.BOOT_US", 10_000.0)
    robot.run(30, "armed")
    robot.go_wrong("reboot:joint_3@0")
    assert [(fault.what, fault.joint) for fault in robot.run(SHOWN, "armed")] == [
        ("drive_not_armed", "joint_3")
    ]


def test_joint_lost_while_armed_is_ignored_until_used_again(robot: Robot) -> None:
    robot.run(20, "armed")
    robot.go_wrong("mute:joint_1@0")
    robot.isolated = frozenset({0})
    assert robot.run(60, "armed") == []
    assert robot.following() == [False, True, True, True]
    assert robot.joints is not None and max(robot.joints.age_ns[1:]) == 0, (
        "it silences nobody behind it"
    )
    robot.go_wrong("mute:joint_1@0", begins=False)
    robot.isolated = frozenset()
    assert robot.run(30, "disarmed") == []
    assert robot.run(20, "armed") == []
    assert robot.following() == [True] * JOINTS


@pytest.mark.usefixtures("with_watchdog")
def test_drives_stop_by_watchdog_when_driver_is_gone(
    robot: Robot,
) -> None:
    """With the joint's own torque limit: a lower one that an ODrive has kept is in odrive/test_limits.py."""
    robot.limit_nm = robot.config.robot.limits.torque_nm
    robot.run(20, "armed")
    robot.backend._clock.robot_time_ns += 190_000_000
    robot.emulator()
    assert robot.following() == [False] * JOINTS
    faults = robot.run(SHOWN, "armed")
    assert {fault.what for fault in faults} == {"drive_fault"}
    assert all(robot.driver_type.expired in fault.cause for fault in faults)
    robot.backend._drives.bring_up()
    assert robot.run(SHOWN, "disarmed") == []
    assert robot.run(SHOWN, "armed") == []


@pytest.mark.usefixtures("with_watchdog")
def test_drives_stopped_behind_cut_bus_are_read_before_clearing(robot: Robot) -> None:
    """The driver ran all the time, and commanded them to damp and to be idle; nothing of it got through."""
    robot.run(30, "armed")
    robot.go_wrong("cut:bus_1@0-9")
    assert "interface_down" in {fault.what for fault in robot.run(30, "armed")}
    assert robot.following() == [False] * JOINTS, "stopped by their watchdogs"
    robot.go_wrong("cut:bus_1@0-9", begins=False)
    robot.damps = True
    faults = robot.run(SHOWN, "fault")
    assert {(fault.what, fault.joint) for fault in faults} == {
        ("drive_fault", f"joint_{i + 1}") for i in range(JOINTS)
    }
    assert all(robot.driver_type.expired in fault.cause for fault in faults)
    assert robot.following() == [False] * JOINTS
    assert robot.run(10, "disarmed") == []
    assert robot.run(30, "armed") == []
    assert robot.following() == [True] * JOINTS


@pytest.mark.usefixtures("with_watchdog")
def test_unreadable_stop_is_not_cleared_meanwhile(robot: Robot) -> None:
    """The host was frozen, and one drive does not answer after it: its watchdog's stop is reported once it does."""
    robot.run(20, "armed")
    robot.go_wrong("mute:joint_2@0-9")
    robot.freeze_host(1.0)
    assert robot.following() == [False] * JOINTS
    robot.damps = True
    first = robot.run(30, "fault")
    named = {fault.joint for fault in first if robot.driver_type.expired in fault.cause}
    assert named == {"joint_1", "joint_3", "joint_4"}, first
    robot.go_wrong("mute:joint_2@0-9", begins=False)
    found = robot.run(SHOWN, "fault")
    assert [fault.joint for fault in found if robot.driver_type.expired in fault.cause] == [
        "joint_2"
    ], found
    assert robot.following() == [False] * JOINTS


def test_damping_before_start_enables_no_drive(robot: Robot) -> None:
    robot.run(5, "disarmed")
    robot.damps = True
    robot.run(10, "fault")
    assert robot.following() == [False] * JOINTS, "a fault of a robot that was not armed"
    robot.run(5, "disarmed")
    drives = drives_of(robot.backend)
    drives.command = lambda *_told, **_more: None  # the enabling is lost on its way
    robot.run(1, "armed")
    del drives.command
    robot.run(30, "fault")
    assert robot.following() == [False] * JOINTS


@on_can
def test_drive_with_other_id_is_missing_then_a_stranger(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    renamed = robot.driver_type.drives(robot.emulator)[0]
    setattr(renamed, "node_id" if hasattr(renamed, "node_id") else "id", 9)
    faults = robot.run(40, "disarmed")
    assert {(fault.what, fault.joint) for fault in faults} == {
        ("drive_silent", "joint_1"),
        ("unknown_node", None),
    }
    assert any("node 9 is on the bus" in fault.cause for fault in faults)
    twin_class = type(robot.emulator)
    made = twin_class.__init__

    def elsewhere(emulator: Any, *rest: Any) -> None:
        made(emulator, *rest)
        emulator._index_by_node_id.pop((id(emulator.wires[1]), 2))

    monkeypatch.setattr(twin_class, "__init__", elsewhere)
    with raises_error(BackendError, code="drive/not-complete", field="joint_2"):
        Robot(robot.driver_type)


@on_can
def test_duplicate_drive_ids_stop_the_robot_and_block_start(robot: Robot) -> None:
    robot.run(20, "armed")
    serials = [joint.serial for joint in robot.backend.describe().joints]
    assert len(set(serials)) == JOINTS
    assert all(serials)
    robot.go_wrong("duplicate:joint_2@0-9")
    [fault] = robot.run(SHOWN, "armed")
    assert fault.what == "duplicate_node"
    assert fault.joint == "joint_2"
    assert fault.scope == "robot"
    assert serials[1] in fault.cause
    assert robot.following() == [False] * JOINTS
    assert [fault.what for fault in robot.run(SHOWN, "disarmed")] == ["duplicate_node"], (
        "reset while it is there"
    )
    with raises_error(BackendError, code="drive/not-complete"):
        robot.backend._drives.bring_up()
    robot.go_wrong("duplicate:joint_2@0-9", begins=False)
    robot.backend._drives.bring_up()
    assert robot.run(5, "fault") == []
    assert robot.run(SHOWN, "disarmed") == []
    assert robot.run(SHOWN, "armed") == []


@on_can
def test_another_program_that_commands_drives_stops_the_robot(robot: Robot) -> None:
    robot.run(20, "armed")
    channel = drives_of(robot.backend).wire.channel
    command = can.Message(arbitration_id=2 << 5 | 7, data=[8, 0, 0, 0], is_extended_id=False)
    if robot.driver_type.backend is MoteusBackend:
        command = can.Message(arbitration_id=2, data=[1, 0, 10], is_fd=True, is_extended_id=False)
    if robot.driver_type.backend is Cia402Backend:
        command = can.Message(
            arbitration_id=0x602, data=[0x2B, 0x40, 0x60, 0, 0x0F, 0, 0, 0], is_extended_id=False
        )
    protocol = can.CanProtocol.CAN_FD if command.is_fd else can.CanProtocol.CAN_20
    with can.Bus(interface="virtual", channel=channel, protocol=protocol) as bus:
        bus.send(command)
        assert [fault.what for fault in robot.run(3, "armed")] == ["second_host"]


@on_can
def test_bus_log_is_read_by_python_can_as_sent(driver_type: Family, tmp_path: Path) -> None:
    one = Robot(driver_type, log=str(tmp_path / "bus.log"))
    one.run(5, "armed")
    one.backend.close()
    with can.LogReader(tmp_path / "bus.log") as log:
        frames = list(log)
    assert len(frames) > 5 * 3 * JOINTS
    assert {frame.is_fd for frame in frames} == {driver_type.backend is MoteusBackend}
    assert {frame.is_rx for frame in frames} == {True, False}
    assert all(frame.is_extended_id == (frame.arbitration_id > 0x7FF) for frame in frames)


@on_can
@pytest.mark.parametrize(
    "dotted",
    [
        {"rate_hz": 0},
        {"rate_hz": 20},
        {"robot__joints": {"joint_2": {"id": 127}}},
        {"robot__joints": {"joint_2": {"port": "can7"}}},
    ],
)
def test_what_drives_cannot_do_is_refused_before_the_start(
    driver_type: Family, dotted: dict[str, Any]
) -> None:
    name = driver_type.backend.name
    fixed = {"backend": name, "robot__chain__modules": JOINTS, "rate_hz": 100}
    config = make_run_config(
        **fixed
        | dotted
        | ({"rate_hz": driver_type.too_fast_hz} if dotted.get("rate_hz") == 0 else {})
    )
    with raises_error(
        ConfigError,
        code=(
            "bus/invalid-channel",
            "bus/overloaded",
            "drive/unsupported-setting",
            "drive/watchdog-too-short",
        ),
    ):
        driver_type.backend.check(config, driver_type.backend.Settings())
