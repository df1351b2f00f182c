"""Tests how known obstacles correct a dead-reckoned pose: by contacts, and because the body cannot overlap them."""

import numpy as np
import pytest

from snakesim_gnc.guidance.pose.anchoring import (
    ESTIMATED_CONTACT_TRUST,
    MEASURED_CONTACT_TRUST,
    ObstacleAnchors,
)
from snakesim_gnc.guidance.pose.body_history import BasePose
from snakesim_gnc.guidance.pose.localization import PoseLocalizer, PoseNoise
from snakesim_hal.model.geometry.kinematics import compute_link_frames
from snakesim_hal.wire.messages import Contact, KnownObstacle
from snakesim_testing.gnc.stage import BODY_RADIUS_M, make_robot
from snakesim_testing.hal.small_robots import make_link_contact

ROBOT = make_robot()
LENGTHS = [link.length_m for link in ROBOT.links]
SHAPE = 0.35 * np.sin(0.9 * np.arange(len(ROBOT.joints)))
TRUE_W = np.array([0.2, -0.1, 0.3])  # x, y, heading
PEG_M = 0.05
LINKS_AT_PEGS = ((2, 1), (7, -1), (11, 1))  # link, and the side of it where a peg is (1: left)
CONTACT_ALONG_M = 0.07  # of estimated contacts: 15 mm from the middle of their links


def make_base_pose(planar_w) -> BasePose:
    return BasePose(np.array(planar_w), BODY_RADIUS_M, np.eye(3))


def make_pegs(gap_m: float = 0.0) -> list[KnownObstacle]:
    """Return pegs beside the middles of the links of a body at its true pose, at this distance."""
    base = make_base_pose(TRUE_W)
    rear_w, frames = compute_link_frames(
        base.position_w, base.rotation, SHAPE, ["yaw"] * len(SHAPE), LENGTHS
    )
    pegs: list[KnownObstacle] = []
    for link, side in LINKS_AT_PEGS:
        middle_w = rear_w[link] + 0.5 * LENGTHS[link] * frames[link][:, 0]
        distance_m = side * (BODY_RADIUS_M + PEG_M + gap_m)
        x, y, _ = (middle_w + distance_m * frames[link][:, 1]).tolist()
        peg = KnownObstacle(
            name=f"{link}",
            shape="cylinder",
            position_w=(x, y, 0.1),
            radius_m=PEG_M,
            height_m=0.2,
        )
        pegs.append(peg)
    return pegs


def make_contacts(side: int = 1, force_n: float = 10.0) -> list[Contact]:
    """Return a contact on each link at a peg: on the side of the peg (1), or on the other side (-1)."""
    return [
        make_link_contact(
            link,
            position_l=(CONTACT_ALONG_M, peg_side * side * BODY_RADIUS_M, 0.0),
            normal_l=(0.0, -float(peg_side * side), 0.0),
            tangent_2_l=(0.0, 0.0, float(peg_side * side)),
            force_l=(0.0, -peg_side * side * force_n, 0.0),
        )
        for link, peg_side in LINKS_AT_PEGS
    ]


def localize(
    offset_w, obstacles, contacts, trust=ESTIMATED_CONTACT_TRUST, updates: int = 20
) -> PoseLocalizer:
    """Return a localizer that starts with a wrong pose, after some corrections by obstacles."""
    localizer = PoseLocalizer(ROBOT, make_base_pose(TRUE_W + offset_w), PoseNoise())
    localizer.covariance = np.diag([0.02, 0.02, 0.03]) ** 2
    anchors = ObstacleAnchors(ROBOT, obstacles)
    for _ in range(updates):
        anchors.correct_pose(localizer, SHAPE, contacts, trust)
    return localizer


@pytest.mark.parametrize(
    ("trust", "updates"), [(ESTIMATED_CONTACT_TRUST, 20), (MEASURED_CONTACT_TRUST, 1000)]
)
@pytest.mark.parametrize("offset_w", [(0.0, 0.02, 0.0), (0.015, -0.01, 0.02)])
def test_anchoring_by_three_known_pegs_corrects_the_pose(trust, updates, offset_w):
    localizer = localize(np.array(offset_w), make_pegs(), make_contacts(), trust, updates)
    assert np.abs(localizer.base.planar_w - TRUE_W).max() < 0.006
    assert localizer.position_sd_m < 0.02


def test_anchoring_without_contacts_reduces_overlap_with_pegs():
    offset_w = np.array([0.0, 0.02, 0.0])
    error_before_m, error_after_m = (
        np.linalg.norm(
            (localize(offset_w, make_pegs(), [], updates=updates).base.planar_w - TRUE_W)[:2]
        )
        for updates in (0, 20)
    )
    assert error_after_m < 0.7 * error_before_m


@pytest.mark.parametrize(
    "contacts",
    [[], make_contacts(side=-1), make_contacts(force_n=0.1)],
    ids=["none", "other side", "weak"],
)
def test_anchoring_without_matching_contacts_changes_nothing(contacts):
    start = localize(np.zeros(3), make_pegs(gap_m=0.02), contacts, updates=0)
    later = localize(np.zeros(3), make_pegs(gap_m=0.02), contacts)
    assert later.base.planar_w.tolist() == start.base.planar_w.tolist() == TRUE_W.tolist()
    assert np.array_equal(later.covariance, start.covariance)


def test_anchoring_without_obstacles_changes_nothing():
    localizer = localize(np.zeros(3), [], make_contacts())
    assert localizer.base.planar_w.tolist() == TRUE_W.tolist()
