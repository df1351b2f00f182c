"""The heights of hilly ground. The simulator builds the ground from them, and viewers draw it."""

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene import Heightfield

SAMPLES_PER_WAVE = 12  # in one direction, so that hills are smooth
MIN_SAMPLES = 16  # along an edge
MAX_SAMPLES = 500  # along an edge; more would slow down the simulator
WAVES = 40  # plane waves whose sum is the ground
WAVELENGTH_SPREAD = (0.7, 1.3)  # wave numbers of the waves, relative to that of the typical wavelength


def make_heights(heightfield: Heightfield) -> Floats:
    """Return the heights over the square area, (n, n) float64 in m, row by row along y.

    The ground is a sum of plane waves in random directions, so it is smooth, and the same for the same seed:

        h(x, y) = sum_i cos(k_i (x cos(d_i) + y sin(d_i)) + phase_i)

    It is then scaled and shifted to the range from -height/2 to +height/2.

    Args:
        heightfield: area, wavelength, height and seed of the ground.
    """
    random = np.random.default_rng(heightfield.seed)
    samples = SAMPLES_PER_WAVE * heightfield.area_m / heightfield.wavelength_m
    n = int(np.clip(samples, MIN_SAMPLES, MAX_SAMPLES))
    x = np.linspace(-heightfield.area_m / 2, heightfield.area_m / 2, n)
    heights = np.zeros((n, n))
    for _ in range(WAVES):
        direction, phase = random.uniform(0, 2 * np.pi, 2)
        wave_number = 2 * np.pi / heightfield.wavelength_m * random.uniform(*WAVELENGTH_SPREAD)
        along_x = wave_number * np.cos(direction) * x
        along_y = wave_number * np.sin(direction) * x
        heights += np.cos(along_x[None, :] + along_y[:, None] + phase)
    heights -= heights.min()
    return heightfield.height_m * (heights / heights.max() - 0.5)
