"""Tests how the obstacle map changes over time.

Scans and contacts add obstacles. Scans that pass through them, and the body itself, remove them. Drift makes them
uncertain, and their number is bounded.
"""

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

SECOND_NS = 1_000_000_000
BODY_RADIUS_M = 0.04


def make_map(*obstacles, scans=4) -> ObstacleMap:
    """Return a map after several scans of obstacles, 50 ms apart."""
    map_ = ObstacleMap()
    for k in range(scans):
        map_.add_scan(make_lidar_scan(*obstacles, timestamp_ns=k * SECOND_NS // 20))
    return map_


def add_contact(map_, center_w, radius_m, angle_rad) -> None:
    """Add a contact with a cylinder, at this angle about its center."""
    normal_w = np.array([math.cos(angle_rad), math.sin(angle_rad)])
    map_.add_contacts([(np.array(center_w) + radius_m * normal_w, normal_w)], 0)


def get_single_obstacle(map_, now_ns=0) -> KnownObstacle:
    """Return the obstacle of a map that must have exactly one."""
    (obstacle,) = map_.list_obstacles(now_ns, 0.0)
    return obstacle


def has_obstacle_at(map_, x_m, y_m) -> bool:
    """Return whether the map has an obstacle within 1 cm of a place."""
    return any(
        math.dist(obstacle.position_w[:2], (x_m, y_m)) < 0.01
        for obstacle in map_.list_obstacles(0, 0.0)
    )


def test_map_obstacle_seen_repeatedly_gains_confidence():
    map_after_one_scan = make_map(make_cylinder("a", 0.8, 0.0), scans=1)
    assert get_single_obstacle(map_after_one_scan).confidence < 0.65
    map_after_six_scans = make_map(make_cylinder("a", 0.8, 0.0), scans=6)
    obstacle = get_single_obstacle(map_after_six_scans)
    assert obstacle.confidence > 0.9
    assert obstacle.last_seen_ns == 5 * SECOND_NS // 20
    assert not obstacle.touched
    # The confidence decreases with time.
    later = get_single_obstacle(map_after_six_scans, now_ns=120 * SECOND_NS)
    assert later.confidence < obstacle.confidence


@given(st.floats(0.03, 0.07), st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=12))
@settings(max_examples=choose_trial_count(40))
def test_map_contacts_all_around_find_an_unseen_obstacle(radius_m, angles_rad):
    center_w = (0.5, 0.2)
    map_ = ObstacleMap()
    for angle_rad in angles_rad:
        add_contact(map_, center_w, radius_m, angle_rad)
    obstacle = get_single_obstacle(map_)
    assert obstacle.touched
    assert obstacle.name.startswith("touched")
    assert obstacle.shape == "cylinder"
    error_m = math.dist(obstacle.position_w[:2], center_w)
    assert error_m < 3 * obstacle.position_sd_m + 0.005


def test_map_contact_elsewhere_adds_obstacle_and_on_known_keeps_it():
    map_ = make_map(make_cylinder("a", 0.8, 0.0))
    name = get_single_obstacle(map_).name
    add_contact(map_, (0.8, 0.0), 0.05, 3.0)
    obstacle = get_single_obstacle(map_)
    assert obstacle.touched
    assert obstacle.name == name
    assert map_.find_track(np.array([0.75, 0.0])) is map_.tracks[0]
    assert map_.find_track(np.array([0.5, 0.5])) is None
    add_contact(map_, (0.8, 0.4), 0.05, 3.0)
    assert len(map_.list_obstacles(0, 0.0)) == 2


def test_map_obstacle_seen_through_is_dropped():
    map_ = make_map(make_cylinder("ghost", 0.6, 0.0), make_cylinder("real", 0.8, 0.4))
    for k in range(8):
        map_.add_scan(
            make_lidar_scan(
                make_cylinder("real", 0.8, 0.4),
                make_box("behind", 2.0, 0.0, (0.1, 1.5)),
                timestamp_ns=k,
            )
        )
    assert all(
        math.dist(obstacle.position_w[:2], (0.6, 0.0)) > 0.3
        for obstacle in map_.list_obstacles(0, 0.0)
    )
    assert has_obstacle_at(map_, 0.8, 0.4)


def test_map_obstacle_hidden_or_out_of_view_is_kept():
    map_ = make_map(make_cylinder("a", 1.2, 0.0))
    for k in range(20):
        map_.add_scan(make_lidar_scan(make_box("screen", 0.5, 0.0, (0.05, 0.8)), timestamp_ns=k))
    assert has_obstacle_at(map_, 1.2, 0.0)
    for k in range(20):
        map_.add_scan(make_lidar_scan(at=(2.0, 0.0), timestamp_ns=k))
    assert has_obstacle_at(map_, 1.2, 0.0)


def test_map_obstacle_inside_the_body_is_dropped():
    map_ = make_map(make_cylinder("smoke", 0.6, 0.0), make_cylinder("beside", 0.6, 0.3))
    for k in range(40):
        body_axis_w = np.column_stack([np.linspace(0, 0.02 * k, 50), np.zeros(50)])
        map_.remove_surfaces_in_body(body_axis_w, BODY_RADIUS_M)
    assert len(map_.list_obstacles(0, 0.0)) == 1
    assert has_obstacle_at(map_, 0.6, 0.3)


def test_map_obstacle_that_overlaps_the_body_is_trimmed():
    map_ = ObstacleMap()
    # The scans show one face of a box. Its depth is a guess, with which it overlaps the body behind it.
    for k in range(4):
        map_.add_scan(make_lidar_scan(make_box("thin", 0.8, 0.0, (0.03, 0.3)), timestamp_ns=k))
    body_x_m = 0.8 + 0.015 + BODY_RADIUS_M + 0.002
    body_axis_w = np.column_stack([np.full(40, body_x_m), np.linspace(-0.3, 0.3, 40)])
    box = get_single_obstacle(map_)
    assert box.shape == "box"
    assert measure_overlap_m(box, body_axis_w) > 0.02
    for _ in range(5):
        map_.remove_surfaces_in_body(body_axis_w, BODY_RADIUS_M)
    assert measure_overlap_m(get_single_obstacle(map_), body_axis_w) < 0.012


def measure_overlap_m(obstacle: KnownObstacle, body_axis_w: np.ndarray) -> float:
    """Return how far an obstacle reaches into the body."""
    axis_distance_m = min(compute_outline_distance_m(obstacle, point_w) for point_w in body_axis_w)
    return BODY_RADIUS_M - axis_distance_m


def test_map_after_drift_trusts_the_newest_scan_most():
    map_without_drift = make_map(make_cylinder("a", 0.8, 0.0))
    map_with_drift = make_map(make_cylinder("a", 0.8, 0.0))
    map_with_drift.add_drift(0.02**2)
    for map_ in (map_without_drift, map_with_drift):
        map_.add_scan(make_lidar_scan(make_cylinder("a", 0.815, 0.0)))
    assert get_single_obstacle(map_with_drift).position_w[0] == pytest.approx(0.815, abs=0.003)
    assert get_single_obstacle(map_without_drift).position_w[0] < 0.812


def test_map_drops_distant_obstacles_and_bounds_their_number(monkeypatch):
    monkeypatch.setattr(obstacle_map, "MAX_TRACKS", 64)
    map_ = make_map(make_cylinder("a", 0.8, 0.0))
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
