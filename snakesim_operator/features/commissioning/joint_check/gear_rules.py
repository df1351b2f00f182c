"""Rules for the gear of a joint: ratio, backlash and coupling, by the motion of its links or by torques. Pure."""

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
MIN_SLIPPING_RATIO = 0.5  # of link and drive in the small motion; within backlash it is near 0
SHAKE_LINK = "shake the link, then add --gear-by-hand"
CONFIRM_GEAR_BY_HAND = NO_LINK + f"measure it with `snakesim robot calibrate gear`, {SHAKE_LINK}"
NO_BACKLASH = "no backlash above"  # and then the angle above which the torque excludes it


def judge_gear_by_links(
    motion_ratio: float,
    lost_motion: LostMotion | None,
    held_motion: HeldMotion | None,
    small_motion_ratio: float | None,
    drive: JointDrive,
    allowed_backlash_rad: float,
    *,
    is_load_passed_on: bool,
) -> PropertyFinding:
    """Judge whether a joint's links turn as far as its encoder measures.

    Args:
        motion_ratio: Motion of the links divided by the motion by the encoder, with its sign.
        lost_motion: Backlash of the joint; None if it is not known.
        held_motion: Motion of its links while its drive held still; None if it is not known.
        small_motion_ratio: The same ratio as `motion_ratio` in the small motion; None if it is not known.
        drive: The drive as the robot file has it.
        allowed_backlash_rad: Largest backlash that is not judged as wrong.
        is_load_passed_on: Whether the torque of other joints changes with the small motion of this one.
    """
    ratio = abs(motion_ratio)
    if ratio < MAX_RATIO_ERROR:
        if is_load_passed_on:
            return PropertyFinding(
                "wrong",
                "its coupling slips: its drive turns and no link does, but it passes a torque on; fasten the coupling, "
                "and check the gear",
            )
        return PropertyFinding(
            "wrong",
            f"{IS_LOOSE}: its drive turns and no link does. Either the coupling slips, or the backlash is wider than "
            "the motion; fasten the coupling, and check the gear",
        )
    # Within backlash a link does not move at all, so it does not follow a small motion either.
    follows_small_motion = (
        small_motion_ratio is not None and abs(small_motion_ratio) > MIN_SLIPPING_RATIO
    )
    reasons: list[str] = []
    if lost_motion is not None and lost_motion.lost_rad > max(
        allowed_backlash_rad, lost_motion.noise_rad
    ):
        if follows_small_motion:
            return PropertyFinding(
                "wrong",
                f"its coupling slips: its link follows a small motion, and stays behind by {lost_motion.lost_rad:.3f} "
                "rad in a large one; fasten the coupling, and check the gear",
            )
        ratio = abs(lost_motion.ratio)  # not reduced by the backlash
        backlash = (
            f"{lost_motion.lost_rad:.3f} rad ({np.rad2deg(lost_motion.lost_rad):.1f} degrees)"
        )
        reasons.append(
            f"backlash of {backlash}: its drive turns that much further than its link when the load reverses, "
            f"{allowed_backlash_rad:g} rad are allowed; repair the gear, or allow more with --allow-backlash"
        )
    elif held_motion is not None and held_motion.turned_rad > max(
        allowed_backlash_rad, held_motion.noise_rad
    ):
        return _make_held_motion_finding(held_motion, follows_small_motion=follows_small_motion)
    if abs(ratio - 1) >= MAX_RATIO_ERROR:
        other_cause = ""
        if lost_motion is None:
            other_cause = ", or backlash, as it moved to one side only or its gyros are noisy"
        reasons.append(
            f"turns {ratio:.2f} as far as its drive measures: gear = {drive.gear / ratio:.3g}{other_cause}"
        )
    if reasons:
        return PropertyFinding("wrong", "; ".join(reasons))
    if lost_motion is None:
        return PropertyFinding(
            "unknown",
            f"backlash unknown, as it moved to one side only or its gyros are noisy: {SHAKE_LINK}",
        )
    if lost_motion.noise_rad > allowed_backlash_rad:
        return PropertyFinding(
            "unknown",
            f"backlash unknown, as the noise of gyros and encoder allows {lost_motion.noise_rad:.3f} rad, and "
            f"{allowed_backlash_rad:g} rad are allowed: {SHAKE_LINK}",
        )
    return CONFIRMED


def _make_held_motion_finding(
    held_motion: HeldMotion, *, follows_small_motion: bool
) -> PropertyFinding:
    """Return the finding on a gear whose links turned while its drive held still."""
    turned = (
        f"its links turned against each other by {held_motion.turned_rad:.3f} rad while its drive held still and "
        "another joint moved"
    )
    if follows_small_motion:
        return PropertyFinding(
            "wrong", f"its coupling slips: {turned}; fasten the coupling, and check the gear"
        )
    return PropertyFinding(
        "wrong",
        f"{IS_LOOSE}: {turned}. Either the coupling slips, or the gear has backlash; fasten the coupling, and check "
        "the gear",
    )


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
                "fasten the coupling, and check the gear",
            )
        case "loose":
            return PropertyFinding(
                "wrong",
                f"{IS_LOOSE}: its torque does not follow its angle. Either the coupling slips, or the gear has "
                "backlash; fasten the coupling, and check the gear",
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
