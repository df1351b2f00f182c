"""Pipes as MuJoCo geoms. A solid pipe is one capsule, and a hollow one consists of staves, as a barrel does.

MuJoCo has no hollow shape. A mesh would be replaced by its convex hull, and a height field cannot have a roof. A
capsule and a box have contacts in closed form, at two points if they are parallel. So a link that lies in the pipe is
supported over its length, like one on a step. The inside of the pipe is a regular polygon around a circle of
`inner_radius_m`, and with 32 staves its corners are 0.5 % of the radius farther out.
"""

import math

import mujoco
import numpy as np

from snakesim_hal.model.scene_file.pipes import get_pipe_name
from snakesim_hal.model.scene_file.terrain import Pipe
from snakesim_sim_backend.model.ground import GROUND_GROUP, SAND
from snakesim_sim_backend.model.surface import ContactParameters

PIPE = "pipe:"  # prefix of the geoms of a pipe
STAVES = 32  # of a whole pipe; half as many if its top is open
ROOF_GROUP = 5  # MuJoCo geom group of staves above the axis, of their own: a snake does not start on the roof


def get_pipe_geom_names(index: int, pipe: Pipe) -> list[str]:
    """Return the names of the geoms of a pipe."""
    name = f"{PIPE}{get_pipe_name(index, pipe)}"
    if pipe.inner_radius_m is None:
        return [name]
    return [f"{name}:{stave}" for stave in range(STAVES // 2 if pipe.open_top else STAVES)]


def is_roof(name: str, group: int) -> bool:
    """Return whether the geom with this name and MuJoCo group is a part of a pipe above its axis."""
    return name.startswith(PIPE) and group == ROOF_GROUP


def add_pipes(spec: mujoco.MjSpec, pipes: list[Pipe], contact: ContactParameters) -> None:
    """Add the pipes of a scene to a model.

    Args:
        spec: Model, which is changed.
        pipes: Pipes of the scene.
        contact: Parameters of MuJoCo's contacts with them.
    """
    for index, pipe in enumerate(pipes):
        if pipe.inner_radius_m is None:
            _add_solid_pipe(spec, index, pipe, contact)
        else:
            _add_staves(spec, index, pipe, pipe.inner_radius_m, contact)


def _add_solid_pipe(
    spec: mujoco.MjSpec, index: int, pipe: Pipe, contact: ContactParameters
) -> None:
    half_m = pipe.length_m / 2 - pipe.radius_m
    middle = np.array([*pipe.position_m, pipe.find_axis_height_m()])
    along = half_m * np.array([math.cos(pipe.yaw_rad), math.sin(pipe.yaw_rad), 0.0])
    (name,) = get_pipe_geom_names(index, pipe)
    spec.worldbody.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        size=[pipe.radius_m, 0.0, 0.0],
        fromto=[*(middle - along), *(middle + along)],
        group=GROUND_GROUP,
        rgba=SAND,
        **contact,
    )


def _add_staves(
    spec: mujoco.MjSpec, index: int, pipe: Pipe, inner_radius_m: float, contact: ContactParameters
) -> None:
    """Add the staves of a hollow pipe. The first ones are at its left edge, and the middle of the half at its bottom.

    Staves are as wide as the outside requires, so that no gap is left there. They overlap in the corners of the inside,
    within each other.
    """
    half_turn_rad = math.pi / STAVES
    wall_m = pipe.radius_m - inner_radius_m
    half_width_m = pipe.radius_m * math.tan(half_turn_rad)
    middle_radius_m = inner_radius_m + wall_m / 2
    x, y = pipe.position_m
    yaw = np.array([math.cos(pipe.yaw_rad / 2), 0.0, 0.0, math.sin(pipe.yaw_rad / 2)])
    for stave, name in enumerate(get_pipe_geom_names(index, pipe)):
        # Angle of the stave about the axis, from the horizontal on its left side downward.
        angle_rad = (2 * stave + 1) * half_turn_rad
        roll_rad = math.pi / 2 - angle_rad
        left_m = middle_radius_m * math.cos(angle_rad)
        below_m = middle_radius_m * math.sin(angle_rad)
        orientation = np.zeros(4)
        mujoco.mju_mulQuat(
            orientation, yaw, np.array([math.cos(roll_rad / 2), math.sin(roll_rad / 2), 0.0, 0.0])
        )
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[pipe.length_m / 2, half_width_m, wall_m / 2],
            pos=[
                x - left_m * math.sin(pipe.yaw_rad),
                y + left_m * math.cos(pipe.yaw_rad),
                pipe.find_axis_height_m() - below_m,
            ],
            quat=orientation.tolist(),
            group=GROUND_GROUP if below_m > 0.0 else ROOF_GROUP,
            rgba=SAND,
            **contact,
        )
