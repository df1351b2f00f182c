"""Tests the height of a path that leads over platforms, and the pitch joints that follow this height."""

import math

import numpy as np
import pytest

from snakesim_gnc.control.climb import CLEARANCE_M, PlatformClimb, compute_path_height_m
from snakesim_gnc.geometry.body_on_path import BodyOnPath
from snakesim_gnc.navigation.platform_rises import PlatformRises
from snakesim_hal.model.geometry.kinematics import compute_link_frames
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import KnownObstacle, PathRise
from snakesim_testing.gnc.stage import make_robot

RISE = PathRise(from_s_m=1.0, to_s_m=1.6, height_m=0.1)
AXES = ["yaw", "pitch"] * 9
STRAIGHT = [(0.0, 0.0), (4.0, 0.0)]


def make_platform(x_m: float, length_m: float, yaw_rad: float = 0.0) -> KnownObstacle:
    return KnownObstacle(
        name="step",
        shape="box",
        position_w=(x_m, 0.0, 0.05),
        half_size_m=(0.5 * length_m, 0.5, 0.05),
        height_m=0.1,
        yaw_rad=yaw_rad,
    )


@pytest.mark.parametrize("yaw_rad", [0.0, 0.5])
def test_path_over_platform_rises_along_its_outline(yaw_rad: float) -> None:
    rises = PlatformRises([make_platform(1.3, 0.6, yaw_rad), make_platform(3.0, 0.2)])
    first, second = rises.find_rises(1, STRAIGHT)
    half_length_m = 0.3 / math.cos(yaw_rad)
    assert first.from_s_m == pytest.approx(1.3 - half_length_m, abs=0.011)
    assert first.to_s_m == pytest.approx(1.3 + half_length_m, abs=0.011)
    assert first.height_m == pytest.approx(0.1)
    assert second.from_s_m == pytest.approx(2.9, abs=0.011)
    assert rises.find_rises(2, [(0.0, 2.0), (4.0, 2.0)]) == []


@pytest.mark.parametrize("tail_s_m", [-0.9, -0.3, 0.2, 0.6, 1.1, 1.5])
def test_climb_puts_each_link_at_the_height_of_the_path(tail_s_m: float) -> None:
    robot = make_robot(18, ("yaw", "pitch"))
    angles_rad = PlatformClimb(robot).compute_pitch_angles_rad([RISE], tail_s_m)
    lengths_m = [link.length_m for link in robot.links]
    expected_m = [
        compute_path_height_m([RISE], tail_s_m + s_m) for s_m in np.cumsum([0.0, *lengths_m])
    ]
    # The tail has a slope of its own, up to the first pitch joint.
    tail_slope_rad = np.arcsin((expected_m[2] - expected_m[0]) / (lengths_m[0] + lengths_m[1]))
    cos = math.cos(tail_slope_rad)
    sin = math.sin(tail_slope_rad)
    rotation = np.array([[cos, 0.0, -sin], [0.0, 1.0, 0.0], [sin, 0.0, cos]])
    origins_w, _ = compute_link_frames(
        (0.0, 0.0, expected_m[0]), rotation, angles_rad, AXES, lengths_m
    )
    heights_m = origins_w[:, 2]
    assert np.abs(heights_m[::2] - expected_m[:-1:2]).max() < 1e-9
    assert np.abs(heights_m - expected_m[:-1]).max() < CLEARANCE_M


def test_climb_without_pitch_joints_commands_no_angles() -> None:
    assert not PlatformClimb(make_robot(13)).compute_pitch_angles_rad([RISE], 0.5).any()


def test_body_on_ramp_is_shorter_seen_from_above() -> None:
    segments = [0.1, *[0.2] * 8, 0.1]
    level_x_m, climbing_x_m = (
        BodyOnPath(Route(STRAIGHT), segments, rises).compute_pose_at(0.0).body_points_w[0]
        for rises in ([], [RISE])
    )
    assert np.all(level_x_m[:4] == climbing_x_m[:4])
    assert level_x_m[-1] == pytest.approx(1.8)
    assert 0.005 < level_x_m[-1] - climbing_x_m[-1] < 0.05
