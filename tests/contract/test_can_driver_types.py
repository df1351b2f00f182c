"""Every driver type commands emulated drives in lockstep, through the lifecycle states of a robot.

This includes the servos on serial ports. `tests/unit/serial_backend` tests what is special for them.
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
from snakesim_serial_backend.dynamixel import registers as dynamixel_registers
from snakesim_serial_backend.dynamixel.backend import DynamixelBackend
from snakesim_serial_backend.feetech import registers as feetech_registers
from snakesim_serial_backend.feetech.backend import FeetechBackend
from snakesim_testing.benches.emulated_drives import DrivesOfAnyType
from snakesim_testing.drivers.drive_rig import DriveRig, drives_of
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.messages import raises_error

JOINTS = 4
RATE_HZ = 100  # one tick is 10 ms
TARGET_RAD = 0.1  # setpoint of every joint, by default of `DriveRig`
TARGET_TOLERANCE_RAD = 0.02
ALL_FOLLOW = [True] * JOINTS
NONE_FOLLOWS = [False] * JOINTS

# Durations in ticks.
ARM_TICKS = 20  # until all drives of an armed robot follow setpoints
FAULT_REPORT_TICKS = 20  # until a fault is reported: a heartbeat period has ten ticks
RESTART_TICKS = 80  # until a drive has restarted and its driver has configured it again
RESET_TICKS = 80  # until drives are reset, some by a restart
TOO_FAST = 0  # stands for the rate that is too fast for a driver type


@dataclass(frozen=True)
class DriverTypeCase:
    """What a test must know about a driver type and its emulator."""

    backend: type[DriverTypeBackend]
    drives: Callable[[Any], list[Any]]  # returns the drives of an emulator
    follows: Callable[[Any], bool]  # returns whether a drive follows setpoints
    settings: Callable[[Any, int], object]  # returns what the drive of a joint has in force
    expired: str  # text of the fault of an expired watchdog
    overheated: str  # text of the fault of a hot drive
    serial: str = ""  # template of a serial number, for the number of a drive
    firmware: str = ""
    too_fast_hz: float = 0.0
    bring_up_s: float = 0.5


def get_motor_limits(emulator: Any, joint: int) -> tuple[float, float]:
    """Return the stiffness and the torque limit of a motor."""
    return emulator.body.motors._kp[joint], emulator.body.motors._limit[joint]


DRIVER_TYPES = {
    "odrive": DriverTypeCase(
        OdriveBackend,
        lambda emulator: emulator.axes,
        lambda axis: axis.state == AxisState.CLOSED_LOOP,
        get_motor_limits,
        "watchdog_timer_expired",
        "motor_over_temp",
        "38550000000{}",
        "0.6.11",
        500,
    ),
    "moteus": DriverTypeCase(
        MoteusBackend,
        lambda emulator: emulator.controllers,
        lambda controller: controller.mode == MoteusMode.POSITION,
        get_motor_limits,
        "its watchdog expired",
        "fault 38, over-temperature",
        "3033363665115510{:08X}",
        "",
        2000,
    ),
    "cia402": DriverTypeCase(
        Cia402Backend,
        lambda emulator: emulator.drives,
        lambda drive: drive.state == PowerState.ENABLED,
        get_motor_limits,
        "error 0x8130, communication: no heartbeat of the host: its watchdog expired",
        "error 0x4210, temperature",
        "00000000-00000402-4020000{}",
        "1.0",
        500,
        bring_up_s=3.0,  # a hundred SDO transfers for each drive
    ),
    "dynamixel": DriverTypeCase(
        DynamixelBackend,
        lambda emulator: emulator.servos,
        lambda servo: (
            servo.is_torque_on
            and servo.table[dynamixel_registers.WATCHDOG] != dynamixel_registers.TRIPPED
        ),
        lambda emulator, joint: (
            emulator.servos[joint].table[dynamixel_registers.GAINS : dynamixel_registers.GAINS + 6],
            emulator.servos[joint].table[dynamixel_registers.WATCHDOG],
        ),
        "stopped by its bus watchdog",
        "overheating",
    ),
    "feetech": DriverTypeCase(
        FeetechBackend,
        lambda emulator: emulator.servos,
        lambda servo: servo.is_torque_on,
        lambda emulator, joint: emulator.servos[joint].table[
            feetech_registers.TORQUE_ENABLE : feetech_registers.GOALS
        ],
        "held its last angle",
        "overheating",
        firmware="3.10",
    ),
}
for_can_driver_types = pytest.mark.parametrize(
    "driver_type", ["odrive", "moteus", "cia402"], indirect=True
)


class DriveRobot(DriveRig):
    """A robot with a backend of a driver type and its emulated drives."""

    def __init__(self, driver_type: DriverTypeCase, **settings: Any) -> None:
        self.driver_type = driver_type
        config = make_run_config(
            backend=driver_type.backend.name, robot__chain__modules=JOINTS, rate_hz=RATE_HZ
        )
        config = apply_backend_modes(config, driver_type.backend)
        fixed: dict[str, Any] = {
            "physics_model": "inertia",
            "bring_up_limit_s": driver_type.bring_up_s,
        }
        super().__init__(
            config, driver_type.backend(config, driver_type.backend.Settings(**fixed | settings))
        )
        self._observed_drives = DrivesOfAnyType(self.backend)

    @property
    def emulator(self) -> Any:
        return drives_of(self.backend)._emulator

    def pause_host(self, seconds: float) -> None:
        """Let time pass at the drives while the driver is paused."""
        self._observed_drives.freeze_driver(seconds, lambda _seconds: None)
        self.tick += round(seconds * self.config.rate_hz)

    def list_following(self) -> list[bool]:
        """Return for each drive whether it follows setpoints."""
        return [self.driver_type.follows(drive) for drive in self.driver_type.drives(self.emulator)]

    def assert_joints_reached_target(self) -> None:
        assert self.joints is not None
        assert self.joints.angle_rad == pytest.approx(
            [TARGET_RAD] * JOINTS, abs=TARGET_TOLERANCE_RAD
        )


@pytest.fixture(params=DRIVER_TYPES)
def driver_type(request: pytest.FixtureRequest) -> DriverTypeCase:
    return DRIVER_TYPES[request.param]


@pytest.fixture
def with_watchdog(driver_type: DriverTypeCase) -> None:
    """Skip driver types whose drives have no watchdog."""
    if not driver_type.backend.has_watchdog:
        pytest.skip(
            f"the driver type {driver_type.backend.name} declares that its drives have no watchdog"
        )


@pytest.fixture
def robot(driver_type: DriverTypeCase) -> Iterator[DriveRobot]:
    opened = DriveRobot(driver_type)
    yield opened
    opened.backend.close()


def test_driver_describes_serials_and_firmware_that_drives_report(robot: DriveRobot) -> None:
    joints = robot.backend.describe().joints
    assert [joint.serial for joint in joints] == [
        robot.driver_type.serial.format(i + 1) for i in range(JOINTS)
    ]
    assert {joint.firmware for joint in joints} == {robot.driver_type.firmware}


@pytest.mark.heavy
def test_drive_error_persists_until_reset_and_is_reported_again(
    robot: DriveRobot,
) -> None:
    assert robot.run(30, "disarmed") == []
    assert robot.run(30, "armed") == []
    robot.go_wrong("overheat:joint_2@0-9")
    fault = robot.run(FAULT_REPORT_TICKS, "armed")[0]
    assert fault.what == "drive_fault"
    assert fault.joint == "joint_2"
    assert robot.driver_type.overheated in fault.cause

    assert robot.run(50, "fault") == [], "the same error is reported again"
    assert robot.run(50, "estop") == [], "the same error is reported again"
    assert robot.list_following() == NONE_FOLLOWS
    assert [fault.joint for fault in robot.run(RESET_TICKS, "disarmed")] == ["joint_2"], (
        "the drive was still hot at the reset"
    )

    robot.go_wrong("overheat:joint_2@0-9", begins=False)
    robot.emulator.body.thermal.winding_temperature_c[:] = 20.0
    robot.run(5, "fault")
    assert robot.run(RESET_TICKS, "disarmed") == []
    assert robot.run(60, "armed") == []
    robot.assert_joints_reached_target()


RESTARTED_JOINT = 2
RESTART = f"reboot:joint_{RESTARTED_JOINT + 1}@0"


def test_drive_restarted_in_motion_stays_off_until_reset(robot: DriveRobot) -> None:
    """A drive that restarts has lost its settings, so the whole robot stops, and stays off until a person resets it."""
    robot.run(ARM_TICKS, "armed")

    robot.go_wrong(RESTART)
    faults = robot.run(RESTART_TICKS, "armed")

    assert [(fault.what, fault.joint) for fault in faults] == [("drive_silent", "joint_3")]
    assert robot.list_following() == NONE_FOLLOWS, "the drives are off, also after the restart"


def test_drive_restarted_in_motion_follows_with_its_settings_after_reset(
    robot: DriveRobot,
) -> None:
    robot.run(ARM_TICKS, "armed")
    robot.go_wrong(RESTART)
    robot.run(RESTART_TICKS, "armed")

    assert robot.run(10, "fault") == [], "the same restart is reported again"
    assert robot.run(10, "disarmed") == []
    robot.run(40, "armed")

    assert robot.list_following() == ALL_FOLLOW
    robot.assert_joints_reached_target()
    settings = [robot.driver_type.settings(robot.emulator, joint) for joint in range(JOINTS)]
    assert settings[RESTARTED_JOINT] == settings[0], (
        "the driver has not configured it as the others"
    )
    _, torque_limit_nm = get_motor_limits(robot.emulator, RESTARTED_JOINT)
    assert torque_limit_nm == pytest.approx(robot.limit_nm, abs=0.01)


def test_drive_restarted_between_ticks_does_not_continue(
    robot: DriveRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The drive boots within one tick, so it is never silent. Its state shows that it has restarted."""
    monkeypatch.setattr("snakesim_drivers.emulation.emulated_body.BOOT_US", 10_000.0)
    robot.run(30, "armed")

    robot.go_wrong(RESTART)
    faults = robot.run(FAULT_REPORT_TICKS, "armed")

    assert [(fault.what, fault.joint) for fault in faults] == [("drive_not_armed", "joint_3")]


def test_joint_lost_while_armed_is_ignored_until_used_again(robot: DriveRobot) -> None:
    robot.run(ARM_TICKS, "armed")

    robot.go_wrong("mute:joint_1@0")
    robot.isolated = frozenset({0})
    assert robot.run(60, "armed") == []
    assert robot.list_following() == [False, True, True, True]
    assert robot.joints is not None and max(robot.joints.age_ns[1:]) == 0, (
        "a silent drive does not delay the others"
    )

    robot.go_wrong("mute:joint_1@0", begins=False)
    robot.isolated = frozenset()
    assert robot.run(30, "disarmed") == []
    assert robot.run(ARM_TICKS, "armed") == []
    assert robot.list_following() == ALL_FOLLOW


@pytest.mark.usefixtures("with_watchdog")
def test_drives_stop_by_watchdog_when_driver_is_gone(
    robot: DriveRobot,
) -> None:
    """Command the torque limit of the joint. odrive/test_limits.py tests a lower one, which an ODrive keeps."""
    robot.limit_nm = robot.config.robot.limits.torque_nm
    robot.run(ARM_TICKS, "armed")

    robot.backend._clock.robot_time_ns += 190_000_000  # longer than each watchdog
    robot.emulator()
    assert robot.list_following() == NONE_FOLLOWS

    faults = robot.run(FAULT_REPORT_TICKS, "armed")
    assert {fault.what for fault in faults} == {"drive_fault"}
    assert all(robot.driver_type.expired in fault.cause for fault in faults), faults

    robot.backend._drives.bring_up()
    assert robot.run(FAULT_REPORT_TICKS, "disarmed") == []
    assert robot.run(FAULT_REPORT_TICKS, "armed") == []


@pytest.mark.usefixtures("with_watchdog")
def test_drives_stopped_behind_cut_bus_are_reported_before_reset(robot: DriveRobot) -> None:
    """Read the stop first, although the driver ran all the time and its commands were lost on the cut bus."""
    robot.run(30, "armed")
    robot.go_wrong("cut:bus_1@0-9")
    assert "interface_down" in {fault.what for fault in robot.run(30, "armed")}
    assert robot.list_following() == NONE_FOLLOWS, "the watchdogs have stopped the drives"

    robot.go_wrong("cut:bus_1@0-9", begins=False)
    robot.damps = True
    faults = robot.run(FAULT_REPORT_TICKS, "fault")
    assert {(fault.what, fault.joint) for fault in faults} == {
        ("drive_fault", f"joint_{i + 1}") for i in range(JOINTS)
    }
    assert all(robot.driver_type.expired in fault.cause for fault in faults), faults
    assert robot.list_following() == NONE_FOLLOWS

    assert robot.run(10, "disarmed") == []
    assert robot.run(30, "armed") == []
    assert robot.list_following() == ALL_FOLLOW


@pytest.mark.usefixtures("with_watchdog")
def test_stop_of_silent_drive_is_reported_when_it_answers(robot: DriveRobot) -> None:
    """Report the stop of a drive that is silent after a pause of the host as soon as it answers again."""
    robot.run(ARM_TICKS, "armed")
    robot.go_wrong("mute:joint_2@0-9")
    robot.pause_host(1.0)  # longer than each watchdog
    assert robot.list_following() == NONE_FOLLOWS

    robot.damps = True
    first_faults = robot.run(30, "fault")
    stopped_joints = {
        fault.joint for fault in first_faults if robot.driver_type.expired in fault.cause
    }
    assert stopped_joints == {"joint_1", "joint_3", "joint_4"}, first_faults

    robot.go_wrong("mute:joint_2@0-9", begins=False)
    later_faults = robot.run(FAULT_REPORT_TICKS, "fault")
    assert [fault.joint for fault in later_faults if robot.driver_type.expired in fault.cause] == [
        "joint_2"
    ], later_faults
    assert robot.list_following() == NONE_FOLLOWS


def test_damping_before_start_enables_no_drive(robot: DriveRobot) -> None:
    robot.run(5, "disarmed")
    robot.damps = True
    robot.run(10, "fault")
    assert robot.list_following() == NONE_FOLLOWS, "the robot was not armed before the fault"

    robot.run(5, "disarmed")
    drives = drives_of(robot.backend)
    drives.command = lambda *_arguments, **_options: None  # the command that enables them is lost
    robot.run(1, "armed")
    del drives.command
    robot.run(30, "fault")
    assert robot.list_following() == NONE_FOLLOWS, "no drive was enabled before the fault"


@for_can_driver_types
def test_drive_with_other_id_is_silent_and_an_unknown_node(
    robot: DriveRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    wrong_id = 9  # of no joint
    readdressed_drive = robot.driver_type.drives(robot.emulator)[0]
    id_attribute = "node_id" if hasattr(readdressed_drive, "node_id") else "id"
    setattr(readdressed_drive, id_attribute, wrong_id)

    faults = robot.run(40, "disarmed")

    assert {(fault.what, fault.joint) for fault in faults} == {
        ("drive_silent", "joint_1"),
        ("unknown_node", None),
    }
    assert any(f"node {wrong_id} is on the bus" in fault.cause for fault in faults)

    emulator_class = type(robot.emulator)
    create_emulator = emulator_class.__init__

    def create_emulator_with_wrong_id(emulator: Any, *arguments: Any) -> None:
        create_emulator(emulator, *arguments)
        emulator._index_by_node_id.pop((id(emulator.wires[1]), 2))

    monkeypatch.setattr(emulator_class, "__init__", create_emulator_with_wrong_id)
    with raises_error(BackendError, code="drive/not-complete", field="joint_2"):
        DriveRobot(robot.driver_type)


@for_can_driver_types
def test_duplicate_drive_ids_stop_the_robot_and_block_start(robot: DriveRobot) -> None:
    robot.run(20, "armed")
    serials = [joint.serial for joint in robot.backend.describe().joints]
    assert len(set(serials)) == JOINTS
    assert all(serials)

    robot.go_wrong("duplicate:joint_2@0-9")
    [fault] = robot.run(FAULT_REPORT_TICKS, "armed")
    assert fault.what == "duplicate_node"
    assert fault.joint == "joint_2"
    assert fault.scope == "robot"
    assert serials[1] in fault.cause
    assert robot.list_following() == NONE_FOLLOWS
    assert [fault.what for fault in robot.run(FAULT_REPORT_TICKS, "disarmed")] == [
        "duplicate_node"
    ], "the second drive was present at the reset"
    with raises_error(BackendError, code="drive/not-complete"):
        robot.backend._drives.bring_up()

    robot.go_wrong("duplicate:joint_2@0-9", begins=False)
    robot.backend._drives.bring_up()
    assert robot.run(5, "fault") == []
    assert robot.run(FAULT_REPORT_TICKS, "disarmed") == []
    assert robot.run(FAULT_REPORT_TICKS, "armed") == []


@for_can_driver_types
def test_second_program_that_commands_drives_stops_the_robot(robot: DriveRobot) -> None:
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


@for_can_driver_types
def test_bus_log_is_read_by_python_can_as_sent(driver_type: DriverTypeCase, tmp_path: Path) -> None:
    logged_robot = DriveRobot(driver_type, log=str(tmp_path / "bus.log"))
    logged_robot.run(5, "armed")
    logged_robot.backend.close()
    with can.LogReader(tmp_path / "bus.log") as log:
        frames = list(log)
    assert len(frames) > 5 * 3 * JOINTS, "fewer than three frames per joint and tick"
    assert {frame.is_fd for frame in frames} == {driver_type.backend is MoteusBackend}
    assert {frame.is_rx for frame in frames} == {True, False}
    assert all(frame.is_extended_id == (frame.arbitration_id > 0x7FF) for frame in frames)


@for_can_driver_types
@pytest.mark.parametrize(
    "changes",
    [
        {"rate_hz": TOO_FAST},
        {"rate_hz": 20},
        {"robot__joints": {"joint_2": {"id": 127}}},
        {"robot__joints": {"joint_2": {"port": "can7"}}},
    ],
)
def test_configuration_that_drives_do_not_support_is_refused(
    driver_type: DriverTypeCase, changes: dict[str, Any]
) -> None:
    valid = {
        "backend": driver_type.backend.name,
        "robot__chain__modules": JOINTS,
        "rate_hz": 100,
    }
    invalid: dict[str, Any] = valid | changes
    if invalid["rate_hz"] == TOO_FAST:
        invalid["rate_hz"] = driver_type.too_fast_hz
    config = make_run_config(**invalid)
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
