"""The limiter on arrays against the limiter of real robots, bit for bit, over random commands."""

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
    """A robot whose joints have limits of their own; some cannot move."""
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


def draw(random: np.random.Generator, scale: float) -> Any:
    """Numbers of which some are zeros, of both signs, and some are exactly at typical bounds."""
    values = random.normal(0.0, scale, (ROBOTS, JOINTS))
    special = random.choice([0.0, -0.0, 0.4, -0.4, 0.7, 1.5, -1.5], (ROBOTS, JOINTS))
    return np.where(random.random((ROBOTS, JOINTS)) < 0.3, special, values)


@pytest.mark.parametrize("mode", [JointMode.POSITION, JointMode.VELOCITY, JointMode.TORQUE])
def test_arrays_of_robots_are_limited_as_each_robot_alone(mode: JointMode) -> None:
    random = np.random.default_rng(int(mode))
    robots = [make_robot(random) for _ in range(ROBOTS)]
    limits_of_robot = [JointLimits.from_description(robot) for robot in robots]
    limits = LimitArrays.allocate(ROBOTS, JOINTS, robots[0].period_ns * 1e-9)
    for i, robot in enumerate(robots):
        limits.set_robot(i, robot)
    for _ in range(ROUNDS):
        requested = draw(random, 2.0)
        last_target = draw(random, 1.0)
        angle_rad, velocity_rad_s = draw(random, 1.0), draw(random, 3.0)
        fraction = np.where(
            random.random((ROBOTS, JOINTS)) < 0.7, 1.0, random.uniform(0.2, 1.0, (ROBOTS, JOINTS))
        )
        last_limit_nm = limits.torque_nm * random.choice([0.0, 0.5, 1.0], (ROBOTS, JOINTS))
        measured = MeasuredArrays(angle_rad, velocity_rad_s)

        torque_limit_nm = limit_torque_limits(last_limit_nm, fraction, limits)
        target = limit_targets(mode, requested, last_target, torque_limit_nm, measured, limits)
        names = find_active_limit_indices(
            mode, requested, target, torque_limit_nm, fraction, measured, limits
        )

        for i, robot_limits in enumerate(limits_of_robot):
            asked: JointCommand = make_joint_command(
                robots[i],
                mode=[mode] * JOINTS,
                target=requested[i].tolist(),
                torque_limit_nm=limits.torque_nm[i].tolist(),
            )
            state = MeasuredState(angle_rad[i], velocity_rad_s[i], np.zeros(JOINTS))
            last = AppliedSetpoints(np.full(JOINTS, int(mode)), last_target[i], last_limit_nm[i])
            expected = limit_command(
                asked, measured=state, last=last, limits=robot_limits, torque_fraction=fraction[i]
            )
            assert target[i].tobytes() == expected.target.tobytes()
            assert torque_limit_nm[i].tobytes() == expected.torque_limit_nm.tobytes()
            expected_names = find_active_limits(
                asked, expected, measured=state, limits=robot_limits, torque_fraction=fraction[i]
            )
            assert {
                joint: LIMIT_NAMES[name] for joint, name in enumerate(names[i].tolist()) if name
            } == expected_names
