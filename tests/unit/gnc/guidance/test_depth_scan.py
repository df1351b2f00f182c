"""Depth images and ranges to scans: what stands is found, the ground and its hills are not, latency and dropouts do."""

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

EYE_M = 0.06  # height of the camera
SCENE = [
    make_cylinder("near", 0.6, 0.1, 0.04),
    make_cylinder("far", 1.2, -0.3, 0.06),
    make_box("block", 0.8, 0.4, (0.12, 0.08), 0.5),
]


def look(obstacles, rotation, *, ground=flat_ground, eye=None, at=(0.0, 0.0)) -> AzimuthScan:
    z = EYE_M + float(ground(np.array(at[0]), np.array(at[1])))
    position = np.array([*at, z])
    image = render_depth_image(obstacles, position, rotation, ground=ground, sensor_errors=eye)
    scanner = DepthScanner(INTRINSICS, RangeNoise(0.002, 0.003))
    return scanner.make_scan(
        decode_depth_m(image), 0, position, rotation, np.array([z - EYE_M, 0.0, 0.0])
    )


def errors_m(scan, obstacles) -> np.ndarray:
    points = scan.points_w[np.isfinite(scan.range_m)]
    return np.array([min(abs(compute_outline_distance_m(o, p)) for o in obstacles) for p in points])


@pytest.mark.parametrize(
    ("ground", "eye", "median_m", "max_m"),
    [
        (flat_ground, None, 0.001, 0.006),
        (make_hills(0.02, 1.5), SensorErrors(0.002, 0.003, 0.01), 0.004, 0.02),
    ],
    ids=["flat", "hills and noise"],
)
def test_points_lie_on_what_stands_there(ground, eye, median_m, max_m):
    off = errors_m(look(SCENE, make_rotation(0.1), ground=ground, eye=eye), SCENE)
    assert len(off) > 20
    assert np.median(off) < median_m
    assert off.max() < max_m


@pytest.mark.slow
@given(st.floats(-0.6, 0.6), st.floats(-0.1, 0.15), st.floats(-0.15, 0.15))
def test_depth_scan_points_are_right_with_rotated_head(yaw, pitch, roll):
    scan = look(SCENE, make_rotation(yaw, pitch, roll))
    off = errors_m(scan, SCENE)
    assert len(off) == 0 or (np.median(off) < 0.004 and off.max() < 0.02)


def test_depth_scan_averages_noise_and_bridges_dropouts():
    scan = look(SCENE, make_rotation(0.0), eye=SensorErrors(0.004, 0.004, 0.1))
    off = errors_m(scan, SCENE)
    assert len(off) > 20
    assert np.median(off) < 0.003
    hits = np.flatnonzero(np.isfinite(scan.range_m) & (scan.range_m < 0.7))
    assert set(np.diff(hits)) == {1}


@pytest.mark.parametrize("seed", range(4))
def test_depth_scan_hills_are_ground(seed):
    ground = make_hills(0.02 + 0.01 * seed, 1.5)
    at = (0.7 * seed, 0.3 * seed)
    scan = look(
        [],
        make_rotation(0.4 * seed),
        ground=ground,
        eye=SensorErrors(0.002, 0.003, 0.01, np.random.default_rng(seed)),
        at=at,
    )
    assert not np.isfinite(scan.range_m).any()
    assert np.median(scan.free_m) > 0.5  # which one can see along


def test_free_space_ends_at_the_first_obstacle():
    scan = look(SCENE, make_rotation(0.0))
    # Before and behind the near one.
    bins, ranges = scan.find_bins(np.array([[0.5, 0.083], [2.0, 0.333]]))
    assert bins[0] == bins[1] >= 0
    assert ranges[0] < scan.compute_clear_distances_m()[bins[0]] < ranges[1]
    assert scan.find_bins(np.array([-1.0, 0.0]))[0] == -1


def test_nothing_seen_is_nothing_known():
    dark = look(SCENE, make_rotation(0.0), eye=SensorErrors(dropout=1.0))
    assert not np.isfinite(dark.range_m).any()
    assert not dark.free_m.any()


def test_a_lidar_sees_the_same_shapes_all_around():
    position, rotation = np.array([0.0, 0.0, 0.05]), make_rotation(0.3)
    around = [*SCENE, make_cylinder("left", 0.1, 0.5)]
    scan = make_scan(
        render_lidar_scan(around, position, rotation), position, rotation, 0.0, RangeNoise()
    )
    off = errors_m(scan, around)
    assert len(off) > 30
    assert off.max() < 1e-6
    names = {
        min(around, key=lambda o: abs(compute_outline_distance_m(o, p))).name
        for p in scan.points_w
        if np.isfinite(p[0])
    }
    assert names == {"near", "far", "block", "left"}


def test_a_beam_into_the_ground_is_no_obstacle():
    position, rotation = np.array([0.0, 0.0, 0.05]), make_rotation(0.0, 0.1)
    ranges = render_lidar_scan([], position, rotation, beam_count=1)
    scan = make_scan(ranges, position, rotation, 0.0, RangeNoise())
    assert not np.isfinite(scan.range_m).any()


def test_depth_scan_ground_plane_follows_slope_but_not_objects():
    bottoms = np.column_stack(
        [np.linspace(-1.4, 0, 14), np.zeros(14), 0.05 * np.linspace(-1.4, 0, 14)]
    )
    plane = fit_plane_under_body(bottoms, np.zeros(2))
    assert plane == pytest.approx([0.0, 0.05, 0.0], abs=0.01)
    random = np.random.default_rng(0)
    x, y = random.uniform(0, 1, 400), random.uniform(-0.5, 0.5, 400)
    ground = np.column_stack([x, y, 0.05 * x - 0.03 * y])
    peg = np.column_stack([np.full(80, 0.5), np.full(80, 0.1), random.uniform(0, 0.2, 80)])
    found = refine_plane(plane, np.vstack([ground, peg]))
    assert found == pytest.approx([0.0, 0.05, -0.03], abs=0.005)
    assert math.isclose(refine_plane(plane, ground[:5])[1], plane[1])  # too few points to say
