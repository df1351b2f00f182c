"""Tests the pose of a body on a path, its location by the measured body, and its progress from old world models."""

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
TAIL_S_M = 0.3  # of the tail on the path, at the start


@given(st.floats(-1.0, 7.0))
def test_body_on_path_equals_the_start_pose_of_the_hal(tail_s_m):
    placed = place_chain_on_route(ROUTE, tail_s_m, SEGMENTS)
    pose = BODY.compute_pose_at(tail_s_m)
    assert pose.angles_rad == pytest.approx(placed.angles_rad, abs=5e-3)
    assert pose.body_points_w[:, 0] == pytest.approx(placed.tail_w, abs=3e-4)
    assert np.hypot(*np.diff(pose.body_points_w)) == pytest.approx(SEGMENTS, abs=2e-4)
    assert np.all(np.diff(pose.body_points_s_m) > 0)


@given(st.floats(-0.3, 4.0), st.floats(-0.03, 0.03))
def test_find_tail_of_body_on_path_returns_its_position(tail_s_m, guess_error_m):
    placed = place_chain_on_route(ROUTE, tail_s_m, SEGMENTS)
    body_points_w = compute_chain_points(
        placed.tail_w, placed.heading_rad, placed.angles_rad.tolist(), SEGMENTS
    )
    assert BODY.find_tail_s_m(body_points_w) == pytest.approx(tail_s_m, abs=3e-4)
    assert BODY.refine_tail_s_m(body_points_w, tail_s_m + guess_error_m) == pytest.approx(
        tail_s_m, abs=3e-4
    )


def test_find_tail_of_body_beside_path_returns_best_fit():
    body_points_w = compute_body_points(make_stage(), 0.4) + np.array([[0.0], [0.02]])
    assert BODY.find_tail_s_m(body_points_w) == pytest.approx(0.4, abs=0.003)


def test_chain_points_equal_those_of_the_3d_kinematics():
    angles_rad = np.linspace(-0.5, 0.6, 13)
    rotation = rotation_from_quaternion(quaternion_from_yaw(0.7))
    origins, rotations = compute_link_frames(
        (1.0, 2.0, 0.0), rotation, angles_rad, ["yaw"] * 13, SEGMENTS
    )
    chain_points_w = compute_chain_points((1.0, 2.0), 0.7, angles_rad.tolist(), SEGMENTS)
    assert chain_points_w[:, :-1].T.ravel() == pytest.approx(origins[:, :2].ravel())
    assert chain_points_w[:, -1] == pytest.approx((origins[-1] + 0.055 * rotations[-1][:, 0])[:2])


@given(st.floats(-3.1, 3.1))
def test_heading_is_computed_from_a_quaternion(yaw_rad):
    assert compute_heading_rad(quaternion_from_yaw(yaw_rad)) == pytest.approx(yaw_rad)


def test_planar_body_treats_pitch_joints_as_straight():
    body = PlanarBody(make_robot(4, ("yaw", "pitch")))
    assert body.yaw_joints == [0, 2]
    assert body.segments_m == pytest.approx([0.055, 0.22, 0.165])
    assert body.body_points_s_m == pytest.approx([0.0, 0.055, 0.275, 0.44])
    pose = BodyOnPath(ROUTE, body.segments_m).compute_pose_at(0.1)
    assert body.expand_joint_angles(pose) == pytest.approx(
        [pose.angles_rad[0], 0.0, pose.angles_rad[1], 0.0]
    )
    joints_w = body.compute_joint_positions_w(pose)
    assert joints_w[1] == pytest.approx((joints_w[0] + joints_w[2]) / 2)
    assert [body.find_link_at(s) for s in (0.0, 0.06, 0.2, 0.43)] == [0, 1, 2, 4]


def make_progress() -> PathProgress:
    return PathProgress(PlanarBody(make_robot()), speed_filter_s=0.03)


def follow_moving_body(progress, stage, speed_m_s, ticks):
    """Update the progress of a body at constant speed, from world models that are two or three ticks old."""
    location = None
    for tick in range(ticks):
        world_tick = max(tick - 2, 0) // 2 * 2
        observation = stage.make_observation(
            tick,
            TAIL_S_M + speed_m_s * tick * PERIOD_S,
            world_age_ticks=tick - world_tick,
            world_tail_s_m=TAIL_S_M + speed_m_s * world_tick * PERIOD_S,
        )
        location = progress.update(observation)
    assert isinstance(location, BodyLocation)
    return location


@pytest.mark.parametrize("speed_m_s", [0.0, 0.2, 0.5])
def test_progress_from_old_world_model_gives_present_position(speed_m_s):
    location = follow_moving_body(make_progress(), make_stage(), speed_m_s, 61)
    assert location.speed_m_s == pytest.approx(speed_m_s, abs=0.01)
    assert location.tail_s_m == pytest.approx(TAIL_S_M + speed_m_s * 60 * PERIOD_S, abs=1e-3)


def test_progress_with_repeated_pose_keeps_its_speed():
    """Guidance still makes world models after the motion capture has stopped."""
    speed_m_s = 0.2
    last_pose_tick = 58
    stage = make_stage()
    progress = make_progress()
    follow_moving_body(progress, stage, speed_m_s, 61)
    for tick in range(61, 71):
        location = progress.update(
            stage.make_observation(
                tick,
                TAIL_S_M + speed_m_s * tick * PERIOD_S,
                world_tail_s_m=TAIL_S_M + speed_m_s * last_pose_tick * PERIOD_S,
                pose_age_ticks=tick - last_pose_tick,
            )
        )
        assert isinstance(location, BodyLocation)
        assert location.is_new_world
        assert location.speed_m_s == pytest.approx(speed_m_s, abs=0.01)
        assert location.tail_s_m == pytest.approx(TAIL_S_M + speed_m_s * tick * PERIOD_S, abs=2e-3)


def test_progress_after_missing_world_models_locates_body_again():
    stage = make_stage()
    progress = make_progress()
    follow_moving_body(progress, stage, 0.2, 61)
    for tick in range(61, 161):
        progress.update(stage.make_observation(tick, 0.5, without="world"))
    location = progress.update(stage.make_observation(161, 0.55))
    assert isinstance(location, BodyLocation)
    assert location.may_have_jumped
    assert location.tail_s_m == pytest.approx(0.55, abs=2e-3)
    assert location.speed_m_s == 0.0


def test_progress_on_new_path_reports_a_possible_jump():
    stage = make_stage()
    progress = make_progress()
    first = progress.update(stage.make_observation(0, TAIL_S_M))
    on_same_path = progress.update(stage.make_observation(1, TAIL_S_M))
    stage.path_id = 7
    on_new_path = progress.update(stage.make_observation(2, TAIL_S_M))
    assert isinstance(first, BodyLocation)
    assert isinstance(on_same_path, BodyLocation)
    assert isinstance(on_new_path, BodyLocation)
    assert first.may_have_jumped
    assert not on_same_path.may_have_jumped
    assert on_new_path.may_have_jumped
