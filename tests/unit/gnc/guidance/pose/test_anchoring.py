"""Tests how known obstacles correct a dead-reckoned pose: by contacts, and because the body cannot overlap them."""

from collections.abc import Sequence

import numpy as np
import pytest

from snakesim_gnc.guidance.pose.anchoring import (
    ESTIMATED_CONTACT_TRUST,
    MEASURED_CONTACT_TRUST,
    MIN_FORCE_N,
    GapTrust,
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
NO_ERROR_W = (0.0, 0.0, 0.0)
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


def make_contacts_on_links_at_pegs(
    *, is_on_side_of_peg: bool = True, force_n: float = 10.0
) -> list[Contact]:
    """Return a contact on each link that has a peg beside it, on the side of the peg or on the other side."""
    contacts: list[Contact] = []
    for link, peg_side in LINKS_AT_PEGS:
        side = peg_side if is_on_side_of_peg else -peg_side
        contact = make_link_contact(
            link,
            position_l=(CONTACT_ALONG_M, side * BODY_RADIUS_M, 0.0),
            normal_l=(0.0, -float(side), 0.0),
            tangent_2_l=(0.0, 0.0, float(side)),
            force_l=(0.0, -side * force_n, 0.0),
        )
        contacts.append(contact)
    return contacts


def make_localizer(error_w: Sequence[float] = NO_ERROR_W) -> PoseLocalizer:
    """Return a localizer whose estimate differs from the true pose by this error (x, y, heading)."""
    localizer = PoseLocalizer(ROBOT, make_base_pose(TRUE_W + np.array(error_w)), PoseNoise())
    localizer.covariance = np.diag([0.02, 0.02, 0.03]) ** 2
    return localizer


def correct_pose_repeatedly(
    localizer: PoseLocalizer,
    *,
    obstacles: list[KnownObstacle],
    contacts: list[Contact],
    trust: GapTrust = ESTIMATED_CONTACT_TRUST,
    updates: int = 20,
) -> None:
    """Correct the estimate of a localizer by obstacles and contacts, in several updates."""
    anchors = ObstacleAnchors(ROBOT, obstacles)
    for _ in range(updates):
        anchors.correct_pose(localizer, SHAPE, contacts, trust)


@pytest.mark.parametrize(
    ("trust", "updates"), [(ESTIMATED_CONTACT_TRUST, 20), (MEASURED_CONTACT_TRUST, 1000)]
)
@pytest.mark.parametrize("error_w", [(0.0, 0.02, 0.0), (0.015, -0.01, 0.02)])
def test_anchoring_by_three_known_pegs_corrects_the_pose(trust, updates, error_w):
    localizer = make_localizer(error_w)
    correct_pose_repeatedly(
        localizer,
        obstacles=make_pegs(),
        contacts=make_contacts_on_links_at_pegs(),
        trust=trust,
        updates=updates,
    )
    assert np.abs(localizer.base.planar_w - TRUE_W).max() < 0.006
    assert localizer.position_sd_m < 0.02


def test_anchoring_without_contacts_reduces_overlap_with_pegs():
    localizer = make_localizer(error_w=(0.0, 0.02, 0.0))
    error_before_m = np.linalg.norm((localizer.base.planar_w - TRUE_W)[:2])
    correct_pose_repeatedly(localizer, obstacles=make_pegs(), contacts=[])
    error_after_m = np.linalg.norm((localizer.base.planar_w - TRUE_W)[:2])
    assert error_after_m < 0.7 * error_before_m


@pytest.mark.parametrize(
    "contacts",
    [
        [],
        make_contacts_on_links_at_pegs(is_on_side_of_peg=False),
        make_contacts_on_links_at_pegs(force_n=0.1 * MIN_FORCE_N),
    ],
    ids=["none", "other side", "weak"],
)
def test_anchoring_without_matching_contacts_changes_nothing(contacts):
    """A contact matches a peg if it pushes the body away from it with more than MIN_FORCE_N."""
    pegs_beside_body = make_pegs(gap_m=0.02)  # they do not overlap it, which would correct the pose
    localizer = make_localizer(error_w=NO_ERROR_W)
    covariance_before = localizer.covariance.copy()
    assert localizer.base.planar_w.tolist() == TRUE_W.tolist()

    correct_pose_repeatedly(localizer, obstacles=pegs_beside_body, contacts=contacts, updates=20)

    assert localizer.base.planar_w.tolist() == TRUE_W.tolist()
    assert np.array_equal(localizer.covariance, covariance_before)


def test_anchoring_without_obstacles_changes_nothing():
    localizer = make_localizer(error_w=NO_ERROR_W)
    correct_pose_repeatedly(localizer, obstacles=[], contacts=make_contacts_on_links_at_pegs())
    assert localizer.base.planar_w.tolist() == TRUE_W.tolist()
