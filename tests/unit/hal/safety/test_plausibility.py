"""The plausibility checker rejects glitches and frozen sensors, and accepts lost and late samples."""

import math
import random
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointLimits, JointMask
from snakesim_hal.safety.plausibility import PlausibilityChecker, replace_non_finite_values
from snakesim_hal.wire.freshness import FRESH_PERIODS
from snakesim_hal.wire.messages import Fault, JointMode, JointState
from snakesim_testing.hal.limiter_rig import JOINT_COUNT, LIMITS, ROBOT
from snakesim_testing.hal.small_robots import (
    LEASE_NS,
    PERIOD_NS,
    make_description,
    make_joint_state,
)
from snakesim_testing.hypothesis_profiles import choose_trial_count

NOISE_RAD = 0.05  # by which an angle may change in no time
# How far an angle may be from the last one after one period of 10 ms: noise, and twice the speed limit of 5 rad/s.
REACH_RAD = NOISE_RAD + 2 * 5.0 * 0.01
SETTLED_SAMPLES = 5  # consistent samples in a row at a new place, until it is accepted
MAX_CAUSE_LENGTH = 400  # characters of the cause of a fault
FAULT_KIND = "state_invalid"
NO_JOINTS: JointMask = np.zeros(JOINT_COUNT, dtype=np.bool_)


def make_applied(
    target: Any = 0.0, mode: JointMode = JointMode.POSITION, torque_limit: float = 4.0
) -> AppliedSetpoints:
    """Return the same applied setpoint for every joint."""
    return AppliedSetpoints(
        np.full(JOINT_COUNT, int(mode)),
        np.full(JOINT_COUNT, target),
        np.full(JOINT_COUNT, torque_limit),
    )


class CheckerRig:
    """A plausibility checker that receives a sample each period."""

    def __init__(self, **values: Any) -> None:
        self.checker = PlausibilityChecker(LIMITS)
        self.timestamp_ns = 0
        assert self.check_sample(**values) is None

    def check_sample(
        self,
        angle: Any = 0.0,
        *values: Any,
        applied: AppliedSetpoints | None = None,
        periods: float = 1,
        late_ns: int = 0,
        isolated: JointMask = NO_JOINTS,
        **fields: Any,
    ) -> Fault | None:
        """Check a sample, which the host receives late by some time, and return the fault."""
        self.timestamp_ns += round(periods * PERIOD_NS)
        joint_state = make_joint_state(
            ROBOT, angle, *values, timestamp_ns=self.timestamp_ns, tick=7, **fields
        )
        doubt = self.checker.check(
            joint_state, now_ns=self.timestamp_ns + late_ns, applied=applied, isolated=isolated
        )
        self.doubted_joints = [] if doubt is None else np.flatnonzero(doubt.joints).tolist()
        return None if doubt is None else doubt.fault

    @property
    def angles(self) -> list[float]:
        return self.checker.measured.angle_rad.tolist()


# --- jumps -----------------------------------------------------------------------------------------------------


def test_plausibility_first_angle_is_always_accepted() -> None:
    assert CheckerRig(angle=1.4).angles == [1.4] * JOINT_COUNT


@pytest.mark.parametrize("applied", [None, make_applied()])
@pytest.mark.parametrize("side", [1, -1])
def test_plausibility_angle_jump_is_rejected_as_fault_of_its_joint(
    applied: AppliedSetpoints | None, side: int
) -> None:
    rig = CheckerRig()
    assert rig.check_sample([0.0, side * (REACH_RAD - 1e-6), 0.0], applied=applied) is None
    fault = rig.check_sample([0.01, side * 0.9, 0.0], 1.0, 2.0, applied=applied)
    assert fault is not None
    assert fault.what == FAULT_KIND
    assert fault.joint == "joint_2"
    assert fault.tick == 7
    jump_rad = side * (0.9 - REACH_RAD)
    assert (
        fault.cause
        == f"faster than any joint turns: a jump of joint_2 by {jump_rad:+.2f} rad in 10 ms"
    )


@pytest.mark.parametrize("applied", [None, make_applied()])
@pytest.mark.parametrize("side", [1, -1])
def test_plausibility_jumping_joint_keeps_last_valid_angle(
    applied: AppliedSetpoints | None, side: int
) -> None:
    rig = CheckerRig()
    rig.check_sample([0.0, side * (REACH_RAD - 1e-6), 0.0], applied=applied)
    rig.check_sample([0.01, side * 0.9, 0.0], 1.0, 2.0, applied=applied)
    assert rig.angles == pytest.approx([0.01, side * REACH_RAD, 0.0], abs=1e-5)
    assert rig.checker.measured.velocity_rad_s.tolist() == [1.0, 0.0, 1.0]
    assert rig.checker.measured.torque_nm.tolist() == [2.0, 0.0, 2.0]
    returned = [0.02, side * (REACH_RAD + 0.01), 0.0]
    assert rig.check_sample(returned, applied=applied) is None


def test_plausibility_jump_of_several_joints_names_them_all() -> None:
    fault = CheckerRig().check_sample([0.5, 0.0, -0.6])
    assert fault is not None
    assert fault.joint is None
    assert fault.cause.endswith("joint_1 by +0.50 rad in 10 ms, joint_3 by -0.60 rad in 10 ms")


@pytest.mark.parametrize("periods", [2, 10])
def test_plausibility_lost_samples_extend_the_reachable_angle(periods: int) -> None:
    max_change_rad = NOISE_RAD + 10.0 * periods * 0.01  # twice the speed limit, for all periods

    assert CheckerRig().check_sample(max_change_rad - 1e-6, periods=periods) is None
    assert CheckerRig().check_sample(max_change_rad + 1e-6, periods=periods) is not None


def test_plausibility_age_of_a_sample_counts_as_time() -> None:
    """Allow no change for a repeated measurement, and more change after an old one."""
    rig = CheckerRig()
    aged_by_its_period_ns = [PERIOD_NS] * JOINT_COUNT  # measured with the sample before
    assert rig.check_sample(0.1, age_ns=aged_by_its_period_ns) is not None
    assert rig.check_sample(0.04, age_ns=[2 * PERIOD_NS] * JOINT_COUNT) is None, "noise is allowed"

    rig = CheckerRig(age_ns=[3 * PERIOD_NS] * JOINT_COUNT)
    assert rig.check_sample(0.4, age_ns=[0] * JOINT_COUNT) is None, "four periods have passed"


def test_plausibility_host_pause_extends_the_reachable_angle() -> None:
    far_rad = 0.5  # within reach after five periods, and not after one

    assert CheckerRig().check_sample(far_rad) is not None
    assert CheckerRig().check_sample(far_rad, late_ns=4 * PERIOD_NS) is None


@pytest.mark.parametrize(
    ("applied", "accepted_sample", "accepted_rad"),
    [(None, SETTLED_SAMPLES, 1.24), (make_applied(), SETTLED_SAMPLES + 1, 1.25)],
    ids=["not armed", "armed"],
)
def test_plausibility_new_place_is_accepted_after_repeats_unless_armed(
    applied: AppliedSetpoints | None, accepted_sample: int, accepted_rad: float
) -> None:
    """Accept a joint that was bent by hand between two samples, after some consistent samples.

    An armed robot does not accept them. The sixth sample comes when the robot is not armed any more.
    """
    rig = CheckerRig()

    faults = [rig.check_sample(1.2 + 0.01 * k, applied=applied) for k in range(SETTLED_SAMPLES)]
    faults.append(rig.check_sample(1.25, periods=0.5))

    assert [fault is None for fault in faults].index(True) == accepted_sample - 1
    assert rig.angles == pytest.approx([accepted_rad] * JOINT_COUNT, abs=0.011)


def test_plausibility_inconsistent_jumps_are_never_accepted() -> None:
    rig = CheckerRig()

    for _ in range(3):
        assert rig.check_sample(5.0) is not None
        assert rig.check_sample(-5.0) is not None

    for _ in range(SETTLED_SAMPLES - 2):  # with the newest of them, one sample too few at -5 rad
        assert rig.check_sample(-5.0) is not None, "the samples at other places were counted, too"


def test_plausibility_plausible_sample_restarts_counting_at_a_new_place() -> None:
    rig = CheckerRig()
    for _ in range(SETTLED_SAMPLES - 1):
        assert rig.check_sample(-5.0) is not None

    assert rig.check_sample(0.0) is None, "the joint is where it was before the jump"

    for _ in range(SETTLED_SAMPLES - 1):
        assert rig.check_sample(-5.0) is not None, "a sample from before the return was counted"
    assert rig.check_sample(-5.0) is None


def count_samples_at_zero_after_jump(rig: CheckerRig) -> None:
    """Let a joint at -3 rad jump to 0, and count all samples there but the last one that settles it.

    The last sample is at time 0. Then the time to the next one, and with it the reach, has no rounding error.
    """
    rig.timestamp_ns = -SETTLED_SAMPLES * PERIOD_NS
    assert rig.check_sample(5.0) is not None, "too far from -3 and from 0, so it counts for neither"
    for _ in range(SETTLED_SAMPLES - 1):
        assert rig.check_sample(0.0) is not None, "three rad in a period is a jump"
    assert rig.timestamp_ns == 0


def test_plausibility_jumps_exactly_within_reach_are_consistent() -> None:
    """A sample exactly at the reach of the last one counts as the same new place, which is accepted now."""
    rig = CheckerRig(angle=-3.0)
    count_samples_at_zero_after_jump(rig)

    assert rig.check_sample(REACH_RAD) is None, "the last sample at the new place is rejected"


def test_plausibility_jumps_just_beyond_reach_are_inconsistent() -> None:
    """A sample farther away than the reach is another new place, where counting starts again."""
    rig = CheckerRig(angle=-3.0)
    count_samples_at_zero_after_jump(rig)

    assert rig.check_sample(REACH_RAD + 1e-12) is not None, "two places were counted as one"


def test_plausibility_repeated_sample_does_not_count_again() -> None:
    """A sample with the timestamp of the last one is the same sample, sent again."""
    rig = CheckerRig()
    assert rig.check_sample(1.4) is not None
    for _ in range(7):
        assert rig.check_sample(1.4, periods=0.0) is not None

    for _ in range(SETTLED_SAMPLES - 2):  # with the first one, all but the last sample
        assert rig.check_sample(1.4) is not None
    assert rig.check_sample(1.4) is None


def test_plausibility_repeated_sample_never_counts_twice() -> None:
    """It does not count either if the host receives it a little later each time."""
    rig = CheckerRig()
    assert rig.check_sample(1.4) is not None

    for late_ns in range(1, 12):
        assert rig.check_sample(1.4, periods=0.0, late_ns=late_ns) is not None


def test_plausibility_earlier_timestamp_leaves_at_least_the_slack() -> None:
    assert CheckerRig().check_sample(0.04, periods=-0.5) is None, "less than the noise of an angle"


def test_plausibility_jumping_joints_are_counted_separately() -> None:
    """Require the same number of samples from each joint, also from one that jumps to zero."""
    rig = CheckerRig(angle=[0.0, 1.0, 0.0])
    assert rig.check_sample([3.0, 1.0, 0.0]) is not None, "joint_1 has jumped to 3"

    for sample in range(SETTLED_SAMPLES - 1):
        fault = rig.check_sample([3.0, 0.0, 0.0])
        assert fault is not None, f"joint_2 has jumped to 0, sample {sample}"
    assert rig.angles[:2] == [3.0, 1.0], "joint_1 is accepted, and joint_2 lacks one sample"

    assert rig.check_sample([3.0, 0.0, 0.0]) is None


def test_plausibility_second_jumping_joint_is_reported_alone() -> None:
    rig = CheckerRig()
    for _ in range(SETTLED_SAMPLES - 1):
        assert rig.check_sample([1.4, 0.0, 0.0]) is not None, "joint_1 has jumped"

    fault = rig.check_sample([1.4, 0.0, 1.4])  # joint_1 has settled, and joint_3 jumps

    assert fault is not None
    assert fault.joint == "joint_3"
    assert rig.angles == [1.4, 0.0, 0.0]


@pytest.mark.parametrize(
    "defect",
    [
        {"valid": [True, False, True]},
        {"age_ns": [0, LEASE_NS + 1, 0]},
        {"angle": [0.1, float("nan"), 0.1]},
    ],
)
def test_plausibility_unknown_joint_leaves_others_unchanged(defect: dict[str, Any]) -> None:
    rig = CheckerRig()
    values: dict[str, Any] = {"angle": 0.1, **defect}
    fault = rig.check_sample(**values)
    assert fault is not None
    assert fault.joint == "joint_2"
    assert fault.cause == "no valid and fresh state of joint_2"
    assert rig.angles == [0.1, 0.0, 0.1]


def test_plausibility_fault_of_many_joints_has_bounded_length() -> None:
    robot = make_description(chain__modules=100)
    checker = PlausibilityChecker(JointLimits.from_description(robot))
    no_joints = np.zeros(100, dtype=np.bool_)
    checker.check(make_joint_state(robot), now_ns=0, applied=None, isolated=no_joints)

    doubt = checker.check(make_joint_state(robot, 1.0), now_ns=0, applied=None, isolated=no_joints)

    assert doubt is not None
    assert len(doubt.fault.cause) == MAX_CAUSE_LENGTH
    assert doubt.joints.all()


JOINT_2_ISOLATED: JointMask = np.array([False, True, False])


def test_plausibility_isolated_joint_is_not_checked() -> None:
    rig = CheckerRig()

    assert rig.check_sample(valid=[True, False, True], isolated=JOINT_2_ISOLATED) is None
    assert rig.doubted_joints == []
    assert rig.check_sample([0.0, 1.0, 0.0], isolated=JOINT_2_ISOLATED) is None, "a jump of joint_2"
    assert rig.doubted_joints == []


def test_plausibility_other_joints_are_checked_beside_an_isolated_one() -> None:
    rig = CheckerRig()

    assert rig.check_sample(valid=[True, True, False], isolated=JOINT_2_ISOLATED) is not None
    assert rig.doubted_joints == [2]
    jumped = [0.0, 0.0, 1.0]
    assert rig.check_sample(jumped, isolated=JOINT_2_ISOLATED) is not None
    assert rig.doubted_joints == [2]


def test_plausibility_fault_of_some_joints_has_the_scope_of_joints() -> None:
    rig = CheckerRig()

    fault = rig.check_sample(valid=[True, False, False])

    assert fault is not None
    assert fault.scope == "joint"
    assert rig.doubted_joints == [1, 2]


def test_plausibility_state_of_wrong_length_is_fault_of_robot() -> None:
    rig = CheckerRig()

    fault = rig.check_sample(valid=[])

    assert fault is not None
    assert fault.scope == "robot"
    assert rig.doubted_joints == [0, 1, 2]
    assert fault.tick == 7
    assert fault.what == FAULT_KIND
    assert fault.cause == "no joint state of 3 joints"
    assert fault.joint is None


def test_plausibility_angle_exactly_at_reach_is_accepted() -> None:
    """Without time between two samples, the reach is the noise of an angle."""
    next_float_rad = float(np.nextafter(NOISE_RAD, 1.0))

    assert CheckerRig(angle=0.0).check_sample(NOISE_RAD, periods=0) is None
    assert CheckerRig(angle=0.0).check_sample(next_float_rad, periods=0) is not None


@pytest.mark.parametrize("column", ["angle_rad", "velocity_rad_s", "torque_nm"])
def test_plausibility_published_state_has_only_finite_values(column: str) -> None:
    rig = CheckerRig(angle=0.1)
    valid_state = make_joint_state(ROBOT, 0.12, 0.2, 0.3)
    assert replace_non_finite_values(valid_state, rig.checker.measured) is valid_state
    corrupted = msgspec.structs.replace(valid_state, **{column: [0.5, float("nan"), 0.7]})
    published = replace_non_finite_values(corrupted, rig.checker.measured)
    assert published.valid == [True, False, True]
    assert published.angle_rad[1] == 0.1
    assert published.velocity_rad_s[1] == published.torque_nm[1] == 0.0
    assert getattr(published, column)[::2] == [0.5, 0.7]
    assert published.age_ns == valid_state.age_ns
    assert [published.angle_rad[0], published.velocity_rad_s[2], published.torque_nm[2]] != [
        0.1,
        0.0,
        0.0,
    ]
    assert replace_non_finite_values(
        msgspec.structs.replace(corrupted, valid=[False, True, True]), rig.checker.measured
    ).valid == [
        False,
        False,
        True,
    ]


@pytest.mark.parametrize("column", ["angle_rad", "velocity_rad_s", "torque_nm", "valid"])
def test_plausibility_state_of_wrong_length_is_published_unchanged(column: str) -> None:
    short_state = msgspec.structs.replace(
        make_joint_state(ROBOT, float("nan")), **{column: [float("nan")]}
    )
    assert replace_non_finite_values(short_state, CheckerRig().checker.measured) is short_state


# --- frozen sensors --------------------------------------------------------------------------------------------

LEASE_PERIODS = LEASE_NS // PERIOD_NS
FAR_TARGET_RAD = 0.075  # a target that has moved farther must have changed the torque
FAR_PERIODS = (
    4  # by then, a target that moves by 0.02 rad per period is more than FAR_TARGET_RAD away
)
MANY_PERIODS = 50  # many times as long as a joint may be frozen


def repeat_state(
    rig: CheckerRig,
    periods: int,
    target_step_rad: float = 0.02,
    torque: float = 0.5,
    mode: JointMode = JointMode.POSITION,
    isolated: JointMask = NO_JOINTS,
) -> Fault | None:
    """Repeat a joint state while the target moves, and return the last fault."""
    fault = None
    for k in range(periods):
        fault = rig.check_sample(
            0.0, 0.0, torque, applied=make_applied(target_step_rad * k, mode), isolated=isolated
        )
    return fault


def test_plausibility_joint_that_repeats_while_target_moves_is_frozen() -> None:
    rig = CheckerRig(torque=0.5)
    repeated_for_one_lease = repeat_state(rig, FAR_PERIODS + LEASE_PERIODS + 1)
    assert repeated_for_one_lease is None

    fault = rig.check_sample(0.0, 0.0, 0.5, applied=make_applied(0.2))

    assert fault is not None
    assert fault.what == "joint_frozen"
    assert (
        fault.cause == "the same state repeated while its target moves: joint_1, joint_2, joint_3"
    )


def test_plausibility_isolated_joint_is_not_reported_as_frozen() -> None:
    periods_until_frozen = FAR_PERIODS + LEASE_PERIODS + 2
    rig = CheckerRig(torque=0.5)

    assert repeat_state(rig, periods_until_frozen, isolated=JOINT_2_ISOLATED) is not None
    assert rig.doubted_joints == [0, 2], "the joints that are not isolated"

    rig = CheckerRig(torque=0.5)
    all_joints = ~NO_JOINTS
    assert repeat_state(rig, periods_until_frozen, isolated=all_joints) is None


JOINT_1_ISOLATED: JointMask = np.array([True, False, False])
SAMPLE_COUNT = 60
HALFWAY = 30  # sample from which joint_2 may be frozen


def test_plausibility_joint_freezes_while_an_isolated_joint_is_frozen() -> None:
    """The isolated joint_1 is frozen from the start, joint_2 stops halfway, and joint_3 always moves."""
    rig = CheckerRig(torque=0.5)
    faults: list[Fault | None] = []

    for sample in range(SAMPLE_COUNT):
        angle = [0.0, 0.01 * min(sample, HALFWAY), 0.01 * sample]
        applied = make_applied(0.02 * sample)
        faults.append(rig.check_sample(angle, 0.0, 0.5, applied=applied, isolated=JOINT_1_ISOLATED))

    assert not any(faults[:HALFWAY]), "joint_2 still moved"
    assert faults[-1] is not None
    assert rig.doubted_joints == [1]


def test_plausibility_joint_freezes_after_its_mode_has_changed() -> None:
    """A repeated state of joint_2 is no fault in velocity mode, and is one after a change to position mode."""
    rig = CheckerRig(torque=0.5)
    fault = None

    for sample in range(SAMPLE_COUNT):
        applied = make_applied(0.02 * sample)
        if sample < HALFWAY:
            applied.mode[1] = JointMode.VELOCITY
        angle = [0.0, 0.0, 0.01 * sample]
        fault = rig.check_sample(angle, 0.0, 0.5, applied=applied, isolated=JOINT_1_ISOLATED)
        assert fault is None or sample > HALFWAY, f"joint_2 was in velocity mode, sample {sample}"

    assert fault is not None
    assert rig.doubted_joints == [1]


def test_plausibility_state_may_repeat_for_exactly_one_lease() -> None:
    rig = CheckerRig(torque=0.5)
    # The target becomes far at time 0, so that the sum of the times is exact.
    rig.timestamp_ns = -2 * PERIOD_NS
    for target in (0.0, 0.2):
        assert rig.check_sample(0.0, 0.0, 0.5, applied=make_applied(target)) is None
    assert rig.timestamp_ns == 0

    far = make_applied(0.2)
    one_lease = LEASE_NS / PERIOD_NS  # in periods
    a_moment = 1e-6  # in periods
    assert rig.check_sample(0.0, 0.0, 0.5, applied=far, periods=one_lease) is None
    assert rig.check_sample(0.0, 0.0, 0.5, applied=far, periods=a_moment) is not None


@pytest.mark.parametrize("step", [0.02, -0.02])
def test_plausibility_target_motion_in_both_directions_reveals_frozen_joint(step: float) -> None:
    assert repeat_state(CheckerRig(torque=0.5), 20, step) is not None


def test_plausibility_slow_target_reveals_frozen_joint_only_later() -> None:
    step_rad = 0.0014
    moves_too_little = 50  # periods, in which the target moves by 0.069 rad
    moves_far_enough = (
        70  # periods, in which it moves by 0.097 rad, of which the last are after FAR_TARGET_RAD
    )

    assert repeat_state(CheckerRig(torque=0.5), moves_too_little, step_rad) is None
    assert repeat_state(CheckerRig(torque=0.5), moves_far_enough, step_rad) is not None


def test_plausibility_rested_joint_has_one_lease_to_follow_a_jump() -> None:
    rig = CheckerRig(torque=0.5)
    assert repeat_state(rig, 100, target_step_rad=0.0) is None, (
        "a joint at rest may repeat its state"
    )

    faults = [
        rig.check_sample(0.0, 0.0, 0.5, applied=make_applied(0.3)) for _ in range(LEASE_PERIODS + 2)
    ]
    assert faults[:LEASE_PERIODS] == [None] * LEASE_PERIODS
    assert faults[-1] is not None


def test_plausibility_saturated_motor_may_repeat_its_state() -> None:
    """At its torque limit of 4 Nm, a motor cannot react to a target that moves."""
    assert repeat_state(CheckerRig(torque=4.0), MANY_PERIODS, torque=3.9) is None
    assert repeat_state(CheckerRig(torque=-4.0), MANY_PERIODS, torque=-3.9) is None

    rig = CheckerRig()
    for k in range(MANY_PERIODS):
        assert rig.check_sample(applied=make_applied(0.02 * k, torque_limit=0.0)) is None


@pytest.mark.parametrize("mode", [JointMode.PASSIVE, JointMode.VELOCITY, JointMode.TORQUE])
def test_plausibility_joint_without_position_target_is_not_frozen(mode: JointMode) -> None:
    assert repeat_state(CheckerRig(torque=0.5), MANY_PERIODS, mode=mode) is None


def test_plausibility_joint_of_a_disarmed_robot_is_not_frozen() -> None:
    rig = CheckerRig(torque=0.5)

    for _ in range(MANY_PERIODS):
        assert rig.check_sample(0.0, 0.0, 0.5, applied=None) is None


def test_plausibility_disarming_starts_the_frozen_time_again() -> None:
    rig = CheckerRig(torque=0.5)
    nearly_frozen_periods = FAR_PERIODS + LEASE_PERIODS
    repeat_state(rig, nearly_frozen_periods)

    assert rig.check_sample(0.0, 0.0, 0.5, applied=None) is None

    assert repeat_state(rig, nearly_frozen_periods) is None, "time before the disarming was counted"


def test_plausibility_mode_change_starts_the_frozen_time_again() -> None:
    rig = CheckerRig(torque=0.5)
    nearly_frozen_periods = FAR_PERIODS + LEASE_PERIODS
    in_velocity_mode = make_applied(9.0, JointMode.VELOCITY)

    for _ in range(4):
        assert repeat_state(rig, nearly_frozen_periods) is None
        assert rig.check_sample(0.0, 0.0, 0.5, applied=in_velocity_mode) is None


def test_plausibility_revived_joint_has_a_full_lease_until_frozen() -> None:
    rig = CheckerRig(torque=0.5)
    nearly_frozen_periods = FAR_PERIODS + LEASE_PERIODS
    assert repeat_state(rig, nearly_frozen_periods) is None
    moved_rad = 1e-9  # any change shows that the sensor works
    assert rig.check_sample(moved_rad, 0.0, 0.5, applied=make_applied(0.2)) is None

    faults = [
        rig.check_sample(moved_rad, 0.0, 0.5, applied=make_applied(0.4))
        for _ in range(LEASE_PERIODS)
    ]

    assert faults == [None] * LEASE_PERIODS


@pytest.mark.parametrize("column", [0, 1, 2], ids=["angle", "velocity", "torque"])
def test_plausibility_joint_with_any_changing_value_is_not_frozen(column: int) -> None:
    rig = CheckerRig()
    for k in range(MANY_PERIODS):
        angle_velocity_torque = [0.0, 0.0, 0.5]
        angle_velocity_torque[column] += 1e-9 * (k % 2)
        applied = make_applied(0.02 * k)
        assert rig.check_sample(*angle_velocity_torque, applied=applied) is None


def test_plausibility_target_exactly_at_threshold_reveals_nothing() -> None:
    rig = CheckerRig(torque=0.5)
    assert rig.check_sample(0.0, 0.0, 0.5, applied=make_applied(0.0)) is None
    for _ in range(3 * LEASE_PERIODS):
        assert rig.check_sample(0.0, 0.0, 0.5, applied=make_applied(FAR_TARGET_RAD)) is None


def test_plausibility_host_pauses_do_not_count_as_frozen() -> None:
    """A joint is frozen if it repeats its state for over one lease after its target has moved far.

    The time is that between the timestamps of the samples. The host, which checks them late, does not count its pauses.
    """
    target_step_rad = 0.02  # in each period
    far_sample = math.floor(FAR_TARGET_RAD / target_step_rad) + 1  # from it on, the target is far
    lease_samples = LEASE_NS // PERIOD_NS
    sample_count = (
        far_sample + lease_samples - 1
    )  # the last is less than a lease after `far_sample`
    host_pause_ns = LEASE_NS  # between two samples; their sum is many leases
    rig = CheckerRig(torque=0.5)

    for sample in range(sample_count):  # their timestamps are one period apart
        applied = make_applied(target=sample * target_step_rad)
        fault = rig.check_sample(
            angle=0.0, torque=0.5, applied=applied, late_ns=sample * host_pause_ns
        )
        assert fault is None, f"the pauses of the host were counted, sample {sample}"


def test_plausibility_old_sample_is_not_frozen() -> None:
    """Accept a state that was measured once and grows old, because its age is checked instead."""
    rig = CheckerRig(torque=0.5)
    for k in range(1, FRESH_PERIODS + 1):
        assert (
            rig.check_sample(
                0.0, 0.0, 0.5, applied=make_applied(0.1 * k), age_ns=[k * PERIOD_NS] * JOINT_COUNT
            )
            is None
        )


# --- the fast path for ordinary states -----------------------------------------------------------------------------


class FullChecker(PlausibilityChecker):
    """A plausibility checker without the fast path."""

    def _is_ordinary(self, joints: JointState) -> bool:
        del joints
        return False


def generate_states(
    rng: random.Random, length: int
) -> Iterator[tuple[JointState, AppliedSetpoints | None]]:
    """Yield states at the edges of every check, in which at most one joint differs, and applied setpoints."""
    timestamp_ns = 0
    target = 0.0
    angle = [0.4] * JOINT_COUNT
    limit_ns = LIMITS.max_state_age_ns
    for _ in range(length):
        timestamp_ns += rng.choice((0, PERIOD_NS, PERIOD_NS, PERIOD_NS, LEASE_NS))
        target += rng.choice((0.0, 0.08))
        velocity = [rng.choice((0.5, 0.6))] * JOINT_COUNT
        torque = [rng.choice((0.5, 0.6))] * JOINT_COUNT
        ages = [0] * JOINT_COUNT
        valid = [True] * JOINT_COUNT
        changed_joint = rng.randrange(JOINT_COUNT)
        match rng.choice(
            (
                "angle",
                "angle",
                "angle",
                "mirrored",
                "velocity",
                "torque",
                "age",
                "valid",
                "none",
                "none",
            )
        ):
            case "angle":
                angle[changed_joint] += rng.choice((0.05, -0.05, 0.3, -0.3, 2.0))
            case "mirrored":
                angle = [-angle_rad for angle_rad in angle]
            case "velocity":
                velocity[changed_joint] = rng.choice((0.0, math.nan, math.inf))
            case "torque":
                torque[changed_joint] = rng.choice((0.0, math.nan, math.inf))
            case "age":
                ages[changed_joint] = rng.choice((limit_ns, limit_ns + 1))
            case "valid":
                valid[changed_joint] = False
            case _:
                pass
        count = 0 if rng.random() < 0.02 else JOINT_COUNT
        joint_state = make_joint_state(
            ROBOT,
            angle[:count],
            velocity,
            torque,
            timestamp_ns=timestamp_ns,
            age_ns=ages,
            valid=valid,
        )
        yield joint_state, make_applied(target) if rng.random() < 0.9 else None


@pytest.mark.trials
def test_plausibility_fast_path_equals_the_full_check() -> None:
    rng = random.Random(5)
    for _ in range(choose_trial_count(300)):
        fast = PlausibilityChecker(LIMITS)
        full = FullChecker(LIMITS)
        for joint_state, applied in generate_states(rng, 24):
            results = [
                checker.check(
                    joint_state,
                    now_ns=joint_state.timestamp_ns,
                    applied=applied,
                    isolated=NO_JOINTS,
                )
                for checker in (fast, full)
            ]
            assert repr(results[0]) == repr(results[1])
            for values, expected in zip(
                vars(fast.measured).values(), vars(full.measured).values(), strict=True
            ):
                assert values.tolist() == expected.tolist()


@pytest.mark.parametrize("checker_class", [PlausibilityChecker, FullChecker])
def test_plausibility_angle_may_change_by_noise_immediately(
    checker_class: type[PlausibilityChecker],
) -> None:
    checker = checker_class(LIMITS)
    for angle in (0.0, 0.05):
        assert (
            checker.check(
                make_joint_state(ROBOT, angle), now_ns=0, applied=make_applied(), isolated=NO_JOINTS
            )
            is None
        )
