"""The rules for a gear whose links were measured: backlash that was not measured is unknown, and never confirmed."""

import pytest

from snakesim_hal.model.robot_file.joints import JointDrive
from snakesim_operator.features.commissioning.joint_check.gear_rules import (
    IS_LOOSE,
    LinkMotions,
    judge_gear_by_links,
)
from snakesim_operator.features.commissioning.joint_check.joint_verdict import PropertyFinding
from snakesim_operator.features.commissioning.joint_check.lost_motion import (
    HeldMotion,
    LostMotion,
)

ALLOWED_BACKLASH_RAD = 0.01

NO_BACKLASH = LostMotion(lost_rad=0.004, noise_rad=0.005, ratio=1.0)


def judge(
    lost_motion: LostMotion | None,
    held_motion: HeldMotion | None = None,
    *,
    small_motion_ratio: float | None = 1.0,
) -> PropertyFinding:
    """Judge a gear whose links turn exactly as far as its drive."""
    motions = LinkMotions(
        motion_ratio=1.0,
        lost_motion=lost_motion,
        held_motions=[] if held_motion is None else [held_motion],
        small_motion_ratio=small_motion_ratio,
        passes_torque_on=True,
    )
    return judge_gear_by_links(motions, JointDrive(), ALLOWED_BACKLASH_RAD)


def test_gear_with_little_lost_motion_is_confirmed() -> None:
    assert judge(NO_BACKLASH).state == "confirmed"


@pytest.mark.parametrize(
    ("held_motion", "state"),
    [
        (HeldMotion(turned_rad=0.009, noise_rad=0.005), "confirmed"),
        (HeldMotion(turned_rad=0.009, noise_rad=0.025), "confirmed"),
        (HeldMotion(turned_rad=0.02, noise_rad=0.025), "unknown"),
    ],
    ids=[
        "less than allowed",
        "less than allowed, much noise",
        "more than allowed, less than noise",
    ],
)
def test_gear_whose_held_links_hardly_turn_is_not_wrong(
    held_motion: HeldMotion, state: str
) -> None:
    assert judge(NO_BACKLASH, held_motion).state == state


@pytest.mark.parametrize(
    ("small_motion_ratio", "beginning"),
    [(0.9, "its coupling slips"), (0.1, IS_LOOSE), (None, IS_LOOSE)],
    ids=["follows the small motion", "stays in the small motion", "no small motion"],
)
def test_gear_whose_held_links_turn_is_wrong(
    small_motion_ratio: float | None, beginning: str
) -> None:
    held_motion = HeldMotion(turned_rad=0.08, noise_rad=0.01)
    finding = judge(NO_BACKLASH, held_motion, small_motion_ratio=small_motion_ratio)
    assert finding.state == "wrong"
    assert finding.reason.startswith(beginning)
    assert "0.080 rad while its drive held still" in finding.reason


@pytest.mark.parametrize(
    ("lost_motion", "reason"),
    [
        (None, "to one side only"),
        (LostMotion(lost_rad=0.012, noise_rad=0.02, ratio=1.0), "allows 0.020 rad"),
    ],
    ids=["backlash not measured", "noise above the allowed backlash"],
)
def test_gear_with_unknown_backlash_is_not_confirmed(
    lost_motion: LostMotion | None, reason: str
) -> None:
    finding = judge(lost_motion)
    assert finding.state == "unknown"
    assert reason in finding.reason
    assert "--gear-by-hand" in finding.reason


@pytest.mark.parametrize(
    ("small_motion_ratio", "beginning"),
    [(0.9, "its coupling slips"), (0.65, IS_LOOSE), (0.1, "backlash of 0.030 rad")],
    ids=["follows the small motion", "follows a part of it", "stays in the small motion"],
)
def test_gear_that_loses_motion_is_named_by_its_small_motion(
    small_motion_ratio: float, beginning: str
) -> None:
    lost_motion = LostMotion(lost_rad=0.03, noise_rad=0.005, ratio=1.0)
    finding = judge(lost_motion, small_motion_ratio=small_motion_ratio)
    assert finding.state == "wrong"
    assert finding.reason.startswith(beginning)
