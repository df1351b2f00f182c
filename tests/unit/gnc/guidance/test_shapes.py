"""Clusters and shapes: what belongs together, circles and boxes from what of them is seen, and how sure that is."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snakesim_gnc.guidance.mapping.clusters import find_clusters
from snakesim_gnc.guidance.mapping.obstacle_map import ObstacleMap
from snakesim_gnc.guidance.mapping.surfaces import MAX_CELLS, MAX_INFORMATION, SurfaceCells
from snakesim_gnc.guidance.mapping.tracks import ObstacleTrack, fit_shapes
from snakesim_hal.model.geometry.outlines import compute_outline_distance_m
from snakesim_testing.gnc.rendered import make_box, make_cylinder, make_lidar_scan
from snakesim_testing.hypothesis_profiles import choose_trial_count

NOISE_M = 0.002


def track_shape(truth, *, random=None, views=((0.0, 0.0),), noise_m=NOISE_M) -> ObstacleTrack:
    """A track of what a lidar saw of one obstacle, from some places."""
    track = ObstacleTrack(1, "it")
    for x, y in views:
        scan = make_lidar_scan(truth, at=(x, y))
        hits = np.flatnonzero(np.isfinite(scan.range_m))
        towards = scan.origin_w - scan.points_w[hits]
        towards = towards / np.hypot(*towards.T)[:, None]
        points = scan.points_w[hits]
        if random is not None:
            points = points - towards * noise_m * random.standard_normal(len(points))[:, None]
        track.surface.add(points, np.full(len(hits), noise_m), towards)
    fit_shapes([track])
    return track


def test_shapes_of_separate_objects_are_separate_clusters():
    things = [
        make_cylinder("a", 0.8, 0.3),
        make_cylinder("b", 0.8, 0.1),
        make_cylinder("behind", 1.3, 0.33),
        make_box("c", 0.7, -0.3, (0.1, 0.2)),
    ]
    scan = make_lidar_scan(*things)
    clusters = find_clusters(scan)
    owners = [
        {
            min(things, key=lambda o: abs(compute_outline_distance_m(o, scan.points_w[i]))).name
            for i in c
        }
        for c in clusters
    ]
    assert all(len(names) == 1 for names in owners)
    assert set.union(*owners) == {"a", "b", "behind", "c"}


def test_a_concave_corner_is_two_things():
    walls = [make_box("ahead", 1.0, 0.0, (0.05, 1.0)), make_box("beside", 0.5, 0.5, (1.0, 0.05))]
    assert len(find_clusters(make_lidar_scan(*walls))) >= 2
    assert len(find_clusters(make_lidar_scan(walls[0]))) == 1


@given(st.floats(0.03, 0.08), st.floats(0.3, 1.2), st.floats(-0.5, 0.5), st.integers(0, 1000))
@settings(max_examples=choose_trial_count(60))
def test_a_cylinder_is_found_as_well_as_its_covariance_says(radius, x, y, seed):
    track = track_shape(make_cylinder("it", x, y, radius), random=np.random.default_rng(seed))
    off = math.dist(track.center_w, (x, y))
    assert off < 5 * track.position_sd_m
    if track.shape == "cylinder":  # seen by five beams, one in thousands is taken for a box
        assert off < 0.02
        assert abs(track.radius_m - radius) < 5 * track.size_sd_m


@given(st.floats(0.08, 0.3), st.floats(0.08, 0.3), st.floats(0.35, 1.2), st.integers(0, 1000))
@settings(max_examples=choose_trial_count(60))
def test_a_box_seen_at_two_faces_is_found_whole(length, width, yaw, seed):
    truth = make_box("it", 0.8, 0.1, (length, width), yaw)
    track = track_shape(
        truth, random=np.random.default_rng(seed), views=((0.0, 0.0), (0.0, 0.5), (0.0, -0.3))
    )
    assert track.shape == "box"
    assert math.dist(track.center_w, (0.8, 0.1)) < 0.025
    assert sorted(2 * track.half_size_m) == pytest.approx(sorted((length, width)), abs=0.04)
    turn = (track.yaw_rad - yaw + math.pi / 4) % (math.pi / 2) - math.pi / 4
    assert abs(turn) < 0.15


def test_shape_with_single_visible_face_marks_depth_as_guess():
    one = track_shape(make_box("it", 0.8, 0.0, (0.1, 0.16)))
    assert one.shape == "box"
    assert one.position_sd_m > 0.015  # its back side is open
    face = one.center_w[0] - min(one.half_size_m)
    assert abs(one.center_w[1]) < 0.01
    assert abs(face - 0.75) < 0.01 or abs(one.center_w[0] - max(one.half_size_m) - 0.75) < 0.01
    around = track_shape(
        make_box("it", 0.8, 0.0, (0.1, 0.16)), views=((0.0, 0.0), (0.3, 0.6), (0.3, -0.6))
    )
    assert around.position_sd_m < 0.01
    assert math.dist(around.center_w, (0.8, 0.0)) < 0.01


def test_a_long_face_is_a_thin_wall():
    wall = track_shape(make_box("it", 0.8, 0.0, (0.04, 1.0)))
    assert wall.shape == "box"
    assert min(wall.half_size_m) < 0.04
    assert max(wall.half_size_m) == pytest.approx(0.5, abs=0.05)


def test_a_short_arc_leaves_the_line_of_sight_uncertain():
    whole, part = track_shape(make_cylinder("it", 0.8, 0.0)), ObstacleTrack(2, "part")
    few = slice(len(whole.surface) // 2 - 2, len(whole.surface) // 2 + 2)
    part.surface.add(
        whole.surface.points_w[few], np.full(4, NOISE_M), whole.surface.outward_directions_w[few]
    )
    fit_shapes([part])
    assert part.position_sd_m > 5 * whole.position_sd_m


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=300))
def test_a_surface_is_bounded_and_never_surer_than_the_mount(places):
    surface = SurfaceCells()
    for _ in range(3):
        surface.add(
            np.array(places), np.full(len(places), 0.001), np.tile([1.0, 0.0], (len(places), 1))
        )
    assert 0 < len(surface) <= MAX_CELLS
    assert surface.weights.max() <= MAX_INFORMATION


def test_fusing_looks_lowers_the_scatter_and_the_told_error():
    random, truth = np.random.default_rng(3), make_cylinder("it", 0.8, 0.1)

    def scatter_m(looks: int) -> tuple[float, float]:
        found = [
            track_shape(truth, random=random, views=((0.0, 0.0),) * looks, noise_m=0.005)
            for _ in range(30)
        ]
        return float(np.std([t.center_w[0] for t in found])), float(
            np.median([t.position_sd_m for t in found])
        )

    once, often = scatter_m(1), scatter_m(10)
    assert often[0] < 0.5 * once[0]
    assert often[1] < 0.7 * once[1]
    assert often[1] > often[0]  # it is not thought better than it is


def test_pieces_of_a_wall_become_one():
    map_ = ObstacleMap()
    hidden = [make_box("wall", 1.0, 0.0, (0.05, 1.6)), make_cylinder("post", 0.5, 0.0, 0.03)]
    map_.add_scan(make_lidar_scan(*hidden))
    assert len(map_.tracks) == 3  # the post hides the middle of the wall
    for _ in range(8):
        map_.add_scan(make_lidar_scan(hidden[0]))
    assert [t.shape for t in map_.tracks if t.compute_log_odds_at(0) > 0.4] == ["box"]
