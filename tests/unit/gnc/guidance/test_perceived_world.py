"""The whole of guidance on a snake that moves through a field it does not know, held against the field."""

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


def reported(drive: SlidingSnake) -> WorldModel:
    world = drive.world.make_world(drive.cycle, drive.cycle * STEP_NS)
    assert world is not None
    return world


def scored(drive: SlidingSnake, turns: int, *, pose: bool = True) -> MapScore:
    """The map every half second, against the truth; without a pose sensor as the robot sees it."""
    total = MapScore()
    for here in drive.run_cycles(turns, pose=pose):
        if drive.cycle % 25 == 0 and drive.cycle > 25:
            obstacles = reported(drive).obstacles
            if not pose:
                obstacles = align_map(
                    obstacles, drive.world.localizer.base.planar_w.tolist(), here.base_w
                )
            total.add(score_map(obstacles, drive.obstacles, here.head_w, here.headings_rad[-1]))
    return total


@pytest.mark.slow  # a lidar maps the same below
def test_a_field_is_mapped_to_millimetres():
    total = scored(SlidingSnake(make_random_obstacles(1)), 200)
    assert len(total.position_errors_m) > 30
    assert total.visible_count > 20
    assert np.median(total.position_errors_m) < 0.005
    assert np.median(total.surface_errors_m) < 0.003
    assert total.missed_count <= 0.05 * total.visible_count
    assert total.ghost_count <= 0.02 * total.reported_count
    assert np.median(total.position_errors_in_sd) < 1.5
    assert np.percentile(total.position_errors_in_sd, 90) < 3.5  # as sure as it may be


@pytest.mark.slow  # a whole run on hills is in tests/system/physics/test_locomotion.py
def test_perceived_field_on_hills_is_mapped():
    total = scored(SlidingSnake(make_random_obstacles(2), ground=make_hills(0.02, 1.5)), 200)
    assert np.median(total.position_errors_m) < 0.008
    assert total.missed_count <= 0.1 * total.visible_count
    assert total.ghost_count <= 0.05 * total.reported_count


@pytest.mark.slow
def test_perceived_world_without_pose_sensor_matches_robot_view():
    total = scored(SlidingSnake(make_random_obstacles(3)), 300, pose=False)
    assert np.median(total.position_errors_m) < 0.02
    assert total.ghost_count <= 0.1 * total.reported_count


@pytest.mark.slow
def test_perceived_image_counts_where_it_was_captured():
    """At 0.4 m/s an image is 16 mm old, and the head turns meanwhile."""
    drive = SlidingSnake(make_random_obstacles(1), speed_m_s=0.4)
    assert np.median(scored(drive, 150).position_errors_m) < 0.006


def test_perceived_samples_without_body_pose_are_counted_and_ignored():
    drive = SlidingSnake(make_random_obstacles(1))
    *_, here = drive.run_cycles(30)
    image, before = drive.make_depth_image(here, 30 * STEP_NS), reported(drive)
    # Older than what is in the map.
    drive.world.add_ranging_sample(msgspec.structs.replace(image, timestamp_ns=STEP_NS), NOISE)
    drive.world.add_ranging_sample(
        msgspec.structs.replace(image, timestamp_ns=900 * STEP_NS), NOISE
    )  # of the future
    joints = drive.make_joint_state(here, here)
    broken = msgspec.structs.replace(
        joints, timestamp_ns=joints.timestamp_ns + STEP_NS, valid=[False] * len(joints.valid)
    )
    drive.world.add_joints(broken, None, None)
    drive.world.add_ranging_sample(image, NOISE)
    assert sum(drive.world.rejected_sample_counts.values()) == 3
    assert len(drive.world.rejected_sample_counts) == 3
    after = reported(drive)
    assert after.depth_timestamp_ns == before.depth_timestamp_ns
    assert len(after.obstacles) == len(before.obstacles)


@pytest.mark.slow
def test_perceived_world_after_streams_end_grows_uncertain():
    drive = SlidingSnake(make_random_obstacles(1))
    list(drive.run_cycles(60))
    drive.delayed_images.clear()
    before = reported(drive)
    assert len(before.obstacles) > 3
    list(drive.run_cycles(100, pose=False, images=False, imu=False))
    after = reported(drive)
    assert after.pose_timestamp_ns == before.pose_timestamp_ns
    assert after.depth_timestamp_ns == before.depth_timestamp_ns
    assert after.base_confidence < before.base_confidence
    assert (after.base_position_sd_m or 0) > 5 * (before.base_position_sd_m or 1)
    seen = {o.name: o for o in before.obstacles}
    assert {o.name for o in after.obstacles} <= set(seen)
    assert all(o.confidence <= seen[o.name].confidence for o in after.obstacles)
    assert all(o.last_seen_ns == seen[o.name].last_seen_ns for o in after.obstacles)


def test_perceived_contact_has_the_name_used_in_the_map():
    """Of a peg, unseen, at the left side of the middle link."""
    touch = make_link_contact(
        7,
        obstacle="a name from the simulator",
        position_l=(0.05, 0.04, 0.0),
        force_l=(0.0, -3.0, 0.0),
    )
    drive = SlidingSnake([])
    for _ in drive.run_cycles(10, images=False):
        drive.world.add_contacts(
            Contacts(tick=drive.cycle, timestamp_ns=drive.cycle * STEP_NS, contacts=[touch])
        )
    world = drive.world.make_world(9, 9 * STEP_NS)
    assert world is not None
    assert world.contacts
    assert {c.obstacle for c in world.contacts} <= {o.name for o in world.obstacles}
    assert all(o.touched for o in world.obstacles)
    assert "simulator" not in repr(world)


def test_a_lidar_maps_as_a_camera_does():
    drive = SlidingSnake([make_cylinder("a", 2.0, 0.3), make_cylinder("b", 2.2, -0.25)])
    here = drive.compute_pose(0)
    for here in drive.run_cycles(60, images=False):
        beams = render_lidar_scan(
            drive.obstacles,
            here.origins_w[-1],
            here.rotations[-1],
            timestamp_ns=drive.cycle * STEP_NS,
        )
        drive.world.add_ranging_sample(
            msgspec.structs.replace(beams, link=len(here.origins_w) - 1), NOISE
        )
    total = score_map(
        reported(drive).obstacles, drive.obstacles, here.head_w, here.headings_rad[-1]
    )
    assert len(total.position_errors_m) == 2
    assert max(total.position_errors_m) < 0.005
    assert not total.ghost_count


def test_before_the_first_joint_state_there_is_no_world():
    drive = SlidingSnake([])
    world = PerceivedWorld(drive.robot, drive.world.localizer.base, PoseNoise())
    assert world.make_world(0, 0) is None
