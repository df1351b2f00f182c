"""A map against the truth: errors, misses, ghosts, and what could be seen at all."""

import math

import pytest

from snakesim_hal.wire.messages import KnownObstacle
from snakesim_operator.results.metrics.map_score import MapScore, align_map, score_map

HEAD = (0.0, 0.0)


def peg(name: str, x: float, y: float, radius_m: float = 0.05, sd_m: float = 0.01) -> KnownObstacle:
    return KnownObstacle(
        name=name, shape="cylinder", position_w=(x, y, 0.1), radius_m=radius_m, position_sd_m=sd_m
    )


def block(
    name: str, x: float, y: float, half: tuple[float, float], yaw: float = 0.0
) -> KnownObstacle:
    return KnownObstacle(
        name=name, shape="box", position_w=(x, y, 0.1), half_size_m=(*half, 0.1), yaw_rad=yaw
    )


def test_a_true_map_has_no_errors():
    truth = [peg("a", 0.6, 0.1), block("b", 0.7, -0.2, (0.05, 0.1), 0.3)]
    found = score_map(truth, truth, HEAD, 0.0)
    assert found.position_errors_m == [0.0, 0.0]
    assert max(found.surface_errors_m) < 1e-9
    assert found.missed_count == 0
    assert found.ghost_count == 0
    assert found.visible_count == 2
    assert found.reported_count == 2


def test_errors_are_of_centres_surfaces_and_sizes():
    found = score_map([peg("seen_1", 0.61, 0.1, 0.06)], [peg("a", 0.6, 0.1)], HEAD, 0.0)
    assert found.position_errors_m == [pytest.approx(0.01)]
    assert found.size_errors_m == [pytest.approx(0.01)]
    assert found.position_errors_in_sd == [pytest.approx(1.0)]
    assert found.surface_errors_m[0] < 0.005  # the side that is seen is nearly where it should be


def test_ghosts_and_misses_are_counted():
    found = score_map([peg("ghost", 0.5, -0.3)], [peg("a", 0.6, 0.2)], HEAD, 0.0)
    assert found.missed_count == 1
    assert found.ghost_count == 1
    assert found.position_errors_m == []


def test_what_is_hidden_behind_or_far_is_no_miss():
    truth = [
        block("screen", 0.5, 0.0, (0.02, 0.2)),
        peg("hidden", 0.8, 0.0),
        peg("behind", -0.5, 0.0),
        peg("far", 2.0, 0.5),
    ]
    found = score_map([], truth, HEAD, 0.0)
    assert found.visible_count == 1
    assert found.missed_count == 1
    # The one behind, after turning around.
    assert score_map([], truth, HEAD, math.pi).missed_count == 1


def test_map_score_partly_seen_wall_is_no_ghost():
    found = score_map(
        [block("seen_1", 0.6, 0.2, (0.025, 0.3))],
        [block("wall", 0.6, 0.0, (0.025, 2.0))],
        HEAD,
        0.0,
    )
    assert not found.ghost_count
    assert not found.missed_count
    assert max(found.surface_errors_m) < 1e-9


def test_a_wrong_pose_can_be_taken_out():
    believed, real = (1.0, 0.2, 0.3), (1.1, 0.1, 0.35)
    turn = real[2] - believed[2]
    seen = peg("seen_1", 1.6, 0.2)
    x = real[0] + 0.6 * math.cos(turn)
    y = real[1] + 0.6 * math.sin(turn)
    (there,) = align_map([seen], believed, real)
    assert there.position_w[:2] == pytest.approx((x, y))


def test_map_scores_can_be_summed():
    total = MapScore()
    for _ in range(2):
        total.add(score_map([peg("g", 0.5, -0.3)], [peg("a", 0.6, 0.2)], HEAD, 0.0))
    assert total.missed_count == 2
    assert total.ghost_count == 2
    assert total.reported_count == 2
    assert total.visible_count == 2
