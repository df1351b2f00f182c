"""The Dynamixel driver commands emulated servos in lockstep, through the lifecycle states of a robot.

`tests/contract/test_can_driver_types.py` tests hardware errors, restarts and lost joints.
"""

import math
import re
from collections.abc import Iterator
from typing import Any

import pytest

from snakesim_drivers.emulation.mounted import MountedDrive
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.wire.messages import JointMode
from snakesim_serial_backend.dynamixel import registers
from snakesim_serial_backend.dynamixel.backend import DynamixelBackend
from snakesim_serial_backend.dynamixel.emulator import EmulatedDynamixel
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_testing.drivers.drive_rig import DriveRig, drives_of
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.messages import raises_error

JOINTS = 4
FAULT_REPORT_TICKS = (
    10  # until a fault is reported: each servo reports its health every fourth tick
)


class ServoRobot(DriveRig):
    """A robot with a Dynamixel backend and its emulated servos."""

    def __init__(self, settings: DynamixelSettings | None = None, **dotted: Any) -> None:
        config = make_run_config(
            backend="dynamixel", robot__chain__modules=JOINTS, rate_hz=100, **dotted
        )
        settings = settings or DynamixelSettings(physics_model="inertia", bring_up_limit_s=0.5)
        super().__init__(config, DynamixelBackend(config, settings))

    @property
    def emulator(self) -> EmulatedDynamixel:
        return drives_of(self.backend)._emulator


@pytest.fixture
def robot() -> Iterator[ServoRobot]:
    opened = ServoRobot()
    yield opened
    opened.backend.close()


def test_servos_stop_by_watchdog_when_driver_is_gone(robot: ServoRobot) -> None:
    robot.run(40, "armed")
    robot.mode = JointMode.TORQUE
    robot.target = 0.5
    robot.run(2, "armed")
    robot.backend._clock.robot_time_ns += 190_000_000
    robot.emulator()
    assert {servo.table[registers.WATCHDOG] for servo in robot.emulator.servos} == {
        registers.TRIPPED
    }
    faults = robot.run(FAULT_REPORT_TICKS, "armed")
    assert {fault.what for fault in faults} == {"drive_fault"}
    assert "watchdog" in faults[0].cause
    robot.run(5, "fault")
    robot.mode = JointMode.POSITION
    robot.target = 0.1
    assert robot.run(10, "disarmed") == []
    assert robot.run(60, "armed") == []


def test_servo_in_torque_mode_stops_just_beyond_its_travel(
    robot: ServoRobot,
) -> None:
    robot.run(40, "armed")
    robot.mode = JointMode.TORQUE
    robot.target = -0.05
    robot.run(8, "armed")
    assert robot.joints is not None
    assert robot.joints.torque_nm == pytest.approx([-0.05] * JOINTS, abs=0.004)
    servo = drives_of(robot.backend).servos[0]
    emulator = robot.emulator.servos[0]
    goal_rad = (
        emulator.read_register("i", registers.GOAL_POSITION) * registers.RAD
        + servo.turns * 2 * math.pi
    )
    assert servo.lower_rad - 0.5 < goal_rad < servo.lower_rad


def test_servo_angle_after_start_in_any_turn_is_joint_angle(robot: ServoRobot) -> None:
    robot.run(1, "disarmed")
    assert robot.joints is not None
    start_angles_rad = robot.joints.angle_rad
    for zero_rad in (math.pi, -0.02, 6.0):
        shifted_robot = ServoRobot(robot__drive={"zero_rad": zero_rad})
        shifted_robot.run(40, "armed")
        joint_state = shifted_robot.joints
        shifted_robot.backend.close()
        assert joint_state is not None
        assert joint_state.angle_rad == pytest.approx([0.1] * JOINTS, abs=0.02)
    assert start_angles_rad == pytest.approx([0.0] * JOINTS, abs=0.002)


def test_servo_id_model_and_setting_mismatches_are_named_at_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    create_emulator = EmulatedDynamixel.__init__

    def create_changed_emulator(emulator: EmulatedDynamixel, *arguments: Any) -> None:
        create_emulator(emulator, *arguments)
        first, second, third, fourth = emulator.servos
        first.table[7] = 9
        second.write_register("H", registers.MODEL, 1060)
        third.write_register("i", registers.HOMING_OFFSET, -100)
        fourth.write_register("H", registers.CURRENT_LIMIT, 10)

    monkeypatch.setattr(EmulatedDynamixel, "__init__", create_changed_emulator)
    with pytest.raises(BackendError) as refusal:
        ServoRobot()
    text = str(refusal.value)
    for expected in (
        "joint_1 (id 1 on /dev/pts/",
        "does not answer: it is off, or has another id or baud rate",
        "is of another model: XL430-W250 neither measures nor limits current",
        "has drive mode 0 and homing offset -100; both must be 0",
        "has a current limit of 0.03 A",
        "id 9 on /dev/pts/",
        "is no joint's: XM540-W270",
    ):
        assert expected in text, text


@pytest.mark.parametrize(
    ("register", "value"),
    [
        (registers.SECONDARY_ID, 1),
        (registers.STARTUP, 3),
    ],
)
def test_servo_with_settings_that_would_move_it_is_refused(
    robot: ServoRobot, register: int, value: int
) -> None:
    robot.emulator.servos[2].table[register] = value
    with raises_error(BackendError, code="drive/not-complete", field="joint_3"):
        drives_of(robot.backend).bring_up()


def test_servo_outside_of_its_travel_is_refused_at_start() -> None:
    settings = DynamixelSettings(
        physics_model="inertia", mounted={"joint_1": MountedDrive(zero_rad=2.5)}
    )
    with raises_error(BackendError, code="drive/unsupported-setting", field="joint_1"):
        ServoRobot(settings)


@pytest.mark.parametrize(
    "dotted",
    [
        {"rate_hz": 250},
        {"rate_hz": 20},
        {"robot__joints": {"joint_2": {"id": 253}}},
        {"robot__joints": {"joint_2": {"port": "/dev/ttyUSB7"}}},
        {"robot__joints": {"joint_2": {"gear": 2.0}}},
    ],
)
def test_configuration_that_servos_do_not_support_is_refused_before_start(
    dotted: dict[str, Any],
) -> None:
    config = make_run_config(
        **{"backend": "dynamixel", "robot__chain__modules": JOINTS, "rate_hz": 100, **dotted}
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
        DynamixelBackend.check(config, DynamixelSettings())


# Delays of an answer, in units of 2 us. A servo as delivered has 250.
SAME_DELAY = 250
OTHER_DELAY = 0


@pytest.mark.parametrize(
    "delay",
    [
        OTHER_DELAY,
        SAME_DELAY,
    ],
    ids=["one after the other", "at the same time"],
)
def test_servos_with_one_id_are_refused_at_start(robot: ServoRobot, delay: int) -> None:
    """Detect a second servo although servos have no serial numbers.

    With the same delay, the answers collide. With different delays, they follow each other.
    """
    robot.go_wrong("duplicate:joint_2@0-9")
    robot.emulator.servos[1].table[registers.DELAY] = delay
    with raises_error(BackendError, code="drive/not-complete", field="joint_2"):
        drives_of(robot.backend).bring_up()
    robot.go_wrong("duplicate:joint_2@0-9", begins=False)
    drives_of(robot.backend).bring_up()


@pytest.mark.parametrize(
    ("delay", "expected_fault", "pattern"),
    [
        (OTHER_DELAY, "duplicate_node", "joint_2 .* is duplicated: it answers one question twice"),
        (
            SAME_DELAY,
            "drive_silent",
            "joint_2 .* sends garbled bytes: a second servo has its id, or the line is dist",
        ),
    ],
    ids=["one after the other", "at the same time"],
)
def test_servo_with_duplicate_id_stops_the_robot(
    robot: ServoRobot, delay: int, expected_fault: str, pattern: str
) -> None:
    robot.run(20, "armed")
    robot.emulator.servos[1].table[registers.DELAY] = delay
    robot.go_wrong("duplicate:joint_2@0-9")
    fault = robot.run(FAULT_REPORT_TICKS, "armed")[0]
    assert (fault.what, fault.joint) == (expected_fault, "joint_2") and re.search(
        pattern, fault.cause
    ), fault
    assert fault.scope == ("robot" if expected_fault == "duplicate_node" else "joint")


@pytest.mark.parametrize("model", ["XM430-W350", "XL330-M288"])
def test_emulated_servos_have_the_model_of_the_settings(model: str) -> None:
    robot = ServoRobot(
        DynamixelSettings(physics_model="inertia", bring_up_limit_s=0.5, model=model)
    )
    robot.run(40, "armed")
    assert robot.joints is not None and robot.joints.angle_rad == pytest.approx(
        [0.1] * JOINTS, abs=0.02
    )
    robot.backend.close()


def test_emulated_model_without_current_limit_is_refused_by_name() -> None:
    settings = DynamixelSettings(physics_model="inertia", bring_up_limit_s=0.5, model="XL430-W250")
    with pytest.raises(BackendError, match="XL430-W250 neither measures nor limits current"):
        ServoRobot(settings)
