"""Where the robot and the obstacles are at tick 0."""

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.geometry.kinematics import (
    compute_link_frames,
    quaternion_from_yaw,
    rotation_from_quaternion,
)
from snakesim_hal.model.geometry.outlines import CapsuleOutline
from snakesim_hal.model.geometry.route import (
    compute_yaw_segments_m,
    expand_yaw_angles,
    place_chain_on_route,
)
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.model.scenario.run_config import RunConfig
from snakesim_hal.model.scene_file.placement import (
    PlacedObstacle,
    place_scene_obstacles,
    validate_start_clearance,
)
from snakesim_hal.model.scene_file.scene import make_route
from snakesim_hal.wire.messages import KnownObstacle

# Second part of the seed of the map errors, so that they differ from other random numbers of the run's seed.
MAP_ERROR_SEED = 0x5EED


def validate_start_pose(config: RunConfig) -> None:
    """Raise ConfigError unless the robot can lie at its start pose, and no obstacle overlaps it there.

    Raises:
        ConfigError: The robot cannot lie at the start pose, or an obstacle is in its place.
    """
    if config.start.on_route and config.scene.route is None:
        raise ConfigError(
            f"scenario {config.name!r}: `start.on_route` is true but scene {config.scene.name!r} has no route; "
            f"set start.on_route = false with position_m and yaw_rad, or add a [route] to the scene",
            code="scene/no-route",
        )
    angles_rad = compute_start_pose(config).angles_rad.tolist()
    for joint, angle_rad in zip(config.robot.joint_table, angles_rad, strict=True):
        if not joint.limits.lower_rad <= angle_rad <= joint.limits.upper_rad:
            raise _start_angle_error(config, joint, angle_rad)
    place_obstacles(config)


def _start_angle_error(config: RunConfig, joint: Joint, angle_rad: float) -> ConfigError:
    """Return the error for a joint whose start angle is outside of its limits."""
    limits = joint.limits
    if not config.start.on_route:
        return ConfigError(
            f"robot {config.robot.name!r}: {joint.name} may turn from {limits.lower_rad:g} to "
            f"{limits.upper_rad:g} rad, and the robot starts straight, at 0; let its limits include that, or "
            f"start it on a route that suits them",
            code="config/out-of-range",
        )
    return ConfigError(
        f"scenario {config.name!r}: lying on the route, {joint.name} would start at {angle_rad:.2f} rad; robot "
        f"{config.robot.name!r} allows {limits.lower_rad:g} to {limits.upper_rad:g} rad. Choose a "
        f"smoother route",
        code="config/out-of-range",
    )


@dataclass(frozen=True)
class StartPose:
    """Pose of the snake at tick 0."""

    position_w: tuple[float, float]  # of the tail end, on the ground
    yaw_rad: float
    angles_rad: NDArray[np.float64]  # (n_joints,), tail to head


def compute_start_pose(config: RunConfig) -> StartPose:
    """Compute the pose of the snake at tick 0: on the scene's route, or straight at the configured pose."""
    robot = config.robot
    start = config.start
    route = make_route(config.scene)
    if not start.on_route or route is None:
        straight_rad = np.zeros(robot.chain.modules)
        return StartPose(start.position_m, start.yaw_rad, straight_rad)
    segments_m = compute_yaw_segments_m(robot.axes, robot.link_lengths_m)
    chain = place_chain_on_route(route, start.tail_s_m, segments_m)
    return StartPose(
        chain.tail_w, chain.heading_rad, expand_yaw_angles(robot.axes, chain.angles_rad)
    )


def make_start_capsules(config: RunConfig) -> list[CapsuleOutline]:
    """Return the outlines of the links at tick 0 as seen from above, tail to head."""
    robot = config.robot
    pose = compute_start_pose(config)
    radius_m = robot.module.radius_m
    base_w = (*pose.position_w, radius_m)
    base_rotation = rotation_from_quaternion(quaternion_from_yaw(pose.yaw_rad))
    origins, rotations = compute_link_frames(
        base_w, base_rotation, pose.angles_rad, robot.axes, robot.link_lengths_m
    )
    capsules: list[CapsuleOutline] = []
    for i, length_m in enumerate(robot.link_lengths_m):
        front_w = origins[i] + length_m * rotations[i][:, 0]
        rear_x, rear_y, _ = origins[i].tolist()
        front_x, front_y, _ = front_w.tolist()
        capsules.append(
            CapsuleOutline(
                name=f"link_{i}",
                rear_m=(rear_x, rear_y),
                front_m=(front_x, front_y),
                radius_m=radius_m,
            )
        )
    return capsules


def place_obstacles(config: RunConfig) -> list[PlacedObstacle]:
    """Place all obstacles of the scene, and check that none overlaps the snake at its start pose.

    Raises:
        ConfigError: An obstacle cannot be placed, or overlaps the snake's start pose.
    """
    snake_capsules = make_start_capsules(config)
    placed = place_scene_obstacles(config.scene, snake_capsules)
    validate_start_clearance(config.scene, placed, snake_capsules)
    return placed


def get_noisy_obstacle_map(config: RunConfig, *, walkable: bool = False) -> list[KnownObstacle]:
    """Return the obstacles of the scene as the known map has them: at their true positions plus a random error.

    The standard deviation of the error is `mission.map_error_m`.

    Args:
        config: Run configuration. Its seed determines the errors.
        walkable: If True, return the platforms that the snake may lie on. If False, return the obstacles that it pushes
            against.
    """
    obstacles = [item.obstacle for item in place_obstacles(config) if item.walkable == walkable]
    error_sigma_m = config.mission.map_error_m
    if error_sigma_m == 0.0:
        return obstacles
    # Platforms and other obstacles have random streams of their own: the boolean counts as 0 or 1.
    rng = np.random.default_rng((config.seed, MAP_ERROR_SEED + walkable))
    errors_m = rng.normal(0.0, error_sigma_m, (len(obstacles), 2))
    displaced: list[KnownObstacle] = []
    for obstacle, (error_x, error_y) in zip(obstacles, errors_m.tolist(), strict=True):
        x, y, z = obstacle.position_w
        position_w = (x + error_x, y + error_y, z)
        displaced.append(msgspec.structs.replace(obstacle, position_w=position_w))
    return displaced
