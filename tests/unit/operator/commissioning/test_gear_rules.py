"""The rules for a gear whose links were measured: backlash that was not measured is unknown, and never confirmed."""

import pytest

from snakesim_hal.model.robot_file.joints import JointDrive
from snakesim_operator.features.commissioning.joint_check.gear_rules import judge_gear_by_links
from snakesim_operator.features.commissioning.joint_check.joint_verdict import PropertyFinding
from snakesim_operator.features.commissioning.joint_check.lost_motion import LostMotion

ALLOWED_BACKLASH_RAD = 0.01


def judge(lost_motion: LostMotion | None) -> PropertyFinding:
    """Judge a gear whose links turn exactly as far as its drive."""
    return judge_gear_by_links(
        1.0, lost_motion, 1.0, JointDrive(), ALLOWED_BACKLASH_RAD, is_load_passed_on=True
    )


def test_gear_with_little_lost_motion_is_confirmed() -> None:
    assert judge(LostMotion(lost_rad=0.004, noise_rad=0.005, ratio=1.0)).state == "confirmed"


@pytest.mark.parametrize(
    ("lost_motion", "reason"),
    [
        (None, "moved to one side only"),
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
