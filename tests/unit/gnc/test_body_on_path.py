"""A chain on a path: as the HAL lays it, found again where it is, followed from old world models."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_gnc.control.progress import BodyLocation, PathProgress
from snakesim_gnc.geometry.body_on_path import BodyOnPath, compute_chain_points, compute_heading_rad
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.model.geometry.kinematics import (
    compute_link_frames,
    quaternion_from_yaw,
    rotation_from_quaternion,
)
from snakesim_hal.model.geometry.route import place_chain_on_route
from snakesim_testing.gnc.stage import (
    PERIOD_S,
    compute_body_points,
    make_robot,
    make_route,
    make_stage,
)

SEGMENTS = [0.055, *[0.11] * 12, 0.055]
ROUTE = make_route()
BODY = BodyOnPath(ROUTE, SEGMENTS)


@given(st.floats(-1.0, 7.0))
def test_body_on_path_lies_as_the_start_pose_is_laid(tail_s_m):
    lay, lie = place_chain_on_route(ROUTE, tail_s_m, SEGMENTS), BODY.compute_pose_at(tail_s_m)
    assert lie.angles_rad == pytest.approx(lay.angles_rad, abs=5e-3)
    assert lie.body_points_w[:, 0] == pytest.approx(lay.tail_w, abs=3e-4)
    assert np.hypot(*np.diff(lie.body_points_w)) == pytest.approx(SEGMENTS, abs=2e-4)
    assert np.all(np.diff(lie.body_points_s_m) > 0)


@given(st.floats(-0.3, 4.0), st.floats(-0.03, 0.03))
def test_a_body_on_the_path_is_found_again(tail_s_m, off_m):
    lay = place_chain_on_route(ROUTE, tail_s_m, SEGMENTS)
    nodes = compute_chain_points(lay.tail_w, lay.heading_rad, lay.angles_rad.tolist(), SEGMENTS)
    assert BODY.find_tail_s_m(nodes) == pytest.approx(tail_s_m, abs=3e-4)
    assert BODY.refine_tail_s_m(nodes, tail_s_m + off_m) == pytest.approx(tail_s_m, abs=3e-4)


def test_a_body_beside_the_path_is_where_it_fits_best():
    nodes = compute_body_points(make_stage(), 0.4) + np.array([[0.0], [0.02]])
    assert BODY.find_tail_s_m(nodes) == pytest.approx(0.4, abs=0.003)


def test_nodes_are_those_of_the_3d_kinematics():
    angles = np.linspace(-0.5, 0.6, 13)
    rotation = rotation_from_quaternion(quaternion_from_yaw(0.7))
    origins, rotations = compute_link_frames(
        (1.0, 2.0, 0.0), rotation, angles, ["yaw"] * 13, SEGMENTS
    )
    nodes = compute_chain_points((1.0, 2.0), 0.7, angles.tolist(), SEGMENTS)
    assert nodes[:, :-1].T.ravel() == pytest.approx(origins[:, :2].ravel())
    assert nodes[:, -1] == pytest.approx((origins[-1] + 0.055 * rotations[-1][:, 0])[:2])


@given(st.floats(-3.1, 3.1))
def test_heading_is_computed_from_a_quaternion(yaw_rad):
    assert compute_heading_rad(quaternion_from_yaw(yaw_rad)) == pytest.approx(yaw_rad)


def test_pitch_joints_count_as_straight():
    body = PlanarBody(make_robot(4, ("yaw", "pitch")))
    assert body.yaw_joints == [0, 2]
    assert body.segments_m == pytest.approx([0.055, 0.22, 0.165])
    assert body.body_points_s_m == pytest.approx([0.0, 0.055, 0.275, 0.44])
    lie = BodyOnPath(ROUTE, body.segments_m).compute_pose_at(0.1)
    assert body.expand_joint_angles(lie) == pytest.approx(
        [lie.angles_rad[0], 0.0, lie.angles_rad[1], 0.0]
    )
    joints = body.compute_joint_positions_w(lie)
    assert joints[1] == pytest.approx((joints[0] + joints[2]) / 2)
    assert [body.find_link_at(s) for s in (0.0, 0.06, 0.2, 0.43)] == [0, 1, 2, 4]


def make_progress() -> PathProgress:
    return PathProgress(PlanarBody(make_robot()), speed_filter_s=0.03)


def follow(progress, stage, speed_m_s, ticks):
    """Feed a body that moves steadily, through world models that are two or three ticks old."""
    located = None
    for tick in range(ticks):
        seen = max(tick - 2, 0) // 2 * 2
        observation = stage.make_observation(
            tick,
            0.3 + speed_m_s * tick * PERIOD_S,
            world_age_ticks=tick - seen,
            world_tail_s_m=0.3 + speed_m_s * seen * PERIOD_S,
        )
        located = progress.update(observation)
    assert isinstance(located, BodyLocation)
    return located


@pytest.mark.parametrize("speed_m_s", [0.0, 0.2, 0.5])
def test_progress_gives_the_present_from_an_old_world_model(speed_m_s):
    located = follow(make_progress(), make_stage(), speed_m_s, 61)
    assert located.speed_m_s == pytest.approx(speed_m_s, abs=0.01)
    assert located.tail_s_m == pytest.approx(0.3 + speed_m_s * 60 * PERIOD_S, abs=1e-3)


def test_body_on_path_repeated_pose_is_not_standing_still():
    """Guidance goes on making world models when the motion capture has stopped."""
    stage, progress = make_stage(), make_progress()
    follow(progress, stage, 0.2, 61)
    for tick in range(61, 71):  # new world models, all with the pose of tick 58
        located = progress.update(
            stage.make_observation(
                tick,
                0.3 + 0.2 * tick * PERIOD_S,
                world_tail_s_m=0.3 + 0.2 * 0.58,
                pose_age_ticks=tick - 58,
            )
        )
        assert isinstance(located, BodyLocation)
        assert located.is_new_world
        assert located.speed_m_s == pytest.approx(0.2, abs=0.01)
        assert located.tail_s_m == pytest.approx(0.3 + 0.2 * tick * PERIOD_S, abs=2e-3)


def test_body_on_path_lost_body_is_located_again():
    stage, progress = make_stage(), make_progress()
    follow(progress, stage, 0.2, 61)
    for tick in range(61, 161):
        progress.update(stage.make_observation(tick, 0.5, without="world"))
    found = progress.update(stage.make_observation(161, 0.55))
    assert isinstance(found, BodyLocation)
    assert found.may_have_jumped
    assert found.tail_s_m == pytest.approx(0.55, abs=2e-3)
    assert found.speed_m_s == 0.0


def test_a_new_path_is_noticed():
    stage, progress = make_stage(), make_progress()
    first = progress.update(stage.make_observation(0, 0.3))
    again = progress.update(stage.make_observation(1, 0.3))
    stage.path_id = 7
    other = progress.update(stage.make_observation(2, 0.3))
    assert isinstance(first, BodyLocation)
    assert isinstance(again, BodyLocation)
    assert isinstance(other, BodyLocation)
    assert (first.may_have_jumped, again.may_have_jumped, other.may_have_jumped) == (
        True,
        False,
        True,
    )
