"""A path over a platform has a height, and the joints that turn up and down take its shape."""

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


def platform(x_m: float, length_m: float, yaw_rad: float = 0.0) -> KnownObstacle:
    half = (0.5 * length_m, 0.5, 0.05)
    return KnownObstacle(
        name="step",
        shape="box",
        position_w=(x_m, 0.0, 0.05),
        half_size_m=half,
        height_m=0.1,
        yaw_rad=yaw_rad,
    )


@pytest.mark.parametrize("yaw_rad", [0.0, 0.5])
def test_a_path_rises_where_it_leads_over_a_platform(yaw_rad: float) -> None:
    rises = PlatformRises([platform(1.3, 0.6, yaw_rad), platform(3.0, 0.2)])
    first, second = rises.find_rises(1, STRAIGHT)
    half_m = 0.3 / math.cos(yaw_rad)
    assert (first.from_s_m, first.to_s_m) == pytest.approx((1.3 - half_m, 1.3 + half_m), abs=0.011)
    assert first.height_m == pytest.approx(0.1)
    assert second.from_s_m == pytest.approx(2.9, abs=0.011)
    assert rises.find_rises(2, [(0.0, 2.0), (4.0, 2.0)]) == []


@pytest.mark.parametrize("tail_s_m", [-0.9, -0.3, 0.2, 0.6, 1.1, 1.5])
def test_climb_every_body_part_has_height_of_path(tail_s_m: float) -> None:
    angles = PlatformClimb(make_robot(18, ("yaw", "pitch"))).compute_pitch_angles_rad(
        [RISE], tail_s_m
    )
    lengths = [link.length_m for link in make_robot(18, ("yaw", "pitch")).links]
    wanted = [compute_path_height_m([RISE], tail_s_m + s) for s in np.cumsum([0.0, *lengths])]
    # The tail's slope, to its first pitch.
    begins_up = np.arcsin((wanted[2] - wanted[0]) / (lengths[0] + lengths[1]))
    c, s = math.cos(begins_up), math.sin(begins_up)
    rotation = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    heights = compute_link_frames((0.0, 0.0, wanted[0]), rotation, angles, AXES, lengths)[0][:, 2]
    assert np.abs(heights[::2] - wanted[:-1:2]).max() < 1e-9
    assert np.abs(heights - wanted[:-1]).max() < CLEARANCE_M


def test_climb_needs_pitch_joints() -> None:
    assert not PlatformClimb(make_robot(13)).compute_pitch_angles_rad([RISE], 0.5).any()


def test_seen_from_above_a_body_on_a_ramp_is_shorter() -> None:
    segments = [0.1, *[0.2] * 8, 0.1]
    level, climbing = (
        BodyOnPath(Route(STRAIGHT), segments, rises).compute_pose_at(0.0).body_points_w[0]
        for rises in ([], [RISE])
    )
    assert np.all(level[:4] == climbing[:4])
    assert level[-1] == pytest.approx(1.8)
    assert 0.005 < level[-1] - climbing[-1] < 0.05
