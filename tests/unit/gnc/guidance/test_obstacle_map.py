"""The map over time: touches, what is passed through, ghosts, duplicates, drift, and bounds."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snakesim_gnc.guidance.mapping import obstacle_map
from snakesim_gnc.guidance.mapping.obstacle_map import FORGET_DISTANCE_M, ObstacleMap
from snakesim_hal.model.geometry.outlines import compute_outline_distance_m
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_testing.gnc.rendered import make_box, make_cylinder, make_lidar_scan
from snakesim_testing.hypothesis_profiles import choose_trial_count

S = 1_000_000_000
BODY_M = 0.04


def mapped(*obstacles, looks=4) -> ObstacleMap:
    map_ = ObstacleMap()
    for k in range(looks):
        map_.add_scan(make_lidar_scan(*obstacles, timestamp_ns=k * S // 20))
    return map_


def touch(map_, center, radius_m, angle_rad) -> None:
    """A contact with a round thing, from outside."""
    normal = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    map_.add_contacts([(np.array(center) + radius_m * normal, normal)], 0)


def only(map_, now_ns=0) -> KnownObstacle:
    (reported,) = map_.list_obstacles(now_ns, 0.0)
    return reported


def test_map_obstacle_seen_repeatedly_gains_confidence():
    once, often = (
        mapped(make_cylinder("a", 0.8, 0.0), looks=1),
        mapped(make_cylinder("a", 0.8, 0.0), looks=6),
    )
    reported = only(often)
    assert only(once).confidence < 0.65
    assert reported.confidence > 0.9
    assert reported.last_seen_ns == 5 * S // 20
    assert not reported.touched
    assert only(often, now_ns=120 * S).confidence < reported.confidence  # belief fades


@given(st.floats(0.03, 0.07), st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=12))
@settings(max_examples=choose_trial_count(40))
def test_touches_all_around_find_a_thing_that_was_never_seen(radius, angles):
    map_ = ObstacleMap()
    for angle in angles:
        touch(map_, (0.5, 0.2), radius, angle)
    reported = only(map_)
    assert reported.touched
    assert reported.name.startswith("touched")
    assert reported.shape == "cylinder"
    off = math.dist(reported.position_w[:2], (0.5, 0.2))
    assert off < 3 * reported.position_sd_m + 0.005


def test_map_contact_elsewhere_adds_obstacle_and_on_known_keeps_it():
    map_ = mapped(make_cylinder("a", 0.8, 0.0))
    name = only(map_).name
    touch(map_, (0.8, 0.0), 0.05, 3.0)
    reported = only(map_)
    assert reported.touched
    assert reported.name == name
    assert map_.find_track(np.array([0.75, 0.0])) is map_.tracks[0]
    assert map_.find_track(np.array([0.5, 0.5])) is None
    touch(map_, (0.8, 0.4), 0.05, 3.0)
    assert len(map_.list_obstacles(0, 0.0)) == 2


def test_map_obstacle_seen_through_is_dropped():
    map_ = mapped(make_cylinder("ghost", 0.6, 0.0), make_cylinder("real", 0.8, 0.4))
    for k in range(8):
        map_.add_scan(
            make_lidar_scan(
                make_cylinder("real", 0.8, 0.4),
                make_box("behind", 2.0, 0.0, (0.1, 1.5)),
                timestamp_ns=k,
            )
        )
    assert all(math.dist(o.position_w[:2], (0.6, 0.0)) > 0.3 for o in map_.list_obstacles(0, 0.0))
    assert any(math.dist(o.position_w[:2], (0.8, 0.4)) < 0.01 for o in map_.list_obstacles(0, 0.0))


def test_map_obstacle_hidden_or_out_of_view_is_kept():
    map_ = mapped(make_cylinder("a", 1.2, 0.0))
    for k in range(20):
        map_.add_scan(make_lidar_scan(make_box("screen", 0.5, 0.0, (0.05, 0.8)), timestamp_ns=k))
    assert any(math.dist(o.position_w[:2], (1.2, 0.0)) < 0.01 for o in map_.list_obstacles(0, 0.0))
    for k in range(20):
        map_.add_scan(make_lidar_scan(at=(2.0, 0.0), timestamp_ns=k))
    assert any(math.dist(o.position_w[:2], (1.2, 0.0)) < 0.01 for o in map_.list_obstacles(0, 0.0))


def test_map_obstacle_inside_the_body_is_dropped():
    map_ = mapped(make_cylinder("smoke", 0.6, 0.0), make_cylinder("beside", 0.6, 0.3))
    for k in range(40):
        axis = np.column_stack([np.linspace(0, 0.02 * k, 50), np.zeros(50)])
        map_.remove_surfaces_in_body(axis, BODY_M)
    reported = map_.list_obstacles(0, 0.0)
    assert len(reported) == 1
    assert math.dist(reported[0].position_w[:2], (0.6, 0.3)) < 0.01


def test_where_the_body_lies_nothing_reaches():
    map_ = ObstacleMap()
    for k in range(4):  # one face of a box: how deep it is, is a guess
        map_.add_scan(make_lidar_scan(make_box("thin", 0.8, 0.0, (0.03, 0.3)), timestamp_ns=k))
    axis = np.column_stack([np.full(40, 0.8 + 0.015 + BODY_M + 0.002), np.linspace(-0.3, 0.3, 40)])
    outer = only(map_)
    assert outer.shape == "box"
    assert _depth_beyond(outer, axis) > 0.02
    for _ in range(5):
        map_.remove_surfaces_in_body(axis, BODY_M)
    assert _depth_beyond(only(map_), axis) < 0.012


def _depth_beyond(reported: KnownObstacle, axis: np.ndarray) -> float:
    """How far an obstacle reaches into the body."""
    return BODY_M - min(compute_outline_distance_m(reported, p) for p in axis)


def test_the_newest_look_counts_most_after_drift():
    still, drifted = mapped(make_cylinder("a", 0.8, 0.0)), mapped(make_cylinder("a", 0.8, 0.0))
    drifted.add_drift(0.02**2)
    for map_ in (still, drifted):
        map_.add_scan(make_lidar_scan(make_cylinder("a", 0.815, 0.0)))
    assert only(drifted).position_w[0] == pytest.approx(0.815, abs=0.003)
    assert only(still).position_w[0] < 0.812


def test_far_things_are_forgotten_and_their_number_is_bounded(monkeypatch):
    monkeypatch.setattr(obstacle_map, "MAX_TRACKS", 64)
    map_ = mapped(make_cylinder("a", 0.8, 0.0))
    map_.drop_distant_tracks(np.array([[FORGET_DISTANCE_M + 0.5, 0.0]]))
    assert len(map_.tracks) == 1
    map_.drop_distant_tracks(np.array([[FORGET_DISTANCE_M + 1.0, 0.0]]))
    assert not map_.tracks
    map_.add_contacts(
        [(np.array([0.2 * (k % 10), 0.2 * (k // 10)]), np.array([1.0, 0.0])) for k in range(100)], 0
    )
    assert len(map_.tracks) == 100
    map_.drop_distant_tracks(np.zeros((1, 2)))
    assert len(map_.tracks) == 64
