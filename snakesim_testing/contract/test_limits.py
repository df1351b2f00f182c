"""Limits that the motor itself enforces."""

import numpy as np

from snakesim_hal.wire.messages import Mode
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.recordings import Pushing
from snakesim_testing.contract.rig import Rig


def test_the_torque_limit_of_the_setpoints_is_kept(rig: Rig, pushing: Pushing) -> None:
    """Velocity mode (or else a position beyond it) against a stop pushes with the limit, and no more."""
    rig.skip_without(torque=True)
    measured_nm = abs(pushing.limited.torque_nm[-1, :2])
    limit_nm = pushing.limit_nm
    assert max(measured_nm) < (1 + t.TORQUE_SHARE) * limit_nm + t.TORQUE_NM, (
        f"{measured_nm} N·m, limit is {limit_nm:.2f} N·m"
    )
    assert min(measured_nm) > (1 - t.TORQUE_SHARE) * limit_nm - t.TORQUE_NM, (
        f"{measured_nm} N·m does not use the limit of {limit_nm:.2f}"
    )


def test_a_torque_limit_of_zero_lets_nothing_move(rig: Rig) -> None:
    """In position mode, with a target that is far away."""
    rig.arm()
    asked = {i: (Mode.POSITION, rig.home_rad[i] + t.STEP_RAD) for i in range(rig.count)}
    before = np.array(rig.newest_joints.angle_rad)
    record = rig.drive(asked, rig.count_periods(t.CRUISE_S), torque_limit_nm=[0.0] * rig.count)
    moved = np.abs(record.angle_rad - before).max()
    assert moved < t.STILL_RAD, f"it moved by {moved:.3f} rad"


def test_no_joint_goes_beyond_its_limits(rig: Rig, pushing: Pushing) -> None:
    """Not even without the limiter, which would prevent it: pushed by torque and by speed, the stop holds."""
    for i, joint in enumerate(rig.robot.joints):
        angles = pushing.all.angle_rad[:, i]
        assert angles.max() < joint.angle_max_rad + t.OVERSHOOT_RAD, f"{joint.name}: {angles.max():.3f} rad"
        assert angles.min() > joint.angle_min_rad - t.OVERSHOOT_RAD, f"{joint.name}: {angles.min():.3f} rad"
