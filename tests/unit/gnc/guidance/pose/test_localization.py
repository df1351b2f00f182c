"""Tests the localization of the base with and without a pose sensor, and with late, noisy and jumping poses.

The standard deviation that it reports must not be smaller than its errors suggest.
"""

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


def measure_errors_m(snake: SlidingSnake, cycles) -> list[float]:
    """Run cycles, and return the position error of the localizer after each."""
    return [
        math.dist(snake.world.localizer.base.planar_w[:2], true_pose.base_w[:2])
        for true_pose in cycles
    ]


def compute_last_true_pose(snake: SlidingSnake):
    return snake.compute_pose(snake.cycle - 1)


def test_localization_with_pose_sensor_is_precise_and_certain():
    snake = SlidingSnake([])
    errors_m = measure_errors_m(snake, snake.run_cycles(100, images=False))
    assert np.median(errors_m[5:]) < 0.0008
    assert snake.world.localizer.position_sd_m < 0.001


def test_dead_reckoning_reports_a_realistic_standard_deviation():
    snake = SlidingSnake([])
    errors_m = measure_errors_m(snake, snake.run_cycles(250, pose=False, images=False))
    localizer = snake.world.localizer
    # The snake has moved by 1 m.
    assert errors_m[-1] < 0.15
    assert errors_m[-1] < 3 * localizer.position_sd_m
    assert localizer.position_sd_m > 0.02
    assert abs(localizer.base.planar_w[2] - compute_last_true_pose(snake).base_w[2]) < 0.02


def test_dead_reckoning_of_resting_snake_does_not_drift():
    snake = SlidingSnake([], speed_m_s=0.0)
    errors_m = measure_errors_m(snake, snake.run_cycles(250, pose=False, images=False))
    assert max(errors_m) < 0.005


@pytest.mark.slow
def test_localization_by_the_map_corrects_dead_reckoning():
    last_errors_m: list[float] = []
    for images in (False, True):
        snake = SlidingSnake(make_random_obstacles(1))
        # In the first cycles, the snake has a pose sensor.
        list(snake.run_cycles(20))
        snake.world.localizer.pose_timestamp_ns = None
        errors_m = measure_errors_m(snake, snake.run_cycles(250, pose=False, images=images))
        assert errors_m[-1] < 4 * snake.world.localizer.position_sd_m
        last_errors_m.append(errors_m[-1])
    without_map_m, with_map_m = last_errors_m
    assert with_map_m < 0.5 * without_map_m
    assert with_map_m < 0.03


def test_localization_rejects_a_jumping_pose_until_it_persists():
    jump_m = 0.3
    snake = SlidingSnake([])
    localizer = snake.world.localizer
    *_, true_pose = snake.run_cycles(50, images=False)
    for true_pose in snake.run_cycles(10, pose=False, images=False):
        snake.world.add_pose(snake.make_pose(true_pose, off_m=jump_m))
    assert abs(localizer.base.planar_w[0] - true_pose.base_w[0]) < 0.03
    assert localizer.rejected_pose_count == 10
    for true_pose in snake.run_cycles(20, pose=False, images=False):
        snake.world.add_pose(snake.make_pose(true_pose, off_m=jump_m))
    assert localizer.base.planar_w[0] == pytest.approx(true_pose.base_w[0] + jump_m, abs=0.005)


def test_localization_with_late_poses_corrects_the_present_pose():
    latency_cycles = 10  # 0.2 s, in which the snake moves by 4 cm
    snake = SlidingSnake([])
    delayed_poses: list = []
    for true_pose in snake.run_cycles(150, pose=False, images=False):
        delayed_poses.append(snake.make_pose(true_pose))
        if len(delayed_poses) > latency_cycles:
            snake.world.add_pose(delayed_poses.pop(0))
    localized_w = snake.world.localizer.base.planar_w[:2]
    assert math.dist(localized_w, compute_last_true_pose(snake).base_w[:2]) < 0.012


def test_body_history_interpolates_only_between_stored_timestamps():
    snake = SlidingSnake([])
    history = BodyHistory(snake.robot)
    true_poses = [snake.compute_pose(cycle) for cycle in range(60)]
    for cycle, true_pose in enumerate(true_poses):
        base = BasePose(np.array(true_pose.base_w), 0.04, np.eye(3))
        history.add(cycle * STEP_NS, base, true_pose.angles_rad.tolist())
    assert history.interpolate_body(0) is None, "the first poses are not stored any more"
    between = history.interpolate_body(int(40.5 * STEP_NS))
    assert between is not None
    middle_w = 0.5 * (true_poses[40].head_w + true_poses[41].head_w)
    assert np.abs(between.head_end_w - middle_w).max() < 1e-4
    assert history.interpolate_body(59 * STEP_NS + 10 * STEP_NS) is None

    shift_m = 0.1
    history.shift_all_poses(np.array(true_poses[50].base_w[:2]), np.array([shift_m, 0.0, 0.0]))
    shifted = history.interpolate_base(55 * STEP_NS)
    assert shifted is not None
    assert shifted.planar_w[0] == pytest.approx(true_poses[55].base_w[0] + shift_m)


def test_quaternion_of_a_rotation_gives_the_rotation_again():
    for angles in ((0.3, 0.2, -0.1), (3.1, 0.0, 0.0), (-2.0, 1.2, 3.0), (0.0, -1.5, 1.0)):
        rotation = make_rotation(*angles)
        assert rotation_from_quaternion(quaternion_from_rotation(rotation)) == pytest.approx(
            rotation
        )
