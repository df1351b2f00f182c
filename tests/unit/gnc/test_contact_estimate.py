"""The contact estimate finds pushes that are known, where they are, and none where there are none."""

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
STARTS_M = np.append(0.0, np.cumsum(LENGTHS))  # along the body
MASS_KG = sum(link.mass_kg for link in ROBOT.links)
SHAPE = 0.35 * np.sin(0.9 * np.arange(COUNT))


def readings(pushes, *, friction=0.0, acceleration=(0.0, 0.0)):
    """Torques and IMU of a body that is pushed as told, (link, side, along_m, force_n) each, and slides along x.

    By d'Alembert: forces, and inertia against the common acceleration, are carried by the joints. Also returns what is
    left over of force and moment, which is zero if that acceleration is true.
    """
    rear, frames = compute_link_frames((0, 0, 0), np.eye(3), SHAPE, ["yaw"] * COUNT, LENGTHS)
    middles = rear + frames[:, :, 0] * np.array(LENGTHS)[:, None] / 2
    masses = np.array([link.mass_kg for link in ROBOT.links])
    loads = [
        (
            k,
            middles[k],
            masses[k] * (np.array([-friction * GRAVITY_M_S2, 0, 0]) - [*acceleration, 0]),
        )
        for k in range(COUNT + 1)
    ]
    for link, side, along_m, force_n in pushes:
        outward = side * frames[link][:, 1] if side else frames[link][:, 0]
        point = rear[link] + along_m * frames[link][:, 0] + ROBOT.links[link].radius_m * outward
        loads.append((link, point, -force_n * outward))
    torques = [
        -sum(np.cross(at - rear[i + 1], load)[2] for k, at, load in loads if k > i)
        for i in range(COUNT)
    ]
    felt = [tuple(frame.T @ [*acceleration, GRAVITY_M_S2]) for frame in frames]
    still = [(0.0, 0.0, 0.0)] * (COUNT + 1)
    imu = Imu(
        tick=0,
        timestamp_ns=0,
        link=list(range(COUNT + 1)),
        angular_velocity_rad_s=still,
        acceleration_m_s2=felt,
    )
    center = masses @ middles / masses.sum()
    turning_nm = sum(np.cross(at - center, load)[2] for _, at, load in loads)
    return torques, imu, np.sum([load for _, _, load in loads], axis=0), turning_nm


def estimated(torques, imu, pose: Pose | None = None) -> list[EstimatedPush]:
    return estimate_pushes(ROBOT, SHAPE.tolist(), [0.0] * COUNT, torques, imu, pose)


@pytest.mark.parametrize(
    ("friction", "moves"), [(0.0, None), (0.3, make_pose(velocity_w=(0.3, 0.0, 0.0)))]
)
def test_contact_estimate_without_contact_is_zero_despite_ground_friction(friction, moves):
    torques, imu, *_ = readings([], friction=friction, acceleration=(-friction * GRAVITY_M_S2, 0.0))
    assert estimated(torques, imu, pose=moves) == []


@pytest.mark.parametrize("side", [1, -1])
def test_contact_estimate_locates_side_and_force_of_accelerating_pushes(side):
    """The last one is as strong as it must be for the body not to turn."""

    def pushes(last_n):
        return [(2, side, 0.05, 12.0), (7, -side, 0.08, 20.0), (11, side, 0.03, last_n)]

    turning = [readings(pushes(force_n))[3] for force_n in (0.0, 1.0)]
    wanted = pushes(turning[0] / (turning[0] - turning[1]))
    sum_n = readings(wanted)[2]
    torques, imu, left_n, left_nm = readings(wanted, acceleration=tuple(sum_n[:2] / MASS_KG))
    assert np.abs(left_n).max() < 1e-9
    assert abs(left_nm) < 1e-9
    found = estimated(torques, imu)
    for link, side_of_it, along_m, force_n in wanted:
        place_m = STARTS_M[link] + along_m
        near = [
            c
            for c in found
            if c.normal_l == (0.0, -side_of_it, 0.0)
            and abs(STARTS_M[c.link] + c.distance_from_rear_joint_m - place_m) < 0.08
        ]
        assert sum(c.force_n for c in near) == pytest.approx(force_n, rel=0.1), found
        middle_m = sum(
            (STARTS_M[c.link] + c.distance_from_rear_joint_m) * c.force_n for c in near
        ) / sum(c.force_n for c in near)
        assert middle_m == pytest.approx(place_m, abs=0.02)
        assert all(0.5 < c.confidence <= 1.0 for c in near)


def test_contact_estimate_without_imu_relies_on_torques():
    imu = Imu(tick=0, timestamp_ns=0, link=[], angular_velocity_rad_s=[], acceleration_m_s2=[])
    assert estimated([0.0] * COUNT, imu) == []


def test_pitch_joints_give_no_equation_and_break_nothing():
    mixed = make_robot(axes=("yaw", "pitch"))
    torques, imu, *_ = readings([])
    torques = [
        3.0 if joint.axis == "pitch" else torque
        for joint, torque in zip(mixed.joints, torques, strict=True)
    ]
    assert estimate_pushes(mixed, [0.0] * COUNT, [0.0] * COUNT, torques, imu, None) == []
