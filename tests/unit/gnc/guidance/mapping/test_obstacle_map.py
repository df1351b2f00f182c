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
SCAN_PERIOD_NS = SECOND_NS // 20
BODY_RADIUS_M = 0.04
CYLINDER_RADIUS_M = 0.05  # of every cylinder that `make_cylinder` makes here
FACING_SENSOR_RAD = (
    3.0  # direction of a contact as seen from a cylinder's center: almost -x, where the sensor is
)


def make_map(*obstacles, scans=4) -> ObstacleMap:
    """Return a map after several scans of obstacles, 50 ms apart."""
    map_ = ObstacleMap()
    for k in range(scans):
        map_.add_scan(make_lidar_scan(*obstacles, timestamp_ns=k * SCAN_PERIOD_NS))
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
    map_after_six_scans = make_map(make_cylinder("a", 0.8, 0.0), scans=6)

    assert get_single_obstacle(map_after_one_scan).confidence < 0.65
    assert get_single_obstacle(map_after_six_scans).confidence > 0.9


def test_map_obstacle_of_scans_has_time_of_newest_scan():
    obstacle = get_single_obstacle(make_map(make_cylinder("a", 0.8, 0.0), scans=6))

    assert obstacle.last_seen_ns == 5 * SCAN_PERIOD_NS, "the first scan is at time 0"
    assert not obstacle.touched, "only a contact touches an obstacle"


def test_map_obstacle_not_seen_again_loses_confidence():
    map_ = make_map(make_cylinder("a", 0.8, 0.0), scans=6)

    confidence_now = get_single_obstacle(map_).confidence
    confidence_after_two_minutes = get_single_obstacle(map_, now_ns=120 * SECOND_NS).confidence

    assert confidence_after_two_minutes < confidence_now


@given(st.floats(0.03, 0.07), st.lists(st.floats(-1.0, 1.0), min_size=3, max_size=12))
@settings(max_examples=choose_trial_count(40))
def test_map_contacts_all_around_find_an_unseen_obstacle(radius_m, angles_rad):
    """The error of the found place is at most three of its standard deviations and 5 mm."""
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


def test_map_contact_on_scanned_obstacle_keeps_its_name():
    center_w = (0.8, 0.0)
    map_ = make_map(make_cylinder("a", *center_w))
    name_before_contact = get_single_obstacle(map_).name

    add_contact(map_, center_w, CYLINDER_RADIUS_M, FACING_SENSOR_RAD)

    obstacle = get_single_obstacle(map_)  # the contact has added no second obstacle
    assert obstacle.touched
    assert obstacle.name == name_before_contact


def test_map_contact_away_from_scanned_obstacle_adds_another_one():
    map_ = make_map(make_cylinder("scanned", 0.8, 0.0))
    unseen_center_w = (0.8, 0.4)  # 0.4 m to the left of the scanned obstacle

    add_contact(map_, (0.8, 0.0), CYLINDER_RADIUS_M, FACING_SENSOR_RAD)
    add_contact(map_, unseen_center_w, CYLINDER_RADIUS_M, FACING_SENSOR_RAD)

    assert len(map_.list_obstacles(0, 0.0)) == 2, (
        "the first contact belongs to the scanned obstacle, and only the second adds one"
    )


def test_map_finds_track_only_at_its_outline():
    center_x_m = 0.8
    map_ = make_map(make_cylinder("a", center_x_m, 0.0))
    add_contact(map_, (center_x_m, 0.0), CYLINDER_RADIUS_M, FACING_SENSOR_RAD)
    on_outline_w = np.array([center_x_m - CYLINDER_RADIUS_M, 0.0])
    far_away_w = np.array([0.5, 0.5])  # more than half a meter from the outline

    (track,) = map_.tracks
    assert map_.find_track(on_outline_w) is track
    assert map_.find_track(far_away_w) is None


def test_map_obstacle_seen_through_is_dropped():
    map_ = make_map(make_cylinder("ghost", 0.6, 0.0), make_cylinder("real", 0.8, 0.4))

    # The scans show the box behind the ghost, so their rays have passed through the place of the ghost.
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
    ), "the ghost is still in the map"
    assert has_obstacle_at(map_, 0.8, 0.4), "the real obstacle was seen in every scan"


def test_map_obstacle_hidden_or_out_of_view_is_kept():
    """A scan that cannot see an obstacle is no evidence against it."""
    map_ = make_map(make_cylinder("a", 1.2, 0.0))

    for k in range(20):
        map_.add_scan(make_lidar_scan(make_box("screen", 0.5, 0.0, (0.05, 0.8)), timestamp_ns=k))
    assert has_obstacle_at(map_, 1.2, 0.0), "the screen hides the obstacle"

    sensor_past_obstacle_w = (2.0, 0.0)  # and it looks along x, away from the obstacle
    for k in range(20):
        map_.add_scan(make_lidar_scan(at=sensor_past_obstacle_w, timestamp_ns=k))
    assert has_obstacle_at(map_, 1.2, 0.0), "the obstacle is behind the sensor"


def test_map_obstacle_inside_the_body_is_dropped():
    map_ = make_map(make_cylinder("smoke", 0.6, 0.0), make_cylinder("beside", 0.6, 0.3))

    # The head of a straight body advances along x by 2 cm a step, right through the place of the smoke.
    for k in range(40):
        head_x_m = 0.02 * k
        body_axis_w = np.column_stack([np.linspace(0, head_x_m, 50), np.zeros(50)])
        map_.remove_surfaces_in_body(body_axis_w, BODY_RADIUS_M)

    assert len(map_.list_obstacles(0, 0.0)) == 1, "only the obstacle beside the body is left"
    assert has_obstacle_at(map_, 0.6, 0.3)


def test_map_obstacle_that_overlaps_the_body_is_trimmed():
    """The scans show one face of a box. Its depth is a guess, with which it overlaps the body behind it."""
    box_x_m = 0.8
    box_depth_m = 0.03
    gap_m = 0.002  # between the back of the real box and the skin of the body
    map_ = ObstacleMap()
    for k in range(4):
        thin_box = make_box("thin", box_x_m, 0.0, (box_depth_m, 0.3))
        map_.add_scan(make_lidar_scan(thin_box, timestamp_ns=k))
    body_x_m = box_x_m + box_depth_m / 2 + gap_m + BODY_RADIUS_M
    body_axis_w = np.column_stack([np.full(40, body_x_m), np.linspace(-0.3, 0.3, 40)])

    box = get_single_obstacle(map_)
    assert box.shape == "box"
    assert measure_overlap_m(box, body_axis_w) > 0.02, "there is nothing to trim"

    for _ in range(5):
        map_.remove_surfaces_in_body(body_axis_w, BODY_RADIUS_M)

    assert measure_overlap_m(get_single_obstacle(map_), body_axis_w) < 0.012


def measure_overlap_m(obstacle: KnownObstacle, body_axis_w: np.ndarray) -> float:
    """Return how far an obstacle reaches into the body."""
    axis_distance_m = min(compute_outline_distance_m(obstacle, point_w) for point_w in body_axis_w)
    return BODY_RADIUS_M - axis_distance_m


def test_map_after_drift_trusts_the_newest_scan_most():
    """After a drift of 2 cm the map takes over a new place, which without drift only changes its mean."""
    old_x_m = 0.8
    new_x_m = 0.815
    map_without_drift = make_map(make_cylinder("a", old_x_m, 0.0))
    map_with_drift = make_map(make_cylinder("a", old_x_m, 0.0))

    map_with_drift.add_drift(0.02**2)
    for map_ in (map_without_drift, map_with_drift):
        map_.add_scan(make_lidar_scan(make_cylinder("a", new_x_m, 0.0)))

    assert get_single_obstacle(map_with_drift).position_w[0] == pytest.approx(new_x_m, abs=0.003)
    assert get_single_obstacle(map_without_drift).position_w[0] < 0.812


def test_map_drops_obstacles_beyond_the_forget_distance():
    """The distance counts from the outline of an obstacle, which is at x = 0.85 m on the side of the body."""
    map_ = make_map(make_cylinder("a", 0.8, 0.0))
    body_within_distance_w = np.array([[FORGET_DISTANCE_M + 0.5, 0.0]])
    body_too_far_w = np.array([[FORGET_DISTANCE_M + 1.0, 0.0]])

    map_.drop_distant_tracks(body_within_distance_w)
    assert len(map_.tracks) == 1

    map_.drop_distant_tracks(body_too_far_w)
    assert not map_.tracks


def test_map_bounds_the_number_of_its_obstacles(monkeypatch):
    max_tracks = 64
    monkeypatch.setattr(obstacle_map, "MAX_TRACKS", max_tracks)
    map_ = ObstacleMap()
    spacing_m = 0.2  # so that each contact starts an obstacle of its own
    normal_w = np.array([1.0, 0.0])
    contacts = [
        (np.array([spacing_m * (k % 10), spacing_m * (k // 10)]), normal_w) for k in range(100)
    ]

    map_.add_contacts(contacts, 0)
    assert len(map_.tracks) == 100, "a contact has started no obstacle of its own"

    body_at_origin_w = np.zeros((1, 2))
    map_.drop_distant_tracks(body_at_origin_w)
    assert len(map_.tracks) == max_tracks
