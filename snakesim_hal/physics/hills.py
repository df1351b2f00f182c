"""The heights of uneven ground, as the simulator builds it and viewers draw it. Pure."""

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene import Heightfield

SAMPLES_PER_WAVE = 12
MAX_SAMPLES = 500  # along an edge
WAVES = 40


def hills(uneven: Heightfield) -> Floats:
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
