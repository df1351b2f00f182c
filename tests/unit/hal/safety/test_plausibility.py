"""Which joint states are believed: glitches, lost and late samples, and sensors that are stuck."""

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

REACH = 0.05 + 2 * 5.0 * 0.01  # rad in a period
WORD = "state_invalid"
NOBODY: JointMask = np.zeros(JOINT_COUNT, dtype=np.bool_)


def targets(
    target: Any = 0.0, mode: JointMode = JointMode.POSITION, torque_limit: float = 4.0
) -> AppliedSetpoints:
    return AppliedSetpoints(
        np.full(JOINT_COUNT, int(mode)),
        np.full(JOINT_COUNT, target),
        np.full(JOINT_COUNT, torque_limit),
    )


class Bench:
    """A watch that gets a sample a period."""

    def __init__(self, **values: Any) -> None:
        self.watch = PlausibilityChecker(LIMITS)
        self.timestamp_ns = 0
        assert self.see(**values) is None

    def see(
        self,
        angle: Any = 0.0,
        *values: Any,
        applied: AppliedSetpoints | None = None,
        periods: float = 1,
        late_ns: int = 0,
        aside: JointMask = NOBODY,
        **other: Any,
    ) -> Fault | None:
        self.timestamp_ns += round(periods * PERIOD_NS)
        seen = make_joint_state(
            ROBOT, angle, *values, timestamp_ns=self.timestamp_ns, tick=7, **other
        )
        doubt = self.watch.check(
            seen, now_ns=self.timestamp_ns + late_ns, applied=applied, isolated=aside
        )
        self.doubted = [] if doubt is None else np.flatnonzero(doubt.joints).tolist()
        return None if doubt is None else doubt.fault

    @property
    def angles(self) -> list[float]:
        return self.watch.measured.angle_rad.tolist()


# --- jumps -----------------------------------------------------------------------------------------------------


def test_the_first_angle_is_believed_wherever_it_is() -> None:
    assert Bench(angle=1.4).angles == [1.4] * JOINT_COUNT


@pytest.mark.parametrize("applied", [None, targets()])
@pytest.mark.parametrize("side", [1, -1])
def test_plausibility_angle_jump_is_rejected_as_fault_of_its_joint(
    applied: AppliedSetpoints | None, side: int
) -> None:
    bench = Bench()
    assert bench.see([0.0, side * (REACH - 1e-6), 0.0], applied=applied) is None
    fault = bench.see([0.01, side * 0.9, 0.0], 1.0, 2.0, applied=applied)
    assert fault is not None
    assert fault.what == WORD
    assert fault.joint == "joint_2"
    assert fault.tick == 7
    jump_rad = side * (0.9 - REACH)
    assert (
        fault.cause
        == f"faster than any joint turns: a jump of joint_2 by {jump_rad:+.2f} rad in 10 ms"
    )


@pytest.mark.parametrize("applied", [None, targets()])
@pytest.mark.parametrize("side", [1, -1])
def test_plausibility_jumping_joint_keeps_last_valid_angle(
    applied: AppliedSetpoints | None, side: int
) -> None:
    bench = Bench()
    bench.see([0.0, side * (REACH - 1e-6), 0.0], applied=applied)
    bench.see([0.01, side * 0.9, 0.0], 1.0, 2.0, applied=applied)
    assert bench.angles == pytest.approx([0.01, side * REACH, 0.0], abs=1e-5)
    assert bench.watch.measured.velocity_rad_s.tolist() == [1.0, 0.0, 1.0]
    assert bench.watch.measured.torque_nm.tolist() == [2.0, 0.0, 2.0]
    returned = [0.02, side * (REACH + 0.01), 0.0]
    assert bench.see(returned, applied=applied) is None


def test_a_jump_of_several_joints_names_them_all() -> None:
    fault = Bench().see([0.5, 0.0, -0.6])
    assert fault is not None
    assert fault.joint is None
    assert fault.cause.endswith("joint_1 by +0.50 rad in 10 ms, joint_3 by -0.60 rad in 10 ms")


@pytest.mark.parametrize("periods", [2, 10])
def test_after_lost_samples_a_joint_may_be_further_away(periods: int) -> None:
    far = 0.05 + 10.0 * periods * 0.01
    assert Bench().see(far - 1e-6, periods=periods) is None
    assert Bench().see(far + 1e-6, periods=periods) is not None


def test_age_counts_as_time() -> None:
    """A sample that says again what was taken before may not differ from it; one that was old has time to make good."""
    bench = Bench()
    assert bench.see(0.1, age_ns=[PERIOD_NS] * JOINT_COUNT) is not None
    assert bench.see(0.04, age_ns=[2 * PERIOD_NS] * JOINT_COUNT) is None
    bench = Bench(age_ns=[3 * PERIOD_NS] * JOINT_COUNT)
    assert bench.see(0.4, age_ns=[0] * JOINT_COUNT) is None


def test_plausibility_host_pause_extends_the_reachable_angle() -> None:
    assert Bench().see(0.5) is not None
    assert Bench().see(0.5, late_ns=4 * PERIOD_NS) is None


def test_plausibility_new_place_is_accepted_after_repeats_unless_armed() -> None:
    """A joint that was bent by hand between two samples; slowly, so that time alone does not make it good."""
    for applied, seen in ((None, 5), (targets(), 6)):
        bench = Bench()
        found = [bench.see(1.2 + 0.01 * k, applied=applied) for k in range(5)] + [
            bench.see(1.25, periods=0.5)
        ]
        assert [fault is None for fault in found].index(True) == seen - 1
        assert bench.angles == pytest.approx([1.24 if seen == 5 else 1.25] * JOINT_COUNT, abs=0.011)


def test_places_that_do_not_agree_are_not_believed() -> None:
    bench = Bench()
    for k in range(6):
        assert bench.see((5.0, -5.0)[k % 2]) is not None
    for _ in range(3):  # the newest place, once more than before
        assert bench.see(-5.0) is not None
    assert bench.see(0.0) is None
    assert bench.see(-5.0) is not None  # one good sample, and counting begins again
    for _ in range(3):
        assert bench.see(-5.0) is not None
    assert bench.see(-5.0) is None


@pytest.mark.parametrize(("farther_rad", "agrees"), [(0.0, True), (1e-12, False)])
def test_places_that_are_just_within_reach_agree(farther_rad: float, agrees: bool) -> None:
    bench = Bench(angle=-3.0)
    bench.timestamp_ns = -5 * PERIOD_NS
    assert bench.see(5.0) is not None
    for _ in range(4):
        assert bench.see(0.0) is not None
    assert bench.timestamp_ns == 0  # so that the time to the next sample is exact
    assert (bench.see(REACH + farther_rad) is None) == agrees


def test_a_sample_that_is_repeated_does_not_count_again() -> None:
    bench = Bench()
    for k in range(8):
        assert bench.see(1.4, periods=0.0 if k else 1.0) is not None
    for _ in range(3):
        assert bench.see(1.4) is not None
    assert bench.see(1.4) is None


def test_plausibility_repeated_sample_never_counts_twice() -> None:
    bench = Bench()
    for k in range(12):
        assert bench.see(1.4, periods=0.0 if k else 1.0, late_ns=k) is not None


def test_plausibility_earlier_timestamp_leaves_at_least_the_slack() -> None:
    assert Bench().see(0.04, periods=-0.5) is None


def test_who_strays_first_does_not_help_who_strays_later() -> None:
    """All must be at a new place for as many samples, also one that goes to zero."""
    bench = Bench(angle=[0.0, 1.0, 0.0])
    assert bench.see([3.0, 1.0, 0.0]) is not None
    for k in range(4):
        assert bench.see([3.0, 0.0, 0.0]) is not None, k
    assert bench.angles[:2] == [3.0, 1.0]
    assert bench.see([3.0, 0.0, 0.0]) is None


def test_joints_are_judged_each_by_itself() -> None:
    bench = Bench()
    for _ in range(4):
        assert bench.see([1.4, 0.0, 0.0]) is not None
    fault = bench.see([1.4, 0.0, 1.4])
    assert fault is not None
    assert fault.joint == "joint_3"
    assert bench.angles == [1.4, 0.0, 0.0]


@pytest.mark.parametrize(
    "bad",
    [
        {"valid": [True, False, True]},
        {"age_ns": [0, LEASE_NS + 1, 0]},
        {"angle": [0.1, float("nan"), 0.1]},
    ],
)
def test_plausibility_unknown_joint_leaves_others_unchanged(bad: dict[str, Any]) -> None:
    bench = Bench()
    values: dict[str, Any] = {"angle": 0.1, **bad}
    fault = bench.see(**values)
    assert fault is not None
    assert fault.joint == "joint_2"
    assert fault.cause == "no valid and fresh state of joint_2"
    assert bench.angles == [0.1, 0.0, 0.1]


def test_a_long_story_fits_into_a_message() -> None:
    robot = make_description(chain__modules=100)
    watch = PlausibilityChecker(JointLimits.from_description(robot))
    nobody = np.zeros(100, dtype=np.bool_)
    watch.check(make_joint_state(robot), now_ns=0, applied=None, isolated=nobody)
    doubt = watch.check(make_joint_state(robot, 1.0), now_ns=0, applied=None, isolated=nobody)
    assert doubt is not None
    assert len(doubt.fault.cause) == 400
    assert doubt.joints.all()


@pytest.mark.parametrize("at", [1, 2])
def test_who_is_set_aside_is_not_looked_at(at: int) -> None:
    bench, aside = Bench(), NOBODY.copy()
    aside[1] = True
    valid = [i != at for i in range(JOINT_COUNT)]
    found = bench.see(valid=valid, aside=aside)
    assert (found is None) == (at == 1)
    assert bench.doubted == [2] * (at == 2)
    jumped = [0.0, 0.0, 0.0]
    jumped[at] = 1.0
    assert (bench.see(jumped, aside=aside) is None) == (at == 1)
    assert bench.doubted == [2] * (at == 2)


def test_plausibility_fault_reaches_joints_or_the_whole_robot() -> None:
    bench = Bench()
    fault = bench.see(valid=[True, False, False])
    assert fault is not None
    assert fault.scope == "joint"
    assert bench.doubted == [1, 2]
    fault = bench.see(valid=[])
    assert fault is not None
    assert fault.scope == "robot"
    assert bench.doubted == [0, 1, 2]
    assert fault.tick == 7
    assert fault.what == WORD
    assert fault.cause == "no joint state of 3 joints"
    assert fault.joint is None


def test_plausibility_angle_exactly_at_reach_is_accepted() -> None:
    assert Bench(angle=0.0).see(0.05, periods=0) is None
    assert Bench(angle=0.0).see(float(np.nextafter(0.05, 1.0)), periods=0) is not None


@pytest.mark.parametrize("column", ["angle_rad", "velocity_rad_s", "torque_nm"])
def test_what_is_published_has_numbers_only(column: str) -> None:
    bench = Bench(angle=0.1)
    sound = make_joint_state(ROBOT, 0.12, 0.2, 0.3)
    assert replace_non_finite_values(sound, bench.watch.measured) is sound
    corrupted = msgspec.structs.replace(sound, **{column: [0.5, float("nan"), 0.7]})
    published = replace_non_finite_values(corrupted, bench.watch.measured)
    assert published.valid == [True, False, True]
    assert published.angle_rad[1] == 0.1
    assert published.velocity_rad_s[1] == published.torque_nm[1] == 0.0
    assert getattr(published, column)[::2] == [0.5, 0.7]
    assert published.age_ns == sound.age_ns
    assert [published.angle_rad[0], published.velocity_rad_s[2], published.torque_nm[2]] != [
        0.1,
        0.0,
        0.0,
    ]
    assert replace_non_finite_values(
        msgspec.structs.replace(corrupted, valid=[False, True, True]), bench.watch.measured
    ).valid == [
        False,
        False,
        True,
    ]


@pytest.mark.parametrize("column", ["angle_rad", "velocity_rad_s", "torque_nm", "valid"])
def test_plausibility_state_of_wrong_length_is_published_unchanged(column: str) -> None:
    odd = msgspec.structs.replace(make_joint_state(ROBOT, float("nan")), **{column: [float("nan")]})
    assert replace_non_finite_values(odd, Bench().watch.measured) is odd


# --- stuck sensors ---------------------------------------------------------------------------------------------

LEASE_PERIODS = LEASE_NS // PERIOD_NS


FAR_PERIODS = 4  # until a target that moves by 0.02 rad a period is further than 0.075 rad


def stuck(
    bench: Bench,
    periods: int,
    step: float = 0.02,
    torque: float = 0.5,
    mode: JointMode = JointMode.POSITION,
    aside: JointMask = NOBODY,
) -> Fault | None:
    return [
        bench.see(0.0, 0.0, torque, applied=targets(step * k, mode), aside=aside)
        for k in range(periods)
    ][-1]


def test_plausibility_joint_that_repeats_while_target_moves_is_frozen() -> None:
    bench = Bench(torque=0.5)
    assert stuck(bench, FAR_PERIODS + LEASE_PERIODS + 1) is None  # for a lease, and no longer
    fault = bench.see(0.0, 0.0, 0.5, applied=targets(0.2))
    assert fault is not None
    assert fault.what == "joint_frozen"
    assert (
        fault.cause == "the same state repeated while its target moves: joint_1, joint_2, joint_3"
    )


def test_plausibility_isolated_joint_is_not_reported_as_frozen() -> None:
    isolated = NOBODY.copy()
    isolated[1] = True
    bench = Bench(torque=0.5)
    assert stuck(bench, FAR_PERIODS + LEASE_PERIODS + 2, aside=isolated) is not None
    assert bench.doubted == [0, 2]
    everybody = ~NOBODY
    assert stuck(Bench(torque=0.5), FAR_PERIODS + LEASE_PERIODS + 2, aside=everybody) is None


def test_plausibility_joint_freezes_while_an_isolated_joint_is_frozen() -> None:
    isolated = NOBODY.copy()
    isolated[0] = True
    bench = Bench(torque=0.5)
    faults: list[Fault | None] = []
    for k in range(60):
        angle = [0.0, 0.01 * min(k, 30), 0.01 * k]  # the second joint stops after a while
        faults.append(bench.see(angle, 0.0, 0.5, applied=targets(0.02 * k), aside=isolated))
    assert not any(faults[:30])
    assert faults[-1] is not None
    assert bench.doubted == [1]


def test_plausibility_joint_freezes_after_its_mode_has_changed() -> None:
    isolated = NOBODY.copy()
    isolated[0] = True
    bench = Bench(torque=0.5)
    fault = None
    for k in range(60):
        applied = targets(0.02 * k)
        if k < 30:
            applied.mode[1] = JointMode.VELOCITY
        fault = bench.see([0.0, 0.0, 0.01 * k], 0.0, 0.5, applied=applied, aside=isolated)
        assert fault is None or k > 30
    assert fault is not None
    assert bench.doubted == [1]


def test_plausibility_state_may_repeat_for_exactly_one_lease() -> None:
    bench = Bench(torque=0.5)
    # The target is far at time 0, so that the sum of the times is exact.
    bench.timestamp_ns = -2 * PERIOD_NS
    for target in (0.0, 0.2):
        assert bench.see(0.0, 0.0, 0.5, applied=targets(target)) is None
    assert bench.timestamp_ns == 0
    lease_periods = LEASE_NS / PERIOD_NS
    assert bench.see(0.0, 0.0, 0.5, applied=targets(0.2), periods=lease_periods) is None
    assert bench.see(0.0, 0.0, 0.5, applied=targets(0.2), periods=1e-6) is not None


@pytest.mark.parametrize("step", [0.02, -0.02])
def test_the_way_of_the_target_counts_in_both_directions(step: float) -> None:
    assert stuck(Bench(torque=0.5), 20, step) is not None


def test_a_target_that_hardly_moves_proves_nothing() -> None:
    assert stuck(Bench(torque=0.5), 50, 0.0014) is None  # 0.069 rad of the 0.075 that it takes
    assert stuck(Bench(torque=0.5), 70, 0.0014) is not None


def test_plausibility_rested_joint_has_one_lease_to_follow_a_jump() -> None:
    bench = Bench(torque=0.5)
    assert stuck(bench, 100, 0.0) is None
    seen = [bench.see(0.0, 0.0, 0.5, applied=targets(0.3)) for _ in range(LEASE_PERIODS + 2)]
    assert seen[:LEASE_PERIODS] == [None] * LEASE_PERIODS
    assert seen[-1] is not None


def test_plausibility_saturated_motor_may_repeat_its_state() -> None:
    assert stuck(Bench(torque=4.0), 50, torque=3.9) is None
    assert stuck(Bench(torque=-4.0), 50, torque=-3.9) is None
    bench = Bench()
    for k in range(50):
        assert bench.see(applied=targets(0.02 * k, torque_limit=0.0)) is None


def test_plausibility_frozen_needs_position_target_of_armed_robot() -> None:
    for mode in (JointMode.PASSIVE, JointMode.VELOCITY, JointMode.TORQUE):
        assert stuck(Bench(torque=0.5), 50, mode=mode) is None
    bench = Bench(torque=0.5)
    for _ in range(50):
        assert bench.see(0.0, 0.0, 0.5) is None
    stuck(bench, FAR_PERIODS + LEASE_PERIODS)
    assert bench.see(0.0, 0.0, 0.5) is None  # disarmed, and everything begins again
    assert stuck(bench, FAR_PERIODS + LEASE_PERIODS) is None


def test_a_mode_between_begins_anew() -> None:
    bench = Bench(torque=0.5)
    for _ in range(4):
        assert stuck(bench, FAR_PERIODS + LEASE_PERIODS) is None
        assert bench.see(0.0, 0.0, 0.5, applied=targets(9.0, JointMode.VELOCITY)) is None


def test_plausibility_revived_joint_has_a_full_lease_until_frozen() -> None:
    bench = Bench(torque=0.5)
    assert stuck(bench, FAR_PERIODS + LEASE_PERIODS) is None  # far for nearly a lease
    assert bench.see(1e-9, 0.0, 0.5, applied=targets(0.2)) is None  # every joint moves
    assert [bench.see(1e-9, 0.0, 0.5, applied=targets(0.4)) for _ in range(LEASE_PERIODS)] == [
        None
    ] * LEASE_PERIODS


@pytest.mark.parametrize("column", [0, 1, 2])
def test_whatever_still_changes_is_alive(column: int) -> None:
    bench = Bench()
    for k in range(50):
        row = np.array([0.0, 0.0, 0.5]) + 1e-9 * (k % 2) * (np.arange(3) == column)
        assert (
            bench.see(float(row[0]), float(row[1]), float(row[2]), applied=targets(0.02 * k))
            is None
        )


def test_a_target_that_moved_just_so_far_proves_nothing() -> None:
    bench = Bench(torque=0.5)
    assert bench.see(0.0, 0.0, 0.5, applied=targets(0.0)) is None
    for _ in range(3 * LEASE_PERIODS):
        assert bench.see(0.0, 0.0, 0.5, applied=targets(0.075)) is None


def test_that_the_host_was_held_up_makes_no_joint_frozen() -> None:
    bench = Bench(torque=0.5)
    for k in range(FAR_PERIODS + 4):
        assert bench.see(0.0, 0.0, 0.5, applied=targets(0.02 * k), late_ns=k * LEASE_NS) is None


def test_a_sample_that_is_only_old_is_not_frozen() -> None:
    """It was taken once: what is lost is judged by its age."""
    bench = Bench(torque=0.5)
    for k in range(1, FRESH_PERIODS + 1):
        assert (
            bench.see(0.0, 0.0, 0.5, applied=targets(0.1 * k), age_ns=[k * PERIOD_NS] * JOINT_COUNT)
            is None
        )


# --- the shortcut for ordinary states ----------------------------------------------------------------------------


class Whole(PlausibilityChecker):
    """The checks without the shortcut."""

    def _is_ordinary(self, joints: JointState) -> bool:
        del joints
        return False


def walk(rng: random.Random, length: int) -> Iterator[tuple[JointState, AppliedSetpoints | None]]:
    """States at the edges of every check, in which at most one joint is not like the others; and what was applied."""
    timestamp_ns, target, angle = 0, 0.0, [0.4] * JOINT_COUNT
    limit_ns = LIMITS.max_state_age_ns
    for _ in range(length):
        timestamp_ns += rng.choice((0, PERIOD_NS, PERIOD_NS, PERIOD_NS, LEASE_NS))
        target += rng.choice((0.0, 0.08))
        velocity, torque = (
            [rng.choice((0.5, 0.6))] * JOINT_COUNT,
            [rng.choice((0.5, 0.6))] * JOINT_COUNT,
        )
        ages, valid = [0] * JOINT_COUNT, [True] * JOINT_COUNT
        odd = rng.randrange(JOINT_COUNT)
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
                angle[odd] += rng.choice((0.05, -0.05, 0.3, -0.3, 2.0))
            case "mirrored":
                angle = [-at for at in angle]
            case "velocity":
                velocity[odd] = rng.choice((0.0, math.nan, math.inf))
            case "torque":
                torque[odd] = rng.choice((0.0, math.nan, math.inf))
            case "age":
                ages[odd] = rng.choice((limit_ns, limit_ns + 1))
            case "valid":
                valid[odd] = False
            case _:
                pass
        count = 0 if rng.random() < 0.02 else JOINT_COUNT
        seen = make_joint_state(
            ROBOT,
            angle[:count],
            velocity,
            torque,
            timestamp_ns=timestamp_ns,
            age_ns=ages,
            valid=valid,
        )
        yield seen, targets(target) if rng.random() < 0.9 else None


@pytest.mark.trials
def test_ordinary_states_are_judged_as_by_the_whole_check() -> None:
    rng = random.Random(5)
    for _ in range(choose_trial_count(300)):
        quick, whole = PlausibilityChecker(LIMITS), Whole(LIMITS)
        for seen, applied in walk(rng, 24):
            taken = [
                one.check(seen, now_ns=seen.timestamp_ns, applied=applied, isolated=NOBODY)
                for one in (quick, whole)
            ]
            assert repr(taken[0]) == repr(taken[1])
            for good, expected in zip(
                vars(quick.measured).values(), vars(whole.measured).values(), strict=True
            ):
                assert good.tolist() == expected.tolist()


@pytest.mark.parametrize("check", [PlausibilityChecker, Whole])
def test_an_angle_may_differ_by_the_noise_at_once(check: type[PlausibilityChecker]) -> None:
    watch = check(LIMITS)
    for angle in (0.0, 0.05):
        assert (
            watch.check(
                make_joint_state(ROBOT, angle), now_ns=0, applied=targets(), isolated=NOBODY
            )
            is None
        )
