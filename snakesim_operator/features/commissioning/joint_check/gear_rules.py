"""Rules for the gear of a joint: ratio, backlash and coupling, by the motion of its links or by torques. Pure."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from snakesim_hal.model.robot_file.joints import JointDrive
from snakesim_operator.features.commissioning.joint_check.gear_play import GearPlay
from snakesim_operator.features.commissioning.joint_check.joint_verdict import (
    CONFIRMED,
    PropertyFinding,
)
from snakesim_operator.features.commissioning.joint_check.lost_motion import HeldMotion, LostMotion
from snakesim_operator.features.commissioning.joint_check.property_rules import NO_LINK
from snakesim_operator.features.commissioning.tolerances import MAX_RATIO_ERROR

IS_LOOSE = "its gear or coupling is loose"  # which of them is not clear
FASTEN_COUPLING = "fasten the coupling, and check the gear"
SHAKE_LINK = "shake the link, then add --gear-by-hand"
CONFIRM_GEAR_BY_HAND = NO_LINK + f"measure it with `snakesim robot calibrate gear`, {SHAKE_LINK}"
NO_BACKLASH = "no backlash above"  # and then the angle above which the torque excludes it
# By how much of its ratio a link follows the small motion of its drive. Behind a coupling that slips, it follows nearly
# all of it, and within backlash nearly nothing. In between, the teeth may have touched for a part of the motion.
MIN_FRACTION_BEHIND_COUPLING = 0.8
MAX_FRACTION_WITHIN_BACKLASH = 0.5
NO_LOST_MOTION = (
    "the motions of its link and its drive fit no ratio: it moved too little or to one side only, its gyros are noisy "
    "or silent, or its coupling slips"
)


@dataclass(frozen=True)
class LinkMotions:
    """The motions of a joint's links by their gyros, compared with those of its drive by its encoder."""

    motion_ratio: float  # motion of the links divided by that of the drive, with its sign
    lost_motion: LostMotion | None  # while the joint moved; None if it could not be measured
    held_motions: Sequence[HeldMotion]  # while its drive held still
    small_motion_ratio: float | None  # as `motion_ratio`, in the small motion; None if not measured
    # Whether the torque of other joints changes with the direction of its motions.
    passes_torque_on: bool

    @property
    def tooth_ratio(self) -> float:
        """Ratio of link and drive while the teeth touch. Backlash reduces `motion_ratio`, so the larger one counts."""
        if self.lost_motion is None:
            return self.motion_ratio
        return max(self.motion_ratio, self.lost_motion.ratio, key=abs)

    @property
    def followed_fraction(self) -> float | None:
        """How much of the small motion the link followed, 0 to about 1; None if not measured."""
        if self.small_motion_ratio is None:
            return None
        # Without the ratio of the teeth, that of the robot file counts.
        ratio = 1.0 if self.lost_motion is None else self.lost_motion.ratio
        return abs(self.small_motion_ratio / ratio)

    def find_largest_held_motion(self, allowed_backlash_rad: float) -> HeldMotion | None:
        """Return the largest motion of the links while the drive held still, a certain one if there is any.

        Args:
            allowed_backlash_rad: A motion counts only if it is larger.
        """
        return max(
            (held for held in self.held_motions if held.turned_rad > allowed_backlash_rad),
            key=lambda held: (held.is_certain, held.turned_rad),
            default=None,
        )


def judge_gear_by_links(
    motions: LinkMotions, drive: JointDrive, allowed_backlash_rad: float
) -> PropertyFinding:
    """Judge whether a joint's links turn as far as its encoder measures.

    Args:
        motions: Motions of the links.
        drive: The drive as the robot file has it.
        allowed_backlash_rad: Largest backlash that is not judged as wrong.
    """
    if abs(motions.motion_ratio) < MAX_RATIO_ERROR:
        return _judge_motionless_link(motions)
    lost = motions.lost_motion
    if lost is not None and lost.lost_rad > max(allowed_backlash_rad, lost.noise_rad):
        return _judge_lost_motion(motions, lost, drive, allowed_backlash_rad)
    held = motions.find_largest_held_motion(allowed_backlash_rad)
    if held is not None and held.is_certain:
        return _judge_held_motion(motions, held)
    if wrong_ratio := _describe_wrong_ratio(motions.tooth_ratio, drive):
        other_cause = ""
        if lost is None:
            other_cause = f"; or it has backlash, which was not measured, as {NO_LOST_MOTION}"
        return PropertyFinding("wrong", wrong_ratio + other_cause)
    if lost is None:
        return PropertyFinding("unknown", f"backlash unknown, as {NO_LOST_MOTION}: {SHAKE_LINK}")
    if lost.noise_rad > allowed_backlash_rad:
        return PropertyFinding(
            "unknown",
            f"backlash unknown, as the noise of gyros and encoder allows {lost.noise_rad:.3f} rad, and "
            f"{allowed_backlash_rad:g} rad are allowed: {SHAKE_LINK}",
        )
    if held is not None:
        return PropertyFinding(
            "unknown",
            f"coupling unknown, as {_describe_held_motion(held)}, and the noise of gyros and encoder allows "
            f"{held.noise_rad:.3f} rad: {SHAKE_LINK}",
        )
    return CONFIRMED


def _judge_motionless_link(motions: LinkMotions) -> PropertyFinding:
    """Judge a gear whose drive turns while no link does."""
    if motions.passes_torque_on:
        return PropertyFinding(
            "wrong",
            "its coupling slips: its drive turns and no link does, but it passes a torque on; "
            f"{FASTEN_COUPLING}",
        )
    return PropertyFinding(
        "wrong",
        f"{IS_LOOSE}: its drive turns and no link does. Either the coupling slips, or the backlash is wider than "
        f"the motion; {FASTEN_COUPLING}",
    )


def _judge_lost_motion(
    motions: LinkMotions, lost: LostMotion, drive: JointDrive, allowed_backlash_rad: float
) -> PropertyFinding:
    """Judge a gear whose drive turns further than its link: by its small motion, it has backlash or slips."""
    followed = motions.followed_fraction
    if followed is None:
        return PropertyFinding(
            "wrong",
            f"{IS_LOOSE}: its link stays behind by {lost.lost_rad:.3f} rad. Either the gear has backlash, or the "
            f"coupling slips; {FASTEN_COUPLING}",
        )
    if followed > MIN_FRACTION_BEHIND_COUPLING:
        return PropertyFinding(
            "wrong",
            f"its coupling slips: its link follows a small motion, and stays behind by {lost.lost_rad:.3f} rad in a "
            f"large one; {FASTEN_COUPLING}",
        )
    if followed > MAX_FRACTION_WITHIN_BACKLASH:
        return PropertyFinding(
            "wrong",
            f"{IS_LOOSE}: its link stays behind by {lost.lost_rad:.3f} rad, and follows only {followed:.2f} of a "
            f"small motion. Either the gear has backlash, or the coupling slips; {FASTEN_COUPLING}",
        )
    reasons = [
        f"backlash of {lost.lost_rad:.3f} rad ({np.rad2deg(lost.lost_rad):.1f} degrees): its drive turns that much "
        f"further than its link when the load reverses; {allowed_backlash_rad:g} rad are allowed. Repair the gear, or "
        "allow more with --allow-backlash"
    ]
    if wrong_ratio := _describe_wrong_ratio(lost.ratio, drive):
        reasons.append(wrong_ratio)
    return PropertyFinding("wrong", "; ".join(reasons))


def _judge_held_motion(motions: LinkMotions, held: HeldMotion) -> PropertyFinding:
    """Judge a gear whose links turned while its drive held still."""
    turned = _describe_held_motion(held)
    followed = motions.followed_fraction
    if followed is not None and followed > MIN_FRACTION_BEHIND_COUPLING:
        return PropertyFinding("wrong", f"its coupling slips: {turned}; {FASTEN_COUPLING}")
    return PropertyFinding(
        "wrong",
        f"{IS_LOOSE}: {turned}. Either the coupling slips, or the gear has backlash; {FASTEN_COUPLING}",
    )


def _describe_held_motion(held: HeldMotion) -> str:
    return (
        f"its links turned against each other by {held.turned_rad:.3f} rad while its drive held still and another "
        "joint moved"
    )


def _describe_wrong_ratio(motion_ratio: float, drive: JointDrive) -> str:
    """Return which gear ratio the motion of the links shows; empty if it is that of the robot file."""
    ratio = abs(motion_ratio)
    if abs(ratio - 1) < MAX_RATIO_ERROR:
        return ""
    return f"turns {ratio:.2f} as far as its drive measures: gear = {drive.gear / ratio:.3g}"


def judge_gear_by_torque(play: GearPlay, allowed_backlash_rad: float) -> PropertyFinding:
    """Judge a gear whose links were not measured. Its ratio stays unknown.

    Args:
        play: What the torques show.
        allowed_backlash_rad: Largest backlash that is not judged as wrong.
    """
    allowed = f"{allowed_backlash_rad:g} rad are allowed"
    backlash = f"backlash of about {play.min_backlash_rad:.3f} rad or more"
    match play.kind:
        case "backlash" if play.min_backlash_rad > allowed_backlash_rad:
            return PropertyFinding(
                "wrong",
                f"{backlash}: within it, its drive turns without the load of its link, {allowed}; repair the gear, or "
                "allow more with --allow-backlash",
            )
        case "slipping":
            return PropertyFinding(
                "wrong",
                "its coupling slips: its torque stays low and does not follow its angle, unlike that of other joints; "
                f"{FASTEN_COUPLING}",
            )
        case "loose":
            return PropertyFinding(
                "wrong",
                f"{IS_LOOSE}: its torque does not follow its angle. Either the coupling slips, or the gear has "
                f"backlash; {FASTEN_COUPLING}",
            )
        case "tight" if play.max_backlash_rad <= allowed_backlash_rad:
            return PropertyFinding(
                "unknown",
                f"{NO_BACKLASH} {play.max_backlash_rad:.3f} rad found, ratio unknown: {CONFIRM_GEAR_BY_HAND}",
                excludes_backlash=True,
            )
        case "tight":
            reason = f"{NO_BACKLASH} {play.max_backlash_rad:.3f} rad found, but only {allowed}"
            return PropertyFinding("unknown", f"{reason}: {CONFIRM_GEAR_BY_HAND}")
        case "backlash":
            return PropertyFinding("unknown", f"{backlash}, and {allowed}: {CONFIRM_GEAR_BY_HAND}")
        case "unknown":
            return PropertyFinding(
                "unknown",
                f"backlash and ratio unknown, as {play.reason}: {CONFIRM_GEAR_BY_HAND}",
            )
