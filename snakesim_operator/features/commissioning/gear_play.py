"""Judges from torques alone whether the gear of a joint is tight, has backlash, or slips in its coupling. Pure.

In the small motion, the torque of a tight joint follows its angle, because the floor holds the links. The joints of a
robot are compared with each other, because the friction of the floor is unknown:

    torque follows the angle   tight: the load comes back with every motion
    it does not, and the neighbors' load is missing, too, until the large motion        backlash
    it does not, and even the large motion loads the neighbors no more than that        the coupling slips

The joints at both ends carry only one link, which may slide without any such torque. So they may be found tight, but
not loose. A pitch joint is not judged: the weight of its links presses the teeth to one side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from snakesim_operator.features.commissioning.load_response import LoadResponse

MIN_CHANGE_NM = 0.03  # of torque, that proves a load
NOISE_FACTOR = 2.0  # of the range of a torque at rest; a smaller change may be noise
# Of the elastic torque of a typical joint between others. Sound joints have a third of it or more, loose ones a
# thirtieth or less.
MIN_TIGHT_FRACTION = 0.2
MAX_LOOSE_FRACTION = 0.1
# Of the neighbors' change of torque in the large motion, in the small one.
MAX_BACKLASH_FRACTION = 0.25
MIN_SLIPPING_FRACTION = 0.4
# Of the elastic torque of a typical joint, in the neighbors in the large motion; behind a gear that holds, it is more.
MAX_SLIPPING_LOAD_FRACTION = 0.5
NO_CLEAR_LOAD = "its torque hardly follows its angle"
PlayKind = Literal["tight", "backlash", "slipping", "loose", "unknown"]


@dataclass(frozen=True)
class GearPlay:
    """Whether the gear of a joint is tight, and why it may not be known."""

    kind: PlayKind
    reason: str = ""  # of "unknown"


def judge_gear_plays(
    responses: Sequence[LoadResponse | None], axes: Sequence[str]
) -> list[GearPlay]:
    """Judge the gears of all joints, tail to head.

    Args:
        responses: How torques answered the motions of each joint; None where it did not make them.
        axes: Axis of each joint, "yaw" or "pitch".
    """
    return [
        _judge_gear_play(responses, joint, is_yaw=axis == "yaw") for joint, axis in enumerate(axes)
    ]


def _judge_gear_play(
    responses: Sequence[LoadResponse | None], joint_index: int, *, is_yaw: bool
) -> GearPlay:
    response = responses[joint_index]
    if response is None:
        return GearPlay("unknown", "it made no small motion")
    if not is_yaw:
        return GearPlay(
            "unknown", "the weight of its links presses the teeth of its gear to one side"
        )
    typical_nm = _find_typical_elastic_nm(responses, joint_index)
    min_change_nm = max(MIN_CHANGE_NM, NOISE_FACTOR * response.noise_nm)
    if typical_nm < min_change_nm:
        return GearPlay("unknown", "the floor hardly loads the joints")
    if response.elastic_nm >= max(MIN_TIGHT_FRACTION * typical_nm, min_change_nm):
        return GearPlay("tight")
    if joint_index in (0, len(responses) - 1):
        return GearPlay("unknown", "the floor hardly loads its only link")
    if response.elastic_nm > MAX_LOOSE_FRACTION * typical_nm:
        return GearPlay("unknown", NO_CLEAR_LOAD)
    return _judge_loose_gear(response, typical_nm, min_change_nm)


def _judge_loose_gear(response: LoadResponse, typical_nm: float, min_change_nm: float) -> GearPlay:
    """Judge a joint between others whose torque does not follow its angle in the small motion.

    Args:
        response: How torques answered its motions.
        typical_nm: Elastic torque of a typical joint.
        min_change_nm: Change of a torque that proves a load.
    """
    max_slipping_nm = MAX_SLIPPING_LOAD_FRACTION * typical_nm
    min_slipping_nm = MIN_SLIPPING_FRACTION * response.neighbors_large_nm
    is_never_loaded = max(response.neighbors_large_nm, response.noise_nm) <= max_slipping_nm
    is_loaded_alike = response.neighbors_small_nm >= max(min_slipping_nm, response.noise_nm)
    if is_never_loaded or is_loaded_alike:
        return GearPlay("slipping")
    if _has_backlash(response, min_change_nm):
        return GearPlay("backlash")
    if response.noise_nm > MAX_LOOSE_FRACTION * typical_nm:
        return GearPlay("unknown", NO_CLEAR_LOAD)
    return GearPlay("loose")


def _has_backlash(response: LoadResponse, min_change_nm: float) -> bool:
    """Return whether the load of a joint is missing in the small motion, and comes in the large one."""
    large_nm = response.neighbors_large_nm
    # It must be more than noise.
    max_small_nm = MAX_BACKLASH_FRACTION * large_nm
    is_loaded_late = min(large_nm, response.load_nm) >= min_change_nm
    is_load_missing = max(response.neighbors_small_nm, response.noise_nm) <= max_small_nm
    return is_loaded_late and is_load_missing


def _find_typical_elastic_nm(responses: Sequence[LoadResponse | None], joint_index: int) -> float:
    """Return the median elastic torque of the other joints, without those at the ends; 0 if there are none."""
    elastic_nm = [
        response.elastic_nm
        for joint, response in enumerate(responses)
        if response is not None and joint not in (0, joint_index, len(responses) - 1)
    ]
    return float(np.median(elastic_nm)) if elastic_nm else 0.0
