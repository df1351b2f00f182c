"""The record of the last start check in a robot file: who confirmed the joints, when, and on which drives.

The record is valid for the joints and the properties that were checked. If the file changes how a joint is mounted, or
another drive answers, the robot counts as not checked.
"""

import hashlib
from collections.abc import Sequence
from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import MAX_JOINTS, from_zero

# The controller of the start check; it may run on a robot that is not checked yet.
START_CHECK_CONTROLLER = "joint_check"
ShortText = Annotated[str, Meta(max_length=200)]
JointProperty = Literal["drive", "order", "sign", "gear", "zero"]
# Those that a start check confirms for every joint.
PROPERTIES: tuple[JointProperty, ...] = get_args(JointProperty)
JointNames = Annotated[list[ShortText], Meta(max_length=MAX_JOINTS)]

REMEDY = "check it again (docs/hardware/calibration.md)"


class StartCheckRecord(FileStruct, frozen=True, kw_only=True):
    """The section [checked], which `snakesim robot check` writes."""

    by: ShortText
    """Name of the person who checked the robot."""

    on: ShortText
    """Date of the check."""

    joints: ShortText
    """Digest of how the joints were mounted at the check. If it differs now, the record is not valid."""

    backend: ShortText
    """Backend that the robot was checked with."""

    hardware: ShortText = ""
    """Hardware of that backend, as it reports it. Empty: it does not report it."""

    serials: JointNames = []
    """Serial numbers of the drives, tail to head. Empty: the drives do not report them."""

    confirmed: Annotated[list[JointProperty], Meta(max_length=len(PROPERTIES))] = []
    """Properties that are confirmed for every joint. A robot can be armed only if all of them are."""

    by_hand: Annotated[dict[JointProperty, JointNames], Meta(max_length=len(PROPERTIES))] = {}
    """For each property, the joints for which a person confirmed it. For the others the check did."""

    by_shape: Annotated[list[JointProperty], Meta(max_length=len(PROPERTIES))] = []
    """Properties that drawn shapes confirmed for every joint (`snakesim robot shape check`)."""

    shaken: JointNames = []
    """Joints whose link a person shook, and found that it does not move before its drive. Shapes do not show that."""

    straight: bool = False
    """True: a person laid the robot straight, and the zeros were judged from that pose."""

    allowed_backlash_rad: Annotated[float, from_zero(0.5, "rad")] = 0.0
    """Backlash of a gear that the check allowed."""


def compute_mounting_digest(joints: Sequence[Joint]) -> str:
    """Return a digest of everything that the start check judges.

    It covers the order, axes, ids, buses, signs, zeros, gears and torque constants of the joints.
    """
    rows: list[tuple[str, str, int, Any, float | None]] = []
    for joint in joints:
        drive = msgspec.to_builtins(joint.drive)
        rows.append((joint.name, joint.axis, joint.id, drive, joint.motor.torque_constant_nm_per_a))
    encoded = msgspec.json.encode(rows, order="deterministic")
    return hashlib.sha256(encoded).hexdigest()[:16]


def find_unchecked_reason(
    checked: StartCheckRecord | None, joints: Sequence[Joint], robot: RobotDescription
) -> str:
    """Find the reason why a robot counts as not checked.

    Args:
        checked: Record of the last start check in the robot file. None if the robot was never checked.
        joints: Joints as the robot file describes them now.
        robot: Description from the host, with the serial numbers that the drives report now.

    Returns:
        The reason as a clause that follows the robot's name, or an empty text if the robot is checked or emulated.
    """
    if robot.emulated:
        return ""
    if checked is None:
        return "its joints have not been checked against its file: check them (docs/hardware/calibration.md)"
    changed_mounting = _describe_changed_mounting(checked, joints)
    if changed_mounting:
        return changed_mounting
    unconfirmed = [name for name in PROPERTIES if name not in checked.confirmed]
    if unconfirmed:
        return (
            f"the check by {checked.by} on {checked.on} did not confirm of every joint: {', '.join(unconfirmed)}: "
            f"{REMEDY}"
        )
    return _describe_changed_drives(checked, robot)


def find_change_since_check(
    checked: StartCheckRecord, joints: Sequence[Joint], robot: RobotDescription
) -> str:
    """Find what has changed since a check, so that what it confirmed is not valid any more.

    Args:
        checked: Record of the check.
        joints: Joints as the robot file describes them now.
        robot: Description from the host, with the serial numbers that the drives report now.

    Returns:
        The change as a clause that follows the robot's name, or an empty text if the check is still valid.
    """
    return _describe_changed_mounting(checked, joints) or _describe_changed_drives(checked, robot)


def _describe_changed_mounting(checked: StartCheckRecord, joints: Sequence[Joint]) -> str:
    """Return that the file describes joints as mounted in another way than at the check; otherwise an empty text."""
    if checked.joints == compute_mounting_digest(joints):
        return ""
    return f"how its joints are mounted was changed in its file {_format_since(checked)}: {REMEDY}"


def _describe_changed_drives(checked: StartCheckRecord, robot: RobotDescription) -> str:
    """Return which drives are others than at the check; an empty text if none is."""
    since = _format_since(checked)
    drives_report_serials = any(joint.serial for joint in robot.joints)
    if drives_report_serials or any(checked.serials):
        replaced = _describe_replaced_drives(checked, robot)
        if not replaced:
            return ""
        return f"{'; '.join(replaced)}: changed {since}: {REMEDY}"
    if (checked.backend, checked.hardware) != (robot.backend, robot.hardware):
        checked_on = f"{checked.backend} {checked.hardware}"
        now_on = f"{robot.backend} {robot.hardware}"
        return f"its drives do not report an identity, and it is on {now_on} now, {checked_on} {since}: {REMEDY}"
    return ""


def _format_since(checked: StartCheckRecord) -> str:
    return f"since {checked.by} checked it on {checked.on}"


def _describe_replaced_drives(checked: StartCheckRecord, robot: RobotDescription) -> list[str]:
    """Return a sentence for each joint whose drive has another serial number than at the check."""
    checked_serials = checked.serials or [""] * len(robot.joints)
    sentences: list[str] = []
    for joint, before in zip(robot.joints, checked_serials, strict=False):
        if joint.serial != before:
            sentences.append(
                f"{joint.name} has drive {joint.serial or 'unknown'}, and had {before or 'unknown'}"
            )
    return sentences
