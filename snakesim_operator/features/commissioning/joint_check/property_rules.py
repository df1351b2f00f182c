"""Rules for drive, order, sign and zero of a joint: whether they match the robot file, and what to do if not. Pure.

Each rule gets what was measured, and returns a finding with its sentence. The rules for the gear are in `gear_rules`.
"""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.checked import JointProperty
from snakesim_hal.model.robot_file.joints import JointDrive
from snakesim_operator.features.commissioning.joint_check.joint_verdict import (
    CONFIRMED,
    PropertyFinding,
)
from snakesim_operator.features.commissioning.joint_check.link_shares import MIN_RATE_RAD_S
from snakesim_operator.features.commissioning.joint_check.measurements import (
    CheckMeasurements,
    Mask,
)
from snakesim_operator.features.commissioning.tolerances import MAX_RATIO_ERROR

MIN_MOVED_RAD = 0.012  # a fifth of the default motion to one side
# Of its target's range and time; other joints move one without current at times.
MIN_FOLLOWED_FRACTION = 0.3
# Mean along the motion; a light link's inertia may be a tenth of it against the motion.
MIN_TORQUE_NM = 0.1
# Of an angle behind its target, so that the servo surely pushes in this direction.
MIN_LAG_RAD = 0.005
MAX_STRAIGHT_ERROR_RAD = 0.08  # a robot that was laid straight by hand is straight within that
MAX_GRAVITY_ERROR_RAD = 0.05  # accuracy of an angle from the direction of gravity
MIN_GRAVITY_M_S2 = 5.0  # across the axis of a joint; with less, gravity does not give its angle
NO_MOTION = "it did not move; correct its drive, and run the check again"
NO_END = (
    "its motion did not come: the run ended before; run the check again with a longer --duration"
)
NO_LINK_TURNS = "no link turns with it; correct its gear, and run the check again"
NO_LINK = (
    "the links on both sides need an IMU or motion capture, at 30 Hz or more; or check the robot with "
    "`snakesim robot shape check`; or "
)
CONFIRM_DIRECTION_BY_HAND = (
    NO_LINK + "turn it with `snakesim robot calibrate direction`, then add --by-hand"
)
ENCODER_STICKS = "its encoder has a dead zone; correct it, and run the check again"
NO_REST = "the robot did not rest before the first motion; run the check again"
NOT_STRAIGHT = "lay the robot straight, run the check again, and add --straight"


def has_followed_target(measurements: CheckMeasurements, joint_index: int) -> bool:
    """Return whether a joint's encoder followed its target."""
    commanded = measurements.is_in_large_motion(joint_index)
    if not commanded.any():
        return False
    target_range_rad = float(np.ptp(measurements.target_rad[commanded, joint_index]))
    is_moving = np.abs(measurements.velocity_rad_s[commanded, joint_index]) > MIN_RATE_RAD_S
    moved_far_enough = measurements.measure_motion_range_rad(joint_index) >= max(
        MIN_MOVED_RAD, MIN_FOLLOWED_FRACTION * target_range_rad
    )
    moved_long_enough = bool(np.mean(is_moving) >= MIN_FOLLOWED_FRACTION)
    return moved_far_enough and moved_long_enough


def compute_mean_driving_torque_nm(
    measurements: CheckMeasurements, joint_index: int
) -> float | None:
    """Return the mean of a joint's torque, positive where it drives; None if it is not measured."""
    velocity = measurements.velocity_rad_s[:, joint_index]
    is_moving = measurements.is_in_large_motion(joint_index) & (np.abs(velocity) > MIN_RATE_RAD_S)
    if "torque" not in measurements.drives[joint_index].measures or not is_moving.any():
        return None
    return float(
        np.mean(measurements.torque_nm[is_moving, joint_index] * np.sign(velocity[is_moving]))
    )


def list_torques_towards_target(measurements: CheckMeasurements, joint_index: int) -> Floats:
    """Return a joint's torques while it was behind its target, (n,); positive if they point towards the target.

    Those of a sound drive do, also if the load is so large that the joint is moved against them.
    """
    lag_rad = measurements.target_rad[:, joint_index] - measurements.angle_rad[:, joint_index]
    is_lagging = measurements.is_in_large_motion(joint_index) & (np.abs(lag_rad) > MIN_LAG_RAD)
    return measurements.torque_nm[is_lagging, joint_index] * np.sign(lag_rad[is_lagging])


def judge_drive(
    measurements: CheckMeasurements,
    joint_index: int,
    torque_nm: float | None,
    dead_zone_rad: float | None,
) -> PropertyFinding:
    """Judge whether a joint's drive moves it, and measures its angle.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint.
        torque_nm: Mean torque along the motion; None if it is not measured.
        dead_zone_rad: Dead zone of its encoder; None if it has none.
    """
    if not measurements.is_in_large_motion(joint_index).any():
        return PropertyFinding("unknown", NO_END)
    if dead_zone_rad is not None:
        return PropertyFinding(
            "wrong",
            f"its encoder has a dead zone: its angle sticks, and then jumps by {dead_zone_rad:.3f} rad "
            f"({np.rad2deg(dead_zone_rad):.1f} degrees); fasten the encoder and its magnet, or replace it",
        )
    if not has_followed_target(measurements, joint_index):
        return PropertyFinding("wrong", _describe_stuck_joint(measurements, joint_index))
    is_braking = torque_nm is not None and torque_nm < -MIN_TORQUE_NM
    # A load may push a sound joint back; its torque points towards the target all the same.
    if is_braking and np.sum(list_torques_towards_target(measurements, joint_index)) <= 0.0:
        return PropertyFinding(
            "wrong", "its torque has the wrong sign: it measures a brake while it drives"
        )
    return CONFIRMED


def _describe_stuck_joint(measurements: CheckMeasurements, joint_index: int) -> str:
    """Return that a joint did not move, and whether its motor pushed."""
    measures_torque = "torque" in measurements.drives[joint_index].measures
    torques_nm = list_torques_towards_target(measurements, joint_index)
    max_torque_nm = float(np.max(torques_nm, initial=0.0))
    if measures_torque and max_torque_nm >= MIN_TORQUE_NM:
        return (
            f"did not move, although its motor pushed with up to {max_torque_nm:.2f} N·m: a brake, a link that is "
            "held, or a load that is too heavy"
        )
    return "did not move: motor, brake, power, or a link that is held"


def make_swapped_findings(joint: str, other: str) -> dict[JointProperty, PropertyFinding]:
    """Return the findings on a joint whose module is swapped with that of another joint: the order is wrong.

    Args:
        joint: Name of the joint.
        other: Name of the joint whose link it moves.
    """
    unknown = PropertyFinding(
        "unknown", f"judged once the ids of {joint} and {other} are right; run the check again then"
    )
    return {
        "order": PropertyFinding(
            "wrong", f"moves the link of {other}: their ids or cables are swapped"
        ),
        "sign": unknown,
        "gear": unknown,
        "zero": unknown,
    }


def make_unmoved_finding(
    measurements: CheckMeasurements, joint_index: int, dead_zone_rad: float | None
) -> PropertyFinding:
    """Return the finding on a property that a joint cannot show, as its encoder did not measure its motion.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint.
        dead_zone_rad: Dead zone of its encoder; None if it has none.
    """
    if dead_zone_rad is not None:
        return PropertyFinding("unknown", ENCODER_STICKS)
    if measurements.is_in_large_motion(joint_index).any():
        return PropertyFinding("unknown", NO_MOTION)
    return PropertyFinding("unknown", NO_END)


def judge_order(motion_ratio: float, candidates: Sequence[str]) -> PropertyFinding:
    """Judge whether a joint's module is in its place. `candidates` are joints whose modules may be there instead."""
    if abs(motion_ratio) < MAX_RATIO_ERROR:
        return PropertyFinding("unknown", NO_LINK_TURNS)
    if candidates:
        return PropertyFinding(
            "unknown",
            f"its module may be exchanged with that of {', '.join(candidates)}: {CONFIRM_DIRECTION_BY_HAND}",
        )
    return CONFIRMED


def judge_sign(motion_ratio: float, drive: JointDrive) -> PropertyFinding:
    """Judge whether a joint's links turn in the direction in which its encoder counts."""
    if np.isnan(motion_ratio):
        return PropertyFinding("unknown", CONFIRM_DIRECTION_BY_HAND)
    if abs(motion_ratio) < MAX_RATIO_ERROR:
        return PropertyFinding("unknown", NO_LINK_TURNS)
    if motion_ratio < 0:
        return PropertyFinding("wrong", f"turns the other way: sign = {-drive.sign}")
    return CONFIRMED


def judge_zero(
    measurements: CheckMeasurements, joint_index: int, *, was_laid_straight: bool
) -> PropertyFinding:
    """Judge whether the zero of a joint's angle in the robot file is right.

    If accelerometers measure the joint's angle by gravity, the encoder is compared with it. Otherwise it is compared
    with zero, if the robot was laid straight.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint.
        was_laid_straight: Whether a person states that the robot lay straight at the start.

    Returns:
        Confirmed, wrong with the zero to write into the robot file, or unknown with the reason.
    """
    at_rest = measurements.is_at_rest()
    before_motion = measurements.is_before_motion()
    angle_by_gravity_rad = None
    if measurements.axes[joint_index] == "pitch":
        angle_by_gravity_rad = _measure_angle_by_gravity_rad(measurements, joint_index, at_rest)
    if angle_by_gravity_rad is not None:
        error_rad = (
            float(np.mean(measurements.angle_rad[at_rest, joint_index])) - angle_by_gravity_rad
        )
        allowed_rad = MAX_GRAVITY_ERROR_RAD
    elif not was_laid_straight:
        return PropertyFinding("unknown", NOT_STRAIGHT)
    elif not before_motion.any():
        return PropertyFinding("unknown", NO_REST)
    else:
        error_rad = float(np.mean(measurements.angle_rad[before_motion, joint_index]))
        allowed_rad = MAX_STRAIGHT_ERROR_RAD
    if abs(error_rad) <= allowed_rad:
        return CONFIRMED
    drive = measurements.drives[joint_index]
    zero_rad = drive.zero_rad + drive.sign * drive.gear * error_rad
    return PropertyFinding(
        "wrong", f"its zero is off by {error_rad:+.3f} rad: zero_rad = {zero_rad:.3f}"
    )


def _measure_angle_by_gravity_rad(
    measurements: CheckMeasurements, joint_index: int, at_rest: Mask
) -> float | None:
    """Return a pitch joint's angle from the direction of gravity in both of its links; None if that is not known."""
    tilts_rad: list[float] = []
    for link in (joint_index, joint_index + 1):
        forces_m_s2 = measurements.link_force_m_s2[at_rest, link]
        known_forces_m_s2 = forces_m_s2[~np.isnan(forces_m_s2[:, 0])]
        if not len(known_forces_m_s2):
            return None
        x, _, z = np.mean(known_forces_m_s2, axis=0)
        if np.hypot(x, z) <= MIN_GRAVITY_M_S2:
            return None
        tilts_rad.append(float(np.arctan2(x, z)))
    difference_rad = tilts_rad[0] - tilts_rad[1]
    return float(np.arctan2(np.sin(difference_rad), np.cos(difference_rad)))
