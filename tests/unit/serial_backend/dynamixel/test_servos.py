"""The Dynamixel driver against emulated servos in lockstep, with the robot's lifecycle as the host would have it.

Hardware errors, restarts and lost joints are in `tests/contract/test_can_driver_types.py`.
"""

import math
import re
from collections.abc import Iterator
from typing import Any

import pytest

from snakesim_drivers.emulation.mounted import MountedDrive
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.wire.messages import JointMode
from snakesim_serial_backend.dynamixel import registers as at
from snakesim_serial_backend.dynamixel.backend import DynamixelBackend
from snakesim_serial_backend.dynamixel.emulator import EmulatedDynamixel
from snakesim_serial_backend.dynamixel.settings import DynamixelSettings
from snakesim_testing.drivers.drive_rig import DriveRig, drives_of
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.messages import raises_error

JOINTS = 4
NOTICED = 10  # ticks in which a fault shows: each servo says its health every fourth


class Robot(DriveRig):
    """The backend and its servos."""

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
def robot() -> Iterator[Robot]:
    one = Robot()
    yield one
    one.backend.close()


def test_servos_stop_by_watchdog_when_driver_is_gone(robot: Robot) -> None:
    robot.run(40, "armed")
    robot.mode, robot.target = JointMode.TORQUE, 0.5
    robot.run(2, "armed")
    robot.backend._clock.robot_time_ns += 190_000_000
    robot.emulator()
    assert {servo.table[at.WATCHDOG] for servo in robot.emulator.servos} == {at.TRIPPED}
    found = robot.run(NOTICED, "armed")
    assert {fault.what for fault in found} == {"drive_fault"}
    assert "watchdog" in found[0].cause
    robot.run(5, "fault")
    robot.mode, robot.target = JointMode.POSITION, 0.1
    assert robot.run(10, "disarmed") == []
    assert robot.run(60, "armed") == []


def test_servo_in_torque_mode_stops_just_beyond_its_travel(
    robot: Robot,
) -> None:
    robot.run(40, "armed")
    robot.mode, robot.target = JointMode.TORQUE, -0.05
    robot.run(8, "armed")
    assert robot.joints is not None
    assert robot.joints.torque_nm == pytest.approx([-0.05] * JOINTS, abs=0.004)
    servo, emulator = drives_of(robot.backend).servos[0], robot.emulator.servos[0]
    goal_rad = emulator.read_register("i", at.GOAL_POSITION) * at.RAD + servo.turns * 2 * math.pi
    assert servo.lower_rad - 0.5 < goal_rad < servo.lower_rad


def test_servo_angle_after_start_in_any_turn_is_joint_angle(robot: Robot) -> None:
    robot.run(1, "disarmed")
    assert robot.joints is not None
    here = robot.joints.angle_rad
    for zero_rad in (math.pi, -0.02, 6.0):
        elsewhere = Robot(robot__drive={"zero_rad": zero_rad})
        elsewhere.run(40, "armed")
        said = elsewhere.joints
        elsewhere.backend.close()
        assert said is not None
        assert said.angle_rad == pytest.approx([0.1] * JOINTS, abs=0.02)
    assert here == pytest.approx([0.0] * JOINTS, abs=0.002)


def test_servo_id_model_and_setting_mismatches_are_named_at_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = EmulatedDynamixel.__init__

    def otherwise(emulator: EmulatedDynamixel, *rest: Any) -> None:
        made(emulator, *rest)
        first, second, third, fourth = emulator.servos
        first.table[7] = 9
        second.write_register("H", at.MODEL, 1060)
        third.write_register("i", at.HOMING_OFFSET, -100)
        fourth.write_register("H", at.CURRENT_LIMIT, 10)

    monkeypatch.setattr(EmulatedDynamixel, "__init__", otherwise)
    with pytest.raises(BackendError) as raised:
        Robot()
    words = str(raised.value)
    for expected in (
        "joint_1 (id 1 on /dev/pts/",
        "does not answer: it is off, or has another id or baud rate",
        "is of another model: XL430-W250 neither measures nor limits current",
        "has drive mode 0 and homing offset -100; both must be 0",
        "has a current limit of 0.03 A",
        "id 9 on /dev/pts/",
        "is no joint's: XM540-W270",
    ):
        assert expected in words, words


@pytest.mark.parametrize(
    ("register", "value"),
    [
        (at.SECONDARY_ID, 1),
        (at.STARTUP, 3),
    ],
)
def test_servo_with_settings_that_would_move_it_is_refused(
    robot: Robot, register: int, value: int
) -> None:
    robot.emulator.servos[2].table[register] = value
    with raises_error(BackendError, code="drive/not-complete", field="joint_3"):
        drives_of(robot.backend).bring_up()


def test_a_servo_outside_of_its_travel_is_refused() -> None:
    elsewhere = DynamixelSettings(
        physics_model="inertia", mounted={"joint_1": MountedDrive(zero_rad=2.5)}
    )
    with raises_error(BackendError, code="drive/unsupported-setting", field="joint_1"):
        Robot(elsewhere)


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
def test_what_servos_cannot_do_is_refused_before_the_start(dotted: dict[str, Any]) -> None:
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


SAME_DELAY, OTHER_DELAY = 250, 0  # of an answer, us / 2: a servo as delivered has 250


@pytest.mark.parametrize(
    "delay",
    [
        OTHER_DELAY,
        SAME_DELAY,
    ],
    ids=["one after the other", "at the same time"],
)
def test_two_servos_of_one_id_are_refused_at_the_start(robot: Robot, delay: int) -> None:
    """They have no serial numbers. With one return delay their answers collide, with two they follow each other."""
    robot.go_wrong("duplicate:joint_2@0-9")
    robot.emulator.servos[1].table[at.DELAY] = delay
    with raises_error(BackendError, code="drive/not-complete", field="joint_2"):
        drives_of(robot.backend).bring_up()
    robot.go_wrong("duplicate:joint_2@0-9", begins=False)
    drives_of(robot.backend).bring_up()


@pytest.mark.parametrize(
    ("delay", "what", "words"),
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
    robot: Robot, delay: int, what: str, words: str
) -> None:
    robot.run(20, "armed")
    robot.emulator.servos[1].table[at.DELAY] = delay
    robot.go_wrong("duplicate:joint_2@0-9")
    fault = robot.run(NOTICED, "armed")[0]
    assert (fault.what, fault.joint) == (what, "joint_2") and re.search(words, fault.cause), fault
    assert fault.scope == ("robot" if what == "duplicate_node" else "joint")


@pytest.mark.parametrize("model", ["XM430-W350", "XL330-M288"])
def test_emulated_servos_are_of_the_model_that_the_settings_name(model: str) -> None:
    robot = Robot(DynamixelSettings(physics_model="inertia", bring_up_limit_s=0.5, model=model))
    robot.run(40, "armed")
    assert robot.joints is not None and robot.joints.angle_rad == pytest.approx(
        [0.1] * JOINTS, abs=0.02
    )
    robot.backend.close()


def test_an_emulated_model_that_the_driver_cannot_use_is_refused_by_its_name() -> None:
    settings = DynamixelSettings(physics_model="inertia", bring_up_limit_s=0.5, model="XL430-W250")
    with pytest.raises(BackendError, match="XL430-W250 neither measures nor limits current"):
        Robot(settings)
