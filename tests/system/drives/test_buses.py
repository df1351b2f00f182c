"""A robot of two driver types on two buses: in turn, and each bus in a thread of its own. Drives are emulated."""

import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from snakesim_can_backend.odrive.protocol import AxisState
from snakesim_drivers.kit.mixed import MixedBackend, MixedSettings
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.wire.messages import ClockMode, JointMode
from snakesim_testing.benches.emulated_drives import DrivesOfAnyType
from snakesim_testing.drivers.drive_rig import DriveRig, drives_of
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

AXES, SERVOS = [0, 1], [2, 3]  # joints
HEAD = (
    {"driver": "odrive"},
    {"joint_3": {"driver": "dynamixel"}, "joint_4": {"driver": "dynamixel"}},
)
LONG_S = 1.0  # a watchdog that a busy computer does not reach
SHORT_S = 0.2


class Robot(DriveRig):
    """Drives of one driver type, by default ODrive axes, and two servos at the head."""

    def __init__(
        self, clock_mode: ClockMode = "lockstep", body: str = "odrive", **driver_types: Any
    ) -> None:
        fixed = {
            name: {"bring_up_limit_s": 2.0} | driver_types.get(name, {})
            for name in (body, "dynamixel")
        }
        config = make_run_config(
            backend="mixed",
            robot__chain__modules=4,
            robot__drive=HEAD[0] | {"driver": body},
            robot__joints=HEAD[1],
            rate_hz=100,
            clock_mode=clock_mode,
            backends=fixed,
        )
        super().__init__(config, MixedBackend(config, MixedSettings(physics_model="inertia")))
        self.axes, self.servos = drives_of(self.backend, 0), drives_of(self.backend, 1)

    def ages_ms(self, joints: list[int]) -> list[float]:
        assert self.joints is not None
        return [self.joints.age_ns[i] * 1e-6 for i in joints]

    def angles(self, joints: list[int]) -> list[float]:
        assert self.joints is not None
        return [self.joints.angle_rad[i] for i in joints]

    def axes_follow(self) -> set[bool]:
        return {axis.state == AxisState.CLOSED_LOOP for axis in self.axes._emulator.axes}

    def servos_follow(self) -> set[bool]:
        return {servo.is_torque_on for servo in self.servos._emulator.servos}

    def enabled(self) -> list[bool]:
        """Of every drive, in truth."""
        return DrivesOfAnyType(self.backend).list_enabled()

    def arm(self) -> None:
        """Until every drive is on, and the driver has no clear left to carry out: a busy computer makes faults."""

        def is_armed() -> bool:
            if self.run(1, "armed"):
                self.run(1, "disarmed")
                time.sleep(0.05)
                return False
            return all(self.enabled()) and self.backend._remaining_grace_cycles <= 0

        wait_until(is_armed, "arms", 20.0)

    def freeze_driver(self, seconds: float) -> None:
        """The driver's threads can do nothing for so long; its drives' time passes."""
        DrivesOfAnyType(self.backend).freeze_driver(seconds, time.sleep)


Opens = Callable[..., Robot]


@pytest.fixture
def opened() -> Iterator[Opens]:
    """Opens robots, and closes them in the end."""
    robots: list[Robot] = []

    def open_one(*given: Any, **driver_types: Any) -> Robot:
        robots.append(Robot(*given, **driver_types))
        return robots[-1]

    yield open_one
    for robot in robots:
        robot.backend.close()


def test_mixed_drive_families_move_as_one_robot(opened: Opens) -> None:
    robot = opened()
    described = robot.backend.describe()
    assert [joint.serial[:4] for joint in described.joints] == ["3855", "3855", "", ""]
    assert described.emulated
    assert [joint.supports_mode(JointMode.VELOCITY) for joint in described.joints] == [True] * 4, (
        "as its file says; a run narrows it"
    )
    assert robot.run(30, "disarmed") == []
    assert robot.run(40, "armed") == []
    assert robot.angles([*AXES, *SERVOS]) == pytest.approx([0.1] * 4, abs=0.02)
    assert robot.axes_follow() == robot.servos_follow() == {True}
    robot.run(5, "estop")
    assert robot.axes_follow() == robot.servos_follow() == {False}


def test_bus_failed_reading_keeps_last_value_and_other_buses(opened: Opens) -> None:
    robot = opened()
    robot.run(20, "armed")
    before = robot.angles(SERVOS)
    robot.go_wrong("cut:bus_2@0-9")
    robot.target = -0.1
    found = robot.run(4, "armed")
    assert robot.angles(SERVOS) == before
    assert robot.ages_ms(SERVOS) == [40.0, 40.0]
    assert robot.ages_ms(AXES) == [0.0, 0.0]
    assert [fault.what for fault in found] == ["interface_down", "drive_silent", "drive_silent"]
    assert [fault.joint for fault in found[1:]] == ["joint_3", "joint_4"], "named as in the robot"
    assert robot.joints is not None
    assert robot.joints.valid == [True] * 4
    robot.run(4, "fault")
    assert robot.joints.valid == [True, True, False, False]
    assert robot.angles(SERVOS) == before


def test_bus_drive_fault_is_injected_and_reported_by_joint_number(opened: Opens) -> None:
    robot = opened()
    robot.run(20, "armed")
    robot.go_wrong("overheat:joint_4@0-9")
    assert [(fault.what, fault.joint) for fault in robot.run(20, "armed")] == [
        ("drive_fault", "joint_4")
    ]
    with raises_error(ConfigError, code="injection/unknown-target", field="bus_3"):
        robot.go_wrong("cut:bus_3@0")


def test_bus_at_half_rate_is_polled_every_second_tick(opened: Opens) -> None:
    robot = opened(dynamixel={"decimation": 2})
    assert robot.backend.describe().sensors[0].delay_s == 0.01, (
        "so old may a joint state be by itself"
    )
    ages: list[list[float]] = []
    for _ in range(6):
        assert robot.run(1, "armed") == []
        ages.append([*robot.ages_ms([0]), *robot.ages_ms([2])])
    assert ages == [[0.0, 0.0], [0.0, 10.0]] * 3
    assert robot.run(1, "armed") == []
    assert robot.run(1, "disarmed") == []
    assert robot.axes_follow() == robot.servos_follow() == {False}, (
        "in a tick in which the servos' turn is not"
    )


class Held:
    """A reading of servos blocks while `go` is not set."""

    def __init__(self, robot: Robot) -> None:
        self.there, self.go = threading.Event(), threading.Event()
        self.go.set()
        read = robot.servos.read

        def wait_and_read() -> None:
            if not self.go.is_set():
                self.there.set()
                self.go.wait()
            read()

        robot.servos.read = wait_and_read


def test_bus_that_blocks_ages_alone_while_others_stop(opened: Opens) -> None:
    robot = opened("realtime", odrive={"watchdog_s": LONG_S}, dynamixel={"watchdog_s": LONG_S})
    held = Held(robot)
    for _ in range(10):
        robot.run(1, "armed")
        time.sleep(0.005)
    held.go.clear()
    robot.run(2, "armed")
    assert held.there.wait(10.0)
    robot.run(1, "armed")  # takes what was read before
    before, ages = robot.angles(SERVOS), [max(robot.ages_ms(SERVOS))]
    for _ in range(15):
        robot.run(1, "armed")
        ages.append(min(robot.ages_ms(SERVOS)))
        time.sleep(0.01)
    assert ages == sorted(ages) and ages[-1] >= 140, "its age grows with each tick"
    assert max(robot.ages_ms(AXES)) < ages[-1], "the other bus is read"
    assert robot.angles(SERVOS) == before
    assert robot.joints is not None
    assert robot.joints.valid[2:] == [False, False]
    robot.run(1, "disarmed")
    wait_until(lambda: robot.axes_follow() == {False}, "axes that are let go", 10.0)
    assert robot.servos_follow() == {True}, "nobody can reach them: their own watchdog stops them"
    held.go.set()
    wait_until(lambda: robot.servos_follow() == {False}, "servos that are let go", 10.0)
    wait_until(
        lambda: robot.run(1, "disarmed") == [] and max(robot.ages_ms(SERVOS)) < ages[-1],
        "news",
        10.0,
    )


def test_bus_with_slow_readings_does_not_delay_ticks(opened: Opens) -> None:
    robot = opened("realtime")
    read, readings = robot.servos.read, [0]

    def counted() -> None:
        readings[0] += 1
        read()

    robot.servos.read = counted
    robot.go_wrong("slow:bus_2@0=0.02")
    began = robot.tick
    while readings[0] <= 5:
        assert robot.run(1, "disarmed") == []
        assert robot.tick < 100_000
    assert robot.tick - began > 3 * readings[0], (
        "if ticks waited for it, they would be as many as its readings"
    )
    robot.go_wrong("slow:bus_2@0=0.02", begins=False)
    assert readings[0] > 5
    assert max(robot.ages_ms(SERVOS)) > 0


def test_bus_without_fresh_setpoints_disables_drives_within_the_lease(opened: Opens) -> None:
    robot = opened("realtime", odrive={"watchdog_s": LONG_S}, dynamixel={"watchdog_s": LONG_S})
    wait_until(
        lambda: (
            (robot.run(1, "armed") and False)
            or robot.axes_follow() == robot.servos_follow() == {True}
        ),
        "arms",
    )
    wait_until(lambda: robot.axes_follow() == robot.servos_follow() == {False}, "both", 10.0)
    assert not any(axis.errors for axis in robot.axes._emulator.axes), "not by their watchdogs"
    found = robot.run(1, "armed")

    def both_are_reported() -> bool:
        found.extend(robot.run(1, "fault"))
        return len(found) >= 2

    wait_until(both_are_reported, "a fault of each bus", 10.0)
    assert {fault.what for fault in found} == {"no_setpoints"}
    assert "one lease" in found[0].cause
    assert robot.axes_follow() == robot.servos_follow() == {False}, (
        "setpoints of an armed robot enabled them again"
    )


@pytest.mark.parametrize("body", ["odrive", "moteus"])
def test_drives_that_stop_while_driver_is_frozen_stay_off(opened: Opens, body: str) -> None:
    """Without a look at them the bus would let its drives go, which clears what their watchdogs have latched."""
    robot = opened(
        "realtime", body, **{body: {"watchdog_s": SHORT_S}, "dynamixel": {"watchdog_s": SHORT_S}}
    )
    robot.arm()
    robot.freeze_driver(3 * SHORT_S)
    assert robot.enabled() == [False] * 4
    robot.damps, named = True, set[str | None]()

    def all_are_named() -> bool:
        found = robot.run(1, "fault")
        assert robot.enabled() == [False] * 4
        named.update(
            fault.joint
            for fault in found
            if fault.what == "drive_fault" and "watchdog" in fault.cause
        )
        return named == {f"joint_{i + 1}" for i in range(4)}

    wait_until(all_are_named, "a fault of every drive", 10.0)
    wait_until(
        lambda: (robot.run(1, "disarmed") and False) or not robot.backend._driven_joints,
        "cleared",
        10.0,
    )
    robot.arm()


def test_bus_thread_error_ends_run_and_disables_all_drives(opened: Opens) -> None:
    robot = opened("realtime", odrive={"watchdog_s": LONG_S}, dynamixel={"watchdog_s": LONG_S})
    wait_until(lambda: (robot.run(1, "armed") and False) or robot.servos_follow() == {True}, "arms")
    robot.axes.wire._bus.shutdown()
    with raises_error(BackendError, code="bus/io-failed"):
        wait_until(lambda: robot.run(1, "armed") and False, "the error", 10.0)
    with pytest.raises(BackendError):
        robot.run(1, "armed")
    robot.backend.close()
    assert robot.servos_follow() == {False}


@pytest.mark.parametrize(
    "changes",
    [
        {"robot__drive": {}},
        {"robot__joints": {"joint_2": {"driver": "odriv"}}},
        {"robot__joints": {"joint_2": {"driver": "sim"}}},
        {"robot__joints": {"joint_2": {"driver": "can"}}},
        {"backends": {"odrive": {"mounted": {}}}},
        {"backends": {"dynamixel": {"baud": 7}}},
        {"backends": {"dynamixel": {"ports": ["/dev/pts/0"]}}},
        {"backends": {"dynamixel": {"decimation": 4}}},
        {"backends": {"odrive": {"decimation": 3, "watchdog_s": 0.05}}},
        {"robot__joints": {"joint_3": {"driver": "dynamixel", "id": 253}}},
    ],
)
def test_mixed_robot_errors_name_joint_family_and_section(changes: dict[str, Any]) -> None:
    fixed: dict[str, Any] = {"robot__drive": HEAD[0], "robot__joints": HEAD[1]}
    config = make_run_config(
        **{"backend": "mixed", "robot__chain__modules": 4, "rate_hz": 100, **fixed, **changes}
    )
    with raises_error(
        ConfigError,
        code=(
            "bus/not-virtual",
            "config/conflict",
            "config/invalid-value",
            "drive/unknown-type",
            "drive/unsupported-setting",
            "drive/watchdog-too-short",
        ),
    ):
        MixedBackend.check(config, MixedSettings())


def test_ids_are_those_of_a_family_on_a_port() -> None:
    config = make_run_config(
        robot__drive=HEAD[0], robot__joints={"joint_3": {"driver": "dynamixel", "id": 1}}
    )
    assert [joint.id for joint in config.robot.joint_table][:3] == [1, 2, 1]
