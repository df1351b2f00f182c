"""Obstacles of the scene as MuJoCo geoms."""

import math
from typing import TypedDict

import mujoco
import numpy as np

from snakesim_hal.model.kinematics import quaternion_from_yaw
from snakesim_hal.model.scene import Placed
from snakesim_sim_backend.ground import GROUND_GROUP, SAND
from snakesim_sim_backend.surface import Skin
from snakesim_sim_backend.yielding import AXES, mass_kg

OBSTACLE = "obstacle:"
STEP = "step:"
OBSTACLE_GROUP = 2
BLUE = [0.24, 0.42, 0.60, 1.0]  # color
LINKS, OBSTACLES = 1, 2  # bits of what a geom has contacts with


class Shape(TypedDict):
    """Keyword arguments of MjsBody.add_geom."""

    type: int
    size: list[float]
    pos: list[float]
    quat: list[float]


def geom_name(placed: Placed) -> str:
    """Of an obstacle."""
    return f"{STEP if placed.walkable else OBSTACLE}{placed.obstacle.name}"


def add_obstacle(
    spec: mujoco.MjSpec, placed: Placed, skin: Skin, *, body_radius_m: float, hills_m: float, strike: bool
) -> None:
    """Add an obstacle to a model; its geom is called `obstacle:<name>`, or `step:<name>` when it is walkable.

    body_radius_m: of the snake; hills_m: from the ground's lowest to its highest point; strike: obstacles meet each
    other, because one of them moves.
    """
    shape, name = _shape(placed, body_radius_m, hills_m), geom_name(placed)
    if placed.walkable:
        spec.worldbody.add_geom(name=name, group=GROUND_GROUP, rgba=SAND, **shape, **skin)
        return
    meets = LINKS | (OBSTACLES if strike else 0)
    if not placed.yields:
        body = spec.worldbody
    else:
        foot = np.array([*placed.obstacle.position_w[:2], 0.0])
        body = spec.worldbody.add_body(name=name, pos=foot)
        for axis, kind in AXES.items():
            body.add_joint(name=f"{name}:{axis}", type=kind, axis=[float(axis == other) for other in AXES])
        shape["pos"] = (shape["pos"] - foot).tolist()
    body.add_geom(
        name=name,
        contype=meets,
        conaffinity=meets,
        group=OBSTACLE_GROUP,
        rgba=BLUE,
        mass=mass_kg(placed) if placed.yields else 0.0,
        **shape,
        **skin,
    )


def _shape(placed: Placed, body_radius_m: float, hills_m: float) -> Shape:
    obstacle = placed.obstacle
    x, y, z = obstacle.position_w
    upright = [1.0, 0.0, 0.0, 0.0]
    if obstacle.shape == "sphere":
        return Shape(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[obstacle.radius_m, 0.0, 0.0], pos=[x, y, z], quat=upright)
    half_x, half_y, _ = obstacle.half_size_m
    top = z + obstacle.height_m / 2
    bottom = z - obstacle.height_m / 2 - hills_m / 2  # no gap below it over a hollow, or where it leans
    bottom -= max(obstacle.radius_m, math.hypot(half_x, half_y)) * math.tan(placed.lean_rad)
    if obstacle.shape == "box":
        kind, size = mujoco.mjtGeom.mjGEOM_BOX, [half_x, half_y]
    elif top - obstacle.radius_m >= 3 * body_radius_m + hills_m / 2:
        # A body that lies here, even one lifted by its own width, only meets the straight part of a peg. So the top
        # may be round, and MuJoCo solves capsule against capsule in closed form, but against a cylinder by iteration.
        kind, size = mujoco.mjtGeom.mjGEOM_CAPSULE, [obstacle.radius_m]
        top -= obstacle.radius_m
        bottom -= obstacle.radius_m
    else:
        kind, size = mujoco.mjtGeom.mjGEOM_CYLINDER, [obstacle.radius_m]
    lean, towards = placed.lean_rad, placed.lean_towards_rad
    middle = (top + bottom) / 2
    aside = middle * math.sin(lean)
    turn, tilt, quat = quaternion_from_yaw(obstacle.yaw_rad), np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(tilt, np.array([-math.sin(towards), math.cos(towards), 0.0]), lean)
    mujoco.mju_mulQuat(quat, tilt, np.array(turn))
    return Shape(
        type=kind,
        size=[*size, (top - bottom) / 2, 0.0][:3],
        pos=[x + aside * math.cos(towards), y + aside * math.sin(towards), middle * math.cos(lean)],
        quat=quat.tolist(),
    )
