"""Compares a map with the truth: errors, missed obstacles, ghosts, and visibility."""

import math

import pytest

from snakesim_hal.wire.messages import KnownObstacle
from snakesim_operator.results.metrics.map_score import MapScore, align_map, score_map

HEAD_M = (0.0, 0.0)


def make_peg(
    name: str, x: float, y: float, radius_m: float = 0.05, sd_m: float = 0.01
) -> KnownObstacle:
    """Make a cylinder whose position has this standard deviation."""
    return KnownObstacle(
        name=name, shape="cylinder", position_w=(x, y, 0.1), radius_m=radius_m, position_sd_m=sd_m
    )


def make_box(
    name: str, x: float, y: float, half_size_m: tuple[float, float], yaw_rad: float = 0.0
) -> KnownObstacle:
    """Make a box with these half sizes along x and y before its rotation."""
    return KnownObstacle(
        name=name,
        shape="box",
        position_w=(x, y, 0.1),
        half_size_m=(*half_size_m, 0.1),
        yaw_rad=yaw_rad,
    )


def test_map_score_of_true_map_has_no_errors():
    truth = [make_peg("a", 0.6, 0.1), make_box("b", 0.7, -0.2, (0.05, 0.1), 0.3)]
    score = score_map(truth, truth, HEAD_M, 0.0)
    assert score.position_errors_m == [0.0, 0.0]
    assert max(score.surface_errors_m) < 1e-9
    assert score.missed_count == 0
    assert score.ghost_count == 0
    assert score.visible_count == 2
    assert score.reported_count == 2


def test_map_score_has_errors_of_centers_surfaces_and_sizes():
    score = score_map([make_peg("seen_1", 0.61, 0.1, 0.06)], [make_peg("a", 0.6, 0.1)], HEAD_M, 0.0)
    assert score.position_errors_m == [pytest.approx(0.01)]
    assert score.size_errors_m == [pytest.approx(0.01)]
    assert score.position_errors_in_sd == [pytest.approx(1.0)]
    assert score.surface_errors_m[0] < 0.005  # the visible side is nearly at its true position


def test_map_score_counts_ghosts_and_missed_obstacles():
    score = score_map([make_peg("ghost", 0.5, -0.3)], [make_peg("a", 0.6, 0.2)], HEAD_M, 0.0)
    assert score.missed_count == 1
    assert score.ghost_count == 1
    assert score.position_errors_m == []


def test_map_score_invisible_obstacle_is_not_missed():
    truth = [
        make_box("screen", 0.5, 0.0, (0.02, 0.2)),
        make_peg("hidden", 0.8, 0.0),
        make_peg("behind", -0.5, 0.0),
        make_peg("far", 2.0, 0.5),
    ]
    score = score_map([], truth, HEAD_M, 0.0)
    assert score.visible_count == 1
    assert score.missed_count == 1
    # After half a turn, only the obstacle behind the head is visible.
    assert score_map([], truth, HEAD_M, math.pi).missed_count == 1


def test_map_score_partly_seen_wall_is_no_ghost():
    score = score_map(
        [make_box("seen_1", 0.6, 0.2, (0.025, 0.3))],
        [make_box("wall", 0.6, 0.0, (0.025, 2.0))],
        HEAD_M,
        0.0,
    )
    assert not score.ghost_count
    assert not score.missed_count
    assert max(score.surface_errors_m) < 1e-9


def test_map_is_aligned_with_the_true_pose():
    # Each pose is x and y in m and yaw in rad.
    estimated_pose = (1.0, 0.2, 0.3)
    true_pose = (1.1, 0.1, 0.35)
    rotation_rad = true_pose[2] - estimated_pose[2]
    seen = make_peg("seen_1", 1.6, 0.2)  # 0.6 m along x from the estimated position
    x = true_pose[0] + 0.6 * math.cos(rotation_rad)
    y = true_pose[1] + 0.6 * math.sin(rotation_rad)
    (aligned,) = align_map([seen], estimated_pose, true_pose)
    assert aligned.position_w[:2] == pytest.approx((x, y))


def test_map_score_total_is_sum_of_scores():
    total = MapScore()
    for _ in range(2):
        total.add(score_map([make_peg("g", 0.5, -0.3)], [make_peg("a", 0.6, 0.2)], HEAD_M, 0.0))
    assert total.missed_count == 2
    assert total.ghost_count == 2
    assert total.reported_count == 2
    assert total.visible_count == 2
