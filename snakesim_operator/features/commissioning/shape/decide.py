"""Decides from the encoders of a robot in drawn shapes how its joints are mounted. Pure.

The readings of a drive, converted to joint angles by the robot file, are in every pose

    scale * reading + shift = drawn angle + placement error

where scale is 1 and shift is 0 if the file is right. The sign of `scale` is that of the drive, its size is the error of
the gear, and `shift` is that of the zero. The placement error is at most the tolerance. So the scales and shifts that
are possible are known exactly. No probability is involved: a joint that is right, and placed within the tolerance, is
never reported as wrong.

Order and sign are decided for any gear and zero. Of gear and zero, the fewest errors that explain the readings are
reported. If one error of either explains them, both are unknown.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.checked import JointProperty
from snakesim_hal.model.robot_file.joints import Joint, JointDrive
from snakesim_operator.features.commissioning.joint_check.joint_verdict import (
    CONFIRMED,
    PropertyFinding,
    PropertyState,
)
from snakesim_operator.features.commissioning.shape.design import PLACEMENT_TOLERANCE_RAD, ShapePose
from snakesim_operator.features.commissioning.tolerances import MAX_RATIO_ERROR

# That drawn shapes decide.
SHAPE_PROPERTIES: tuple[JointProperty, ...] = "order", "sign", "gear", "zero"
# Tolerances by which a drawn joint bends at least; with less, its sign would not be certain.
MIN_SPAN_TOLERANCES = 4
MIN_READING_CHANGE_RAD = 1e-6  # encoders that change less do not move
MAX_ERROR_RAD = 7.0  # of a search for the placement error that would explain readings
ERROR_STEP_RAD = 1e-3  # accuracy of that search


@dataclass(frozen=True)
class ShapeVerdict:
    """The findings on one joint."""

    joint: str
    findings: Mapping[JointProperty, PropertyFinding]  # of `SHAPE_PROPERTIES`

    def list_properties(self, state: PropertyState) -> list[JointProperty]:
        """Return the properties in this state."""
        return [name for name in SHAPE_PROPERTIES if self.findings[name].state == state]

    @property
    def all_confirmed(self) -> bool:
        """Whether every property was confirmed."""
        return all(finding.state == "confirmed" for finding in self.findings.values())


def judge_shapes(
    joints: Sequence[Joint],
    poses: Sequence[ShapePose],
    reading_rad: Floats,
    tolerance_rad: float = PLACEMENT_TOLERANCE_RAD,
) -> list[ShapeVerdict]:
    """Judge order, sign, gear and zero of every joint.

    Args:
        joints: Joints of the robot file, tail to head.
        poses: Poses of the check, with the straight one.
        reading_rad: Joint angles as the robot file computes them from the encoders, (n_poses, n_joints).
        tolerance_rad: Largest placement error of a joint in a pose.

    Returns:
        One verdict for each joint, tail to head.
    """
    drawn_rad = np.array([pose.angle_rad for pose in poses])
    judge = _ShapeJudge(joints, drawn_rad, reading_rad, tolerance_rad)
    return [judge.judge_joint(i) for i in range(len(joints))]


def find_placement_hint(verdicts: Sequence[ShapeVerdict]) -> str:
    """Return what the person may have done if every joint counts the other way; an empty text if not."""
    if len(verdicts) > 1 and all(verdict.findings["sign"].state == "wrong" for verdict in verdicts):
        return "every joint counts the other way: check that the top of the robot is up, and its head at the arrow"
    return ""


class _ShapeJudge:
    """Judges the joints of one robot. Indices of drives are those of the joints that the file gives them."""

    def __init__(
        self, joints: Sequence[Joint], drawn_rad: Floats, reading_rad: Floats, tolerance_rad: float
    ) -> None:
        """Find the joint that each drive measures.

        Args:
            joints: Joints of the robot file, tail to head.
            drawn_rad: Drawn angles, (n_poses, n_joints).
            reading_rad: Measured angles, (n_poses, n_joints).
            tolerance_rad: Largest placement error of a joint in a pose.
        """
        self._joints = joints
        self._drawn_rad = drawn_rad
        self._reading_rad = reading_rad
        self._tolerance_rad = tolerance_rad
        self._candidates = [self._list_candidates(drive) for drive in range(len(joints))]
        certain = [options[0] if len(options) == 1 else None for options in self._candidates]
        self._joint_by_drive = [None if certain.count(joint) > 1 else joint for joint in certain]

    def judge_joint(self, i: int) -> ShapeVerdict:
        """Judge one joint, from the readings of the drive that is really on it."""
        joint = self._joints[i]
        order = self._judge_order(i)
        if i not in self._joint_by_drive:
            unknown = PropertyFinding("unknown", "judged once its order is known")
            if not self._is_bent_far_enough(i):
                unknown = order
            return ShapeVerdict(
                joint.name, {"order": order, "sign": unknown, "gear": unknown, "zero": unknown}
            )
        drive = self._joint_by_drive.index(i)
        reading_rad = _convert_readings(self._joints[drive], joint, self._reading_rad[:, drive])
        mounting = judge_mounting(
            joint.drive, self._drawn_rad[:, i], reading_rad, self._tolerance_rad
        )
        return ShapeVerdict(joint.name, {"order": order, **mounting})

    # --- order ---------------------------------------------------------------------------------------------------

    def _list_candidates(self, drive: int) -> list[int]:
        """Return the joints whose drawn angles a drive may have measured, whatever its sign, gear and zero are."""
        candidates: list[int] = []
        for j in range(len(self._joints)):
            # A joint that bends little looks like others with a wrong gear. It is compared with its own drive only.
            is_comparable = self._is_bent_far_enough(j) if j == drive else self._is_gear_decided(j)
            scales = _find_scales(
                self._drawn_rad[:, j], self._reading_rad[:, drive], self._tolerance_rad
            )
            if is_comparable and scales is not None:
                candidates.append(j)
        return candidates

    def _is_bent_far_enough(self, i: int) -> bool:
        span_rad = float(np.ptp(self._drawn_rad[:, i]))
        return span_rad > MIN_SPAN_TOLERANCES * self._tolerance_rad

    def _is_gear_decided(self, i: int) -> bool:
        return (
            _compute_gear_resolution(self._drawn_rad[:, i], self._tolerance_rad) <= MAX_RATIO_ERROR
        )

    def _judge_order(self, i: int) -> PropertyFinding:
        """Judge whether the drive that the file gives joint `i` is on joint `i`."""
        measured = self._joint_by_drive[i]
        if measured == i:
            return CONFIRMED
        if measured is not None:
            return PropertyFinding("wrong", self._describe_exchange(i, measured))
        return PropertyFinding("unknown", self._explain_unknown_order(i))

    def _explain_unknown_order(self, i: int) -> str:
        """Return why it is unknown which joint the drive of joint `i` measures."""
        candidates = self._candidates[i]
        if len(candidates) > 1:
            names = " and ".join(self._joints[j].name for j in candidates)
            return f"its readings fit {names}, which bend too little to be distinguished"
        if candidates:
            rivals = [j for j, options in enumerate(self._candidates) if options == candidates]
            names = " and ".join(self._joints[j].name for j in rivals)
            return (
                f"{names} all measure {self._joints[candidates[0]].name}: look at ids and encoders"
            )
        if not self._is_bent_far_enough(i):
            span_rad = float(np.ptp(self._drawn_rad[:, i]))
            return (
                f"its limits let the shapes bend it by {span_rad:.2f} rad, and more than "
                f"{MIN_SPAN_TOLERANCES * self._tolerance_rad:.2f} rad are needed; turn it by hand"
            )
        if np.ptp(self._reading_rad[:, i]) < MIN_READING_CHANGE_RAD:
            return "its angle never changed: look at encoder, cable and coupling"
        error_rad = _compute_needed_error_rad(self._drawn_rad[:, i], self._reading_rad[:, i])
        return (
            f"its readings fit no joint: here it would be {error_rad:.2f} rad off the drawing, and "
            f"{self._tolerance_rad:.2f} rad are allowed; place the shapes again, and look at its coupling"
        )

    def _describe_exchange(self, i: int, measured: int) -> str:
        """Return which joint the drive of joint `i` measured, and which id joint `i` should have."""
        name = self._joints[measured].name
        if self._joint_by_drive[measured] == i:
            return f"exchanged with {name}: {_describe_address(self._joints[i], self._joints[measured])}"
        if i not in self._joint_by_drive:
            return f"its drive is on {name}, and it is unknown which drive is here"
        right_drive = self._joints[self._joint_by_drive.index(i)]
        address = _describe_address(self._joints[i], right_drive)
        return f"its drive is on {name}, and that of {right_drive.name} is here: {address}"


def _describe_address(joint: Joint, right_drive: Joint) -> str:
    """Return the id that a joint should have in the file, with the port if that changes, too."""
    if joint.drive.port == right_drive.drive.port:
        return f"id = {right_drive.id}"
    return f'id = {right_drive.id}, port = "{right_drive.drive.port}"'


def _convert_readings(described: Joint, joint: Joint, reading_rad: Floats) -> Floats:
    """Convert angles that one joint's section of the file has computed to those by another joint's section."""
    if described is joint:
        return reading_rad
    drive_angle_rad = DriveMounting([described]).to_drive_angle_rad(reading_rad[:, None])
    return DriveMounting([joint]).to_joint_angle_rad(drive_angle_rad)[:, 0]


# --- sign, gear and zero -----------------------------------------------------------------------------------------


def judge_mounting(
    drive: JointDrive, drawn_rad: Floats, reading_rad: Floats, tolerance_rad: float
) -> dict[JointProperty, PropertyFinding]:
    """Judge sign, gear and zero of a drive that is known to be on its joint.

    Args:
        drive: The drive as the robot file has it.
        drawn_rad: Drawn angles of the joint, (n_poses,).
        reading_rad: Its measured angles, (n_poses,).
        tolerance_rad: Largest placement error.
    """
    scales = _find_scales(drawn_rad, reading_rad, tolerance_rad)
    if scales is None:
        raise ValueError("the drive is on another joint")
    direction = 1.0 if sum(scales) > 0 else -1.0
    sign = CONFIRMED
    if direction < 0:
        sign = PropertyFinding("wrong", f"turns the other way: sign = {-drive.sign}")
    turned_rad = direction * reading_rad  # as the right sign would measure it

    shift_of_right_gear_rad = drawn_rad - turned_rad
    zero_explains_all = bool(np.ptp(shift_of_right_gear_rad) <= 2 * tolerance_rad)
    scales_of_right_zero = _intersect_scales(drawn_rad, turned_rad, tolerance_rad)
    gear_explains_all = scales_of_right_zero is not None
    if bool((np.abs(shift_of_right_gear_rad) <= tolerance_rad).all()):
        return {"sign": sign, "gear": _confirm_gear(drawn_rad, tolerance_rad), "zero": CONFIRMED}
    if zero_explains_all and gear_explains_all:
        either = PropertyFinding(
            "unknown", "a wrong zero or a wrong gear explains its readings; place the shapes again"
        )
        return {"sign": sign, "gear": either, "zero": either}
    if zero_explains_all:
        gear = _confirm_gear(drawn_rad, tolerance_rad)
        shift_rad = _get_middle(shift_of_right_gear_rad)
        return {"sign": sign, "gear": gear, "zero": _report_zero(drive, direction, shift_rad)}
    if scales_of_right_zero is not None:
        scale = direction * sum(scales_of_right_zero) / 2
        return {"sign": sign, "gear": _report_gear(drive, scale), "zero": CONFIRMED}
    scale = sum(scales) / 2
    shift_rad = _get_middle(drawn_rad - scale * reading_rad)
    return {
        "sign": sign,
        "gear": _report_gear(drive, scale),
        "zero": _report_zero(drive, scale, shift_rad),
    }


def _confirm_gear(drawn_rad: Floats, tolerance_rad: float) -> PropertyFinding:
    """Return that a gear is confirmed, or that the drawn angles are too small for that."""
    span_rad = float(np.ptp(drawn_rad))
    resolution = _compute_gear_resolution(drawn_rad, tolerance_rad)
    if resolution <= MAX_RATIO_ERROR:
        return CONFIRMED
    return PropertyFinding(
        "unknown",
        f"its limits let the shapes bend it by {span_rad:.2f} rad, which gives its gear to {resolution:.0%}, and "
        f"{MAX_RATIO_ERROR:.0%} are needed; measure it with `snakesim robot calibrate gear`",
    )


def _compute_gear_resolution(drawn_rad: Floats, tolerance_rad: float) -> float:
    """Return the relative error of a gear that the placement errors of two poses cause, at most."""
    span_rad = float(np.ptp(drawn_rad))
    return 2 * tolerance_rad / span_rad if span_rad > 0 else np.inf


def _report_gear(drive: JointDrive, scale: float) -> PropertyFinding:
    ratio = abs(scale)
    return PropertyFinding(
        "wrong", f"turns {ratio:.2f} as far as its drive measures: gear = {drive.gear / ratio:.3g}"
    )


def _report_zero(drive: JointDrive, scale: float, shift_rad: float) -> PropertyFinding:
    error_rad = -shift_rad / scale  # the reading of the joint at its zero
    zero_rad = drive.zero_rad + drive.sign * drive.gear * error_rad
    return PropertyFinding(
        "wrong", f"its zero is off by {error_rad:+.3f} rad: zero_rad = {zero_rad:.3f}"
    )


def _get_middle(values: Floats) -> float:
    return float(values.max() + values.min()) / 2


# --- scales that are possible ------------------------------------------------------------------------------------


def _find_scales(
    drawn_rad: Floats, reading_rad: Floats, tolerance_rad: float
) -> tuple[float, float] | None:
    """Find the scales with which readings are drawn angles within the tolerance, for some shift.

    A shift exists if the differences of all pairs of poses agree within twice the tolerance.

    Returns:
        The lowest and the highest scale; None if there is none.
    """
    first, second = np.array(list(itertools.combinations(range(len(drawn_rad)), 2))).T
    return _intersect_scales(
        drawn_rad[first] - drawn_rad[second],
        reading_rad[first] - reading_rad[second],
        2 * tolerance_rad,
    )


def _intersect_scales(
    drawn_rad: Floats, reading_rad: Floats, max_error_rad: float
) -> tuple[float, float] | None:
    """Find the scales with |scale * reading - drawn| <= max_error for all poses: lowest and highest; None if none."""
    is_zero = np.abs(reading_rad) < MIN_READING_CHANGE_RAD
    if (np.abs(drawn_rad[is_zero]) > max_error_rad).any():
        return None
    drawn_rad = drawn_rad[~is_zero]
    reading_rad = reading_rad[~is_zero]
    bounds = np.stack(
        ((drawn_rad - max_error_rad) / reading_rad, (drawn_rad + max_error_rad) / reading_rad)
    )
    lowest = float(bounds.min(axis=0).max(initial=-np.inf))
    highest = float(bounds.max(axis=0).min(initial=np.inf))
    return (lowest, highest) if lowest <= highest else None


def _compute_needed_error_rad(drawn_rad: Floats, reading_rad: Floats) -> float:
    """Return the smallest placement error with which readings are drawn angles, for some scale and shift."""
    low_rad = 0.0
    high_rad = MAX_ERROR_RAD
    while high_rad - low_rad > ERROR_STEP_RAD:
        middle_rad = (low_rad + high_rad) / 2
        if _find_scales(drawn_rad, reading_rad, middle_rad) is None:
            low_rad = middle_rad
        else:
            high_rad = middle_rad
    return high_rad
