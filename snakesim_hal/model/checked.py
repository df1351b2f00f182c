"""What a robot file says of the last start check: who found its joints as the file says, when, and on which drives.

It counts for the joints and the properties that were judged: once the file says otherwise of how a joint is mounted, or
another drive answers, the robot counts as not checked.
"""

import hashlib
from collections.abc import Sequence
from typing import Annotated, Literal, get_args

import msgspec
from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.joints import Joint
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import MAX_JOINTS, from_zero

CHECK = "joint_check"  # the controller of the start check: what it is for needs no check before
Words = Annotated[str, Meta(max_length=200)]
JointProperty = Literal["drive", "order", "sign", "gear", "zero"]
PROPERTIES: tuple[JointProperty, ...] = get_args(JointProperty)  # of every joint, that a start check judges
JointNames = Annotated[list[Words], Meta(max_length=MAX_JOINTS)]


class Checked(FileStruct, frozen=True, kw_only=True):
    """The section [checked], which `snakesim joints check` writes."""

    by: Words
    on: Words  # date
    joints: Words  # digest of how they are mounted
    backend: Words
    hardware: Words = ""
    serials: JointNames = []  # tail to head; empty: the drive does not say it
    # Properties that were confirmed of every joint: by the check, but for those of `by_hand`. All are needed to arm.
    confirmed: Annotated[list[JointProperty], Meta(max_length=len(PROPERTIES))] = []
    by_hand: Annotated[dict[JointProperty, JointNames], Meta(max_length=len(PROPERTIES))] = {}  # -> joints
    straight: bool = False  # zeros were judged from the pose in which a person laid the robot
    allowed_backlash_rad: Annotated[float, from_zero(0.5, "rad")] = 0.0  # of every gear


def mounting_digest(joints: Sequence[Joint]) -> str:
    """Of what the start check judges: order, axes, ids, buses, signs, zeros, gears, torque constants."""
    rows = [
        (joint.name, joint.axis, joint.id, msgspec.to_builtins(joint.drive), joint.motor.torque_constant_nm_per_a)
        for joint in joints
    ]
    return hashlib.sha256(msgspec.json.encode(rows, order="deterministic")).hexdigest()[:16]


def why_unchecked(checked: Checked | None, joints: Sequence[Joint], robot: Description) -> str:
    """Why this robot, as it is now, counts as not checked; empty: it was, or nothing real moves."""
    if robot.emulated:
        return ""
    again = "check it again (docs/commissioning.md)"
    if checked is None:
        return "nobody has checked that its joints are as its file says: do so (docs/commissioning.md)"
    since = f"since {checked.by} checked it on {checked.on}"
    if checked.joints != mounting_digest(joints):
        return f"how its joints are mounted was changed in its file {since}: {again}"
    if missing := [name for name in PROPERTIES if name not in checked.confirmed]:
        return (
            f"the check by {checked.by} on {checked.on} did not confirm of every joint: {', '.join(missing)}: {again}"
        )
    serials = [joint.serial for joint in robot.joints]
    if any(serials) or any(checked.serials):
        pairs = zip(robot.joints, checked.serials or [""] * len(serials), strict=False)
        others = [
            f"{joint.name} has drive {joint.serial or 'unknown'}, and had {before or 'unknown'}"
            for joint, before in pairs
            if joint.serial != before
        ]
        return f"{'; '.join(others)}: changed {since}: {again}" if others else ""
    if (checked.backend, checked.hardware) != (robot.backend, robot.hardware):
        there, here = f"{checked.backend} {checked.hardware}", f"{robot.backend} {robot.hardware}"
        return f"its drives do not say who they are, and it is on {here} now, {there} {since}: {again}"
    return ""
