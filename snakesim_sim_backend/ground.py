"""The ground as MuJoCo has it: a plane, or a height field of smooth random hills."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.model.scene import Ground, Uneven

Floats = NDArray[np.float64]

GROUND, HILLS = "ground", "hills"
GROUND_GROUP = 1  # MuJoCo geom group of everything that the snake may lie on, including steps
PLANE_GROUP = 4  # of the plane: rays meet it by a formula of our own, see sensors/rays.py
SAND = [0.76, 0.70, 0.58, 1.0]  # colour
SAMPLES_PER_WAVE = 12
MAX_SAMPLES = 500  # along an edge
WAVES = 40
DEPTH_M = 0.5  # of the height field below its lowest point


def add_ground(spec: mujoco.MjSpec, ground: Ground) -> list[str]:
    """Add the ground to a model. Returns the names of its geoms, which have no contacts until they are paired."""
    uneven = ground.uneven
    lowest = 0.0 if uneven is None else -uneven.height_m / 2
    _add(spec, GROUND, PLANE_GROUP, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], pos=[0, 0, lowest])
    if uneven is None:
        return [GROUND]
    heights = hills(uneven)
    rows = len(heights)
    spec.add_hfield(
        name=HILLS,
        nrow=rows,
        ncol=rows,
        size=[uneven.area_m / 2, uneven.area_m / 2, uneven.height_m, DEPTH_M],
        userdata=((heights - lowest) / uneven.height_m).ravel().tolist(),
    )
    _add(spec, HILLS, GROUND_GROUP, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=HILLS, pos=[0, 0, lowest])
    return [GROUND, HILLS]  # the plane below catches what leaves the hills


def _add(spec: mujoco.MjSpec, name: str, group: int, **shape: Any) -> None:
    spec.worldbody.add_geom(name=name, contype=0, conaffinity=0, group=group, rgba=SAND, **shape)


def hills(uneven: Uneven) -> Floats:
    """Heights over the square area, (n, n) float64 in metres, row by row along y; from -height/2 to +height/2.

    A sum of plane waves of about one wavelength, in random directions: smooth, and the same for a seed.
    """
    random = np.random.default_rng(uneven.seed)
    n = int(np.clip(SAMPLES_PER_WAVE * uneven.area_m / uneven.wavelength_m, 16, MAX_SAMPLES))
    x = np.linspace(-uneven.area_m / 2, uneven.area_m / 2, n)
    heights = np.zeros((n, n))
    for _ in range(WAVES):
        direction, phase = random.uniform(0, 2 * np.pi, 2)
        number = 2 * np.pi / uneven.wavelength_m * random.uniform(0.7, 1.3)
        along_x, along_y = number * np.cos(direction) * x, number * np.sin(direction) * x
        heights += np.cos(along_x[None, :] + along_y[:, None] + phase)
    heights -= heights.min()
    return uneven.height_m * (heights / heights.max() - 0.5)
