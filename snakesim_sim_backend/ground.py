"""The ground as MuJoCo has it: a plane, or a height field of smooth random hills."""

from typing import Any

import mujoco

from snakesim_hal.model.scene import Ground
from snakesim_hal.physics.hills import hills
from snakesim_sim_backend.surface import Skin

GROUND, HILLS = "ground", "hills"
GROUND_GROUP = 1  # MuJoCo geom group of everything that the snake may lie on, including steps
PLANE_GROUP = 4  # of the plane: rays meet it by a formula of our own, see sensors/rays.py
SAND = [0.76, 0.70, 0.58, 1.0]  # color
DEPTH_M = 0.5  # of the height field below its lowest point


def add_ground(spec: mujoco.MjSpec, ground: Ground, skin: Skin) -> list[str]:
    """Add the ground to a model. Returns the names of the geoms that have contacts: none, where it is flat."""
    uneven = ground.heightfield
    lowest = 0.0 if uneven is None else -uneven.height_m / 2
    plane: dict[str, Any] = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0, 0, 1], "pos": [0, 0, lowest]}
    if uneven is None:  # see flat_ground.py
        _add(spec, GROUND, PLANE_GROUP, contype=0, conaffinity=0, **plane)
        return []
    _add(spec, GROUND, PLANE_GROUP, **plane, **skin)
    heights = hills(uneven)
    rows = len(heights)
    spec.add_hfield(
        name=HILLS,
        nrow=rows,
        ncol=rows,
        size=[uneven.area_m / 2, uneven.area_m / 2, uneven.height_m, DEPTH_M],
        userdata=((heights - lowest) / uneven.height_m).ravel().tolist(),
    )
    _add(spec, HILLS, GROUND_GROUP, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=HILLS, pos=[0, 0, lowest], **skin)
    return [GROUND, HILLS]  # the plane below catches what leaves the hills


def _add(spec: mujoco.MjSpec, name: str, group: int, **shape: Any) -> None:
    spec.worldbody.add_geom(name=name, group=group, rgba=SAND, **shape)
