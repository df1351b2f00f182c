"""Obstacles of the scene as MuJoCo geoms."""

import math
from typing import TypedDict

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import quaternion_from_yaw
from snakesim_hal.model.scene_file.placement import PlacedObstacle
from snakesim_sim_backend.laws.yielding import JOINT_TYPE_BY_AXIS, compute_mass_kg, compute_spring
from snakesim_sim_backend.model.ground import GROUND_GROUP, SAND
from snakesim_sim_backend.model.surface import ContactParameters

OBSTACLE = "obstacle:"  # prefix of the geom of an obstacle
STEP = "step:"  # prefix of the geom of an obstacle that the snake may lie on
OBSTACLE_GROUP = 2  # MuJoCo geom group
BLUE = [0.24, 0.42, 0.60, 1.0]  # color
COLLIDES_WITH_LINKS = 1  # bits of contype and conaffinity
COLLIDES_WITH_OBSTACLES = 2
UPRIGHT = [1.0, 0.0, 0.0, 0.0]  # quaternion wxyz


class GeomArguments(TypedDict):
    """Keyword arguments of MjsBody.add_geom; lengths in m."""

    type: int
    size: list[float]
    pos: list[float]
    quat: list[float]


def make_geom_name(placed: PlacedObstacle) -> str:
    """Return the name of an obstacle's geom."""
    prefix = STEP if placed.walkable else OBSTACLE
    return f"{prefix}{placed.obstacle.name}"


def add_obstacle(
    spec: mujoco.MjSpec,
    placed: PlacedObstacle,
    contact: ContactParameters,
    *,
    body_radius_m: float,
    ground_relief_m: float,
    collide: bool,
    step_s: float,
    normal_gravity_m_s2: float,
) -> None:
    """Add an obstacle to a model. Its geom is called `obstacle:<name>`, or `step:<name>` if it is walkable.

    Args:
        spec: Model, which is changed.
        placed: Obstacle with its place.
        contact: Parameters of the obstacle's contacts.
        body_radius_m: Radius of the robot's body in m.
        ground_relief_m: Height of the ground's highest point above its lowest one, in m.
        collide: Whether obstacles also collide with each other, because some of them move.
        step_s: Duration of a physics step in s.
        normal_gravity_m_s2: Part of gravity that presses the obstacle onto the ground.
    """
    name = make_geom_name(placed)
    shape = _make_obstacle_shape(placed, body_radius_m, ground_relief_m)
    if placed.walkable:
        spec.worldbody.add_geom(name=name, group=GROUND_GROUP, rgba=SAND, **shape, **contact)
        return
    collision_bits = COLLIDES_WITH_LINKS
    if collide:
        collision_bits |= COLLIDES_WITH_OBSTACLES
    body = spec.worldbody
    mass_kg = 0.0
    if placed.can_move:
        foot_w = np.array([*placed.obstacle.position_w[:2], 0.0])
        body = _add_yielding_body(spec, name, foot_w)
        body.userdata = compute_spring(placed, step_s, normal_gravity_m_s2)
        shape["pos"] = (shape["pos"] - foot_w).tolist()
        mass_kg = compute_mass_kg(placed)
    body.add_geom(
        name=name,
        contype=collision_bits,
        conaffinity=collision_bits,
        group=OBSTACLE_GROUP,
        rgba=BLUE,
        mass=mass_kg,
        **shape,
        **contact,
    )


def _add_yielding_body(spec: mujoco.MjSpec, name: str, foot_w: Floats) -> mujoco.MjsBody:
    """Add a body that slides along x and y and rotates about z."""
    body = spec.worldbody.add_body(name=name, pos=foot_w)
    for axis, joint_type in JOINT_TYPE_BY_AXIS.items():
        direction = [float(axis == other) for other in JOINT_TYPE_BY_AXIS]
        body.add_joint(name=f"{name}:{axis}", type=joint_type, axis=direction)
    return body


def _make_obstacle_shape(
    placed: PlacedObstacle, body_radius_m: float, ground_relief_m: float
) -> GeomArguments:
    """Return the shape, place and orientation of an obstacle's geom.

    Obstacles other than spheres reach below the ground, so that no gap is left in a hollow or below a leaning one.

    Args:
        placed: Obstacle with its place and its lean.
        body_radius_m: Radius of the robot's body in m.
        ground_relief_m: Height of the ground's highest point above its lowest one, in m.
    """
    obstacle = placed.obstacle
    x, y, z = obstacle.position_w
    if obstacle.shape == "sphere":
        size = [obstacle.radius_m, 0.0, 0.0]
        return GeomArguments(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, pos=[x, y, z], quat=UPRIGHT
        )

    half_x, half_y, _ = obstacle.half_size_m
    top = z + obstacle.height_m / 2
    bottom = z - obstacle.height_m / 2 - ground_relief_m / 2  # no gap over a hollow
    foot_radius_m = max(obstacle.radius_m, math.hypot(half_x, half_y))
    bottom -= foot_radius_m * math.tan(placed.lean_rad)  # and none below an obstacle that leans
    if obstacle.shape == "box":
        geom_type = mujoco.mjtGeom.mjGEOM_BOX
        size = [half_x, half_y]
    elif top - obstacle.radius_m >= 3 * body_radius_m + ground_relief_m / 2:
        # A robot that lies here, even one lifted by its own width, touches only the straight part of a peg. So the top
        # may be round: MuJoCo solves capsule against capsule in closed form, but against a cylinder by iteration.
        geom_type = mujoco.mjtGeom.mjGEOM_CAPSULE
        size = [obstacle.radius_m]
        top -= obstacle.radius_m
        bottom -= obstacle.radius_m
    else:
        geom_type = mujoco.mjtGeom.mjGEOM_CYLINDER
        size = [obstacle.radius_m]

    # MuJoCo has three sizes of every geom: those across the axis, half the height, and unused ones.
    size.append((top - bottom) / 2)
    size += [0.0] * (3 - len(size))

    # A leaning obstacle is tilted about the point of its axis at height 0.
    lean_rad = placed.lean_rad
    direction_rad = placed.lean_towards_rad
    middle = (top + bottom) / 2
    shift = middle * math.sin(lean_rad)
    return GeomArguments(
        type=geom_type,
        size=size,
        pos=[
            x + shift * math.cos(direction_rad),
            y + shift * math.sin(direction_rad),
            middle * math.cos(lean_rad),
        ],
        quat=_compute_tilted_quaternion(obstacle.yaw_rad, lean_rad, direction_rad),
    )


def _compute_tilted_quaternion(yaw_rad: float, lean_rad: float, towards_rad: float) -> list[float]:
    """Return the quaternion wxyz of a rotation by a yaw angle, followed by a tilt towards a direction."""
    axis_w = np.array([-math.sin(towards_rad), math.cos(towards_rad), 0.0])
    tilt = np.zeros(4)
    mujoco.mju_axisAngle2Quat(tilt, axis_w, lean_rad)
    orientation = np.zeros(4)
    mujoco.mju_mulQuat(orientation, tilt, np.array(quaternion_from_yaw(yaw_rad)))
    return orientation.tolist()
