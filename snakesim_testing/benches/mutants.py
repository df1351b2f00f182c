"""Backends that break the contract, each in one way, with the contract tests that must fail on them.

As a pytest plugin (`-p snakesim_testing.benches.mutants`), this module runs each mutant against these tests only.
"""

import dataclasses
import random
import time
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import numpy as np
import pytest
from msgspec.structs import replace

from snakesim_hal.backend import SafeSetpoints, Samples
from snakesim_hal.base.errors import BackendError
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Fault,
    JointMode,
    JointState,
    RangeScan,
    RobotDescription,
    SensorDescription,
)
from snakesim_testing.benches.driver_mutants import DRIVER_MUTANTS
from snakesim_testing.benches.mutant import Mutant, make_test_names
from snakesim_testing.benches.workbench import DrivesWorkbench, Workbench, WorkbenchDrives, mute
from snakesim_testing.contract.bench import Bench
from snakesim_testing.hal.small_robots import make_pose

MUTANTS: list[Mutant] = [*DRIVER_MUTANTS]
TORQUE_LIMIT_NM = 4.0  # of every joint of the test robot
REVOLUTIONS_PER_RAD = 0.16


class FaultyWorkbench(Workbench):
    """A correct backend with one error, in its description, its measurements or its setpoints.

    A mutant replaces one of the methods `change_description`, `change_joint_state` and `change_setpoints`.
    """

    def __init__(self, config: Any, settings: Any) -> None:
        super().__init__(config, settings)
        self.description = self.change_description(self.description)

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        return Samples(self.change_joint_state(super().sample(tick, timestamp_ns).joints))

    def enact(self, setpoints: SafeSetpoints, lifecycle: Any) -> None:
        super().enact(self.change_setpoints(setpoints), lifecycle)

    def change_description(self, robot: RobotDescription) -> RobotDescription:
        """Return the description that the backend reports."""
        return robot

    def change_joint_state(self, joints: JointState) -> JointState:
        """Return the joint state that the backend reports."""
        return joints

    def change_setpoints(self, setpoints: SafeSetpoints) -> SafeSetpoints:
        """Return the setpoints that the joints follow."""
        return setpoints


def register_mutant(*clauses: str, replaced_method: str = "") -> Callable[[Any], Any]:
    """Return a decorator that registers a broken backend with the contract tests that must fail on it.

    Args:
        clauses: Names of the contract tests that must fail, without `test_`.
        replaced_method: Name of a method of `FaultyWorkbench`. The decorated object is then not a backend, but the
            function that replaces this method. If empty, the decorated object is the backend itself.
    """

    def register(broken: Any) -> Any:
        backend = broken
        if replaced_method:
            methods = {replaced_method: staticmethod(broken)}
            backend = type(broken.__name__, (FaultyWorkbench,), methods)
        MUTANTS.append(
            Mutant(
                name=backend.__name__,
                backend=backend,
                breaks=make_test_names(clauses),
                mute_joint=mute,
                make_emulated_drives=WorkbenchDrives,
            )
        )
        return broken

    return register


breaks_description = partial(register_mutant, replaced_method="change_description")
breaks_joint_state = partial(register_mutant, replaced_method="change_joint_state")
breaks_setpoints = partial(register_mutant, replaced_method="change_setpoints")


# --- the description -------------------------------------------------------------------------------------------


def add_sensor(robot: RobotDescription, key: str, rate_hz: float = 50.0) -> RobotDescription:
    """Return a description with one more sensor."""
    return replace(
        robot, sensors=[*robot.sensors, SensorDescription(key=key, rate_hz=rate_hz, delay_s=0.0)]
    )


@breaks_description("the_description_matches_the_robot_file")
def lists_joints_from_the_head(robot):
    """List the joints from the head to the tail."""
    return replace(robot, joints=robot.joints[::-1])


@breaks_description("the_description_matches_the_robot_file")
def limits_in_degrees(robot):
    """Describe the angle limits in degrees."""
    return replace(
        robot, joints=[replace(j, angle_max_rad=np.degrees(j.angle_max_rad)) for j in robot.joints]
    )


@breaks_description("the_layout_is_the_hash_of_the_joints")
def layout_of_another_robot(robot):
    """Describe the layout of another robot."""
    return replace(robot, layout="0" * 16)


@breaks_description("the_description_survives_the_wire")
def max_step_out_of_range(robot):
    """Describe a step that no message may contain."""
    return replace(robot, max_step_rad=20.0)


@breaks_description("every_sensor_listed_is_a_key_of_the_hal_once")
def lists_unknown_sensor(robot):
    """List a sensor whose key the HAL does not have."""
    return add_sensor(robot, "sensor/sonar", rate_hz=10.0)


@breaks_description("every_sensor_listed_delivers_at_about_its_rate")
def lists_missing_sensor(robot):
    """List a sensor that never sends a sample."""
    return add_sensor(robot, keys.IMU, rate_hz=25.0)


@register_mutant("the_description_is_readable_at_once_and_stays")
class ChangingDescription(Workbench):
    """Describes the robot differently at each call."""

    calls = 0

    def describe(self):
        self.calls += 1
        return replace(
            self.description, max_step_rad=self.description.max_step_rad + 0.001 * self.calls
        )


# --- samples ---------------------------------------------------------------------------------------------------


@breaks_joint_state("joints_carry_the_tick_and_stamp_that_were_asked_for")
def uses_its_own_timestamp(joints):
    """Report another time than the host requested."""
    return replace(joints, timestamp_ns=joints.timestamp_ns + 1_000_000)


@breaks_joint_state("every_vector_has_one_entry_a_joint")
def reports_one_joint_too_many(joints):
    """Report one entry more than there are joints."""
    return replace(joints, valid=[*joints.valid, True])


@breaks_joint_state("every_sample_survives_the_wire")
def reports_torque_out_of_range(joints):
    """Report a torque that no message may contain."""
    return replace(joints, torque_nm=[*joints.torque_nm[:-1], 1e6])


@register_mutant("every_joint_is_valid_and_fresh_at_every_tick")
class ReadsEveryThirdTick(FaultyWorkbench):
    """Reports measurements that are up to two periods old."""

    def change_joint_state(self, joints):
        return replace(
            joints, age_ns=[joints.tick % 3 * self.description.period_ns] * len(joints.age_ns)
        )


@breaks_joint_state("what_is_not_known_yet_is_not_reported_as_valid")
def reports_unknown_angle_as_zero(joints):
    """Report an angle of 0 rad before the first measurement."""
    return joints if joints.tick else replace(joints, angle_rad=[0.0] * len(joints.angle_rad))


@register_mutant("readings_follow_the_motion")
class ReportsOldReadingsAsNew(Workbench):
    """Reads the joints in every eighth tick, and reports the same values as new in between."""

    held: Any = None

    def sample(self, tick, timestamp_ns):
        if tick % 8 == 0:
            self.held = super().sample(tick, timestamp_ns)
        return Samples(replace(self.held.joints, tick=tick, timestamp_ns=timestamp_ns))


class WithPose(FaultyWorkbench):
    """Sends a pose in every tick."""

    ahead_ns = 0

    def sample(self, tick, timestamp_ns):
        pose = make_pose(tick, timestamp_ns + self.ahead_ns)
        return Samples(super().sample(tick, timestamp_ns).joints, {keys.POSE: pose})


@register_mutant("nothing_comes_that_is_not_listed")
class SendsUnlistedPose(WithPose):
    """Sends a pose that the description does not list."""


@register_mutant("other_sensors_are_stamped_when_they_were_read")
class TimestampsInTheFuture(WithPose):
    """Sends a pose with a timestamp in the future."""

    ahead_ns = 5_000_000

    def change_description(self, robot):
        return add_sensor(robot, keys.POSE)


class WithSonar(FaultyWorkbench):
    """Sends a range scan in every tick."""

    link = 0
    measured_m = 1.0

    def change_description(self, robot):
        return add_sensor(robot, keys.ranges_key("sonar"))

    def sample(self, tick, timestamp_ns):
        sonar = RangeScan(
            tick=tick,
            timestamp_ns=timestamp_ns,
            link=self.link,
            position_l=(0.0, 0.0, 0.0),
            orientation_l_wxyz=(1.0, 0.0, 0.0, 0.0),
            angle_min_rad=0.0,
            angle_step_rad=0.0,
            range_min_m=0.1,
            range_max_m=2.0,
            range_m=[self.measured_m],
        )
        return Samples(super().sample(tick, timestamp_ns).joints, {keys.ranges_key("sonar"): sonar})


@register_mutant("every_sample_fits_the_robot")
class SonarOnMissingLink(WithSonar):
    """Sends a sample of a link that the robot does not have."""

    link = 99


@register_mutant("no_sample_contradicts_itself")
class ReportsMaximumForNoEcho(WithSonar):
    """Reports a distance beyond the range of the sensor if nothing is near."""

    measured_m = 65.535


# --- modes and units -------------------------------------------------------------------------------------------


def make_passive(setpoints: SafeSetpoints) -> SafeSetpoints:
    """Return the setpoints with all joints passive."""
    return dataclasses.replace(
        setpoints,
        mode=[JointMode.PASSIVE] * len(setpoints.mode),
        target=[0.0] * len(setpoints.mode),
    )


@breaks_setpoints("position_mode_turns_only_the_requested_joint")
def targets_in_degrees(setpoints):
    """Interpret the targets as degrees."""
    return dataclasses.replace(setpoints, target=np.radians(setpoints.target).tolist())


@breaks_setpoints("position_mode_turns_only_the_requested_joint")
def setpoints_from_head_to_tail(setpoints):
    """Apply the setpoints from the head to the tail."""
    return SafeSetpoints(
        setpoints.mode[::-1], setpoints.target[::-1], setpoints.torque_limit_nm[::-1]
    )


@breaks_setpoints(
    "position_mode_turns_only_the_requested_joint",
    "torque_mode_pushes_with_the_torque_that_is_asked",
)
def moves_in_the_wrong_direction(setpoints):
    """Apply the targets with the wrong sign."""
    return dataclasses.replace(setpoints, target=[-target for target in setpoints.target])


@breaks_setpoints(
    "velocity_mode_turns_at_the_speed_that_is_asked", "joints_may_be_in_different_modes_at_once"
)
def speed_in_revolutions(setpoints):
    """Interpret the target speeds as revolutions per second."""
    scale = [REVOLUTIONS_PER_RAD if mode == JointMode.VELOCITY else 1.0 for mode in setpoints.mode]
    return dataclasses.replace(setpoints, target=np.multiply(setpoints.target, scale).tolist())


@breaks_setpoints("joints_may_be_in_different_modes_at_once")
def one_mode_for_all_joints(setpoints):
    """Apply the mode of one joint to all joints."""
    return dataclasses.replace(setpoints, mode=[setpoints.mode[1]] * len(setpoints.mode))


@breaks_setpoints("an_isolated_joint_is_passive_while_others_continue")
def holds_isolated_joints(setpoints):
    """Let isolated joints hold an angle."""
    held = [
        JointMode.POSITION if i in setpoints.isolated else mode
        for i, mode in enumerate(setpoints.mode)
    ]
    target = [
        0.3 if i in setpoints.isolated else target for i, target in enumerate(setpoints.target)
    ]
    return SafeSetpoints(
        held, target, [limit or TORQUE_LIMIT_NM for limit in setpoints.torque_limit_nm]
    )


@breaks_setpoints("an_isolated_joint_is_passive_while_others_continue")
def isolates_all_joints(setpoints):
    """Make all joints passive if one is isolated."""
    return make_passive(setpoints) if setpoints.isolated else setpoints


@register_mutant("an_isolated_joint_is_passive_while_others_continue")
class KeepsJointsIsolated(FaultyWorkbench):
    """Leaves a joint passive after it is no longer isolated."""

    once_isolated: frozenset[int] = frozenset()

    def change_setpoints(self, setpoints):
        self.once_isolated |= setpoints.isolated
        modes = [
            JointMode.PASSIVE if i in self.once_isolated else mode
            for i, mode in enumerate(setpoints.mode)
        ]
        return dataclasses.replace(setpoints, mode=modes)


@breaks_joint_state(
    "the_reported_velocity_is_the_change_of_the_reported_angle",
    "velocity_mode_turns_at_the_speed_that_is_asked",
)
def reports_no_velocity(joints):
    """Report a velocity of 0 rad/s."""
    return replace(joints, velocity_rad_s=[0.0] * len(joints.velocity_rad_s))


@breaks_joint_state("the_reported_velocity_is_the_change_of_the_reported_angle")
def velocity_in_degrees(joints):
    """Report the velocity in degrees per second."""
    return replace(
        joints, velocity_rad_s=[float(np.degrees(speed)) for speed in joints.velocity_rad_s]
    )


@breaks_joint_state(
    "torque_mode_pushes_with_the_torque_that_is_asked", "the_torque_limit_of_the_setpoints_is_kept"
)
def reports_no_torque(joints):
    """Report a torque of 0 N·m."""
    return replace(joints, torque_nm=[0.0] * len(joints.torque_nm))


@register_mutant(
    "a_passive_joint_has_no_torque_and_stays", "nothing_moves_while_disarmed_whatever_is_commanded"
)
class PassiveMovesToZero(Workbench):
    """Moves passive joints to 0 rad."""

    def step(self):
        passive = self.mode == JointMode.PASSIVE
        self.mode[passive] = int(JointMode.POSITION)
        self.target[passive] = 0.0
        self.limit[passive] = TORQUE_LIMIT_NM
        super().step()


@register_mutant("disarmed_joints_have_no_torque", "a_passive_joint_has_no_torque_and_stays")
class PassivePushes(Workbench):
    """Applies a torque to passive joints."""

    def step(self):
        passive = self.mode == JointMode.PASSIVE
        self.mode[passive] = int(JointMode.TORQUE)
        self.target[passive] = 0.3
        self.limit[passive] = TORQUE_LIMIT_NM
        super().step()


@register_mutant("setpoints_hold_until_the_next_ones")
class StopsAtRepeatedSetpoints(FaultyWorkbench):
    """Makes the joints passive if the setpoints are the same as before."""

    last: Any = None

    def change_setpoints(self, setpoints):
        is_repeated = setpoints == self.last
        self.last = setpoints
        return make_passive(setpoints) if is_repeated else setpoints

    def step(self):
        self.limit = np.full(len(self.angle), TORQUE_LIMIT_NM)
        super().step()


@register_mutant("setpoints_hold_without_being_handed_over_again")
class PassiveAfterOnePeriod(Workbench):
    """Makes the joints passive after each period."""

    def advance(self):
        super().advance()
        self.mode[:] = JointMode.PASSIVE


@register_mutant("a_mode_that_a_joint_lacks_is_refused")
class MovesInMissingMode(FaultyWorkbench):
    """Has a joint without a torque mode, which moves without a setpoint."""

    def change_description(self, robot):
        first = replace(
            robot.joints[0], modes=[JointMode.PASSIVE, JointMode.POSITION, JointMode.VELOCITY]
        )
        return replace(robot, joints=[first, *robot.joints[1:]])

    def enact(self, setpoints, lifecycle):
        super().enact(setpoints, lifecycle)
        self.angle[0] += 0.05


# --- limits and switching --------------------------------------------------------------------------------------


@breaks_setpoints(
    "the_torque_limit_of_the_setpoints_is_kept", "a_torque_limit_of_zero_lets_nothing_move"
)
def ignores_torque_limit(setpoints):
    """Apply the full torque limit."""
    return dataclasses.replace(setpoints, torque_limit_nm=[TORQUE_LIMIT_NM] * len(setpoints.mode))


@breaks_setpoints("a_torque_limit_of_zero_lets_nothing_move")
def zero_means_no_torque_limit(setpoints):
    """Interpret a torque limit of 0 as no limit."""
    return dataclasses.replace(
        setpoints, torque_limit_nm=[limit or TORQUE_LIMIT_NM for limit in setpoints.torque_limit_nm]
    )


@register_mutant("no_joint_goes_beyond_its_limits")
class NoEndStops(Workbench):
    """Has end stops far beyond the limits of the joints."""

    def __init__(self, config, settings):
        super().__init__(config, settings)
        self.lower_rad = np.full_like(self.angle, -3.0)
        self.upper_rad = np.full_like(self.angle, 3.0)


@register_mutant("a_mode_switch_makes_no_jump")
class JumpsOnSwitch(Workbench):
    """Starts with full torque when a joint changes its mode."""

    def enact(self, setpoints, lifecycle):
        before = self.mode
        super().enact(setpoints, lifecycle)
        self.torque = np.where(self.mode != before, 3.5, self.torque)

    def advance(self):
        kicked = self.torque >= 3.5
        super().advance()
        self.torque[kicked] = 3.4


# --- lifecycle and faults --------------------------------------------------------------------------------------


@register_mutant("a_robot_with_modules_stops_them_itself_when_not_armed")
class RealRobotIgnoresLifecycle(Workbench):
    """Follows setpoints in every lifecycle state, although it is a real robot."""

    @staticmethod
    def check(config, settings):
        return ("realtime",)

    def enact(self, setpoints, lifecycle):
        super().enact(setpoints, "armed")


@register_mutant(
    "leaving_armed_brings_a_moving_joint_to_rest",
    "a_fault_of_the_backend_latches_and_stops_the_joints",
    "a_controller_that_falls_silent_stops_joints_within_lease",
)
class MovesAfterLeavingArmed(Workbench):
    """Ignores setpoints that arrive when the robot is no longer armed."""

    def enact(self, setpoints, lifecycle):
        if lifecycle == "armed" or (self.mode == JointMode.PASSIVE).all():
            super().enact(setpoints, lifecycle)


@register_mutant("a_fault_brakes_a_moving_joint")
class CoastsAfterFault(Workbench):
    """Switches off the torque of all joints at a fault, instead of braking."""

    def enact(self, setpoints, lifecycle):
        super().enact(make_passive(setpoints) if lifecycle == "fault" else setpoints, lifecycle)


@register_mutant("arming_again_goes_on_from_where_the_robot_is")
class ResumesOldTarget(Workbench):
    """Resumes the setpoints of the last arm session when it is armed again."""

    old: Any = None
    armed_for = 0
    was_armed = False

    def enact(self, setpoints, lifecycle):
        armed = lifecycle == "armed"
        self.armed_for = self.armed_for + 1 if armed else 0
        resume = self.was_armed and armed and self.armed_for <= 6
        super().enact(self.old if resume else setpoints, lifecycle)
        if armed and not resume:
            self.old = setpoints
        self.was_armed = self.was_armed or (not armed and self.old is not None)


@register_mutant("after_reset_and_arm_it_moves_again")
class NeverMovesAgain(Workbench):
    """Does not move any more after its first fault."""

    stopped = False

    def enact(self, setpoints, lifecycle):
        self.stopped = self.stopped or lifecycle in ("fault", "estop")
        super().enact(setpoints, "estop" if self.stopped else lifecycle)


@register_mutant("a_healthy_robot_reports_no_fault")
class ReportsFaultWithoutCause(Workbench):
    """Reports a fault although nothing is wrong."""

    reported = False

    def faults(self):
        if self.reported:
            return []
        self.reported = True
        return [Fault(tick=0, what="wolf", cause="none to be seen")]


@breaks_joint_state("a_silent_joint_grows_old_and_the_robot_stops")
def reports_age_of_zero(joints):
    """Report every measurement as new."""
    return replace(joints, age_ns=[0] * len(joints.age_ns))


@register_mutant("a_silent_joint_grows_old_and_the_robot_stops")
class RepeatsItsFaults(Workbench):
    """Reports the same fault again in every tick."""

    def faults(self):
        return [Fault(tick=0, what="silent", cause=f"joint {i} is silent") for i in self.silent]


FROZEN = "drives_that_stop_during_host_freeze_stay_off_until_reset"


@register_mutant(FROZEN)
class EnablesTrippedDrives(DrivesWorkbench):
    """Enables drives again whose watchdog has tripped."""

    def enact(self, setpoints, lifecycle):
        super().enact(setpoints, lifecycle)
        self.enabled |= self.tripped


@register_mutant(FROZEN)
class ResetsTripsWhenDisabling(DrivesWorkbench):
    """Resets a tripped watchdog with every command that disables a drive."""

    def enact(self, setpoints, lifecycle):
        super().enact(setpoints, lifecycle)
        if lifecycle != "armed":
            self.tripped[:] = False


@register_mutant(FROZEN)
class HasNoWatchdog(DrivesWorkbench):
    """Has drives that follow their last setpoint for an hour."""

    WATCHDOG_S = 3600.0


@register_mutant("drives_brake_after_fault_and_are_off_after_watchdog")
class BrakesForever(DrivesWorkbench):
    """Has drives that brake without a time limit after a fault."""

    def still_brakes(self):
        return self.enabled


@register_mutant("drives_brake_after_fault_and_are_off_after_watchdog")
class DoesNotBrake(DrivesWorkbench):
    """Has drives that do not brake after a fault."""

    def still_brakes(self):
        return self.enabled & False


@register_mutant("bad_commands_are_refused_and_counted_and_move_nothing")
class Creeps(Workbench):
    """Adds a growing offset to all targets."""

    offset_rad = 0.0

    def enact(self, setpoints, lifecycle):
        self.offset_rad += 0.004 * (lifecycle == "armed")
        shifted = [target + self.offset_rad for target in setpoints.target]
        super().enact(dataclasses.replace(setpoints, target=shifted), lifecycle)


# --- closing ---------------------------------------------------------------------------------------------------


@register_mutant("a_closed_backend_drives_nothing")
class DrivesAfterClose(Workbench):
    """Follows setpoints after it was closed."""

    def close(self):
        """Do nothing."""


@register_mutant("closing_twice_does_no_harm")
class ClosesOnce(Workbench):
    """Raises an error if it is closed a second time."""

    def close(self):
        if not self.open:
            raise ValueError("closed already")
        super().close()


@register_mutant("a_backend_opens_again_after_it_was_closed")
class KeepsItsBus(Workbench):
    """Does not release its bus when it is closed."""

    taken: ClassVar[bool] = False

    def __init__(self, config, settings):
        if type(self).taken:
            raise BackendError("the bus is in use")
        type(self).taken = True
        super().__init__(config, settings)


@breaks_joint_state("in_lockstep_same_seed_and_commands_give_same_samples")
def unseeded_noise(joints):
    """Add noise that does not depend on the seed."""
    return replace(
        joints, torque_nm=[torque + random.gauss(0, 1e-4) for torque in joints.torque_nm]
    )


@register_mutant("a_simulator_stands_still_on_request_and_a_robot_refuses")
class SimulatorWithWallTimeWatchdog(FaultyWorkbench):
    """Claims to be a simulator, but has a watchdog that measures wall time."""

    stepped_s = 0.0

    def change_description(self, robot):
        return replace(robot, simulated_time=True)

    def advance(self):
        super().advance()
        self.stepped_s = time.monotonic()

    def sample(self, tick, timestamp_ns):
        if self.stepped_s and time.monotonic() - self.stepped_s > 0.05:
            raise BackendError("the modules have stopped: no setpoint for 50 ms")
        return super().sample(tick, timestamp_ns)


# --- as a plugin -----------------------------------------------------------------------------------------------


def pytest_snakesim_benches() -> list[Bench]:
    """Return a bench for every mutant."""
    return [
        Bench(
            mutant.name,
            mutant.backend,
            mute_joint=mutant.mute_joint,
            make_emulated_drives=mutant.make_emulated_drives,
        )
        for mutant in MUTANTS
    ]


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Run only the contract tests that a mutant must fail."""
    wanted = {(mutant.name, clause) for mutant in MUTANTS for clause in mutant.breaks}

    def is_wanted(item: Any) -> bool:
        return (item.callspec.params["bench"].name, item.originalname) in wanted

    config.hook.pytest_deselected(items=[item for item in items if not is_wanted(item)])
    items[:] = [item for item in items if is_wanted(item)]
