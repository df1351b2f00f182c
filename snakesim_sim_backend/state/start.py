"""Puts the snake on the ground at the scenario's start pose, and lets it come to rest before the run begins."""

import math

import mujoco
import numpy as np

from snakesim_hal.model.geometry.kinematics import (
    compute_link_frames,
    quaternion_from_yaw,
    rotation_from_quaternion,
)
from snakesim_hal.model.scenario import RunConfig, StartPose, compute_start_pose
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.actuators import ModelMotors
from snakesim_sim_backend.model.build import FREE_QPOS, SimModel, view_joint_states
from snakesim_sim_backend.model.ground import GROUND_GROUP, PLANE_GROUP
from snakesim_sim_backend.physics import PhysicsStepper

MAX_REST_SPEED = 1e-3  # m/s and rad/s: slower is at rest
REQUIRED_ROUNDS_AT_REST = 5  # in a row, until the snake has come to rest
ROUND_DURATION_S = 0.01
CLEARANCE_M = 0.2  # below the head of a suspended robot
RAY_START_M = 100.0  # height from which rays look for the ground
RAYS_PER_LINE = 7  # rays along a link, for each of three across it
SETTLING_FRICTION = 2.0  # so that the snake stays in place while it comes to rest
# Quaternion wxyz: a quarter revolution about y.
HEAD_DOWN = [math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0]


def place_and_settle_robot(
    sim: SimModel,
    data: mujoco.MjData,
    physics: PhysicsStepper,
    config: RunConfig,
    motors: ModelMotors,
    settle_s: float,
) -> None:
    """Place the robot at its start pose, let it come to rest, and set the time to 0 with the motors off.

    The robot is placed above the highest ground under it and falls, while the motors hold its start angles. If it has
    not come to rest after `settle_s`, it is stopped. In a fluid that carries it, it stays at `start.height_m` above the
    ground. A suspended robot hangs with its head below its tail. On a slope, only gravity normal to the ground acts
    until the run begins, so that nothing slides or rolls down before.

    Args:
        sim: Compiled model.
        data: State of the simulation, which is changed.
        physics: Physics that steps the simulation.
        config: Configuration of the run, with the start pose and the robot.
        motors: Motors, which hold the start angles until the robot is at rest.
        settle_s: Maximum simulated time in s until the robot is at rest.
    """
    model = sim.model
    pose = compute_start_pose(config)
    data.qpos[:2] = pose.position_w
    data.qpos[3:FREE_QPOS] = quaternion_from_yaw(pose.yaw_rad)
    angles_rad, _ = view_joint_states(data, motors.count)
    angles_rad[:] = pose.angles_rad
    data.qpos[2] = find_highest_ground_m(model, data, config, pose) + config.robot.module.radius_m
    data.qpos[2] += config.start.height_m
    if sim.suspended:
        data.qpos[2] += config.robot.length_m + CLEARANCE_M
        yaw = np.array(quaternion_from_yaw(pose.yaw_rad))
        mujoco.mju_mulQuat(data.qpos[3:FREE_QPOS], yaw, np.array(HEAD_DOWN))
    gravity_along_ground = model.opt.gravity[:2].copy()
    model.opt.gravity[:2] = 0.0
    physics.reset()
    _settle_robot(model, data, physics, config, motors, pose, settle_s)
    model.opt.gravity[:2] = gravity_along_ground

    # The run starts without motion, and without anything that MuJoCo has stored while the robot came to rest.
    data.qvel[:] = 0.0
    data.act[:] = 0.0
    data.qacc_warmstart[:] = 0.0
    data.time = 0.0
    data.warning.number[:] = 0
    motors.switch_off()
    motors.restart_at_time_0()
    physics.reset()


def find_highest_ground_m(
    model: mujoco.MjModel, data: mujoco.MjData, config: RunConfig, pose: StartPose
) -> float:
    """Return the height of the highest ground or step under the robot's outline, found by rays from above.

    Args:
        model: Compiled model.
        data: State of the simulation. Only its kinematics are recomputed.
        config: Configuration of the run, with the robot.
        pose: Position, heading and joint angles at the start.

    Returns:
        The height in m.
    """
    mujoco.mj_kinematics(model, data)
    robot = config.robot
    radius_m = robot.module.radius_m
    rotation = rotation_from_quaternion(quaternion_from_yaw(pose.yaw_rad))
    origins_w, rotations = compute_link_frames(
        (*pose.position_w, 0.0), rotation, pose.angles_rad, robot.axes, robot.link_lengths_m
    )
    ground_groups = np.zeros(mujoco.mjNGROUP, dtype=np.uint8)
    ground_groups[[GROUND_GROUP, PLANE_GROUP]] = 1
    down_w = np.array([0.0, 0.0, -1.0])
    hit_geom = np.zeros(1, dtype=np.int32)
    highest_m = -np.inf
    for origin_w, link_rotation, length_m in zip(
        origins_w, rotations, robot.link_lengths_m, strict=True
    ):
        for along_m in np.linspace(-radius_m, length_m + radius_m, RAYS_PER_LINE):
            for across_m in (-radius_m, 0.0, radius_m):
                point_w = origin_w + along_m * link_rotation[:, 0] + across_m * link_rotation[:, 1]
                point_w[2] = RAY_START_M
                distance_m = mujoco.mj_ray(
                    model, data, point_w, down_w, ground_groups, 1, -1, hit_geom
                )
                highest_m = max(highest_m, RAY_START_M - distance_m)
    return float(highest_m)


def _settle_robot(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    physics: PhysicsStepper,
    config: RunConfig,
    motors: ModelMotors,
    pose: StartPose,
    settle_s: float,
) -> None:
    """Step the physics until the robot has fallen and come to rest, while its motors hold the start angles.

    It ends when the robot has been at rest for REQUIRED_ROUNDS_AT_REST rounds. Friction is raised until then, so that
    the robot does not slide.

    Args:
        model: The compiled model.
        data: State of the simulation, which is changed.
        physics: Steps the simulation.
        config: The run, with the torque limits of the joints.
        motors: The motors.
        pose: Position, heading and joint angles at the start.
        settle_s: Maximum duration.
    """
    modes = [JointMode.POSITION] * motors.count
    limits_nm = [joint.limits.torque_nm for joint in config.robot.joint_table]
    motors.set_inputs(modes, pose.angles_rad.tolist(), limits_nm)
    physics.set_min_friction(SETTLING_FRICTION)
    steps = max(round(ROUND_DURATION_S / model.opt.timestep), 1)
    rounds = round(settle_s / (steps * model.opt.timestep))
    rounds_at_rest = 0
    for _ in range(rounds):
        physics.step(steps)
        if np.abs(data.qvel).max() < MAX_REST_SPEED:
            rounds_at_rest += 1
        else:
            rounds_at_rest = 0
        if rounds_at_rest == REQUIRED_ROUNDS_AT_REST:
            break
    physics.set_min_friction(0.0)
