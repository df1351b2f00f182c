"""Tests scans that are made from depth images and ranges: obstacles are in them, the ground and its hills are not."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_gnc.guidance.ranging.depth_scan import DepthScanner, decode_depth_m
from snakesim_gnc.guidance.ranging.ground import fit_plane_under_body, refine_plane
from snakesim_gnc.guidance.ranging.scan import AzimuthScan, RangeNoise, make_scan
from snakesim_hal.model.geometry.outlines import compute_outline_distance_m
from snakesim_testing.gnc.rendered import (
    INTRINSICS,
    SensorErrors,
    flat_ground,
    make_box,
    make_cylinder,
    make_hills,
    make_rotation,
    render_depth_image,
    render_lidar_scan,
)

CAMERA_HEIGHT_M = 0.06
SCENE = [
    make_cylinder("near", 0.6, 0.1, 0.04),
    make_cylinder("far", 1.2, -0.3, 0.06),
    make_box("block", 0.8, 0.4, (0.12, 0.08), 0.5),
]


def make_depth_scan(
    obstacles, rotation, *, ground=flat_ground, sensor_errors=None, place_m=(0.0, 0.0)
) -> AzimuthScan:
    """Return the scan of a rendered depth image from a camera above this place of the ground."""
    ground_m = float(ground(np.array(place_m[0]), np.array(place_m[1])))
    position_w = np.array([*place_m, CAMERA_HEIGHT_M + ground_m])
    image = render_depth_image(
        obstacles, position_w, rotation, ground=ground, sensor_errors=sensor_errors
    )
    scanner = DepthScanner(INTRINSICS, RangeNoise(0.002, 0.003))
    ground_plane = np.array([position_w[2] - CAMERA_HEIGHT_M, 0.0, 0.0])
    return scanner.make_scan(decode_depth_m(image), 0, position_w, rotation, ground_plane)


def find_nearest_obstacle(obstacles, point_w):
    return min(obstacles, key=lambda obstacle: abs(compute_outline_distance_m(obstacle, point_w)))


def measure_errors_m(scan, obstacles) -> np.ndarray:
    """Return the distance of each point of a scan from the outline of the nearest obstacle."""
    points_w = scan.points_w[np.isfinite(scan.range_m)]
    return np.array(
        [
            abs(compute_outline_distance_m(find_nearest_obstacle(obstacles, point_w), point_w))
            for point_w in points_w
        ]
    )


@pytest.mark.parametrize(
    ("ground", "sensor_errors", "max_median_m", "max_m"),
    [
        (flat_ground, None, 0.001, 0.006),
        (make_hills(0.02, 1.5), SensorErrors(0.002, 0.003, 0.01), 0.004, 0.02),
    ],
    ids=["flat", "hills and noise"],
)
def test_depth_scan_points_are_on_the_outlines_of_obstacles(
    ground, sensor_errors, max_median_m, max_m
):
    scan = make_depth_scan(SCENE, make_rotation(0.1), ground=ground, sensor_errors=sensor_errors)
    errors_m = measure_errors_m(scan, SCENE)
    assert len(errors_m) > 20
    assert np.median(errors_m) < max_median_m
    assert errors_m.max() < max_m


@pytest.mark.slow
@given(st.floats(-0.6, 0.6), st.floats(-0.1, 0.15), st.floats(-0.15, 0.15))
def test_depth_scan_points_are_on_outlines_with_rotated_head(yaw, pitch, roll):
    scan = make_depth_scan(SCENE, make_rotation(yaw, pitch, roll))
    errors_m = measure_errors_m(scan, SCENE)
    assert len(errors_m) == 0 or (np.median(errors_m) < 0.004 and errors_m.max() < 0.02)


def test_depth_scan_averages_noise_and_bridges_dropouts():
    scan = make_depth_scan(SCENE, make_rotation(0.0), sensor_errors=SensorErrors(0.004, 0.004, 0.1))
    errors_m = measure_errors_m(scan, SCENE)
    assert len(errors_m) > 20
    assert np.median(errors_m) < 0.003
    # The near cylinder has no gaps.
    hits = np.flatnonzero(np.isfinite(scan.range_m) & (scan.range_m < 0.7))
    assert set(np.diff(hits)) == {1}


@pytest.mark.parametrize("seed", range(4))
def test_depth_scan_hills_are_no_obstacles(seed):
    scan = make_depth_scan(
        [],
        make_rotation(0.4 * seed),
        ground=make_hills(0.02 + 0.01 * seed, 1.5),
        sensor_errors=SensorErrors(0.002, 0.003, 0.01, np.random.default_rng(seed)),
        place_m=(0.7 * seed, 0.3 * seed),
    )
    assert not np.isfinite(scan.range_m).any()
    assert np.median(scan.free_m) > 0.5


def test_depth_scan_free_space_ends_at_the_first_obstacle():
    scan = make_depth_scan(SCENE, make_rotation(0.0))
    # The near obstacle is between these points, in their direction.
    bins, ranges_m = scan.find_bins(np.array([[0.5, 0.083], [2.0, 0.333]]))
    assert bins[0] == bins[1] >= 0
    assert ranges_m[0] < scan.compute_clear_distances_m()[bins[0]] < ranges_m[1]
    assert scan.find_bins(np.array([-1.0, 0.0]))[0] == -1


def test_depth_scan_of_image_without_depth_is_unknown():
    scan = make_depth_scan(SCENE, make_rotation(0.0), sensor_errors=SensorErrors(dropout=1.0))
    assert not np.isfinite(scan.range_m).any()
    assert not scan.free_m.any()


def test_lidar_scan_points_are_on_outlines_all_around():
    position_w = np.array([0.0, 0.0, 0.05])
    rotation = make_rotation(0.3)
    obstacles = [*SCENE, make_cylinder("left", 0.1, 0.5)]
    beams = render_lidar_scan(obstacles, position_w, rotation)
    scan = make_scan(beams, position_w, rotation, 0.0, RangeNoise())
    errors_m = measure_errors_m(scan, obstacles)
    assert len(errors_m) > 30
    assert errors_m.max() < 1e-6
    names = {
        find_nearest_obstacle(obstacles, point_w).name
        for point_w in scan.points_w
        if np.isfinite(point_w[0])
    }
    assert names == {"near", "far", "block", "left"}


def test_lidar_scan_beam_into_the_ground_is_no_obstacle():
    position_w = np.array([0.0, 0.0, 0.05])
    rotation = make_rotation(0.0, 0.1)
    beams = render_lidar_scan([], position_w, rotation, beam_count=1)
    scan = make_scan(beams, position_w, rotation, 0.0, RangeNoise())
    assert not np.isfinite(scan.range_m).any()


def test_depth_scan_ground_plane_follows_slope_but_not_objects():
    slope_x = 0.05
    slope_y = -0.03
    body_x_m = np.linspace(-1.4, 0, 14)
    underside_w = np.column_stack([body_x_m, np.zeros(14), slope_x * body_x_m])
    plane = fit_plane_under_body(underside_w, np.zeros(2))
    assert plane == pytest.approx([0.0, slope_x, 0.0], abs=0.01)

    random = np.random.default_rng(0)
    x_m = random.uniform(0, 1, 400)
    y_m = random.uniform(-0.5, 0.5, 400)
    ground_w = np.column_stack([x_m, y_m, slope_x * x_m + slope_y * y_m])
    peg_w = np.column_stack([np.full(80, 0.5), np.full(80, 0.1), random.uniform(0, 0.2, 80)])
    refined = refine_plane(plane, np.vstack([ground_w, peg_w]))
    assert refined == pytest.approx([0.0, slope_x, slope_y], abs=0.005)
    # Five points are too few to change the plane.
    assert math.isclose(refine_plane(plane, ground_w[:5])[1], plane[1])
