"""A robot of two driver types has two buses, which are served one after the other or each in its own thread.

All drives are emulated.
"""

import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from snakesim_can_backend.odrive.protocol import AxisState
from snakesim_drivers.kit.mixed import MixedBackend, MixedSettings
from snakesim_hal.base.errors import BackendError, ConfigError
from snakesim_hal.wire.messages import ClockMode, Fault, JointMode
from snakesim_testing.benches.emulated_drives import DrivesOfAnyType
from snakesim_testing.drivers.drive_rig import DriveRig, bus_of, drives_of
from snakesim_testing.hal.small_robots import make_run_config
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.messages import raises_error

AXES = [0, 1]  # indices of the joints with ODrive axes
SERVOS = [2, 3]  # indices of the joints with Dynamixel servos
BODY_DRIVE = {"driver": "odrive"}
HEAD_JOINTS = {"joint_3": {"driver": "dynamixel"}, "joint_4": {"driver": "dynamixel"}}
SHORT_WATCHDOG_S = 0.2


class MixedRobot(DriveRig):
    """Two drives of one driver type, by default ODrive axes, and two servos at the head."""

    def __init__(
        self, clock_mode: ClockMode = "lockstep", body: str = "odrive", **driver_types: Any
    ) -> None:
        backends = {
            name: {"bring_up_limit_s": 2.0} | driver_types.get(name, {})
            for name in (body, "dynamixel")
        }
        config = make_run_config(
            backend="mixed",
            robot__chain__modules=4,
            robot__drive=BODY_DRIVE | {"driver": body},
            robot__joints=HEAD_JOINTS,
            rate_hz=100,
            clock_mode=clock_mode,
            backends=backends,
        )
        super().__init__(config, MixedBackend(config, MixedSettings(physics_model="inertia")))
        self.axes = drives_of(self.backend, 0)
        self.servos = drives_of(self.backend, 1)
        self._observed_drives = DrivesOfAnyType(self.backend)

    def get_ages_ms(self, joints: list[int]) -> list[float]:
        """Return the ages of the published joint states."""
        assert self.joints is not None
        return [self.joints.age_ns[i] * 1e-6 for i in joints]

    def get_angles_rad(self, joints: list[int]) -> list[float]:
        """Return the published joint angles."""
        assert self.joints is not None
        return [self.joints.angle_rad[i] for i in joints]

    def get_axis_enable_states(self) -> set[bool]:
        """Return whether axes are enabled: a set of one value if all have the same state."""
        return {axis.state == AxisState.CLOSED_LOOP for axis in self.axes._emulator.axes}

    def get_servo_enable_states(self) -> set[bool]:
        """Return whether servos are enabled: a set of one value if all have the same state."""
        return {servo.is_torque_on for servo in self.servos._emulator.servos}

    def disable_watchdogs(self) -> None:
        """Let no watchdog expire on a busy computer: whatever stops a drive afterwards is the driver."""
        for axis in self.axes._emulator.axes:
            axis.watchdog_us = math.inf
        self.servos._watchdog_register = bytes([0])  # of servos that are enabled from now on: off

    def has_axis_errors(self) -> bool:
        """Return whether an axis reports an error, such as an expired watchdog."""
        return any(axis.errors for axis in self.axes._emulator.axes)

    def assert_all_drives(self, *, enabled: bool) -> None:
        """Check that all drives are enabled, or that all are disabled."""
        assert self.get_axis_enable_states() == {enabled}
        assert self.get_servo_enable_states() == {enabled}

    def has_all_drives(self, *, enabled: bool) -> bool:
        """Return whether all drives are enabled, or all are disabled."""
        return self.get_axis_enable_states() == self.get_servo_enable_states() == {enabled}

    def list_enabled(self) -> list[bool]:
        """Return the true state of every drive: whether it is enabled."""
        return self._observed_drives.list_enabled()

    def arm(self) -> None:
        """Arm until every drive is enabled and the driver resets no more faults, which a busy computer causes."""

        def is_armed() -> bool:
            if self.run(1, "armed"):
                self.run(1, "disarmed")
                time.sleep(0.05)
                return False
            return all(self.list_enabled()) and self.backend._remaining_grace_cycles <= 0

        wait_until(is_armed, "the robot is armed", 20.0)

    def run_until_enabled(self, is_enabled: Callable[[], bool]) -> None:
        """Run armed ticks until the drives are enabled."""

        def run_and_check() -> bool:
            self.run(1, "armed")
            return is_enabled()

        wait_until(run_and_check, "the drives are enabled")

    def arm_and_freeze_driver(self, seconds: float) -> None:
        """Arm, and then stop the driver's threads for this time, while the time of its drives passes.

        The drives are enabled when the threads stop. On a busy computer, the lease may expire before, so that the
        driver disables them; then this arms again.
        """

        def is_frozen_while_enabled() -> bool:
            self.arm()
            with self._observed_drives.hold_driver():
                if not all(self.list_enabled()):
                    return False
                self._observed_drives.pass_time(seconds, time.sleep)
            return True

        wait_until(is_frozen_while_enabled, "the driver is frozen while its drives are enabled")


OpenRobot = Callable[..., MixedRobot]


@pytest.fixture
def open_robot() -> Iterator[OpenRobot]:
    """Provide a function that opens robots; close them after the test."""
    robots: list[MixedRobot] = []

    def open_mixed_robot(*arguments: Any, **driver_types: Any) -> MixedRobot:
        robots.append(MixedRobot(*arguments, **driver_types))
        return robots[-1]

    yield open_mixed_robot
    for robot in robots:
        robot.backend.close()


def test_mixed_driver_types_move_as_one_robot(open_robot: OpenRobot) -> None:
    robot = open_robot()
    description = robot.backend.describe()
    assert [joint.serial[:4] for joint in description.joints] == ["3855", "3855", "", ""]
    assert description.emulated
    # The description has the modes of the robot file; only a run removes those that a drive does not have.
    for joint in description.joints:
        assert joint.supports_mode(JointMode.VELOCITY)
    assert robot.run(30, "disarmed") == []
    assert robot.run(40, "armed") == []
    assert robot.get_angles_rad([*AXES, *SERVOS]) == pytest.approx([0.1] * 4, abs=0.02)
    robot.assert_all_drives(enabled=True)
    robot.run(5, "estop")
    robot.assert_all_drives(enabled=False)


def test_bus_failed_reading_keeps_last_value_and_other_buses(open_robot: OpenRobot) -> None:
    robot = open_robot()
    robot.run(20, "armed")
    last_angles_rad = robot.get_angles_rad(SERVOS)
    robot.go_wrong("cut:bus_2@0-9")
    robot.target = -0.1
    faults = robot.run(4, "armed")
    assert robot.get_angles_rad(SERVOS) == last_angles_rad
    assert robot.get_ages_ms(SERVOS) == [40.0, 40.0]
    assert robot.get_ages_ms(AXES) == [0.0, 0.0]
    assert [fault.what for fault in faults] == ["interface_down", "drive_silent", "drive_silent"]
    assert [fault.joint for fault in faults[1:]] == ["joint_3", "joint_4"]
    assert robot.joints is not None
    assert robot.joints.valid == [True] * 4
    robot.run(4, "fault")
    assert robot.joints.valid == [True, True, False, False]
    assert robot.get_angles_rad(SERVOS) == last_angles_rad


def test_bus_drive_fault_is_injected_and_reported_by_joint_number(open_robot: OpenRobot) -> None:
    robot = open_robot()
    robot.run(20, "armed")
    robot.go_wrong("overheat:joint_4@0-9")
    (fault,) = robot.run(20, "armed")
    assert fault.what == "drive_fault"
    assert fault.joint == "joint_4"
    with raises_error(ConfigError, code="injection/unknown-target", field="bus_3"):
        robot.go_wrong("cut:bus_3@0")


def test_bus_at_half_rate_is_polled_every_second_tick(open_robot: OpenRobot) -> None:
    robot = open_robot(dynamixel={"decimation": 2})
    max_age_s = robot.backend.describe().sensors[0].delay_s
    assert max_age_s == 0.01
    ages_ms: list[list[float]] = []
    for _ in range(6):
        assert robot.run(1, "armed") == []
        ages_ms.append([*robot.get_ages_ms([0]), *robot.get_ages_ms([2])])
    assert ages_ms == [[0.0, 0.0], [0.0, 10.0]] * 3
    assert robot.run(1, "armed") == []
    # The servos are disabled also in a tick in which their bus is not polled.
    assert robot.run(1, "disarmed") == []
    robot.assert_all_drives(enabled=False)


class BlockableReads:
    """Blocks the bus of some drives in its next read until it may continue."""

    def __init__(self, drives: Any) -> None:
        self.is_blocked = threading.Event()
        self.may_continue = threading.Event()
        self.may_continue.set()
        read = drives.read

        def wait_and_read() -> None:
            if not self.may_continue.is_set():
                self.is_blocked.set()
                self.may_continue.wait()
            read()

        drives.read = wait_and_read


def test_bus_that_blocks_ages_alone_while_others_stop(open_robot: OpenRobot) -> None:
    robot = open_robot("realtime")
    robot.disable_watchdogs()
    reads = BlockableReads(robot.servos)
    for _ in range(10):
        robot.run(1, "armed")
        time.sleep(0.005)
    reads.may_continue.clear()
    robot.run(2, "armed")
    assert reads.is_blocked.wait(10.0)
    robot.run(1, "armed")  # publishes the last values that were read
    last_angles_rad = robot.get_angles_rad(SERVOS)
    ages_ms = [max(robot.get_ages_ms(SERVOS))]
    for _ in range(15):
        robot.run(1, "armed")
        ages_ms.append(min(robot.get_ages_ms(SERVOS)))
        time.sleep(0.01)
    assert ages_ms == sorted(ages_ms), "the age of the servos' state does not grow with each tick"
    assert ages_ms[-1] >= 140
    assert max(robot.get_ages_ms(AXES)) < ages_ms[-1], "the other bus is not read"
    assert robot.get_angles_rad(SERVOS) == last_angles_rad
    assert robot.joints is not None
    assert robot.joints.valid[2:] == [False, False]
    robot.run(1, "disarmed")
    wait_until(lambda: robot.get_axis_enable_states() == {False}, "the axes are disabled", 10.0)
    # The driver cannot reach the servos, and this test has disabled the watchdogs that would stop them.
    assert robot.get_servo_enable_states() == {True}
    reads.may_continue.set()
    wait_until(lambda: robot.get_servo_enable_states() == {False}, "the servos are disabled", 10.0)
    wait_until(
        lambda: robot.run(1, "disarmed") == [] and max(robot.get_ages_ms(SERVOS)) < ages_ms[-1],
        "a newer state of the servos",
        10.0,
    )


# On a busy computer, the thread of the slow bus may pause so long that its drives are reported as silent.
@pytest.mark.quiet
def test_bus_with_slow_readings_does_not_delay_ticks(open_robot: OpenRobot) -> None:
    robot = open_robot("realtime")
    read = robot.servos.read
    read_count = 0

    def count_and_read() -> None:
        nonlocal read_count
        read_count += 1
        read()

    robot.servos.read = count_and_read
    robot.go_wrong("slow:bus_2@0=0.02")
    first_tick = robot.tick
    while read_count <= 5:
        assert robot.run(1, "disarmed") == []
        assert robot.tick < 100_000
    # If ticks waited for the bus, there would be one tick for each read.
    assert robot.tick - first_tick > 3 * read_count
    robot.go_wrong("slow:bus_2@0=0.02", begins=False)
    assert read_count > 5
    assert max(robot.get_ages_ms(SERVOS)) > 0


def open_robot_and_stop_sending_setpoints(open_robot: OpenRobot) -> MixedRobot:
    """Open a robot, enable its drives, and send no setpoints until its two buses have disabled them.

    A bus does so after one lease. The drives have no watchdogs that could do it instead.
    """
    robot = open_robot(clock_mode="realtime")  # each bus has its own thread
    robot.disable_watchdogs()
    robot.run_until_enabled(lambda: robot.has_all_drives(enabled=True))
    wait_until(lambda: robot.has_all_drives(enabled=False), "all drives are disabled", 10.0)
    return robot


def run_until_each_bus_has_a_fault(robot: MixedRobot) -> list[Fault]:
    """Send setpoints in one armed tick, run until the two buses have reported faults, and return the faults."""
    faults = robot.run(ticks=1, lifecycle="armed")

    def are_both_buses_reported() -> bool:
        faults.extend(robot.run(ticks=1, lifecycle="fault"))
        return len(faults) >= 2

    wait_until(are_both_buses_reported, "a fault of each bus", 10.0)
    return faults


def test_bus_without_setpoints_disables_drives_without_watchdogs(
    open_robot: OpenRobot,
) -> None:
    robot = open_robot_and_stop_sending_setpoints(open_robot)
    robot.assert_all_drives(enabled=False)
    assert not robot.has_axis_errors()


def test_bus_without_setpoints_reports_the_expired_lease(open_robot: OpenRobot) -> None:
    robot = open_robot_and_stop_sending_setpoints(open_robot)
    faults = run_until_each_bus_has_a_fault(robot)
    assert {fault.what for fault in faults} == {"no_setpoints"}
    assert "one lease" in faults[0].cause


def test_bus_after_expired_lease_ignores_setpoints_of_armed_tick(open_robot: OpenRobot) -> None:
    """The drives stay off until the operator resets the fault."""
    robot = open_robot_and_stop_sending_setpoints(open_robot)
    run_until_each_bus_has_a_fault(robot)
    robot.assert_all_drives(enabled=False)


# In real time, with watchdogs of 0.2 s. The contract has a clause for it in lockstep.
@pytest.mark.quiet
@pytest.mark.parametrize("body", ["odrive", "moteus"])
def test_drives_that_stop_while_driver_is_frozen_stay_off(open_robot: OpenRobot, body: str) -> None:
    """The bus reads its drives before it disables them, because disabling clears the fault of a watchdog."""
    robot = open_robot(
        "realtime",
        body,
        **{body: {"watchdog_s": SHORT_WATCHDOG_S}, "dynamixel": {"watchdog_s": SHORT_WATCHDOG_S}},
    )
    robot.arm_and_freeze_driver(3 * SHORT_WATCHDOG_S)
    assert robot.list_enabled() == [False] * 4
    robot.damps = True
    joints_with_fault: set[str | None] = set()

    def has_every_joint_a_fault() -> bool:
        faults = robot.run(1, "fault")
        assert robot.list_enabled() == [False] * 4
        joints_with_fault.update(
            fault.joint
            for fault in faults
            if fault.what == "drive_fault" and "watchdog" in fault.cause
        )
        return joints_with_fault == {f"joint_{i + 1}" for i in range(4)}

    wait_until(has_every_joint_a_fault, "a fault of every drive", 10.0)

    def has_no_driven_joint() -> bool:
        robot.run(1, "disarmed")
        return not robot.backend._driven_joints

    wait_until(has_no_driven_joint, "the driver drives no joint", 10.0)
    robot.arm()


def run_until_bus_fails(robot: MixedRobot) -> None:
    """Run armed ticks until the host gets an error of a bus: in a receive or a send, whichever comes first."""
    with pytest.raises(BackendError) as caught:
        wait_until(lambda: robot.run(1, "armed") and False, "the error of the bus", 10.0)
    assert caught.value.code == "bus/io-failed"


def test_bus_thread_error_ends_run_and_disables_all_drives(open_robot: OpenRobot) -> None:
    robot = open_robot("realtime")
    robot.disable_watchdogs()
    robot.run_until_enabled(lambda: robot.get_servo_enable_states() == {True})
    robot.axes.wire._bus.shutdown()
    run_until_bus_fails(robot)
    with pytest.raises(BackendError):
        robot.run(1, "armed")
    robot.backend.close()
    assert robot.get_servo_enable_states() == {False}


def test_bus_error_that_host_has_got_is_not_raised_again_by_close(open_robot: OpenRobot) -> None:
    """Also if the bus fails again between the request to close and its last cycle."""
    robot = open_robot("realtime")
    robot.disable_watchdogs()
    reads = BlockableReads(robot.axes)
    robot.axes.wire._bus.shutdown()
    run_until_bus_fails(robot)
    bus_of_axes = bus_of(robot.backend, 0)
    reads.may_continue.clear()

    def is_reading() -> bool:
        bus_of_axes.request_reading()  # again: an earlier reading may still be in progress
        return reads.is_blocked.is_set()

    wait_until(is_reading, "the bus reads its drives", 10.0)
    bus_of_axes.request_close()
    reads.may_continue.set()  # this reading fails like those before
    robot.backend.close()


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
def test_mixed_robot_errors_name_joint_type_and_section(changes: dict[str, Any]) -> None:
    valid: dict[str, Any] = {
        "backend": "mixed",
        "robot__chain__modules": 4,
        "rate_hz": 100,
        "robot__drive": BODY_DRIVE,
        "robot__joints": HEAD_JOINTS,
    }
    config = make_run_config(**{**valid, **changes})
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


def test_section_of_driver_type_may_only_repeat_values_of_whole_robot() -> None:
    suspended = {"suspended": True}
    standing = {"suspended": False}
    robot: dict[str, Any] = {
        "backend": "mixed",
        "robot__chain__modules": 4,
        "rate_hz": 100,
        "robot__drive": BODY_DRIVE,
        "robot__joints": HEAD_JOINTS,
    }

    def check(whole_robot: dict[str, bool]) -> None:
        backends = {
            "mixed": {"physics_model_settings": whole_robot},
            "odrive": {"physics_model_settings": suspended},
        }
        settings = MixedSettings(physics_model_settings=whole_robot)
        MixedBackend.check(make_run_config(**robot, backends=backends), settings)

    check(suspended)
    with raises_error(ConfigError, code="config/conflict"):
        check(standing)


def test_mixed_robot_may_use_an_id_once_per_driver_type() -> None:
    config = make_run_config(
        robot__drive=BODY_DRIVE, robot__joints={"joint_3": {"driver": "dynamixel", "id": 1}}
    )
    assert [joint.id for joint in config.robot.joint_table][:3] == [1, 2, 1]
