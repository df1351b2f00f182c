"""Tests clusters of scan points, and circles and boxes that are fitted to their visible parts, with uncertainties."""

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


def track_obstacle(obstacle, *, random=None, views=((0.0, 0.0),), noise_m=NOISE_M) -> ObstacleTrack:
    """Return a track of one obstacle after lidar scans from some places, with noise if `random` is given."""
    track = ObstacleTrack(1, "it")
    for x, y in views:
        scan = make_lidar_scan(obstacle, at=(x, y))
        hits = np.flatnonzero(np.isfinite(scan.range_m))
        towards_lidar_w = scan.origin_w - scan.points_w[hits]
        towards_lidar_w = towards_lidar_w / np.hypot(*towards_lidar_w.T)[:, None]
        points_w = scan.points_w[hits]
        if random is not None:
            errors_m = noise_m * random.standard_normal(len(points_w))
            points_w = points_w - towards_lidar_w * errors_m[:, None]
        track.surface.add(points_w, np.full(len(hits), noise_m), towards_lidar_w)
    fit_shapes([track])
    return track


def test_clusters_of_separate_obstacles_are_separate():
    obstacles = [
        make_cylinder("a", 0.8, 0.3),
        make_cylinder("b", 0.8, 0.1),
        make_cylinder("behind", 1.3, 0.33),
        make_box("c", 0.7, -0.3, (0.1, 0.2)),
    ]
    scan = make_lidar_scan(*obstacles)

    def find_nearest_obstacle(beam: int) -> str:
        """Return the name of the obstacle that is nearest to the point of a beam."""
        point_w = scan.points_w[beam]
        return min(obstacles, key=lambda o: abs(compute_outline_distance_m(o, point_w))).name

    names_by_cluster = [
        {find_nearest_obstacle(beam) for beam in cluster} for cluster in find_clusters(scan)
    ]
    assert all(len(names) == 1 for names in names_by_cluster)
    assert set.union(*names_by_cluster) == {"a", "b", "behind", "c"}


def test_clusters_at_a_concave_corner_are_separate():
    walls = [make_box("ahead", 1.0, 0.0, (0.05, 1.0)), make_box("beside", 0.5, 0.5, (1.0, 0.05))]
    assert len(find_clusters(make_lidar_scan(*walls))) >= 2
    assert len(find_clusters(make_lidar_scan(walls[0]))) == 1


@given(st.floats(0.03, 0.08), st.floats(0.3, 1.2), st.floats(-0.5, 0.5), st.integers(0, 1000))
@settings(max_examples=choose_trial_count(60))
def test_cylinder_fit_error_is_within_its_standard_deviations(radius, x, y, seed):
    cylinder = make_cylinder("it", x, y, radius)
    track = track_obstacle(cylinder, random=np.random.default_rng(seed))
    error_m = math.dist(track.center_w, (x, y))
    assert error_m < 5 * track.position_sd_m
    # One in thousands is taken for a box if only five beams hit it.
    if track.shape == "cylinder":
        assert error_m < 0.02
        assert abs(track.radius_m - radius) < 5 * track.size_sd_m


@given(st.floats(0.08, 0.3), st.floats(0.08, 0.3), st.floats(0.35, 1.2), st.integers(0, 1000))
@settings(max_examples=choose_trial_count(60))
def test_box_fit_to_two_faces_finds_the_whole_box(length, width, yaw, seed):
    track = track_obstacle(
        make_box("it", 0.8, 0.1, (length, width), yaw),
        random=np.random.default_rng(seed),
        views=((0.0, 0.0), (0.0, 0.5), (0.0, -0.3)),
    )
    assert track.shape == "box"
    assert math.dist(track.center_w, (0.8, 0.1)) < 0.025
    assert sorted(2 * track.half_size_m) == pytest.approx(sorted((length, width)), abs=0.04)
    # A box that is turned by 90 degrees is the same box.
    yaw_error_rad = (track.yaw_rad - yaw + math.pi / 4) % (math.pi / 2) - math.pi / 4
    assert abs(yaw_error_rad) < 0.15


def test_box_fit_to_one_face_has_uncertain_position():
    box = make_box("it", 0.8, 0.0, (0.1, 0.16))
    face_x_m = 0.75
    from_front = track_obstacle(box)
    assert from_front.shape == "box"
    # No scan has shown the back of the box.
    assert from_front.position_sd_m > 0.015
    assert abs(from_front.center_w[1]) < 0.01
    possible_faces_m = [
        from_front.center_w[0] - min(from_front.half_size_m),
        from_front.center_w[0] - max(from_front.half_size_m),
    ]
    assert any(abs(x_m - face_x_m) < 0.01 for x_m in possible_faces_m)

    from_three_sides = track_obstacle(box, views=((0.0, 0.0), (0.3, 0.6), (0.3, -0.6)))
    assert from_three_sides.position_sd_m < 0.01
    assert math.dist(from_three_sides.center_w, (0.8, 0.0)) < 0.01


def test_box_fit_to_a_long_face_is_a_thin_wall():
    wall = track_obstacle(make_box("it", 0.8, 0.0, (0.04, 1.0)))
    assert wall.shape == "box"
    assert min(wall.half_size_m) < 0.04
    assert max(wall.half_size_m) == pytest.approx(0.5, abs=0.05)


def test_cylinder_fit_to_a_short_arc_has_uncertain_position():
    whole = track_obstacle(make_cylinder("it", 0.8, 0.0))
    middle = len(whole.surface) // 2
    arc = slice(middle - 2, middle + 2)
    part = ObstacleTrack(2, "part")
    part.surface.add(
        whole.surface.points_w[arc], np.full(4, NOISE_M), whole.surface.outward_directions_w[arc]
    )
    fit_shapes([part])
    assert part.position_sd_m > 5 * whole.position_sd_m


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), min_size=1, max_size=300))
def test_surface_cells_bound_their_number_and_information(points_w):
    surface = SurfaceCells()
    for _ in range(3):
        surface.add(
            np.array(points_w),
            np.full(len(points_w), 0.001),
            np.tile([1.0, 0.0], (len(points_w), 1)),
        )
    assert 0 < len(surface) <= MAX_CELLS
    assert surface.weights.max() <= MAX_INFORMATION


def test_shape_fit_of_several_scans_lowers_true_and_reported_error():
    random = np.random.default_rng(3)
    cylinder = make_cylinder("it", 0.8, 0.1)

    def measure_scatter_m(scans: int) -> tuple[float, float]:
        """Return the true and the reported standard deviation of positions from several scans."""
        tracks = [
            track_obstacle(cylinder, random=random, views=((0.0, 0.0),) * scans, noise_m=0.005)
            for _ in range(30)
        ]
        true_sd_m = float(np.std([track.center_w[0] for track in tracks]))
        reported_sd_m = float(np.median([track.position_sd_m for track in tracks]))
        return true_sd_m, reported_sd_m

    true_sd_of_one_m, reported_sd_of_one_m = measure_scatter_m(1)
    true_sd_of_ten_m, reported_sd_of_ten_m = measure_scatter_m(10)
    assert true_sd_of_ten_m < 0.5 * true_sd_of_one_m
    assert reported_sd_of_ten_m < 0.7 * reported_sd_of_one_m
    assert reported_sd_of_ten_m > true_sd_of_ten_m


def test_map_merges_the_pieces_of_a_wall():
    map_ = ObstacleMap()
    wall = make_box("wall", 1.0, 0.0, (0.05, 1.6))
    post = make_cylinder("post", 0.5, 0.0, 0.03)
    # The post hides the middle of the wall.
    map_.add_scan(make_lidar_scan(wall, post))
    assert len(map_.tracks) == 3
    for _ in range(8):
        map_.add_scan(make_lidar_scan(wall))
    likely_tracks = [track for track in map_.tracks if track.compute_log_odds_at(0) > 0.4]
    assert [track.shape for track in likely_tracks] == ["box"]
