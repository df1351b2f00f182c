"""Decelerate and hold: where the joints come to rest, and that no target jumps on the way."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_hal.safety.joint_limits import JointLimits
from snakesim_hal.safety.stop_ramp import StopRamp
from snakesim_hal.wire.messages import JointMode
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


def beginning(
    angle: float, velocity: float, torque: float, mode: JointMode, target: float
) -> StopRamp:
    return StopRamp.start(
        make_measured_state(angle, velocity, torque), make_last_setpoints(mode, target), LIMITS
    )


def targets(halt: StopRamp, periods: int) -> list[float]:
    found = [float(halt.target_rad[0])]
    for _ in range(periods):
        halt = halt.advance(LIMITS)
        found.append(float(halt.target_rad[0]))
    return found


def test_a_joint_at_rest_is_held_where_it_is() -> None:
    assert targets(beginning(0.4, 0.0, 0.0, JointMode.PASSIVE, 0.0), 5) == [0.4] * 6


@pytest.mark.parametrize("side", [1, -1])
def test_a_moving_joint_slows_down_by_its_acceleration(side: int) -> None:
    """From 4 rad/s by 100 rad/s² within 40 ms, and 80 mrad further."""
    way = targets(beginning(0.0, side * 4.0, 0.0, JointMode.POSITION, 0.0), 10)
    assert way[1:6] == pytest.approx([side * x for x in (0.035, 0.06, 0.075, 0.08, 0.08)])
    assert way[-1] == pytest.approx(side * 4.0**2 / 200.0)


def test_the_target_goes_on_from_where_it_was() -> None:
    way = targets(beginning(0.0, 0.0, 0.0, JointMode.POSITION, 0.2), 10)
    assert way[:6] == pytest.approx([0.2, 0.15, 0.1, 0.05, 0.0, 0.0])


def test_stop_ramp_after_another_mode_starts_from_present_torque() -> None:
    halt = beginning(0.1, 1.0, 2.0, JointMode.VELOCITY, 1.0)
    assert halt.target_rad == pytest.approx(np.full(JOINT_COUNT, 0.1 + (2.0 + 2.0 * 1.0) / 40.0))


def test_it_begins_near_the_joint() -> None:
    assert (
        beginning(0.0, 0.0, 100.0, JointMode.TORQUE, 1.0).target_rad.tolist() == [0.3] * JOINT_COUNT
    )
    assert (
        beginning(0.0, 0.0, 0.0, JointMode.POSITION, -1.0).target_rad.tolist()
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
    way = np.array(targets(beginning(angle, velocity, torque, mode, target), 60))
    assert np.abs(way).max() <= 1.5
    assert np.abs(np.diff(way)).max() <= ANGLE_STEP_RAD + TINY
    assert way[-1] == way[-2] == way[-10]
    stops_at = np.clip(angle, -1.5, 1.5) + np.sign(velocity) * min(abs(velocity), 5.0) ** 2 / 200.0
    # It slows down in whole periods.
    assert abs(way[-1] - np.clip(stops_at, -1.5, 1.5)) <= ANGLE_STEP_RAD / 2
