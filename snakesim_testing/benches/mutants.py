"""Backends that break the contract, each in one way, and the clauses that have to notice.

As a pytest plugin (`-p snakesim_testing.benches.mutants`) it runs each mutant against those clauses only.
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


class FaultyWorkbench(Workbench):
    """A correct backend with one error, in its description, its measurements or its setpoints.

    A mutant replaces one of the methods `describes`, `reads` and `alters`.
    """

    def __init__(self, config: Any, settings: Any) -> None:
        super().__init__(config, settings)
        self.description = self.describes(self.description)

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        return Samples(self.reads(super().sample(tick, timestamp_ns).joints))

    def enact(self, setpoints: SafeSetpoints, lifecycle: Any) -> None:
        super().enact(self.alters(setpoints), lifecycle)

    def describes(self, robot: RobotDescription) -> RobotDescription:
        return robot

    def reads(self, joints: JointState) -> JointState:
        return joints

    def alters(self, points: SafeSetpoints) -> SafeSetpoints:
        return points


def register_mutant(*clauses: str, lie: str = "") -> Callable[[Any], Any]:
    """Return a decorator that registers a broken backend with the contract tests that must fail on it.

    Args:
        clauses: Names of the contract tests that must fail, without `test_`.
        lie: Name of a method of `FaultyWorkbench`. The decorated object is then not a backend, but the function that
            replaces this method. If empty, the decorated object is the backend itself.
    """

    def register(broken: Any) -> Any:
        backend = (
            type(broken.__name__, (FaultyWorkbench,), {lie: staticmethod(broken)})
            if lie
            else broken
        )
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


describes, reads, alters = (
    partial(register_mutant, lie=lie) for lie in ("describes", "reads", "alters")
)


# --- the description -------------------------------------------------------------------------------------------


def listing(robot: RobotDescription, key: str, rate_hz: float = 50.0) -> RobotDescription:
    """Return a description that lists one more sensor."""
    return replace(
        robot, sensors=[*robot.sensors, SensorDescription(key=key, rate_hz=rate_hz, delay_s=0.0)]
    )


@describes("the_description_matches_the_robot_file")
def named_from_the_head(robot):
    return replace(robot, joints=robot.joints[::-1])


@describes("the_description_matches_the_robot_file")
def limits_in_degrees(robot):
    return replace(
        robot, joints=[replace(j, angle_max_rad=np.degrees(j.angle_max_rad)) for j in robot.joints]
    )


@describes("the_layout_is_the_hash_of_the_joints")
def layout_of_another(robot):
    return replace(robot, layout="0" * 16)


@describes("the_description_survives_the_wire")
def beyond_bounds(robot):
    return replace(robot, max_step_rad=20.0)


@describes("every_sensor_listed_is_a_key_of_the_hal_once")
def lists_a_sonar(robot):
    return listing(robot, "sensor/sonar", rate_hz=10.0)


@describes("every_sensor_listed_delivers_at_about_its_rate")
def lists_what_it_lacks(robot):
    return listing(robot, keys.IMU, rate_hz=25.0)


@register_mutant("the_description_is_readable_at_once_and_stays")
class NoisyDescription(Workbench):
    calls = 0

    def describe(self):
        self.calls += 1
        return replace(
            self.description, max_step_rad=self.description.max_step_rad + 0.001 * self.calls
        )


# --- samples ---------------------------------------------------------------------------------------------------


@reads("joints_carry_the_tick_and_stamp_that_were_asked_for")
def stamped_by_itself(joints):
    return replace(joints, timestamp_ns=joints.timestamp_ns + 1_000_000)


@reads("every_vector_has_one_entry_a_joint")
def one_too_many(joints):
    return replace(joints, valid=[*joints.valid, True])


@reads("every_sample_survives_the_wire")
def absurd_torque(joints):
    return replace(joints, torque_nm=[*joints.torque_nm[:-1], 1e6])


@register_mutant("every_joint_is_valid_and_fresh_at_every_tick")
class ReadsEveryThirdTick(FaultyWorkbench):
    def reads(self, joints):
        return replace(
            joints, age_ns=[joints.tick % 3 * self.description.period_ns] * len(joints.age_ns)
        )


@reads("what_is_not_known_yet_is_not_reported_as_valid")
def zero_for_unknown(joints):
    return joints if joints.tick else replace(joints, angle_rad=[0.0] * len(joints.angle_rad))


@register_mutant("readings_follow_the_motion")
class OldReadingsAsNew(Workbench):
    held: Any = None

    def sample(self, tick, timestamp_ns):
        if tick % 8 == 0:
            self.held = super().sample(tick, timestamp_ns)
        return Samples(replace(self.held.joints, tick=tick, timestamp_ns=timestamp_ns))


class WithPose(FaultyWorkbench):
    """Sends a pose every tick."""

    ahead_ns = 0

    def sample(self, tick, timestamp_ns):
        seen = make_pose(tick, timestamp_ns + self.ahead_ns)
        return Samples(super().sample(tick, timestamp_ns).joints, {keys.POSE: seen})


@register_mutant("nothing_comes_that_is_not_listed")
class Unlisted(WithPose):
    pass


@register_mutant("other_sensors_are_stamped_when_they_were_read")
class FromTheFuture(WithPose):
    ahead_ns = 5_000_000

    def describes(self, robot):
        return listing(robot, keys.POSE)


class WithSonar(FaultyWorkbench):
    """Sends a range every tick."""

    link, found_m = 0, 1.0

    def describes(self, robot):
        return listing(robot, keys.ranges_key("sonar"))

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
            range_m=[self.found_m],
        )
        return Samples(super().sample(tick, timestamp_ns).joints, {keys.ranges_key("sonar"): sonar})


@register_mutant("every_sample_fits_the_robot")
class OnNoLink(WithSonar):
    link = 99


@register_mutant("no_sample_contradicts_itself")
class SaysTheFurthestForNothing(WithSonar):
    found_m = 65.535


# --- modes and units -------------------------------------------------------------------------------------------


def let_go(points: SafeSetpoints) -> SafeSetpoints:
    """Return the setpoints with all joints passive."""
    return dataclasses.replace(
        points, mode=[JointMode.PASSIVE] * len(points.mode), target=[0.0] * len(points.mode)
    )


@alters("position_mode_turns_only_the_requested_joint")
def targets_in_degrees(points):
    return dataclasses.replace(points, target=np.radians(points.target).tolist())


@alters("position_mode_turns_only_the_requested_joint")
def head_to_tail(points):
    return SafeSetpoints(points.mode[::-1], points.target[::-1], points.torque_limit_nm[::-1])


@alters(
    "position_mode_turns_only_the_requested_joint",
    "torque_mode_pushes_with_the_torque_that_is_asked",
)
def wrong_way_round(points):
    return dataclasses.replace(points, target=[-target for target in points.target])


@alters(
    "velocity_mode_turns_at_the_speed_that_is_asked", "joints_may_be_in_different_modes_at_once"
)
def speed_in_turns(points):
    scale = [0.16 if mode == JointMode.VELOCITY else 1.0 for mode in points.mode]
    return dataclasses.replace(points, target=np.multiply(points.target, scale).tolist())


@alters("joints_may_be_in_different_modes_at_once")
def one_mode_for_all(points):
    return dataclasses.replace(points, mode=[points.mode[1]] * len(points.mode))


@alters("an_isolated_joint_is_passive_while_others_continue")
def holds_what_is_lost(points):
    held = [
        JointMode.POSITION if i in points.isolated else mode for i, mode in enumerate(points.mode)
    ]
    target = [0.3 if i in points.isolated else target for i, target in enumerate(points.target)]
    return SafeSetpoints(held, target, [limit or 4.0 for limit in points.torque_limit_nm])


@alters("an_isolated_joint_is_passive_while_others_continue")
def one_for_all(points):
    return let_go(points) if points.isolated else points


@register_mutant("an_isolated_joint_is_passive_while_others_continue")
class TakesNothingBack(FaultyWorkbench):
    lost: frozenset[int] = frozenset()

    def alters(self, points):
        self.lost |= points.isolated
        modes = [
            JointMode.PASSIVE if i in self.lost else mode for i, mode in enumerate(points.mode)
        ]
        return dataclasses.replace(points, mode=modes)


@reads(
    "the_reported_velocity_is_the_change_of_the_reported_angle",
    "velocity_mode_turns_at_the_speed_that_is_asked",
)
def no_speedometer(joints):
    return replace(joints, velocity_rad_s=[0.0] * len(joints.velocity_rad_s))


@reads("the_reported_velocity_is_the_change_of_the_reported_angle")
def angle_in_degrees(joints):
    return replace(
        joints, velocity_rad_s=[float(np.degrees(speed)) for speed in joints.velocity_rad_s]
    )


@reads(
    "torque_mode_pushes_with_the_torque_that_is_asked", "the_torque_limit_of_the_setpoints_is_kept"
)
def no_torque_sensor(joints):
    return replace(joints, torque_nm=[0.0] * len(joints.torque_nm))


@register_mutant(
    "a_passive_joint_has_no_torque_and_stays", "nothing_moves_while_disarmed_whatever_is_commanded"
)
class PassiveGoesToZero(Workbench):
    def step(self):
        passive = self.mode == JointMode.PASSIVE
        self.mode[passive], self.target[passive], self.limit[passive] = (
            int(JointMode.POSITION),
            0.0,
            4.0,
        )
        super().step()


@register_mutant("disarmed_joints_have_no_torque", "a_passive_joint_has_no_torque_and_stays")
class PassivePushes(Workbench):
    def step(self):
        passive = self.mode == JointMode.PASSIVE
        self.mode[passive], self.target[passive], self.limit[passive] = (
            int(JointMode.TORQUE),
            0.3,
            4.0,
        )
        super().step()


@register_mutant("setpoints_hold_until_the_next_ones")
class ForgetsWhatIsRepeated(FaultyWorkbench):
    last: Any = None

    def alters(self, points):
        repeated, self.last = points == self.last, points
        return let_go(points) if repeated else points

    def step(self):
        self.limit = np.full(len(self.angle), 4.0)
        super().step()


@register_mutant("setpoints_hold_without_being_handed_over_again")
class ForgetsAfterAPeriod(Workbench):
    def advance(self):
        super().advance()
        self.mode[:] = JointMode.PASSIVE


@register_mutant("a_mode_that_a_joint_lacks_is_refused")
class MovesAfterAll(FaultyWorkbench):
    """Has no torque mode, and moves without a setpoint."""

    def describes(self, robot):
        first = replace(
            robot.joints[0], modes=[JointMode.PASSIVE, JointMode.POSITION, JointMode.VELOCITY]
        )
        return replace(robot, joints=[first, *robot.joints[1:]])

    def enact(self, setpoints, lifecycle):
        super().enact(setpoints, lifecycle)
        self.angle[0] += 0.05


# --- limits and switching --------------------------------------------------------------------------------------


@alters("the_torque_limit_of_the_setpoints_is_kept", "a_torque_limit_of_zero_lets_nothing_move")
def ignores_torque_limit(points):
    return dataclasses.replace(points, torque_limit_nm=[4.0] * len(points.mode))


@alters("a_torque_limit_of_zero_lets_nothing_move")
def zero_is_no_limit(points):
    return dataclasses.replace(
        points, torque_limit_nm=[limit or 4.0 for limit in points.torque_limit_nm]
    )


@register_mutant("no_joint_goes_beyond_its_limits")
class NoStops(Workbench):
    def __init__(self, config, settings):
        super().__init__(config, settings)
        self.lower_rad, self.upper_rad = (
            np.full_like(self.angle, -3.0),
            np.full_like(self.angle, 3.0),
        )


@register_mutant("a_mode_switch_makes_no_jump")
class JumpsOnSwitch(Workbench):
    """A change of mode starts with full torque."""

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
class RobotThatTrustsTheHost(Workbench):
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
class GoesOnAfterArmed(Workbench):
    def enact(self, setpoints, lifecycle):
        if lifecycle == "armed" or (self.mode == JointMode.PASSIVE).all():
            super().enact(setpoints, lifecycle)


@register_mutant("arming_again_goes_on_from_where_the_robot_is")
class TakesUpTheOldTarget(Workbench):
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
class NeverWakesAgain(Workbench):
    stopped = False

    def enact(self, setpoints, lifecycle):
        self.stopped = self.stopped or lifecycle in ("fault", "estop")
        super().enact(setpoints, "estop" if self.stopped else lifecycle)


@register_mutant("a_healthy_robot_reports_no_fault")
class CriesWolf(Workbench):
    reported = False

    def faults(self):
        reported, self.reported = self.reported, True
        return [] if reported else [Fault(tick=0, what="wolf", cause="none to be seen")]


@reads("a_silent_joint_grows_old_and_the_robot_stops")
def never_old(joints):
    return replace(joints, age_ns=[0] * len(joints.age_ns))


@register_mutant("a_silent_joint_grows_old_and_the_robot_stops")
class RepeatsItsFaults(Workbench):
    def faults(self):
        return [Fault(tick=0, what="silent", cause=f"joint {i} is silent") for i in self.silent]


FROZEN = "drives_that_stop_during_host_freeze_stay_off_until_reset"


@register_mutant(FROZEN)
class EnablesWhatHasTripped(DrivesWorkbench):
    """Whatever it sends enables drives again."""

    def enact(self, setpoints, lifecycle):
        super().enact(setpoints, lifecycle)
        self.enabled |= self.tripped


@register_mutant(FROZEN)
class ClearsATripBeforeItIsRead(DrivesWorkbench):
    """Any command that lets a drive go ends what its watchdog has latched."""

    def enact(self, setpoints, lifecycle):
        super().enact(setpoints, lifecycle)
        if lifecycle != "armed":
            self.tripped[:] = False


@register_mutant(FROZEN)
class HasNoWatchdog(DrivesWorkbench):
    WATCHDOG_S = 3600.0


@register_mutant("drives_brake_after_fault_and_are_off_after_watchdog")
class BrakesForEver(DrivesWorkbench):
    def still_brakes(self):
        return self.enabled


@register_mutant("drives_brake_after_fault_and_are_off_after_watchdog")
class LetsGoAtOnce(DrivesWorkbench):
    def still_brakes(self):
        return self.enabled & False


@register_mutant("bad_commands_are_refused_and_counted_and_move_nothing")
class Creeps(Workbench):
    crept = 0.0

    def enact(self, setpoints, lifecycle):
        self.crept += 0.004 * (lifecycle == "armed")
        beyond = [target + self.crept for target in setpoints.target]
        super().enact(dataclasses.replace(setpoints, target=beyond), lifecycle)


# --- closing ---------------------------------------------------------------------------------------------------


@register_mutant("a_closed_backend_drives_nothing")
class DrivesAfterClose(Workbench):
    def close(self):
        """Forgotten."""


@register_mutant("closing_twice_does_no_harm")
class ClosesOnce(Workbench):
    def close(self):
        if not self.open:
            raise ValueError("closed already")
        super().close()


@register_mutant("a_backend_opens_again_after_it_was_closed")
class KeepsItsBus(Workbench):
    taken: ClassVar[bool] = False

    def __init__(self, config, settings):
        if type(self).taken:
            raise BackendError("the bus is in use")
        type(self).taken = True
        super().__init__(config, settings)


@reads("in_lockstep_same_seed_and_commands_give_same_samples")
def own_dice(joints):
    return replace(
        joints, torque_nm=[torque + random.gauss(0, 1e-4) for torque in joints.torque_nm]
    )


@register_mutant("a_simulator_stands_still_on_request_and_a_robot_refuses")
class ModulesThatTellThemselvesASimulator(FaultyWorkbench):
    """Their watchdog counts wall time."""

    stepped_s = 0.0

    def describes(self, robot):
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
    """Every mutant on a bench of its own."""
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
    """Leave only the clauses that a mutant has to fail."""
    wanted = {(mutant.name, clause) for mutant in MUTANTS for clause in mutant.breaks}

    def is_wanted(item: Any) -> bool:
        return (item.callspec.params["bench"].name, item.originalname) in wanted

    config.hook.pytest_deselected(items=[item for item in items if not is_wanted(item)])
    items[:] = [item for item in items if is_wanted(item)]
