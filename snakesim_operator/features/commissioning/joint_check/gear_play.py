"""Judges from torques alone whether the gear of a joint is tight, has backlash, or slips in its coupling. Pure.

In the small motion, the torque of a tight joint follows its angle, because the floor holds the links. The joints of a
robot are compared with each other, because the friction of the floor is unknown. The first row that fits counts:

    torque in the small motion               torques of its neighbors                  verdict
    follows the angle, and reverses          any                                       tight, up to a computed angle
    may slide the only link of an end joint  any                                       unknown
    only at one end of the stroke            any                                       backlash
    follows the angle, never reverses        any                                       unknown
    hardly follows it, may slide the links,  any                                       unknown
    reverses, or is clearly a load
    does not follow it                       low, or alike in both motions             the coupling slips, or loose
    does not follow it                       change only in the large motion           backlash
    does not follow it                       between these                             loose; unknown if noisy

A torque that follows the angle excludes backlash only if the load reverses, because teeth that touch on one side carry
any other load. `tooth_contact` computes how much backlash a reversal could still hide.

A coupling that slips transmits its friction also in the small motion, and backlash transmits nothing. So the coupling
is named only if the neighbors measure a torque in the small motion. Otherwise backlash that is wider than both motions
is as likely.

A drive that turns its links slides them on the floor, which needs a certain torque (`sliding_torque`). With less, it
turns without its links. A torque of the neighbors is low if it is less than half of a typical load, and too small to
slide the links. The outermost yaw joints carry only a light end of the robot, which slides with hardly any torque. They
can be found tight, but are usually found loose only if a person laid weights on both end links.

Beside a loose joint, a sound joint may be unloaded, because the loose gear transmits nothing. So an outermost joint,
and a joint that is loaded only at one end of the stroke, is not found loose beside a loose joint.

A pitch joint is not judged: the weight of its links presses the teeth to one side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from snakesim_operator.features.commissioning.joint_check.load_response import (
    LoadResponse,
    find_neighbors_of_same_axis,
)
from snakesim_operator.features.commissioning.joint_check.tooth_contact import ToothContact

# Limits on the torques of emulated joints on a floor. A smaller change of a torque does not prove a load.
MIN_CHANGE_NM = 0.03
NOISE_FACTOR = 2.0  # times the range of the torque at rest, because a smaller change may be noise
# Of the elastic torque of a typical joint between others. Sound joints have a third of it or more, loose ones a
# thirtieth or less.
MIN_TIGHT_FRACTION = 0.2
MAX_LOOSE_FRACTION = 0.1
# The neighbors' range of torque in the small motion, divided by that in the large one.
MAX_BACKLASH_NEIGHBOR_RATIO = 0.25
MIN_SLIPPING_NEIGHBOR_RATIO = 0.4
# The load of a joint with backlash in the large motion, divided by the neighbors' range of torque.
MIN_OWN_LOAD_RATIO = 0.4
# The neighbors' range of torque in the large motion, divided by the elastic torque of a typical joint. Behind a gear
# that holds, it is larger.
MAX_SLIPPING_LOAD_RATIO = 0.5
# Of the small stroke, at one of its ends, without a load. On emulated drives, loose joints whose teeth touch at the
# other end have that much or more. Most sound joints have 0.12 or less; a few have more, most of them beside a joint
# with a fault.
MIN_UNLOADED_FRACTION = 0.3
# The load at the loaded end, divided by the smallest torque that proves a load.
MIN_LOAD_RATIO = 2.0
# Friction of a joint with an unloaded end. Where it is larger, a load may never vanish. On emulated drives, joints with
# backlash had 0.033 N·m or less, and sound joints that looked like them 0.06 or more.
MAX_UNLOADED_FRICTION_NM = 0.045
# The largest load of a loose joint in the small motion, divided by the smallest torque that proves a load. On emulated
# drives, joints with a fault had 2 or less, and two sound ones beside an encoder with a dead zone more than 13.
MAX_LOOSE_LOAD_RATIO = 4.0
# Half the range of a loose joint's torque in the small motion, divided by the torque with which its links slide. On
# emulated robots, sound outermost joints have 0.93 or more. Others may have less, because the whole body bends.
MAX_LOOSE_SLIDING_RATIO = 0.85
NO_CLEAR_LOAD = "its torque hardly follows its angle"
NO_REVERSAL = "the load of its gear does not reverse in the small motion"
LIGHT_END = "the floor may hardly hold the end of the robot (lay a weight on its last link, and add --end-weights)"
BESIDE_LOOSE_JOINT = "the joint beside it is loose, and may be the only cause"
# "loose": it has backlash or slips, which of them is not clear.
PlayKind = Literal["tight", "backlash", "slipping", "loose", "unknown"]
LOOSE_KINDS: Sequence[PlayKind] = ("backlash", "slipping", "loose")


@dataclass(frozen=True)
class GearPlay:
    """The verdict on the gear of a joint."""

    kind: PlayKind
    reason: str = ""  # why it is unknown
    min_backlash_rad: float = 0.0  # of "backlash": it is about that large or larger
    max_backlash_rad: float = float("inf")  # of "tight": the torque excludes more than that


def judge_gear_plays(
    responses: Sequence[LoadResponse | None],
    axes: Sequence[str],
    sliding_torques_nm: Sequence[float],
) -> list[GearPlay]:
    """Judge the gears of all joints, tail to head.

    Args:
        responses: Response of the torques to the motions of each joint; None if it was not measured.
        axes: Axis of each joint, "yaw" or "pitch".
        sliding_torques_nm: Torque with which each joint turns its links on a slippery floor.
    """
    plays = [
        _judge_gear_play(responses, axes, joint, sliding_torques_nm[joint])
        for joint in range(len(responses))
    ]
    return [
        GearPlay("unknown", BESIDE_LOOSE_JOINT)
        if _may_be_sound_beside_loose_joint(responses, plays, axes, joint)
        else play
        for joint, play in enumerate(plays)
    ]


def _may_be_sound_beside_loose_joint(
    responses: Sequence[LoadResponse | None],
    plays: Sequence[GearPlay],
    axes: Sequence[str],
    joint_index: int,
) -> bool:
    """Return whether a joint seems loose, and may be sound, because it is loaded only through a loose neighbor.

    This concerns outermost joints, and joints that are loaded only at one end of the small motion.
    """
    response = responses[joint_index]
    if response is None or plays[joint_index].kind not in LOOSE_KINDS:
        return False
    neighbors = find_neighbors_of_same_axis(axes, joint_index)
    is_beside_loose_joint = any(plays[neighbor].kind in LOOSE_KINDS for neighbor in neighbors)
    is_in_doubt = _is_outermost(axes, joint_index) or _is_loaded_at_one_end_only(response.contact)
    return is_beside_loose_joint and is_in_doubt


def _is_outermost(axes: Sequence[str], joint_index: int) -> bool:
    """Return whether a joint is the first or the last one with its axis."""
    return len(find_neighbors_of_same_axis(axes, joint_index)) < 2


def _judge_gear_play(
    responses: Sequence[LoadResponse | None],
    axes: Sequence[str],
    joint_index: int,
    sliding_nm: float,
) -> GearPlay:
    """Judge the gear of one joint. The other arguments are those of `judge_gear_plays`.

    Args:
        sliding_nm: Torque with which this joint turns its links on a slippery floor.
    """
    response = responses[joint_index]
    if response is None:
        return GearPlay("unknown", "it made no small motion, or the robot did not rest before")
    if axes[joint_index] != "yaw":
        return GearPlay(
            "unknown", "the weight of its links presses the teeth of its gear to one side"
        )
    typical_nm = _compute_typical_elastic_nm(responses, axes, joint_index)
    min_change_nm = max(MIN_CHANGE_NM, NOISE_FACTOR * response.noise_nm)
    if typical_nm < min_change_nm:
        return GearPlay("unknown", "the floor hardly loads the joints")
    contact = response.contact
    follows_angle = response.elastic_nm >= max(MIN_TIGHT_FRACTION * typical_nm, min_change_nm)
    if follows_angle and contact.reversal_rad is not None:
        return GearPlay("tight", max_backlash_rad=contact.reversal_rad)
    is_outermost = _is_outermost(axes, joint_index)
    if is_outermost and not _turns_without_its_links(response, sliding_nm):
        return GearPlay("unknown", LIGHT_END)
    if _is_loaded_at_one_end_only(contact):
        return GearPlay("backlash", min_backlash_rad=contact.unloaded_travel_rad)
    if follows_angle:
        return GearPlay("unknown", NO_REVERSAL)
    if response.elastic_nm > MAX_LOOSE_FRACTION * typical_nm:
        return GearPlay("unknown", NO_CLEAR_LOAD)
    # The smaller range counts, because the torque of the joint contains the friction of its own drive.
    range_nm = min(response.small_range_nm, response.neighbor_small_range_nm)
    if not is_outermost and not _is_too_weak_to_slide(max(range_nm, response.noise_nm), sliding_nm):
        return GearPlay("unknown", NO_CLEAR_LOAD)
    if contact.reversal_rad is not None or _is_clearly_loaded(contact):
        return GearPlay("unknown", NO_CLEAR_LOAD)  # its teeth carry a load
    return _judge_loose_gear(response, typical_nm, sliding_nm, min_change_nm)


def _is_too_weak_to_slide(range_nm: float, sliding_nm: float) -> bool:
    """Return whether a torque is clearly smaller than that with which links slide.

    Args:
        range_nm: Range of the torque in a motion in both directions.
        sliding_nm: Torque with which the links slide.
    """
    return range_nm < 2 * MAX_LOOSE_SLIDING_RATIO * sliding_nm


def _turns_without_its_links(response: LoadResponse, sliding_nm: float) -> bool:
    """Return whether the drive of an outermost joint turned with less torque than its links need to slide.

    Args:
        response: Response of the torques to its motions.
        sliding_nm: Torque with which the links slide.
    """
    contact = response.contact
    if _is_loaded_at_one_end_only(contact) and contact.load_threshold_nm < sliding_nm:
        return True
    # Noise as large as this may hide a torque.
    return _is_too_weak_to_slide(max(response.small_range_nm, response.noise_nm), sliding_nm)


def _is_loaded_at_one_end_only(contact: ToothContact) -> bool:
    """Return whether a joint is loaded at one end of its small stroke, and not at all at the other."""
    is_loaded_at_one_end = contact.max_load_nm >= MIN_LOAD_RATIO * contact.load_threshold_nm
    is_unloaded_at_other_end = (
        contact.unloaded_fraction >= MIN_UNLOADED_FRACTION
        and contact.friction_nm <= MAX_UNLOADED_FRICTION_NM
    )
    return is_loaded_at_one_end and is_unloaded_at_other_end and contact.reversal_rad is None


def _is_clearly_loaded(contact: ToothContact) -> bool:
    """Return whether a joint carries more load in the small motion than any loose joint."""
    return contact.max_load_nm >= MAX_LOOSE_LOAD_RATIO * contact.load_threshold_nm


def _judge_loose_gear(
    response: LoadResponse, typical_nm: float, sliding_nm: float, min_change_nm: float
) -> GearPlay:
    """Judge a joint whose torque does not follow its angle in the small motion, and is too small to slide its links.

    Args:
        response: Response of the torques to its motions.
        typical_nm: Elastic torque of a typical joint.
        sliding_nm: Torque with which the links slide.
        min_change_nm: Change of a torque that proves a load.
    """
    large_nm, small_nm = response.neighbor_large_range_nm, response.neighbor_small_range_nm
    max_slipping_nm = MAX_SLIPPING_LOAD_RATIO * typical_nm
    # A part of the range may be noise.
    does_large_motion_slide_links = not _is_too_weak_to_slide(
        large_nm - NOISE_FACTOR * response.noise_nm, sliding_nm
    )
    are_neighbors_lightly_loaded = (
        max(large_nm, response.noise_nm) <= max_slipping_nm and not does_large_motion_slide_links
    )
    min_slipping_nm = MIN_SLIPPING_NEIGHBOR_RATIO * large_nm
    is_load_alike_in_both_motions = small_nm >= max(min_slipping_nm, response.noise_nm)
    if are_neighbors_lightly_loaded or is_load_alike_in_both_motions:
        # A coupling that slips passes a torque on, and backlash does not.
        return GearPlay("slipping" if response.passed_in_small_motion.is_certain else "loose")
    if _has_backlash(response, min_change_nm):
        return GearPlay("backlash", min_backlash_rad=response.small_motion_rad)
    if response.noise_nm > MAX_LOOSE_FRACTION * typical_nm:
        return GearPlay("unknown", NO_CLEAR_LOAD)
    return GearPlay("loose")


def _has_backlash(response: LoadResponse, min_change_nm: float) -> bool:
    """Return whether the load of a joint is missing in the small motion, and comes in the large one."""
    large_nm = response.neighbor_large_range_nm
    # The neighbors are loaded through this gear, which is therefore loaded as well.
    min_own_load_nm = max(min_change_nm, MIN_OWN_LOAD_RATIO * large_nm)
    is_loaded_in_large_motion = large_nm >= min_change_nm and response.load_nm >= min_own_load_nm
    max_small_nm = MAX_BACKLASH_NEIGHBOR_RATIO * large_nm
    # Noise as large as this could hide a load.
    is_load_missing_in_small_motion = (
        max(response.neighbor_small_range_nm, response.noise_nm) <= max_small_nm
    )
    return is_loaded_in_large_motion and is_load_missing_in_small_motion


def _compute_typical_elastic_nm(
    responses: Sequence[LoadResponse | None], axes: Sequence[str], joint_index: int
) -> float:
    """Return the median elastic torque of the other yaw joints, without the outermost ones; 0 if there are none."""
    elastic_nm = [
        response.elastic_nm
        for joint, (response, axis) in enumerate(zip(responses, axes, strict=True))
        if response is not None
        and axis == "yaw"
        and joint != joint_index
        and not _is_outermost(axes, joint)
    ]
    return float(np.median(elastic_nm)) if elastic_nm else 0.0
