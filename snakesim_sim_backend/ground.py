"""The ground as MuJoCo has it: a plane, or a height field of smooth random hills."""

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.scene import Ground, Uneven
from snakesim_sim_backend.surface import Surface, surface

Floats = NDArray[np.float64]

GROUND = "ground"
GROUND_GROUP = 1  # MuJoCo geom group of all that the snake may lie on, steps too
SAMPLES_PER_WAVE = 12
MOST_SAMPLES = 500  # along an edge
WAVES = 40
DEPTH_M = 0.5  # of the height field below its lowest point


def add_ground(spec: mujoco.MjSpec, ground: Ground, contact_time_s: float) -> None:
    """Put the ground into a model: geoms whose names begin with `ground`."""
    grip = surface(ground.friction, contact_time_s)
    uneven = ground.uneven
    lowest = 0.0 if uneven is None else -uneven.height_m / 2
    _add_plane(spec, lowest, grip)
    if uneven is None:
        return
    heights = hills(uneven)
    rows = len(heights)
    spec.add_hfield(
        name="hills",
        nrow=rows,
        ncol=rows,
        size=[uneven.area_m / 2, uneven.area_m / 2, uneven.height_m, DEPTH_M],
        userdata=((heights - lowest) / uneven.height_m).ravel().tolist(),
    )
    hfield = mujoco.mjtGeom.mjGEOM_HFIELD
    spec.worldbody.add_geom(name=f"{GROUND}_hills", type=hfield, hfieldname="hills", pos=[0, 0, lowest], group=GROUND_GROUP, **grip)


def _add_plane(spec: mujoco.MjSpec, height_m: float, grip: Surface) -> None:
    """The flat ground, which under hills only catches what leaves them."""
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name=GROUND, type=plane, size=[0, 0, 1], pos=[0, 0, height_m], group=GROUND_GROUP, **grip)


def hills(uneven: Uneven) -> Floats:
    """Heights over the square area, (n, n) float64 in metres, row by row along y; from -height/2 to +height/2.

    A sum of plane waves of one wavelength, give or take, in random directions: smooth, and the same for a seed.
    """
    random = np.random.default_rng(uneven.seed)
    n = int(np.clip(SAMPLES_PER_WAVE * uneven.area_m / uneven.wavelength_m, 16, MOST_SAMPLES))
    x = np.linspace(-uneven.area_m / 2, uneven.area_m / 2, n)
    heights = np.zeros((n, n))
    for _ in range(WAVES):
        direction, phase = random.uniform(0, 2 * np.pi, 2)
        number = 2 * np.pi / uneven.wavelength_m * random.uniform(0.7, 1.3)
        along_x, along_y = number * np.cos(direction) * x, number * np.sin(direction) * x
        heights += np.cos(along_x[None, :] + along_y[:, None] + phase)
    heights -= heights.min()
    return uneven.height_m * (heights / heights.max() - 0.5)
