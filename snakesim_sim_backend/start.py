"""Lays the snake on the ground at the scenario's start pose, and lets it come to rest before the run begins."""

import math

import mujoco
import numpy as np

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.model.kinematics import link_frames, quaternion_from_yaw, rotation_from_quaternion
from snakesim_hal.model.scenario import RunConfig, StartPose, start_of
from snakesim_hal.wire.messages import Mode
from snakesim_sim_backend.actuators import Motors
from snakesim_sim_backend.ground import GROUND_GROUP, PLANE_GROUP
from snakesim_sim_backend.model import FREE_QPOS, SimModel, of_joints
from snakesim_sim_backend.physics import Physics

REST = 1e-3  # m/s and rad/s: slower is at rest
REST_ROUNDS = 5
ROUND_S = 0.01
CLEAR_M = 0.2  # below the head of a suspended robot
GRIP = 2.0  # friction while settling, so that the snake stays in place


def place_robot(
    sim: SimModel, data: mujoco.MjData, physics: Physics, config: RunConfig, motors: Motors, settle_s: float
) -> None:
    """Put the snake at its start pose, at rest at time 0 with motors off; suspended, its head is below its tail.

    It is placed above the highest ground under it and falls; the motors hold its start angles meanwhile. If it has
    not come to rest after `settle_s` it is stopped.
    """
    model = sim.model
    pose = start_of(config)
    data.qpos[:2] = pose.position_w
    data.qpos[3:FREE_QPOS] = quaternion_from_yaw(pose.yaw_rad)
    of_joints(data, motors.count)[0][:] = pose.angles_rad
    data.qpos[2] = highest_ground_m(model, data, config, pose) + config.robot.module.radius_m
    if sim.suspended:
        data.qpos[2] += config.robot.length_m + CLEAR_M
        yaw, down = quaternion_from_yaw(pose.yaw_rad), np.array([math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0])
        mujoco.mju_mulQuat(data.qpos[3:FREE_QPOS], np.array(yaw), down)
    physics.begin()
    _settle(model, data, physics, config, motors, pose, settle_s)
    data.qvel[:] = 0.0
    data.act[:] = 0.0
    data.qacc_warmstart[:] = 0.0
    data.time = 0.0
    data.warning.number[:] = 0
    motors.switch_off()
    physics.begin()


def highest_ground_m(model: mujoco.MjModel, data: mujoco.MjData, config: RunConfig, pose: StartPose) -> float:
    """Height of the highest ground or step under the snake's outline, by ray casting from above."""
    mujoco.mj_kinematics(model, data)
    robot = config.robot
    rotation = rotation_from_quaternion(quaternion_from_yaw(pose.yaw_rad))
    origins, rotations = link_frames(
        (*pose.position_w, 0.0), rotation, pose.angles_rad, robot.axes, robot.link_lengths_m
    )
    only_ground = np.zeros(mujoco.mjNGROUP, dtype=np.uint8)
    only_ground[[GROUND_GROUP, PLANE_GROUP]] = 1
    above, down, hit = 100.0, np.array([0.0, 0.0, -1.0]), np.zeros(1, dtype=np.int32)
    highest = -np.inf
    for origin, frame, length in zip(origins, rotations, robot.link_lengths_m, strict=True):
        for along in np.linspace(-robot.module.radius_m, length + robot.module.radius_m, 7):
            for aside in (-robot.module.radius_m, 0.0, robot.module.radius_m):
                point = origin + along * frame[:, 0] + aside * frame[:, 1]
                point[2] = above
                drop = mujoco.mj_ray(model, data, point, down, only_ground, 1, -1, hit)
                highest = max(highest, above - drop)
    return float(highest)


def _settle(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    physics: Physics,
    config: RunConfig,
    motors: Motors,
    pose: StartPose,
    settle_s: float,
) -> None:
    count = motors.count
    limits = [joint.limits.torque_nm for joint in config.robot.joint_table]
    motors.enact(SafeSetpoints([Mode.POSITION] * count, pose.angles_rad.tolist(), limits))
    physics.grip(GRIP)
    steps = max(round(ROUND_S / model.opt.timestep), 1)
    at_rest = 0
    for _ in range(round(settle_s / (steps * model.opt.timestep))):
        physics.step(steps)
        at_rest = at_rest + 1 if np.abs(data.qvel).max() < REST else 0
        if at_rest == REST_ROUNDS:
            break
    physics.grip(0.0)
