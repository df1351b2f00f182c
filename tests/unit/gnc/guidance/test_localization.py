"""Where the robot is: with and without a pose sensor, with late, noisy and jumping poses; the covariance is honest."""

import math

import numpy as np
import pytest

from snakesim_gnc.guidance.pose.body_history import BasePose, BodyHistory
from snakesim_hal.model.geometry.kinematics import (
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from snakesim_testing.gnc.rendered import make_rotation
from snakesim_testing.gnc.sliding_snake import STEP_NS, SlidingSnake, make_random_obstacles


def errors_m(drive: SlidingSnake, places) -> list[float]:
    return [math.dist(drive.world.localizer.base.planar_w[:2], here.base_w[:2]) for here in places]


def test_localization_with_pose_sensor_is_at_least_as_certain():
    drive = SlidingSnake([])
    off = errors_m(drive, drive.run_cycles(100, images=False))
    assert np.median(off[5:]) < 0.0008
    assert drive.world.localizer.position_sd_m < 0.001


def test_dead_reckoning_knows_how_wrong_it_is():
    drive = SlidingSnake([])
    off = errors_m(drive, drive.run_cycles(250, pose=False, images=False))
    sd = drive.world.localizer.position_sd_m
    assert off[-1] < 0.15
    assert off[-1] < 3 * sd  # of 1 m that it has gone
    assert drive.world.localizer.position_sd_m > 0.02
    assert (
        abs(drive.world.localizer.base.planar_w[2] - drive.compute_pose(drive.cycle - 1).base_w[2])
        < 0.02
    )


def test_a_snake_that_does_not_move_its_joints_stays():
    drive = SlidingSnake([], speed_m_s=0.0)
    off = errors_m(drive, drive.run_cycles(250, pose=False, images=False))
    assert max(off) < 0.005


@pytest.mark.slow
def test_the_map_corrects_dead_reckoning():
    off: dict[bool, float] = {}
    for images in (False, True):
        drive = SlidingSnake(make_random_obstacles(1))
        list(drive.run_cycles(20))  # it begins with a pose
        drive.world.localizer.pose_timestamp_ns = None
        off[images] = errors_m(drive, drive.run_cycles(250, pose=False, images=images))[-1]
        assert off[images] < 4 * drive.world.localizer.position_sd_m
    assert off[True] < 0.5 * off[False]
    assert off[True] < 0.03


def test_a_pose_that_jumps_is_not_believed_until_it_stays():
    drive = SlidingSnake([])
    *_, here = drive.run_cycles(50, images=False)
    for here in drive.run_cycles(10, pose=False, images=False):
        drive.world.add_pose(drive.make_pose(here, off_m=0.3))
    assert abs(drive.world.localizer.base.planar_w[0] - here.base_w[0]) < 0.03
    assert drive.world.localizer.rejected_pose_count == 10
    for here in drive.run_cycles(20, pose=False, images=False):
        drive.world.add_pose(drive.make_pose(here, off_m=0.3))
    assert drive.world.localizer.base.planar_w[0] == pytest.approx(here.base_w[0] + 0.3, abs=0.005)


def test_a_late_pose_corrects_what_has_happened_since():
    drive = SlidingSnake([])
    late: list = []
    for here in drive.run_cycles(150, pose=False, images=False):
        late.append(drive.make_pose(here))
        if len(late) > 10:  # 0.2 s, in which it goes 4 cm
            drive.world.add_pose(late.pop(0))
    assert (
        math.dist(
            drive.world.localizer.base.planar_w[:2], drive.compute_pose(drive.cycle - 1).base_w[:2]
        )
        < 0.012
    )


def test_localization_history_returns_body_only_at_stored_timestamps():
    drive = SlidingSnake([])
    history = BodyHistory(drive.robot)
    places = [drive.compute_pose(k) for k in range(60)]
    for k, here in enumerate(places):
        history.add(
            k * STEP_NS, BasePose(np.array(here.base_w), 0.04, np.eye(3)), here.angles_rad.tolist()
        )
    assert history.interpolate_body(0) is None  # longer ago than it remembers
    half = history.interpolate_body(int(40.5 * STEP_NS))
    assert half is not None
    middle = 0.5 * (places[40].head_w + places[41].head_w)
    assert np.abs(half.head_end_w - middle).max() < 1e-4
    assert history.interpolate_body(59 * STEP_NS + 10 * STEP_NS) is None
    history.shift_all_poses(np.array(places[50].base_w[:2]), np.array([0.1, 0.0, 0.0]))
    moved = history.interpolate_base(55 * STEP_NS)
    assert moved is not None
    assert moved.planar_w[0] == pytest.approx(places[55].base_w[0] + 0.1)


def test_quaternions_go_there_and_back():
    for angles in ((0.3, 0.2, -0.1), (3.1, 0.0, 0.0), (-2.0, 1.2, 3.0), (0.0, -1.5, 1.0)):
        rotation = make_rotation(*angles)
        assert rotation_from_quaternion(quaternion_from_rotation(rotation)) == pytest.approx(
            rotation
        )
