"""The stop ramp decelerates joints and holds them where they come to rest, without jumps of the target."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.safety.joint_limits import JointLimits
from snakesim_hal.safety.stop_ramp import StopRamp, StopReaction
from snakesim_hal.wire.messages import JointMode, StopMode
from snakesim_testing.hal.limiter_rig import (
    ANGLE_STEP_RAD,
    JOINT_COUNT,
    TINY,
    make_last_setpoints,
    make_measured_state,
)
from snakesim_testing.hal.small_robots import make_description

ROBOT = make_description(motor__damping_nm_s_per_rad=2.0)
LIMITS = JointLimits.from_description(ROBOT)


def start_ramp(
    angle: float, velocity: float, torque: float, mode: JointMode, target: float
) -> StopRamp:
    """Start a ramp from a measured state and the last setpoint."""
    return StopRamp.start(
        make_measured_state(angle, velocity, torque), make_last_setpoints(mode, target), LIMITS
    )


def list_targets(ramp: StopRamp, periods: int) -> list[float]:
    """Return the targets of the first joint, from the start on."""
    targets_rad = [float(ramp.target_rad[0])]
    for _ in range(periods):
        ramp = ramp.advance(LIMITS)
        targets_rad.append(float(ramp.target_rad[0]))
    return targets_rad


def test_stop_ramp_of_joint_at_rest_holds_its_angle() -> None:
    assert list_targets(start_ramp(0.4, 0.0, 0.0, JointMode.PASSIVE, 0.0), 5) == [0.4] * 6


@pytest.mark.parametrize("side", [1, -1])
def test_stop_ramp_of_moving_joint_decelerates_at_its_limit(side: int) -> None:
    """Stop from 4 rad/s with 100 rad/s² within 40 ms and 80 mrad."""
    targets_rad = list_targets(start_ramp(0.0, side * 4.0, 0.0, JointMode.POSITION, 0.0), 10)
    assert targets_rad[1:6] == pytest.approx(
        [side * distance_rad for distance_rad in (0.035, 0.06, 0.075, 0.08, 0.08)]
    )
    assert targets_rad[-1] == pytest.approx(side * 4.0**2 / 200.0)


def test_stop_ramp_in_position_mode_starts_at_the_target() -> None:
    targets_rad = list_targets(start_ramp(0.0, 0.0, 0.0, JointMode.POSITION, 0.2), 10)
    assert targets_rad[:6] == pytest.approx([0.2, 0.15, 0.1, 0.05, 0.0, 0.0])


def test_stop_ramp_after_another_mode_starts_from_present_torque() -> None:
    ramp = start_ramp(0.1, 1.0, 2.0, JointMode.VELOCITY, 1.0)
    assert ramp.target_rad == pytest.approx(np.full(JOINT_COUNT, 0.1 + (2.0 + 2.0 * 1.0) / 40.0))


def test_stop_ramp_starts_within_one_step_of_the_joint() -> None:
    assert (
        start_ramp(0.0, 0.0, 100.0, JointMode.TORQUE, 1.0).target_rad.tolist()
        == [0.3] * JOINT_COUNT
    )
    assert (
        start_ramp(0.0, 0.0, 0.0, JointMode.POSITION, -1.0).target_rad.tolist()
        == [-0.3] * JOINT_COUNT
    )


@given(
    angle=st.floats(-2, 2),
    velocity=st.floats(-50, 50),
    torque=st.floats(-5, 5),
    mode=st.sampled_from(list(JointMode)),
    target=st.floats(-1.5, 1.5),
)
def test_stop_ramp_from_any_state_never_jumps_or_leaves_range(
    angle: float, velocity: float, torque: float, mode: JointMode, target: float
) -> None:
    targets_rad = np.array(list_targets(start_ramp(angle, velocity, torque, mode, target), 60))
    assert np.abs(targets_rad).max() <= 1.5
    assert np.abs(np.diff(targets_rad)).max() <= ANGLE_STEP_RAD + TINY
    assert targets_rad[-1] == targets_rad[-2] == targets_rad[-10]
    rest_rad = np.clip(angle, -1.5, 1.5) + np.sign(velocity) * min(abs(velocity), 5.0) ** 2 / 200.0
    # The ramp decelerates in whole periods.
    assert abs(targets_rad[-1] - np.clip(rest_rad, -1.5, 1.5)) <= ANGLE_STEP_RAD / 2


@pytest.mark.parametrize("stop_mode", ["passive", "damp", "hold"])
def test_stop_reaction_to_fault_of_a_robot_that_was_never_armed_is_passive(
    stop_mode: StopMode,
) -> None:
    setpoints = StopReaction(LIMITS, stop_mode).make_setpoints("fault", LIMITS.torque_nm)
    assert set(setpoints.mode.tolist()) == {int(JointMode.PASSIVE)}
