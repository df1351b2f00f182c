"""Limits that the motor itself enforces."""

import numpy as np

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.recordings import PushRecording
from snakesim_testing.contract.rig import BackendRig


def test_the_torque_limit_of_the_setpoints_is_kept(rig: BackendRig, pushing: PushRecording) -> None:
    """A joint that pushes against its end stop has the torque limit of its setpoints as torque, and no more."""
    rig.skip_without(torque=True)
    measured_nm = abs(pushing.torque_limited.torque_nm[-1, :2])
    limit_nm = pushing.limit_nm
    assert (
        max(measured_nm)
        < (1 + tolerances.TORQUE_TOLERANCE_FRACTION) * limit_nm + tolerances.TORQUE_TOLERANCE_NM
    ), f"the measured torque {measured_nm} N·m exceeds the limit of {limit_nm:.2f} N·m"
    assert (
        min(measured_nm)
        > (1 - tolerances.TORQUE_TOLERANCE_FRACTION) * limit_nm - tolerances.TORQUE_TOLERANCE_NM
    ), f"the measured torque {measured_nm} N·m does not reach the limit of {limit_nm:.2f} N·m"


def test_a_torque_limit_of_zero_lets_nothing_move(rig: BackendRig) -> None:
    """With a torque limit of zero, no joint moves toward a position target that is far away."""
    rig.arm()
    targets = {
        i: (JointMode.POSITION, rig.home_rad[i] + tolerances.STEP_RAD)
        for i in range(rig.joint_count)
    }
    start_angles_rad = np.array(rig.newest_joints.angle_rad)
    record = rig.command_joints(
        targets,
        rig.count_periods(tolerances.MOTION_DURATION_S),
        torque_limit_nm=[0.0] * rig.joint_count,
    )
    moved_rad = np.abs(record.angle_rad - start_angles_rad).max()
    assert moved_rad < tolerances.STANDSTILL_RAD, (
        f"a joint without torque moved by {moved_rad:.3f} rad"
    )


def test_no_joint_goes_beyond_its_limits(rig: BackendRig, pushing: PushRecording) -> None:
    """Joints that are driven against their end stops without the command limiter do not move beyond their limits."""
    for i, joint in enumerate(rig.robot.joints):
        angles = pushing.whole_record.angle_rad[:, i]
        assert angles.max() < joint.angle_max_rad + tolerances.MAX_OVERSHOOT_RAD, (
            f"{joint.name} was at {angles.max():.3f} rad, beyond its upper limit"
        )
        assert angles.min() > joint.angle_min_rad - tolerances.MAX_OVERSHOOT_RAD, (
            f"{joint.name} was at {angles.min():.3f} rad, beyond its lower limit"
        )
