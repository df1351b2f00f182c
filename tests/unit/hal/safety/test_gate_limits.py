"""The command limiter never applies a setpoint beyond a limit, also at joint ends and at mode changes."""

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


def compute_bounds(mode: JointMode, measured: MeasuredState, i: int) -> tuple[float, float]:
    """Return the bounds of a velocity or torque that keep a joint inside its range."""
    angle = float(measured.angle_rad[i])
    velocity = float(measured.velocity_rad_s[i])
    if mode is JointMode.VELOCITY:
        return compute_velocity_bounds(ROBOT.joints[i], angle, LIMITS.period_s)
    return compute_torque_bounds(ROBOT.joints[i], angle, velocity, LIMITS.period_s)


def is_at_bound(target: float, max_target: float, low: float, high: float) -> bool:
    """Return whether a target is at a speed, torque or angle limit, which has priority over the rate limit."""
    return abs(target) == max_target or target in (low, high)


HUGE = st.floats(-1e5, 1e5)
ANY_ANGLE = st.floats(-3, 3) | st.floats(-1e4, 1e4)


def draw_per_joint(values: st.SearchStrategy[Any]) -> st.SearchStrategy[list[Any]]:
    """Return a strategy for lists with one value for each joint."""
    return st.lists(values, min_size=JOINT_COUNT, max_size=JOINT_COUNT)


@st.composite
def draw_situation(draw: st.DrawFn) -> tuple[JointCommand, MeasuredState, AppliedSetpoints]:
    """Draw a command that is not refused, a measured state, and the setpoints that were applied before."""
    any_target = st.floats(-2, 2) | HUGE
    torque_limit = draw(
        st.none() | draw_per_joint(st.sampled_from([0.0, 1e-12, 2.0, 4.0, 1e5]) | st.floats(0, 10))
    )
    modes = draw(draw_per_joint(st.sampled_from(list(JointMode))))
    command = make_joint_command(
        ROBOT, draw(draw_per_joint(any_target)), modes, torque_limit_nm=torque_limit
    )
    measured = MeasuredState(
        np.array(draw(draw_per_joint(ANY_ANGLE))),
        np.array(draw(draw_per_joint(st.floats(-10, 10) | HUGE))),
        np.array(draw(draw_per_joint(st.floats(-5, 5) | HUGE))),
    )
    last = AppliedSetpoints(
        np.array(draw(draw_per_joint(st.sampled_from([0, 1, 2, 3])))),
        np.array(draw(draw_per_joint(any_target))),
        LIMITS.torque_nm,
    )
    return command, measured, last


@given(draw_situation())
@settings(max_examples=choose_trial_count(300))
def test_limiter_setpoints_for_any_command_are_inside_every_limit(
    case: tuple[JointCommand, MeasuredState, AppliedSetpoints],
) -> None:
    command, measured, last = case
    applied = limit_setpoints(command, measured, last)
    assert np.isfinite(applied.target).all()
    assert np.isfinite(applied.torque_limit_nm).all()
    assert (applied.torque_limit_nm >= 0).all()
    assert (applied.torque_limit_nm <= LIMITS.torque_nm).all()
    if command.torque_limit_nm is not None:
        assert (applied.torque_limit_nm <= np.array(command.torque_limit_nm)).all()
    start = np.where(
        applied.mode == last.mode, last.target, compute_bumpless_targets(command.mode, measured)
    )
    for i in range(JOINT_COUNT):
        target = applied.target[i]
        change = abs(target - start[i])
        assert applied.mode[i] == command.mode[i]
        match command.mode[i]:
            case JointMode.PASSIVE:
                assert target == 0.0
            case JointMode.POSITION:
                assert LIMITS.angle_min_rad[i] <= target <= LIMITS.angle_max_rad[i]
                step_rad = abs(target - measured.angle_rad[i])
                is_inside = abs(measured.angle_rad[i]) <= 1.5 + 0.3
                assert not is_inside or step_rad <= 0.3 + TINY
                if not is_inside:  # the joint is beyond its end, and the target is its end
                    assert target == np.clip(measured.angle_rad[i], -1.5, 1.5)
                # The rate limit is exceeded only to stay near the measured angle, or inside the limits.
                edges = np.clip(measured.angle_rad[i] + np.array([-0.3, 0.3]), -1.5, 1.5)
                assert (
                    change <= ANGLE_STEP_RAD + TINY * abs(start[i]) + TINY
                    or np.abs(edges - target).min() < TINY
                )
            case JointMode.VELOCITY:
                low, high = compute_bounds(command.mode[i], measured, i)
                assert abs(target) <= 5.0
                assert low - TINY <= target <= high + TINY
                assert change <= SPEED_STEP_RAD_S + TINY * abs(start[i]) + TINY or is_at_bound(
                    target, 5.0, low, high
                )
            case JointMode.TORQUE:
                low, high = compute_bounds(command.mode[i], measured, i)
                max_torque_nm = applied.torque_limit_nm[i]
                assert abs(target) <= max_torque_nm
                assert target <= max(high, -max_torque_nm)
                assert target >= min(low, max_torque_nm)
                assert change <= TORQUE_STEP_NM + TINY * abs(start[i]) + TINY or is_at_bound(
                    target, max_torque_nm, low, high
                )


@given(draw_situation())
def test_limiter_names_exactly_the_targets_it_changes(
    case: tuple[JointCommand, MeasuredState, AppliedSetpoints],
) -> None:
    command, measured, last = case
    applied = limit_setpoints(command, measured, last)
    changed = {
        i
        for i in range(JOINT_COUNT)
        if command.mode[i] != JointMode.PASSIVE and applied.target[i] != command.target[i]
    }
    assert set(find_limit_names(command, applied, measured)) == changed
    repeated = limit_setpoints(
        msgspec.structs.replace(command, target=applied.target.tolist()), measured, applied
    )
    assert (repeated.target == applied.target).all()  # applied setpoints pass unchanged


@given(st.lists(draw_per_joint(st.floats(-1.5, 1.5)), min_size=2, max_size=30))
def test_limiter_random_targets_never_exceed_speed_limit(
    target_sequence: list[list[float]],
) -> None:
    """Use a joint that follows immediately, so that only the rate limit applies."""
    zero = np.zeros(JOINT_COUNT)
    last = make_last_setpoints(JointMode.POSITION)
    for target in target_sequence:
        applied = limit_setpoints(
            make_joint_command(ROBOT, target), MeasuredState(last.target, zero, zero), last
        )
        assert np.abs(applied.target - last.target).max() <= ANGLE_STEP_RAD + TINY
        last = applied


def test_limiter_constant_target_is_reached_at_the_rate_limit() -> None:
    for mode, requested, step in (
        (JointMode.POSITION, 0.2, ANGLE_STEP_RAD),
        (JointMode.VELOCITY, 4.0, SPEED_STEP_RAD_S),
        (JointMode.TORQUE, 3.0, TORQUE_STEP_NM),
    ):
        last = make_last_setpoints(mode)
        steps = int(np.ceil(requested / step - 1e-9))
        for step_count in range(1, steps + 1):
            last = limit_setpoints(
                make_joint_command(ROBOT, requested, mode), make_measured_state(), last
            )
            assert last.target[0] == pytest.approx(min(step_count * step, requested))


@pytest.mark.parametrize("angle", [1.6, 1.8, 2.5, 1e4])
@pytest.mark.parametrize("side", [1, -1])
def test_limiter_joint_beyond_its_end_is_only_commanded_back(angle: float, side: int) -> None:
    for requested in (-1e4, -1.5, 0.0, 1.5, 1e4):
        target = limit_in_equal_states(
            make_joint_command(ROBOT, requested), angle=side * angle
        ).target
        assert (np.abs(target) <= 1.5).all()
        assert (
            side * target >= min(angle - 0.3, 1.5) - TINY
        ).all()  # and not further than the maximum step


def test_limiter_torque_limit_zero_allows_no_torque() -> None:
    no_torque = [0.0] * JOINT_COUNT
    for mode in JointMode:
        applied = limit_in_equal_states(
            make_joint_command(ROBOT, 1.0, mode, torque_limit_nm=no_torque), torque=3.0
        )
        assert (applied.torque_limit_nm == 0).all()
    assert (
        limit_in_equal_states(
            make_joint_command(ROBOT, 1.0, JointMode.TORQUE, torque_limit_nm=no_torque), torque=3.0
        ).target
        == 0
    ).all()


def test_limiter_negative_torque_limit_counts_as_zero() -> None:
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


@pytest.mark.parametrize("frozen_value", FROZEN_VALUES)
def test_limiter_limits_states_and_setpoints_are_immutable(frozen_value: Any) -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        frozen_value.torque_nm = 1.0


def test_limiter_torque_limit_never_exceeds_that_of_the_robot() -> None:
    applied = limit_in_equal_states(make_joint_command(ROBOT, 0.0, torque_limit_nm=[1e5, 4.0, 1.0]))
    assert applied.torque_limit_nm.tolist() == [4.0, 4.0, 1.0]
    assert (
        limit_in_equal_states(make_joint_command(ROBOT, 0.0)).torque_limit_nm.tolist()
        == [4.0] * JOINT_COUNT
    )


def test_limiter_joints_may_have_different_modes() -> None:
    command = make_joint_command(
        ROBOT, 9.0, [JointMode.POSITION, JointMode.VELOCITY, JointMode.TORQUE]
    )
    assert limit_in_equal_states(command).target == pytest.approx(
        [ANGLE_STEP_RAD, SPEED_STEP_RAD_S, TORQUE_STEP_NM]
    )


# --- mode changes without a jump of torque -----------------------------------------------------------------------


def compute_motor_torque_nm(target: float, angle: float, velocity: float) -> float:
    """Return the torque of a motor in position mode, with the gains of the description."""
    return 40.0 * (target - angle) - 1.0 * velocity


@given(
    angle=st.floats(-1.0, 1.0),
    velocity=st.floats(-2, 2),
    torque=st.floats(-4, 4),
    requested=st.floats(-10, 10),
    mode=st.sampled_from([JointMode.PASSIVE, JointMode.VELOCITY, JointMode.TORQUE]),
)
def test_limiter_switch_to_position_mode_keeps_present_torque(
    angle: float, velocity: float, torque: float, requested: float, mode: JointMode
) -> None:
    applied = limit_in_equal_states(
        make_joint_command(ROBOT, requested), angle, velocity, torque, mode
    )
    torque_after_switch = compute_motor_torque_nm(applied.target[0], angle, velocity)
    assert abs(torque_after_switch - torque) <= 40.0 * ANGLE_STEP_RAD + 1e-6


@given(
    torque=st.floats(-4, 4),
    requested=st.floats(-10, 10),
    mode=st.sampled_from([JointMode.PASSIVE, JointMode.POSITION, JointMode.VELOCITY]),
)
def test_limiter_switch_to_torque_mode_keeps_present_torque(
    torque: float, requested: float, mode: JointMode
) -> None:
    applied = limit_in_equal_states(
        make_joint_command(ROBOT, requested, JointMode.TORQUE), 0.3, 1.0, torque, mode
    )
    assert abs(applied.target[0] - torque) <= TORQUE_STEP_NM + TINY


@given(velocity=st.floats(-5, 5), requested=st.floats(-10, 10))
def test_limiter_switch_to_velocity_mode_keeps_present_torque(
    velocity: float, requested: float
) -> None:
    applied = limit_in_equal_states(
        make_joint_command(ROBOT, requested, JointMode.VELOCITY),
        0.3,
        velocity,
        1.0,
        JointMode.POSITION,
    )
    joint = ROBOT.joints[0]
    bumpless_rad_s = velocity + 1.0 / joint.velocity_gain_nm_s_per_rad
    max_speed_rad_s = joint.speed_limit_rad_s
    assert (
        min(max(bumpless_rad_s - SPEED_STEP_RAD_S, -max_speed_rad_s), max_speed_rad_s) - TINY
        <= applied.target[0]
    )
    assert (
        applied.target[0]
        <= max(min(bumpless_rad_s + SPEED_STEP_RAD_S, max_speed_rad_s), -max_speed_rad_s) + TINY
    )


def test_limiter_torque_limit_rises_at_the_torque_rate() -> None:
    last = AppliedSetpoints(
        np.zeros(JOINT_COUNT, dtype=np.int64), np.zeros(JOINT_COUNT), np.zeros(JOINT_COUNT)
    )
    applied = limit_setpoints(
        make_joint_command(ROBOT, 0.3, JointMode.POSITION), make_measured_state(), last
    )
    assert applied.torque_limit_nm == pytest.approx(np.full(JOINT_COUNT, TORQUE_STEP_NM))


def test_limiter_mode_switch_without_motion_keeps_every_torque() -> None:
    measured = MeasuredState(
        np.array([0.1, -0.2, 0.3]), np.array([0.5, 0.0, -0.5]), np.array([1.0, -2.0, 0.0])
    )
    hold = compute_bumpless_targets([JointMode.POSITION] * JOINT_COUNT, measured)
    torques_after_switch = [
        compute_motor_torque_nm(*row)
        for row in zip(hold, measured.angle_rad, measured.velocity_rad_s, strict=True)
    ]
    assert torques_after_switch == pytest.approx(measured.torque_nm.tolist())
    assert (
        compute_bumpless_targets([JointMode.TORQUE] * JOINT_COUNT, measured)
        == measured.torque_nm.tolist()
    )


def test_limiter_switch_to_velocity_mode_uses_the_velocity_gain() -> None:
    joint = msgspec.structs.replace(ROBOT.joints[0], velocity_gain_nm_s_per_rad=2.0)
    assert compute_bumpless_target(joint, JointMode.VELOCITY, 0.3, 1.0, 3.0) == 2.5
    assert compute_bumpless_target(joint, JointMode.PASSIVE, 0.3, 1.0, 3.0) == 0.0


def test_limiter_joint_without_stiffness_has_a_finite_target() -> None:
    joint_without_stiffness = msgspec.structs.replace(ROBOT.joints[0], stiffness_nm_per_rad=0.0)
    assert compute_bumpless_target(
        joint_without_stiffness, JointMode.POSITION, 0.0, 0.0, 1.0
    ) == pytest.approx(1e9)
    joints = [msgspec.structs.replace(joint, stiffness_nm_per_rad=0.0) for joint in ROBOT.joints]
    limits = JointLimits.from_description(msgspec.structs.replace(ROBOT, joints=joints))
    measured = make_measured_state(torque_nm=4.0)
    last = make_last_setpoints(JointMode.PASSIVE)
    applied = limit_command(
        make_joint_command(ROBOT, 0.0),
        measured=measured,
        last=last,
        limits=limits,
        torque_fraction=FULL_TORQUE,
    )
    assert np.abs(applied.target).max() <= 0.3


# --- near the ends ---------------------------------------------------------------------------------------------


def test_limiter_stoppable_speed_ends_exactly_at_the_joint_end() -> None:
    """Check that a joint stops exactly at its end, after four periods at this speed and braking."""
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
def test_limiter_velocity_towards_joint_end_stops_before_it(side: int, delay: int) -> None:
    """Drive a joint that follows its target after one or two periods."""
    angle = 0.0
    delayed = [0.0] * delay
    last = make_last_setpoints(JointMode.VELOCITY)
    speeds: list[float] = []
    for _ in range(400):
        last = limit_setpoints(
            make_joint_command(ROBOT, side * 5.0, JointMode.VELOCITY),
            make_measured_state(angle, delayed[0]),
            last,
        )
        delayed = [*delayed[1:], float(last.target[0])]
        angle += delayed[0] * 0.01
        speeds.append(abs(delayed[0]))
        assert abs(angle) <= 1.5
    assert max(speeds) == 5.0
    assert abs(angle) > 1.49
    # The limit at the end has priority over the rate limit, but hardly needs it.
    assert max(np.abs(np.diff(speeds))) <= SPEED_STEP_RAD_S + TINY


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("mode", [JointMode.VELOCITY, JointMode.TORQUE])
@pytest.mark.parametrize("beyond_rad", [0.0, 0.2])
def test_limiter_joint_at_its_end_is_never_driven_outwards(
    side: int, mode: JointMode, beyond_rad: float
) -> None:
    for velocity in (-50.0, -1.0, 0.0, 1.0, 50.0):
        for last in (
            make_last_setpoints(mode, side * 3.0),
            make_last_setpoints(JointMode.POSITION, side * 3.0),
        ):
            for requested in (-9.0, 9.0):
                applied = limit_setpoints(
                    make_joint_command(ROBOT, requested, mode),
                    make_measured_state(side * (1.5 + beyond_rad), velocity),
                    last,
                )
                assert (side * applied.target <= 0.0).all()


@pytest.mark.parametrize("side", [1, -1])
def test_limiter_torque_mode_brakes_a_fast_joint(side: int) -> None:
    measured = make_measured_state(side * 1.4, side * 5.0)
    command = make_joint_command(ROBOT, side * 4.0, JointMode.TORQUE)
    applied = limit_setpoints(command, measured, make_last_setpoints(JointMode.TORQUE, side * 4.0))
    allowed_rad_s = compute_stoppable_speed(0.1, 100.0, 0.01)
    # The velocity gain is 1 N·m·s/rad.
    assert applied.target == pytest.approx(np.full(JOINT_COUNT, side * (allowed_rad_s - 5.0)))
    assert find_limit_names(command, applied, measured) == dict.fromkeys(
        range(JOINT_COUNT), "angle"
    )


def test_limiter_torque_bounds_with_weak_gain_allow_full_torque() -> None:
    weak_joint = msgspec.structs.replace(ROBOT.joints[0], velocity_gain_nm_s_per_rad=1e-3)
    low, high = compute_torque_bounds(weak_joint, 0.0, 0.0, 0.01)
    assert high == -low == pytest.approx(4.0 / 5.0 * compute_stoppable_speed(1.5, 100.0, 0.01))
    assert high > 4.0
    slow_joint = msgspec.structs.replace(weak_joint, speed_limit_rad_s=0.5)
    low, high = compute_torque_bounds(slow_joint, 0.0, 0.0, 0.01)
    assert high == -low == pytest.approx(4.0 / 0.5 * compute_stoppable_speed(1.5, 100.0, 0.01))
    stationary_joint = msgspec.structs.replace(weak_joint, speed_limit_rad_s=0.0)
    low, high = compute_torque_bounds(stationary_joint, 0.0, 0.0, 0.01)
    assert high == -low > 4.0


def test_limiter_joint_near_its_end_is_named_angle_limited() -> None:
    command = make_joint_command(ROBOT, 5.0, JointMode.VELOCITY)
    applied = limit_setpoints(
        command, make_measured_state(1.45), make_last_setpoints(JointMode.VELOCITY, 5.0)
    )
    assert find_limit_names(command, applied, make_measured_state(1.45)) == dict.fromkeys(
        range(JOINT_COUNT), "angle"
    )
    assert find_limit_names(command, applied, make_measured_state(0.0, 1.45)) == dict.fromkeys(
        range(JOINT_COUNT), "acceleration"
    )


def test_limiter_torque_far_from_ends_is_not_named_angle_limited() -> None:
    command = make_joint_command(ROBOT, 5.0, JointMode.TORQUE)
    measured = make_measured_state(0.0, 1.45)
    applied = limit_setpoints(command, measured, make_last_setpoints(JointMode.TORQUE, 4.0))
    assert find_limit_names(command, applied, measured) == dict.fromkeys(
        range(JOINT_COUNT), "torque"
    )


# The maximum speed at 1.45 rad, which is below the speed limit of 5 rad/s.
STOPPABLE_RAD_S = compute_stoppable_speed(1.5 - 1.45, 100.0, 0.01)


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(
    ("angle", "requested", "speed_limit", "limit_name"),
    [
        (1.45, STOPPABLE_RAD_S - 0.1, 5.0, "acceleration"),
        (1.45, STOPPABLE_RAD_S, 5.0, "acceleration"),
        (1.45, STOPPABLE_RAD_S + 0.1, 5.0, "angle"),
        (1.45, STOPPABLE_RAD_S + 0.1, STOPPABLE_RAD_S, "speed"),
        (0.0, 20.0, 5.0, "speed"),
    ],
)
def test_limiter_names_the_tightest_limit(
    side: int, angle: float, requested: float, speed_limit: float, limit_name: str
) -> None:
    robot = make_description(limits__speed_rad_s=speed_limit)
    command = make_joint_command(robot, side * requested, JointMode.VELOCITY)
    limits = JointLimits.from_description(robot)
    active_limits = find_active_limits(
        command,
        make_last_setpoints(JointMode.VELOCITY),
        measured=make_measured_state(side * angle),
        limits=limits,
        torque_fraction=FULL_TORQUE,
    )
    assert active_limits == dict.fromkeys(range(JOINT_COUNT), limit_name)


@pytest.mark.parametrize("velocity", [-3.0, 0.0, 3.0])
def test_limiter_joint_at_its_end_needs_no_torque(velocity: float) -> None:
    """Allow no torque outwards, and inwards only torque that brakes an outward motion."""
    joint = ROBOT.joints[0]
    _, max_nm = compute_torque_bounds(joint, joint.angle_max_rad, velocity, 0.01)
    min_nm, _ = compute_torque_bounds(joint, joint.angle_min_rad, velocity, 0.01)
    assert max_nm == (0.0 if velocity <= 0.0 else -velocity)  # gain 1 N·m·s/rad
    assert min_nm == (0.0 if velocity >= 0.0 else -velocity)


def test_limiter_joint_range_without_width_allows_no_outward_torque() -> None:
    joint = msgspec.structs.replace(ROBOT.joints[0], angle_min_rad=0.0, angle_max_rad=0.0)
    for velocity in (-3.0, 0.0, 3.0):
        low, high = compute_torque_bounds(joint, 0.0, velocity, 0.01)
        assert low <= 0.0 >= high
        assert low <= high


def test_joint_limits_come_from_the_description() -> None:
    robot = make_description(joints={"joint_2": {"speed_rad_s": 2.0}})
    limits = JointLimits.from_description(robot)
    assert limits.angle_min_rad.tolist() == [-1.5] * 3
    assert limits.angle_max_rad.tolist() == [1.5] * 3
    assert limits.speed_rad_s.tolist() == [5.0, 2.0, 5.0]
    assert limits.acceleration_rad_s2.tolist() == [100.0] * 3
    assert limits.torque_nm.tolist() == [4.0] * 3
    assert limits.clip_angles(np.array([-9.0, 9.0, 0.5])).tolist() == [-1.5, 1.5, 0.5]
