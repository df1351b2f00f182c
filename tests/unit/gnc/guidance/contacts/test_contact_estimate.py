"""Compares estimated pushes on the body with known pushes, from which torques and accelerations are computed."""

import numpy as np
import pytest

from snakesim_gnc.guidance.contacts.contact_estimate import EstimatedPush, estimate_pushes
from snakesim_hal.model.geometry.kinematics import compute_link_frames
from snakesim_hal.model.scene_file.solids import GRAVITY_M_S2
from snakesim_hal.wire.messages import Imu, Pose
from snakesim_testing.gnc.stage import make_robot
from snakesim_testing.hal.small_robots import make_pose

ROBOT = make_robot()
COUNT = len(ROBOT.joints)
LENGTHS = [link.length_m for link in ROBOT.links]
STARTS_M = np.append(0.0, np.cumsum(LENGTHS))  # of the links, along the body from the tail
MAX_OFFSET_M = 0.08  # an estimated push that is nearer belongs to a known push
MASS_KG = sum(link.mass_kg for link in ROBOT.links)
SHAPE = 0.35 * np.sin(0.9 * np.arange(COUNT))


def compute_measurements(pushes, *, friction=0.0, acceleration=(0.0, 0.0)):
    """Compute the measurements of a body that is pushed and slides along x.

    By d'Alembert's principle, the joints carry the forces and the inertia against the common acceleration.

    Args:
        pushes: link, side (1: left, -1: right), distance from the rear joint in m, and force in N of each push.
        friction: Coefficient of the ground.
        acceleration: x and y of the whole body, in m/s^2.

    Returns:
        Joint torques in N·m, IMU sample, and the sums of all forces in N and of all moments in N·m about the center
        of mass. The sums are zero if the acceleration is that which the pushes cause.
    """
    rear_w, frames = compute_link_frames((0, 0, 0), np.eye(3), SHAPE, ["yaw"] * COUNT, LENGTHS)
    middles_w = rear_w + frames[:, :, 0] * np.array(LENGTHS)[:, None] / 2
    masses_kg = np.array([link.mass_kg for link in ROBOT.links])
    friction_m_s2 = np.array([-friction * GRAVITY_M_S2, 0, 0])
    # Link, point and force of each load.
    loads = [
        (link, middles_w[link], masses_kg[link] * (friction_m_s2 - [*acceleration, 0]))
        for link in range(COUNT + 1)
    ]
    for link, side, along_m, force_n in pushes:
        outward_w = side * frames[link][:, 1] if side else frames[link][:, 0]
        axis_point_w = rear_w[link] + along_m * frames[link][:, 0]
        skin_point_w = axis_point_w + ROBOT.links[link].radius_m * outward_w
        loads.append((link, skin_point_w, -force_n * outward_w))
    torques_nm = [
        -sum(
            np.cross(point_w - rear_w[joint + 1], force)[2]
            for link, point_w, force in loads
            if link > joint
        )
        for joint in range(COUNT)
    ]
    imu = Imu(
        tick=0,
        timestamp_ns=0,
        link=list(range(COUNT + 1)),
        angular_velocity_rad_s=[(0.0, 0.0, 0.0)] * (COUNT + 1),
        acceleration_m_s2=[tuple(frame.T @ [*acceleration, GRAVITY_M_S2]) for frame in frames],
    )
    center_w = masses_kg @ middles_w / masses_kg.sum()
    force_sum_n = np.sum([force for _, _, force in loads], axis=0)
    moment_sum_nm = sum(np.cross(point_w - center_w, force)[2] for _, point_w, force in loads)
    return torques_nm, imu, force_sum_n, moment_sum_nm


def estimate(torques_nm, imu, pose: Pose | None = None) -> list[EstimatedPush]:
    """Return the estimated pushes on the body, which has the shape of all tests and is not turning its joints."""
    return estimate_pushes(ROBOT, SHAPE.tolist(), [0.0] * COUNT, torques_nm, imu, pose)


def compute_place_m(push: EstimatedPush) -> float:
    """Return the place of a push along the body, from the tail."""
    return STARTS_M[push.link] + push.distance_from_rear_joint_m


@pytest.mark.parametrize(
    ("friction", "pose"), [(0.0, None), (0.3, make_pose(velocity_w=(0.3, 0.0, 0.0)))]
)
def test_contact_estimate_without_contact_is_zero_despite_ground_friction(friction, pose):
    torques_nm, imu, *_ = compute_measurements(
        [], friction=friction, acceleration=(-friction * GRAVITY_M_S2, 0.0)
    )
    assert estimate(torques_nm, imu, pose=pose) == []


@pytest.mark.parametrize("side", [1, -1])
def test_contact_estimate_locates_side_and_force_of_accelerating_pushes(side):
    """The force of the last push is such that the body does not turn."""

    def make_pushes(last_force_n):
        return [(2, side, 0.05, 12.0), (7, -side, 0.08, 20.0), (11, side, 0.03, last_force_n)]

    moment_without_nm, moment_with_1_n_nm = (
        compute_measurements(make_pushes(force_n))[3] for force_n in (0.0, 1.0)
    )
    known_pushes = make_pushes(moment_without_nm / (moment_without_nm - moment_with_1_n_nm))
    acceleration_m_s2 = tuple(compute_measurements(known_pushes)[2][:2] / MASS_KG)
    torques_nm, imu, force_sum_n, moment_sum_nm = compute_measurements(
        known_pushes, acceleration=acceleration_m_s2
    )
    assert np.abs(force_sum_n).max() < 1e-9
    assert abs(moment_sum_nm) < 1e-9

    estimated = estimate(torques_nm, imu)
    for link, push_side, along_m, force_n in known_pushes:
        place_m = STARTS_M[link] + along_m
        near = [
            push
            for push in estimated
            if push.normal_l == (0.0, -push_side, 0.0)
            and abs(compute_place_m(push) - place_m) < MAX_OFFSET_M
        ]
        estimated_n = sum(push.force_n for push in near)
        assert estimated_n == pytest.approx(force_n, rel=0.1), estimated
        mean_place_m = sum(compute_place_m(push) * push.force_n for push in near) / estimated_n
        assert mean_place_m == pytest.approx(place_m, abs=0.02)
        assert all(0.5 < push.confidence <= 1.0 for push in near)


def test_contact_estimate_without_imu_or_torques_finds_no_push():
    imu = Imu(tick=0, timestamp_ns=0, link=[], angular_velocity_rad_s=[], acceleration_m_s2=[])
    assert estimate([0.0] * COUNT, imu) == []


def test_contact_estimate_ignores_torques_of_pitch_joints():
    robot = make_robot(axes=("yaw", "pitch"))
    yaw_torques_nm, imu, *_ = compute_measurements([])
    torques_nm = [
        3.0 if joint.axis == "pitch" else torque_nm
        for joint, torque_nm in zip(robot.joints, yaw_torques_nm, strict=True)
    ]
    assert estimate_pushes(robot, [0.0] * COUNT, [0.0] * COUNT, torques_nm, imu, None) == []
