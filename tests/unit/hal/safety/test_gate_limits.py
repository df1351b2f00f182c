"""Nothing beyond a limit ever comes out of the limiter, also at the ends of a joint and when modes change."""

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointLimits, MeasuredState
from snakesim_hal.safety.limit_names import find_active_limits
from snakesim_hal.safety.limiter import (
    compute_bumpless_target,
    compute_stoppable_speed,
    compute_torque_bounds,
    compute_velocity_bounds,
    limit_command,
)
from snakesim_hal.wire.messages import JointCommand, JointMode
from snakesim_testing.hal.limiter_rig import (
    ANGLE_STEP_RAD,
    FULL_TORQUE,
    JOINT_COUNT,
    LIMITS,
    ROBOT,
    SPEED_STEP_RAD_S,
    TINY,
    TORQUE_STEP_NM,
    compute_bumpless_targets,
    find_limit_names,
    limit_in_equal_states,
    limit_setpoints,
    make_last_setpoints,
    make_measured_state,
)
from snakesim_testing.hal.small_robots import make_description, make_joint_command
from snakesim_testing.hypothesis_profiles import choose_trial_count


def ends(mode: JointMode, measured: MeasuredState, i: int) -> tuple[float, float]:
    angle, velocity = float(measured.angle_rad[i]), float(measured.velocity_rad_s[i])
    if mode is JointMode.VELOCITY:
        return compute_velocity_bounds(ROBOT.joints[i], angle, LIMITS.period_s)
    return compute_torque_bounds(ROBOT.joints[i], angle, velocity, LIMITS.period_s)


def at_a_bound(target: float, most: float, low: float, high: float) -> bool:
    """The speed, torque and angle limits outrank the rate."""
    return abs(target) == most or target in (low, high)


HUGE = st.floats(-1e5, 1e5)
ANY_ANGLE = st.floats(-3, 3) | st.floats(-1e4, 1e4)


def per_joint(values: st.SearchStrategy[Any]) -> st.SearchStrategy[list[Any]]:
    return st.lists(values, min_size=JOINT_COUNT, max_size=JOINT_COUNT)


@st.composite
def situations(draw: st.DrawFn) -> tuple[JointCommand, MeasuredState, AppliedSetpoints]:
    """Any command that passes the refusals, any state, and any setpoints that were applied before."""
    any_target = st.floats(-2, 2) | HUGE
    torque_limit = draw(
        st.none() | per_joint(st.sampled_from([0.0, 1e-12, 2.0, 4.0, 1e5]) | st.floats(0, 10))
    )
    modes = draw(per_joint(st.sampled_from(list(JointMode))))
    asked = make_joint_command(
        ROBOT, draw(per_joint(any_target)), modes, torque_limit_nm=torque_limit
    )
    measured = MeasuredState(
        np.array(draw(per_joint(ANY_ANGLE))),
        np.array(draw(per_joint(st.floats(-10, 10) | HUGE))),
        np.array(draw(per_joint(st.floats(-5, 5) | HUGE))),
    )
    last = AppliedSetpoints(
        np.array(draw(per_joint(st.sampled_from([0, 1, 2, 3])))),
        np.array(draw(per_joint(any_target))),
        LIMITS.torque_nm,
    )
    return asked, measured, last


@given(situations())
@settings(max_examples=choose_trial_count(300))
def test_whatever_is_asked_what_is_applied_is_inside_every_limit(
    case: tuple[JointCommand, MeasuredState, AppliedSetpoints],
) -> None:
    asked, measured, last = case
    applied = limit_setpoints(asked, measured, last)
    assert np.isfinite(applied.target).all()
    assert np.isfinite(applied.torque_limit_nm).all()
    assert (applied.torque_limit_nm >= 0).all()
    assert (applied.torque_limit_nm <= LIMITS.torque_nm).all()
    if asked.torque_limit_nm is not None:
        assert (applied.torque_limit_nm <= np.array(asked.torque_limit_nm)).all()
    start = np.where(
        applied.mode == last.mode, last.target, compute_bumpless_targets(asked.mode, measured)
    )
    for i in range(JOINT_COUNT):
        target, moved = applied.target[i], abs(applied.target[i] - start[i])
        assert applied.mode[i] == asked.mode[i]
        match asked.mode[i]:
            case JointMode.PASSIVE:
                assert target == 0.0
            case JointMode.POSITION:
                assert LIMITS.angle_min_rad[i] <= target <= LIMITS.angle_max_rad[i]
                near = abs(target - measured.angle_rad[i])
                inside = abs(measured.angle_rad[i]) <= 1.5 + 0.3
                assert not inside or near <= 0.3 + TINY
                if not inside:  # pushed beyond its end: straight back to the end, no further
                    assert target == np.clip(measured.angle_rad[i], -1.5, 1.5)
                # Only where staying near the measured angle, or inside the limits, leaves no choice:
                edges = np.clip(measured.angle_rad[i] + np.array([-0.3, 0.3]), -1.5, 1.5)
                assert (
                    moved <= ANGLE_STEP_RAD + TINY * abs(start[i]) + TINY
                    or np.abs(edges - target).min() < TINY
                )
            case JointMode.VELOCITY:
                low, high = ends(asked.mode[i], measured, i)
                assert abs(target) <= 5.0
                assert low - TINY <= target <= high + TINY
                assert moved <= SPEED_STEP_RAD_S + TINY * abs(start[i]) + TINY or at_a_bound(
                    target, 5.0, low, high
                )
            case JointMode.TORQUE:
                low, high = ends(asked.mode[i], measured, i)
                most = applied.torque_limit_nm[i]
                assert abs(target) <= most
                assert target <= max(high, -most)
                assert target >= min(low, most)
                assert moved <= TORQUE_STEP_NM + TINY * abs(start[i]) + TINY or at_a_bound(
                    target, most, low, high
                )


@given(situations())
def test_gate_names_exactly_the_targets_it_changes(
    case: tuple[JointCommand, MeasuredState, AppliedSetpoints],
) -> None:
    asked, measured, last = case
    applied = limit_setpoints(asked, measured, last)
    changed = {
        i
        for i in range(JOINT_COUNT)
        if asked.mode[i] != JointMode.PASSIVE and applied.target[i] != asked.target[i]
    }
    assert set(find_limit_names(asked, applied, measured)) == changed
    again = limit_setpoints(
        msgspec.structs.replace(asked, target=applied.target.tolist()), measured, applied
    )
    assert (again.target == applied.target).all()  # what came out once passes unchanged


@given(st.lists(per_joint(st.floats(-1.5, 1.5)), min_size=2, max_size=30))
def test_gate_random_targets_never_exceed_speed_limit(stream: list[list[float]]) -> None:
    """A joint that follows at once, so that nearness to the measured angle never overrides the rate."""
    zero, last = np.zeros(JOINT_COUNT), make_last_setpoints(JointMode.POSITION)
    for target in stream:
        applied = limit_setpoints(
            make_joint_command(ROBOT, target), MeasuredState(last.target, zero, zero), last
        )
        assert np.abs(applied.target - last.target).max() <= ANGLE_STEP_RAD + TINY
        last = applied


def test_a_target_that_waits_is_reached() -> None:
    for mode, wanted, step in (
        (JointMode.POSITION, 0.2, ANGLE_STEP_RAD),
        (JointMode.VELOCITY, 4.0, SPEED_STEP_RAD_S),
        (JointMode.TORQUE, 3.0, TORQUE_STEP_NM),
    ):
        last = make_last_setpoints(mode)
        steps = int(np.ceil(wanted / step - 1e-9))
        for k in range(1, steps + 1):
            last = limit_setpoints(
                make_joint_command(ROBOT, wanted, mode), make_measured_state(), last
            )
            assert last.target[0] == pytest.approx(min(k * step, wanted))


@pytest.mark.parametrize("angle", [1.6, 1.8, 2.5, 1e4])
@pytest.mark.parametrize("side", [1, -1])
def test_gate_joint_beyond_its_end_is_only_commanded_back(angle: float, side: int) -> None:
    for wanted in (-1e4, -1.5, 0.0, 1.5, 1e4):
        target = limit_in_equal_states(make_joint_command(ROBOT, wanted), angle=side * angle).target
        assert (np.abs(target) <= 1.5).all()
        assert (side * target >= min(angle - 0.3, 1.5) - TINY).all()  # and not past what is near


def test_with_no_torque_allowed_there_is_none() -> None:
    none = [0.0] * JOINT_COUNT
    for mode in JointMode:
        applied = limit_in_equal_states(
            make_joint_command(ROBOT, 1.0, mode, torque_limit_nm=none), torque=3.0
        )
        assert (applied.torque_limit_nm == 0).all()
    assert (
        limit_in_equal_states(
            make_joint_command(ROBOT, 1.0, JointMode.TORQUE, torque_limit_nm=none), torque=3.0
        ).target
        == 0
    ).all()


def test_a_negative_torque_limit_is_none_at_all() -> None:
    assert (
        limit_in_equal_states(
            make_joint_command(ROBOT, 0.0, torque_limit_nm=[-0.5] * JOINT_COUNT)
        ).torque_limit_nm.tolist()
        == [0.0] * JOINT_COUNT
    )


FROZEN_VALUES = [
    LIMITS,
    MeasuredState(*np.zeros((3, 1))),
    AppliedSetpoints(*np.zeros((3, 1))),  # pyright: ignore[reportArgumentType]
]


@pytest.mark.parametrize("held", FROZEN_VALUES)
def test_what_was_decided_stays(held: Any) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        held.torque_nm = 1.0


def test_a_torque_limit_never_raises_the_robots_own() -> None:
    applied = limit_in_equal_states(make_joint_command(ROBOT, 0.0, torque_limit_nm=[1e5, 4.0, 1.0]))
    assert applied.torque_limit_nm.tolist() == [4.0, 4.0, 1.0]
    assert (
        limit_in_equal_states(make_joint_command(ROBOT, 0.0)).torque_limit_nm.tolist()
        == [4.0] * JOINT_COUNT
    )


def test_modes_may_differ_from_joint_to_joint() -> None:
    mixed = make_joint_command(
        ROBOT, 9.0, [JointMode.POSITION, JointMode.VELOCITY, JointMode.TORQUE]
    )
    assert limit_in_equal_states(mixed).target == pytest.approx(
        [ANGLE_STEP_RAD, SPEED_STEP_RAD_S, TORQUE_STEP_NM]
    )


# --- bumpless --------------------------------------------------------------------------------------------------


def motor_torque(target: float, angle: float, velocity: float) -> float:
    """What a joint's motor does with a target in position mode, by the description's gains."""
    return 40.0 * (target - angle) - 1.0 * velocity


@given(
    angle=st.floats(-1.0, 1.0),
    velocity=st.floats(-2, 2),
    torque=st.floats(-4, 4),
    wanted=st.floats(-10, 10),
    mode=st.sampled_from([JointMode.PASSIVE, JointMode.VELOCITY, JointMode.TORQUE]),
)
def test_gate_switch_to_position_mode_keeps_present_torque(
    angle: float, velocity: float, torque: float, wanted: float, mode: JointMode
) -> None:
    applied = limit_in_equal_states(
        make_joint_command(ROBOT, wanted), angle, velocity, torque, mode
    )
    implied = motor_torque(applied.target[0], angle, velocity)
    assert abs(implied - torque) <= 40.0 * ANGLE_STEP_RAD + 1e-6


@given(
    torque=st.floats(-4, 4),
    wanted=st.floats(-10, 10),
    mode=st.sampled_from([JointMode.PASSIVE, JointMode.POSITION, JointMode.VELOCITY]),
)
def test_gate_switch_to_torque_mode_keeps_present_torque(
    torque: float, wanted: float, mode: JointMode
) -> None:
    applied = limit_in_equal_states(
        make_joint_command(ROBOT, wanted, JointMode.TORQUE), 0.3, 1.0, torque, mode
    )
    assert abs(applied.target[0] - torque) <= TORQUE_STEP_NM + TINY


@given(velocity=st.floats(-5, 5), wanted=st.floats(-10, 10))
def test_gate_switch_to_velocity_mode_keeps_present_torque(velocity: float, wanted: float) -> None:
    applied = limit_in_equal_states(
        make_joint_command(ROBOT, wanted, JointMode.VELOCITY),
        0.3,
        velocity,
        1.0,
        JointMode.POSITION,
    )
    joint = ROBOT.joints[0]
    bumpless_rad_s = velocity + 1.0 / joint.velocity_gain_nm_s_per_rad
    top = joint.speed_limit_rad_s
    assert min(max(bumpless_rad_s - SPEED_STEP_RAD_S, -top), top) - TINY <= applied.target[0]
    assert applied.target[0] <= max(min(bumpless_rad_s + SPEED_STEP_RAD_S, top), -top) + TINY


def test_a_torque_limit_rises_no_faster_than_a_torque() -> None:
    none = AppliedSetpoints(
        np.zeros(JOINT_COUNT, dtype=np.int64), np.zeros(JOINT_COUNT), np.zeros(JOINT_COUNT)
    )
    applied = limit_setpoints(
        make_joint_command(ROBOT, 0.3, JointMode.POSITION), make_measured_state(), none
    )
    assert applied.torque_limit_nm == pytest.approx(np.full(JOINT_COUNT, TORQUE_STEP_NM))


def test_a_switch_asked_to_stay_changes_nothing_at_all() -> None:
    measured = MeasuredState(
        np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.0, -0.5]), np.array([1.0, -2.0, 0.0])
    )
    hold = compute_bumpless_targets([JointMode.POSITION] * JOINT_COUNT, measured)
    implied = [
        motor_torque(*row)
        for row in zip(hold, measured.angle_rad, measured.velocity_rad_s, strict=True)
    ]
    assert implied == pytest.approx(measured.torque_nm.tolist())
    assert (
        compute_bumpless_targets([JointMode.TORQUE] * JOINT_COUNT, measured)
        == measured.torque_nm.tolist()
    )


def test_a_switch_to_velocity_mode_reckons_with_the_gain() -> None:
    joint = msgspec.structs.replace(ROBOT.joints[0], velocity_gain_nm_s_per_rad=2.0)
    assert compute_bumpless_target(joint, JointMode.VELOCITY, 0.3, 1.0, 3.0) == 2.5
    assert compute_bumpless_target(joint, JointMode.PASSIVE, 0.3, 1.0, 3.0) == 0.0


def test_a_joint_without_stiffness_gives_a_finite_target() -> None:
    limp = msgspec.structs.replace(ROBOT.joints[0], stiffness_nm_per_rad=0.0)
    assert compute_bumpless_target(limp, JointMode.POSITION, 0.0, 0.0, 1.0) == pytest.approx(1e9)
    joints = [msgspec.structs.replace(joint, stiffness_nm_per_rad=0.0) for joint in ROBOT.joints]
    soft = JointLimits.from_description(msgspec.structs.replace(ROBOT, joints=joints))
    measured, last = make_measured_state(torque_nm=4.0), make_last_setpoints(JointMode.PASSIVE)
    applied = limit_command(
        make_joint_command(ROBOT, 0.0),
        measured=measured,
        last=last,
        limits=soft,
        torque_fraction=FULL_TORQUE,
    )
    assert np.abs(applied.target).max() <= 0.3


# --- near the ends ---------------------------------------------------------------------------------------------


def test_a_joint_can_stop_before_its_end() -> None:
    """Four periods on at that speed, then braked by the acceleration limit, it comes to rest at the very end."""
    for distance in (1e-6, 0.01, 0.3, 3.0):
        speed = compute_stoppable_speed(distance, 100.0, 0.01)
        assert speed * 0.04 + speed**2 / 200.0 == pytest.approx(distance)
        assert speed < np.sqrt(2 * 100.0 * distance)
    assert (
        compute_stoppable_speed(0.0, 100.0, 0.01)
        == compute_stoppable_speed(-1.0, 100.0, 0.01)
        == 0.0
    )


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("delay", [1, 2])
def test_gate_velocity_towards_joint_end_stops_before_it(side: int, delay: int) -> None:
    """A joint that turns as it is told, one or two periods later."""
    angle, reported = 0.0, [0.0] * delay
    last = make_last_setpoints(JointMode.VELOCITY)
    speeds: list[float] = []
    for _ in range(400):
        last = limit_setpoints(
            make_joint_command(ROBOT, side * 5.0, JointMode.VELOCITY),
            make_measured_state(angle, reported[0]),
            last,
        )
        reported = [*reported[1:], float(last.target[0])]
        angle += reported[0] * 0.01
        speeds.append(abs(reported[0]))
        assert abs(angle) <= 1.5
    assert max(speeds) == 5.0
    assert abs(angle) > 1.49
    # What outranks the rate limit hardly needs to.
    assert max(np.abs(np.diff(speeds))) <= SPEED_STEP_RAD_S + TINY


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("mode", [JointMode.VELOCITY, JointMode.TORQUE])
@pytest.mark.parametrize("beyond", [0.0, 0.2])
def test_at_the_end_nothing_drives_outwards(side: int, mode: JointMode, beyond: float) -> None:
    for velocity in (-50.0, -1.0, 0.0, 1.0, 50.0):
        for last in (
            make_last_setpoints(mode, side * 3.0),
            make_last_setpoints(JointMode.POSITION, side * 3.0),
        ):
            for wanted in (-9.0, 9.0):
                applied = limit_setpoints(
                    make_joint_command(ROBOT, wanted, mode),
                    make_measured_state(side * (1.5 + beyond), velocity),
                    last,
                )
                assert (side * applied.target <= 0.0).all()


@pytest.mark.parametrize("side", [1, -1])
def test_gate_torque_mode_brakes_a_fast_joint(side: int) -> None:
    measured, asked = (
        make_measured_state(side * 1.4, side * 5.0),
        make_joint_command(ROBOT, side * 4.0, JointMode.TORQUE),
    )
    applied = limit_setpoints(asked, measured, make_last_setpoints(JointMode.TORQUE, side * 4.0))
    allowed = compute_stoppable_speed(0.1, 100.0, 0.01)
    # Gain 1 N·m·s/rad.
    assert applied.target == pytest.approx(np.full(JOINT_COUNT, side * (allowed - 5.0)))
    assert find_limit_names(asked, applied, measured) == dict.fromkeys(range(JOINT_COUNT), "angle")


def test_a_weak_velocity_mode_leaves_torque_mode_its_torque() -> None:
    weak = msgspec.structs.replace(ROBOT.joints[0], velocity_gain_nm_s_per_rad=1e-3)
    low, high = compute_torque_bounds(weak, 0.0, 0.0, 0.01)
    assert high == -low == pytest.approx(4.0 / 5.0 * compute_stoppable_speed(1.5, 100.0, 0.01))
    assert high > 4.0
    slow = msgspec.structs.replace(weak, speed_limit_rad_s=0.5)
    low, high = compute_torque_bounds(slow, 0.0, 0.0, 0.01)
    assert high == -low == pytest.approx(4.0 / 0.5 * compute_stoppable_speed(1.5, 100.0, 0.01))
    still = msgspec.structs.replace(weak, speed_limit_rad_s=0.0)
    low, high = compute_torque_bounds(still, 0.0, 0.0, 0.01)
    assert high == -low > 4.0


def test_gate_joint_near_its_end_is_named_angle_limited() -> None:
    asked = make_joint_command(ROBOT, 5.0, JointMode.VELOCITY)
    applied = limit_setpoints(
        asked, make_measured_state(1.45), make_last_setpoints(JointMode.VELOCITY, 5.0)
    )
    assert find_limit_names(asked, applied, make_measured_state(1.45)) == dict.fromkeys(
        range(JOINT_COUNT), "angle"
    )
    assert find_limit_names(asked, applied, make_measured_state(0.0, 1.45)) == dict.fromkeys(
        range(JOINT_COUNT), "acceleration"
    )


def test_gate_torque_far_from_ends_is_not_named_angle_limited() -> None:
    asked = make_joint_command(ROBOT, 5.0, JointMode.TORQUE)
    measured = make_measured_state(0.0, 1.45)
    applied = limit_setpoints(asked, measured, make_last_setpoints(JointMode.TORQUE, 4.0))
    assert find_limit_names(asked, applied, measured) == dict.fromkeys(range(JOINT_COUNT), "torque")


# The maximum speed there: below the speed limit of 5 rad/s.
BRAKED = compute_stoppable_speed(1.5 - 1.45, 100.0, 0.01)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    ("angle", "wanted", "speed_limit", "word"),
    [
        (1.45, BRAKED - 0.1, 5.0, "acceleration"),
        (1.45, BRAKED, 5.0, "acceleration"),
        (1.45, BRAKED + 0.1, 5.0, "angle"),
        (1.45, BRAKED + 0.1, BRAKED, "speed"),
        (0.0, 20.0, 5.0, "speed"),
    ],
)
def test_the_tightest_limit_is_the_one_that_is_named(
    side: int, angle: float, wanted: float, speed_limit: float, word: str
) -> None:
    robot = make_description(limits__speed_rad_s=speed_limit)
    asked, limits = (
        make_joint_command(robot, side * wanted, JointMode.VELOCITY),
        JointLimits.from_description(robot),
    )
    named = find_active_limits(
        asked,
        make_last_setpoints(JointMode.VELOCITY),
        measured=make_measured_state(side * angle),
        limits=limits,
        torque_fraction=FULL_TORQUE,
    )
    assert named == dict.fromkeys(range(JOINT_COUNT), word)


@pytest.mark.parametrize("velocity", [-3.0, 0.0, 3.0])
def test_gate_joint_at_its_end_needs_no_torque(velocity: float) -> None:
    """Outwards nothing, and inwards only what brakes a joint that still goes outwards."""
    joint = ROBOT.joints[0]
    _, most = compute_torque_bounds(joint, joint.angle_max_rad, velocity, 0.01)
    least, _ = compute_torque_bounds(joint, joint.angle_min_rad, velocity, 0.01)
    assert most == (0.0 if velocity <= 0.0 else -velocity)  # gain 1 N·m·s/rad
    assert least == (0.0 if velocity >= 0.0 else -velocity)


def test_a_range_without_width_leaves_no_torque() -> None:
    stuck = msgspec.structs.replace(ROBOT.joints[0], angle_min_rad=0.0, angle_max_rad=0.0)
    for velocity in (-3.0, 0.0, 3.0):
        low, high = compute_torque_bounds(stuck, 0.0, velocity, 0.01)
        assert low <= 0.0 >= high
        assert low <= high


def test_joint_limits_are_those_of_the_description() -> None:
    robot = make_description(joints={"joint_2": {"speed_rad_s": 2.0}})
    limits = JointLimits.from_description(robot)
    assert limits.angle_min_rad.tolist() == [-1.5] * 3
    assert limits.angle_max_rad.tolist() == [1.5] * 3
    assert limits.speed_rad_s.tolist() == [5.0, 2.0, 5.0]
    assert limits.acceleration_rad_s2.tolist() == [100.0] * 3
    assert limits.torque_nm.tolist() == [4.0] * 3
    assert limits.clip_angles(np.array([-9.0, 9.0, 0.5])).tolist() == [-1.5, 1.5, 0.5]
