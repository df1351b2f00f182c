"""Compares the limiter on arrays with the limiter of real robots, bit for bit, for random commands."""

from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim.environments.array_limiter import (
    LIMIT_NAMES,
    LimitArrays,
    MeasuredArrays,
    find_active_limit_indices,
    limit_targets,
    limit_torque_limits,
)
from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointLimits, MeasuredState
from snakesim_hal.safety.limit_names import find_active_limits
from snakesim_hal.safety.limiter import limit_command
from snakesim_hal.wire.messages import JointCommand, JointMode, RobotDescription
from snakesim_testing.hal.small_robots import make_description, make_joint_command

ROBOTS = 40
JOINTS = 3
ROUNDS = 30


def make_robot(random: np.random.Generator) -> RobotDescription:
    """Return a robot whose joints have different limits. Some joints cannot move."""
    robot = make_description()
    joints = [
        msgspec.structs.replace(
            joint,
            angle_min_rad=-float(random.choice([0.0, 0.4, 1.5])),
            angle_max_rad=float(random.choice([0.0, 0.7, 1.5])),
            speed_limit_rad_s=float(random.choice([0.0, 2.0, 5.0])),
            acceleration_limit_rad_s2=float(random.uniform(10.0, 200.0)),
            torque_limit_nm=float(random.choice([0.0, 1.0, 4.0])),
            velocity_gain_nm_s_per_rad=float(random.uniform(0.1, 3.0)),
        )
        for joint in robot.joints
    ]
    return msgspec.structs.replace(robot, joints=joints)


def draw_joint_values(random: np.random.Generator, scale: float) -> Any:
    """Return random numbers, of which some are zeros of both signs, and some are exactly at typical limits."""
    values = random.normal(0.0, scale, (ROBOTS, JOINTS))
    special = random.choice([0.0, -0.0, 0.4, -0.4, 0.7, 1.5, -1.5], (ROBOTS, JOINTS))
    return np.where(random.random((ROBOTS, JOINTS)) < 0.3, special, values)


@pytest.mark.parametrize("mode", [JointMode.POSITION, JointMode.VELOCITY, JointMode.TORQUE])
def test_array_limiter_equals_the_limiter_of_each_robot(mode: JointMode) -> None:
    random = np.random.default_rng(int(mode))
    robots = [make_robot(random) for _ in range(ROBOTS)]
    limits_of_robot = [JointLimits.from_description(robot) for robot in robots]
    limits = LimitArrays.allocate(ROBOTS, JOINTS, robots[0].period_ns * 1e-9)
    for i, robot in enumerate(robots):
        limits.set_robot(i, robot)
    for _ in range(ROUNDS):
        requested = draw_joint_values(random, 2.0)
        last_target = draw_joint_values(random, 1.0)
        angle_rad = draw_joint_values(random, 1.0)
        velocity_rad_s = draw_joint_values(random, 3.0)
        torque_fraction = np.where(
            random.random((ROBOTS, JOINTS)) < 0.7, 1.0, random.uniform(0.2, 1.0, (ROBOTS, JOINTS))
        )
        last_limit_nm = limits.torque_nm * random.choice([0.0, 0.5, 1.0], (ROBOTS, JOINTS))
        measured = MeasuredArrays(angle_rad, velocity_rad_s)

        torque_limit_nm = limit_torque_limits(last_limit_nm, torque_fraction, limits)
        target = limit_targets(mode, requested, last_target, torque_limit_nm, measured, limits)
        name_indices = find_active_limit_indices(
            mode, requested, target, torque_limit_nm, torque_fraction, measured, limits
        )

        for i, robot_limits in enumerate(limits_of_robot):
            command: JointCommand = make_joint_command(
                robots[i],
                mode=[mode] * JOINTS,
                target=requested[i].tolist(),
                torque_limit_nm=limits.torque_nm[i].tolist(),
            )
            state = MeasuredState(angle_rad[i], velocity_rad_s[i], np.zeros(JOINTS))
            last = AppliedSetpoints(np.full(JOINTS, int(mode)), last_target[i], last_limit_nm[i])
            expected = limit_command(
                command,
                measured=state,
                last=last,
                limits=robot_limits,
                torque_fraction=torque_fraction[i],
            )
            assert target[i].tobytes() == expected.target.tobytes()
            assert torque_limit_nm[i].tobytes() == expected.torque_limit_nm.tobytes()
            expected_names = find_active_limits(
                command,
                expected,
                measured=state,
                limits=robot_limits,
                torque_fraction=torque_fraction[i],
            )
            active_names = {
                joint: LIMIT_NAMES[name_index]
                for joint, name_index in enumerate(name_indices[i].tolist())
                if name_index
            }
            assert active_names == expected_names
