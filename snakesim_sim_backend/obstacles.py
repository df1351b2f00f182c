"""Obstacles of the scene as MuJoCo geoms."""

from typing import TypedDict

import mujoco

from snakesim_hal.model.kinematics import quaternion_from_yaw
from snakesim_hal.model.scene import Placed
from snakesim_hal.wire.messages import Obstacle
from snakesim_sim_backend.ground import GROUND_GROUP, SAND
from snakesim_sim_backend.settings import SimSettings
from snakesim_sim_backend.surface import frictionless_skin

OBSTACLE = "obstacle:"
STEP = "step:"
OBSTACLE_GROUP = 2
BLUE = [0.24, 0.42, 0.60, 1.0]  # colour


class Shape(TypedDict):
    """Keyword arguments of MjsBody.add_geom."""

    type: int
    size: list[float]
    pos: list[float]
    quat: list[float]


def add_obstacle(
    spec: mujoco.MjSpec, placed: Placed, settings: SimSettings, *, body_radius_m: float, hills_m: float
) -> str | None:
    """Add an obstacle to a model; its geom is called `obstacle:<name>`, or `step:<name>` when it is walkable.

    Returns the geom's name when it has no contacts until it is paired: a walkable or a rough one. A smooth one, the
    usual kind, has contacts with the links by default, which keeps large fields of pegs fast.
    body_radius_m: of the snake; hills_m: from the ground's lowest to its highest point.
    """
    shape = _shape(placed.obstacle, body_radius_m, hills_m)
    name = f"{STEP if placed.walkable else OBSTACLE}{placed.obstacle.name}"
    group, rgba = (GROUND_GROUP, SAND) if placed.walkable else (OBSTACLE_GROUP, BLUE)
    if placed.walkable or placed.friction > 0:
        spec.worldbody.add_geom(name=name, contype=0, conaffinity=0, group=group, rgba=rgba, **shape)
        return name
    spec.worldbody.add_geom(name=name, group=group, rgba=rgba, **shape, **frictionless_skin(settings))
    return None


def _shape(obstacle: Obstacle, body_radius_m: float, hills_m: float) -> Shape:
    x, y, z = obstacle.position_w
    upright = [1.0, 0.0, 0.0, 0.0]
    if obstacle.shape == "sphere":
        return Shape(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[obstacle.radius_m, 0.0, 0.0], pos=[x, y, z], quat=upright)
    top = z + obstacle.height_m / 2
    bottom = z - obstacle.height_m / 2 - hills_m / 2  # no gap below it over a hollow
    if obstacle.shape == "box":
        half_x, half_y, _ = obstacle.half_size_m
        return Shape(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[half_x, half_y, (top - bottom) / 2],
            pos=[x, y, (top + bottom) / 2],
            quat=list(quaternion_from_yaw(obstacle.yaw_rad)),
        )
    kind = mujoco.mjtGeom.mjGEOM_CYLINDER
    if top - obstacle.radius_m >= 3 * body_radius_m + hills_m / 2:
        # A body that lies here, even one lifted by its own width, only meets the straight part of a peg. So the top
        # may be round, and MuJoCo solves capsule against capsule in closed form, but against a cylinder by iteration.
        kind = mujoco.mjtGeom.mjGEOM_CAPSULE
        top -= obstacle.radius_m
        bottom -= obstacle.radius_m
    return Shape(
        type=kind,
        size=[obstacle.radius_m, (top - bottom) / 2, 0.0],
        pos=[x, y, (top + bottom) / 2],
        quat=upright,
    )
