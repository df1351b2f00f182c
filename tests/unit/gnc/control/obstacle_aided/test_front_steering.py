"""Tests the corrections that lead the front of the body back to its path. docs/benchmarks measures whole runs."""

import numpy as np
import pytest

from snakesim_gnc.control.obstacle_aided.front_steering import compute_front_corrections_rad
from snakesim_gnc.geometry.body_on_path import compute_chain_points

SEGMENTS_M = [0.055, *[0.11] * 12, 0.055]
FIRST_JOINT = 8
CORRECTION_M = 0.25


def make_body_points_w(angles_rad: np.ndarray) -> np.ndarray:
    return compute_chain_points((0.0, 0.0), 0.0, angles_rad.tolist(), SEGMENTS_M)


@pytest.fixture
def path_angles_rad() -> np.ndarray:
    return 0.4 * np.sin(0.7 * np.arange(13))


def test_front_corrections_of_body_on_its_path_are_zero(path_angles_rad: np.ndarray):
    points_w = make_body_points_w(path_angles_rad)
    corrections_rad = compute_front_corrections_rad(points_w, points_w, FIRST_JOINT, CORRECTION_M)
    assert corrections_rad == pytest.approx(np.zeros(13), abs=1e-12)


@pytest.mark.parametrize("turn_rad", [-0.3, 0.2])
def test_front_corrections_lead_a_turned_front_to_the_path(
    path_angles_rad: np.ndarray, turn_rad: float
):
    path_w = make_body_points_w(path_angles_rad)
    turned_rad = path_angles_rad.copy()
    turned_rad[FIRST_JOINT - 3] += turn_rad  # all links ahead of this joint are beside the path
    body_w = make_body_points_w(turned_rad)
    corrections_rad = compute_front_corrections_rad(body_w, path_w, FIRST_JOINT, CORRECTION_M)
    assert not corrections_rad[:FIRST_JOINT].any()

    # The joints of the front take their corrected angles.
    steered_rad = turned_rad.copy()
    steered_rad[FIRST_JOINT:] = (path_angles_rad + corrections_rad)[FIRST_JOINT:]
    steered_w = make_body_points_w(steered_rad)
    head_distance_m = np.hypot(*(body_w - path_w)[:, -1])
    steered_head_distance_m = np.hypot(*(steered_w - path_w)[:, -1])
    assert steered_head_distance_m < 0.5 * head_distance_m
    # The last link points to the path, not away from it.
    assert np.hypot(*(steered_w - path_w)[:, -2]) >= steered_head_distance_m
