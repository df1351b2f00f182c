"""Obstacles of the scene as MuJoCo geoms."""

import math
from typing import TypedDict

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import quaternion_from_yaw
from snakesim_hal.model.placement import Placed
from snakesim_sim_backend.laws.yielding import JOINT_OF_AXIS, compute_mass_kg, compute_spring
from snakesim_sim_backend.model.ground import GROUND_GROUP, SAND
from snakesim_sim_backend.model.surface import ContactParameters

OBSTACLE = "obstacle:"  # prefix of the geom of an obstacle
STEP = "step:"  # prefix of the geom of an obstacle that the snake may lie on
OBSTACLE_GROUP = 2  # MuJoCo geom group
BLUE = [0.24, 0.42, 0.60, 1.0]  # color
COLLIDES_WITH_LINKS = 1  # bits of contype and conaffinity
COLLIDES_WITH_OBSTACLES = 2
UPRIGHT = [1.0, 0.0, 0.0, 0.0]  # quaternion wxyz


class Shape(TypedDict):
    """Keyword arguments of MjsBody.add_geom; lengths in m."""

    type: int
    size: list[float]
    pos: list[float]
    quat: list[float]


def geom_name(placed: Placed) -> str:
    """Return the name of an obstacle's geom."""
    prefix = STEP if placed.walkable else OBSTACLE
    return f"{prefix}{placed.obstacle.name}"


def add_obstacle(
    spec: mujoco.MjSpec,
    placed: Placed,
    contact: ContactParameters,
    *,
    body_radius_m: float,
    hills_m: float,
    collide: bool,
    step_s: float,
) -> None:
    """Add an obstacle to a model; its geom is called `obstacle:<name>`, or `step:<name>` when it is walkable.

    Args:
        spec: the model.
        placed: the obstacle.
        contact: parameters of its contacts.
        body_radius_m: radius of the snake.
        hills_m: height of the ground's highest point above its lowest one.
        collide: obstacles also collide with each other, because some of them move.
        step_s: physics step.
    """
    name = geom_name(placed)
    shape = _obstacle_shape(placed, body_radius_m, hills_m)
    if placed.walkable:
        spec.worldbody.add_geom(name=name, group=GROUND_GROUP, rgba=SAND, **shape, **contact)
        return
    collision_bits = COLLIDES_WITH_LINKS
    if collide:
        collision_bits |= COLLIDES_WITH_OBSTACLES
    body = spec.worldbody
    mass_kg = 0.0
    if placed.yields:
        foot_w = np.array([*placed.obstacle.position_w[:2], 0.0])
        body = _add_yielding_body(spec, name, foot_w)
        body.userdata = compute_spring(placed, step_s)
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
    for axis, joint_type in JOINT_OF_AXIS.items():
        direction = [float(axis == other) for other in JOINT_OF_AXIS]
        body.add_joint(name=f"{name}:{axis}", type=joint_type, axis=direction)
    return body


def _obstacle_shape(placed: Placed, body_radius_m: float, hills_m: float) -> Shape:
    """Return the geom of an obstacle. One that is fixed to the ground reaches below it, so that no gap is left.

    Args:
        placed: the obstacle with its place, and how far it leans.
        body_radius_m: radius of the robot's body.
        hills_m: difference in height between the highest and the lowest ground.
    """
    obstacle = placed.obstacle
    x, y, z = obstacle.position_w
    if obstacle.shape == "sphere":
        size = [obstacle.radius_m, 0.0, 0.0]
        return Shape(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, pos=[x, y, z], quat=UPRIGHT)

    half_x, half_y, _ = obstacle.half_size_m
    top = z + obstacle.height_m / 2
    bottom = z - obstacle.height_m / 2 - hills_m / 2  # no gap over a hollow
    foot_radius_m = max(obstacle.radius_m, math.hypot(half_x, half_y))
    bottom -= foot_radius_m * math.tan(placed.lean_rad)  # and none below an obstacle that leans
    if obstacle.shape == "box":
        kind = mujoco.mjtGeom.mjGEOM_BOX
        size = [half_x, half_y]
    elif top - obstacle.radius_m >= 3 * body_radius_m + hills_m / 2:
        # A body that lies here, even one lifted by its own width, only meets the straight part of a peg. So the top
        # may be round, and MuJoCo solves capsule against capsule in closed form, but against a cylinder by iteration.
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        size = [obstacle.radius_m]
        top -= obstacle.radius_m
        bottom -= obstacle.radius_m
    else:
        kind = mujoco.mjtGeom.mjGEOM_CYLINDER
        size = [obstacle.radius_m]

    # A leaning obstacle is tilted about the point of its axis at height 0.
    lean = placed.lean_rad
    towards = placed.lean_towards_rad
    middle = (top + bottom) / 2
    sideways = middle * math.sin(lean)
    return Shape(
        type=kind,
        size=[*size, (top - bottom) / 2, 0.0][:3],
        pos=[x + sideways * math.cos(towards), y + sideways * math.sin(towards), middle * math.cos(lean)],
        quat=_tilted_quaternion(obstacle.yaw_rad, lean, towards),
    )


def _tilted_quaternion(yaw_rad: float, lean_rad: float, towards_rad: float) -> list[float]:
    """Return the orientation, wxyz, of what is rotated by a yaw and then tilted towards a direction."""
    axis_w = np.array([-math.sin(towards_rad), math.cos(towards_rad), 0.0])
    tilt = np.zeros(4)
    mujoco.mju_axisAngle2Quat(tilt, axis_w, lean_rad)
    orientation = np.zeros(4)
    mujoco.mju_mulQuat(orientation, tilt, np.array(quaternion_from_yaw(yaw_rad)))
    return orientation.tolist()
