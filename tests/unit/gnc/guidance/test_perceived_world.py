"""Compares the map of a snake that moves through an unknown random scene with the true obstacles."""

import msgspec
import numpy as np
import pytest

from snakesim_gnc.guidance.perceived_world import PerceivedWorld
from snakesim_gnc.guidance.pose.localization import PoseNoise
from snakesim_hal.wire.messages import Contacts, WorldModel
from snakesim_operator.results.metrics.map_score import MapScore, align_map, score_map
from snakesim_testing.gnc.rendered import make_cylinder, make_hills, render_lidar_scan
from snakesim_testing.gnc.sliding_snake import NOISE, STEP_NS, SlidingSnake, make_random_obstacles
from snakesim_testing.hal.small_robots import make_link_contact


def make_current_world(snake: SlidingSnake) -> WorldModel:
    """Return the world model of the present cycle."""
    world = snake.world.make_world(snake.cycle, snake.cycle * STEP_NS)
    assert world is not None
    return world


def score_cycles(snake: SlidingSnake, cycles: int, *, pose: bool = True) -> MapScore:
    """Compare the map with the true obstacles every half second.

    Without a pose sensor, the map is moved to the true pose first: only relative positions count.
    """
    total = MapScore()
    for true_pose in snake.run_cycles(cycles, pose=pose):
        if snake.cycle % 25 == 0 and snake.cycle > 25:
            obstacles = make_current_world(snake).obstacles
            if not pose:
                localized_w = snake.world.localizer.base.planar_w.tolist()
                obstacles = align_map(obstacles, localized_w, true_pose.base_w)
            heading_rad = true_pose.headings_rad[-1]
            total.add(score_map(obstacles, snake.obstacles, true_pose.head_w, heading_rad))
    return total


@pytest.mark.slow  # a lidar maps the same below
def test_perceived_random_scene_is_mapped_to_millimeters():
    total = score_cycles(SlidingSnake(make_random_obstacles(1)), 200)
    assert len(total.position_errors_m) > 30
    assert total.visible_count > 20
    assert np.median(total.position_errors_m) < 0.005
    assert np.median(total.surface_errors_m) < 0.003
    assert total.missed_count <= 0.05 * total.visible_count
    assert total.ghost_count <= 0.02 * total.reported_count
    assert np.median(total.position_errors_in_sd) < 1.5
    assert np.percentile(total.position_errors_in_sd, 90) < 3.5


@pytest.mark.slow  # a whole run on hills is in tests/system/physics/test_locomotion.py
def test_perceived_random_scene_on_hills_is_mapped():
    total = score_cycles(SlidingSnake(make_random_obstacles(2), ground=make_hills(0.02, 1.5)), 200)
    assert np.median(total.position_errors_m) < 0.008
    assert total.missed_count <= 0.1 * total.visible_count
    assert total.ghost_count <= 0.05 * total.reported_count


@pytest.mark.slow
def test_perceived_world_without_pose_sensor_is_right_relative_to_robot():
    total = score_cycles(SlidingSnake(make_random_obstacles(3)), 300, pose=False)
    assert np.median(total.position_errors_m) < 0.02
    assert total.ghost_count <= 0.1 * total.reported_count


@pytest.mark.slow
def test_perceived_image_is_added_at_its_capture_pose():
    """At 0.4 m/s an image is 16 mm old, and the head turns meanwhile."""
    snake = SlidingSnake(make_random_obstacles(1), speed_m_s=0.4)
    assert np.median(score_cycles(snake, 150).position_errors_m) < 0.006


def test_perceived_samples_without_body_pose_are_counted_and_ignored():
    snake = SlidingSnake(make_random_obstacles(1))
    *_, true_pose = snake.run_cycles(30)
    image = snake.make_depth_image(true_pose, 30 * STEP_NS)
    before = make_current_world(snake)
    old_image = msgspec.structs.replace(image, timestamp_ns=STEP_NS)
    snake.world.add_ranging_sample(old_image, NOISE)
    future_image = msgspec.structs.replace(image, timestamp_ns=900 * STEP_NS)
    snake.world.add_ranging_sample(future_image, NOISE)
    # After invalid angles, the pose of the body at the image's timestamp is unknown.
    joints = snake.make_joint_state(true_pose, true_pose)
    invalid_joints = msgspec.structs.replace(
        joints, timestamp_ns=joints.timestamp_ns + STEP_NS, valid=[False] * len(joints.valid)
    )
    snake.world.add_joints(invalid_joints, None, None)
    snake.world.add_ranging_sample(image, NOISE)
    assert sum(snake.world.rejected_sample_counts.values()) == 3
    assert len(snake.world.rejected_sample_counts) == 3
    after = make_current_world(snake)
    assert after.depth_timestamp_ns == before.depth_timestamp_ns
    assert len(after.obstacles) == len(before.obstacles)


@pytest.mark.slow
def test_perceived_world_after_streams_end_grows_uncertain():
    snake = SlidingSnake(make_random_obstacles(1))
    list(snake.run_cycles(60))
    snake.delayed_images.clear()
    before = make_current_world(snake)
    assert len(before.obstacles) > 3
    list(snake.run_cycles(100, pose=False, images=False, imu=False))
    after = make_current_world(snake)
    assert after.pose_timestamp_ns == before.pose_timestamp_ns
    assert after.depth_timestamp_ns == before.depth_timestamp_ns
    assert after.base_confidence < before.base_confidence
    assert (after.base_position_sd_m or 0) > 5 * (before.base_position_sd_m or 1)
    obstacles_before = {obstacle.name: obstacle for obstacle in before.obstacles}
    assert {obstacle.name for obstacle in after.obstacles} <= set(obstacles_before)
    for obstacle in after.obstacles:
        assert obstacle.confidence <= obstacles_before[obstacle.name].confidence
        assert obstacle.last_seen_ns == obstacles_before[obstacle.name].last_seen_ns


def test_perceived_contact_has_the_name_used_in_the_map():
    """A peg that no scan has shown touches the left side of the middle link."""
    contact = make_link_contact(
        7,
        obstacle="a name from the simulator",
        position_l=(0.05, 0.04, 0.0),
        force_l=(0.0, -3.0, 0.0),
    )
    snake = SlidingSnake([])
    for _ in snake.run_cycles(10, images=False):
        snake.world.add_contacts(
            Contacts(tick=snake.cycle, timestamp_ns=snake.cycle * STEP_NS, contacts=[contact])
        )
    world = snake.world.make_world(9, 9 * STEP_NS)
    assert world is not None
    assert world.contacts
    obstacle_names = {obstacle.name for obstacle in world.obstacles}
    assert {contact.obstacle for contact in world.contacts} <= obstacle_names
    assert all(obstacle.touched for obstacle in world.obstacles)
    assert "simulator" not in repr(world)


def test_perceived_world_from_lidar_has_exact_obstacles():
    snake = SlidingSnake([make_cylinder("a", 2.0, 0.3), make_cylinder("b", 2.2, -0.25)])
    true_pose = snake.compute_pose(0)
    for true_pose in snake.run_cycles(60, images=False):
        beams = render_lidar_scan(
            snake.obstacles,
            true_pose.origins_w[-1],
            true_pose.rotations[-1],
            timestamp_ns=snake.cycle * STEP_NS,
        )
        head_beams = msgspec.structs.replace(beams, link=len(true_pose.origins_w) - 1)
        snake.world.add_ranging_sample(head_beams, NOISE)
    total = score_map(
        make_current_world(snake).obstacles,
        snake.obstacles,
        true_pose.head_w,
        true_pose.headings_rad[-1],
    )
    assert len(total.position_errors_m) == 2
    assert max(total.position_errors_m) < 0.005
    assert not total.ghost_count


def test_perceived_world_before_first_joint_state_is_none():
    snake = SlidingSnake([])
    world = PerceivedWorld(snake.robot, snake.world.localizer.base, PoseNoise())
    assert world.make_world(0, 0) is None
