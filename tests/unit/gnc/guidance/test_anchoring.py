"""Known obstacles hold a reckoned pose: by what the body touches, and by what it cannot lie in."""

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
TOUCHED = ((2, 1), (7, -1), (11, 1))  # link, and on which side of it a peg stands


def base_at(planar_w) -> BasePose:
    return BasePose(np.array(planar_w), BODY_RADIUS_M, np.eye(3))


def pegs(apart_m: float = 0.0) -> list[KnownObstacle]:
    """At the middles of the links of a body that lies where it is in truth."""
    base = base_at(TRUE_W)
    rear, frames = compute_link_frames(
        base.position_w, base.rotation, SHAPE, ["yaw"] * len(SHAPE), LENGTHS
    )
    found: list[KnownObstacle] = []
    for link, side in TOUCHED:
        away_m = side * (BODY_RADIUS_M + PEG_M + apart_m)
        x, y, _ = (
            rear[link] + 0.5 * LENGTHS[link] * frames[link][:, 0] + away_m * frames[link][:, 1]
        ).tolist()
        found.append(
            KnownObstacle(
                name=f"{link}",
                shape="cylinder",
                position_w=(x, y, 0.1),
                radius_m=PEG_M,
                height_m=0.2,
            )
        )
    return found


def pushes(side: int = 1, force_n: float = 10.0) -> list[Contact]:
    """side: -1 for pushes from where no peg is."""
    return [
        make_link_contact(
            link,
            position_l=(
                0.07,
                s * side * BODY_RADIUS_M,
                0.0,
            ),  # 15 mm off along the link, as estimates are
            normal_l=(0.0, -float(s * side), 0.0),
            tangent_2_l=(0.0, 0.0, float(s * side)),
            force_l=(0.0, -s * side * force_n, 0.0),
        )
        for link, s in TOUCHED
    ]


def held(
    off_w, obstacles, contacts, trust=ESTIMATED_CONTACT_TRUST, turns: int = 20
) -> PoseLocalizer:
    """A localizer that begins off the truth, and what is known after some turns."""
    localizer = PoseLocalizer(ROBOT, base_at(TRUE_W + off_w), PoseNoise())
    localizer.covariance = np.diag([0.02, 0.02, 0.03]) ** 2
    anchors = ObstacleAnchors(ROBOT, obstacles)
    for _ in range(turns):
        anchors.correct_pose(localizer, SHAPE, contacts, trust)
    return localizer


@pytest.mark.parametrize(
    ("trust", "turns"), [(ESTIMATED_CONTACT_TRUST, 20), (MEASURED_CONTACT_TRUST, 1000)]
)
@pytest.mark.parametrize("off_w", [(0.0, 0.02, 0.0), (0.015, -0.01, 0.02)])
def test_three_contacts_on_known_pegs_bring_the_pose_back(trust, turns, off_w):
    localizer = held(np.array(off_w), pegs(), pushes(), trust, turns)
    assert np.abs(localizer.base.planar_w - TRUE_W).max() < 0.006
    assert localizer.position_sd_m < 0.02


def test_anchoring_body_never_overlaps_a_peg():
    off = np.array([0.0, 0.02, 0.0])
    before, after = (held(off, pegs(), [], turns=n).base.planar_w for n in (0, 20))
    assert np.linalg.norm((after - TRUE_W)[:2]) < 0.7 * np.linalg.norm((before - TRUE_W)[:2])


@pytest.mark.parametrize(
    "contacts", [[], pushes(side=-1), pushes(force_n=0.1)], ids=["none", "other side", "weak"]
)
def test_pegs_that_are_not_felt_move_nothing(contacts):
    start = held(np.zeros(3), pegs(apart_m=0.02), contacts, turns=0)
    later = held(np.zeros(3), pegs(apart_m=0.02), contacts)
    assert later.base.planar_w.tolist() == start.base.planar_w.tolist() == TRUE_W.tolist()
    assert np.array_equal(later.covariance, start.covariance)


def test_without_obstacles_there_is_nothing_to_hold_on_to():
    assert held(np.zeros(3), [], pushes()).base.planar_w.tolist() == TRUE_W.tolist()
