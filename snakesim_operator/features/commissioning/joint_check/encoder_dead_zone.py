"""Finds encoders with a dead zone: the angle sticks while the shaft moves, and then jumps to it. Pure."""

import numpy as np

from snakesim_operator.features.commissioning.joint_check.measurements import CheckMeasurements

MIN_JUMP_RAD = 0.006  # larger than a step of any encoder that a joint should have
MIN_SPEED_RATIO = 2.0  # of a jump to the largest step of the target in the same motion
STICKING_TICKS = 3  # before a jump
MAX_STICKING_FRACTION = 0.2  # of the jump, by which an angle that sticks may change
MIN_JUMPS = 3  # fewer may be samples that arrived late


def find_dead_zone_rad(measurements: CheckMeasurements, joint_index: int) -> float | None:
    """Return the dead zone of a joint's encoder, as the median of its jumps; None if it does not jump."""
    angle_rad = measurements.angle_rad[:, joint_index]
    target_steps_rad = np.abs(np.diff(measurements.target_rad[:, joint_index]))
    steps_rad = np.diff(angle_rad)
    jumps_rad: list[float] = []
    for motion in measurements.list_motions(joint_index):
        if motion.stop - motion.start < 2:
            continue  # the angle jumped so far in the first tick that the motion was over
        max_target_step_rad = float(np.max(target_steps_rad[motion.start : motion.stop - 1]))
        min_jump_rad = max(MIN_JUMP_RAD, MIN_SPEED_RATIO * max_target_step_rad)
        for tick in range(max(motion.start, STICKING_TICKS), motion.stop - 1):
            jump_rad = abs(float(steps_rad[tick]))
            range_before_jump_rad = float(np.ptp(angle_rad[tick - STICKING_TICKS : tick + 1]))
            if (
                jump_rad >= min_jump_rad
                and range_before_jump_rad <= MAX_STICKING_FRACTION * jump_rad
            ):
                jumps_rad.append(jump_rad)
    if len(jumps_rad) < MIN_JUMPS:
        return None
    return float(np.median(jumps_rad))
