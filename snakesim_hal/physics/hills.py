"""The heights of hilly ground. The simulator builds the ground from them, and viewers draw it."""

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene_file.scene import Heightfield

SAMPLES_PER_WAVE = 12  # in one direction, so that hills are smooth
MIN_SAMPLES = 16  # along an edge
MAX_SAMPLES = 500  # along an edge; more would slow down the simulator
WAVE_COUNT = 40  # plane waves whose sum is the ground
# Wave numbers of the waves, relative to that of the typical wavelength.
WAVELENGTH_SPREAD = 0.7, 1.3


def make_heights(heightfield: Heightfield) -> Floats:
    """Compute the heights of random hills on a square grid.

    The ground is a sum of plane waves in random directions, so it is smooth, and the same for the same seed:

        h(x, y) = sum_i cos(k_i (x cos(d_i) + y sin(d_i)) + phase_i)

    It is then scaled and shifted to the range from -height/2 to +height/2.

    Args:
        heightfield: Area, wavelength, height and seed of the ground.

    Returns:
        Heights in m as an (n, n) float64 array: rows along y, columns along x.
    """
    rng = np.random.default_rng(heightfield.seed)
    needed_samples = SAMPLES_PER_WAVE * heightfield.area_m / heightfield.wavelength_m
    sample_count = int(np.clip(needed_samples, MIN_SAMPLES, MAX_SAMPLES))
    # The same for x and y.
    grid_m = np.linspace(-heightfield.area_m / 2, heightfield.area_m / 2, sample_count)
    heights = np.zeros((sample_count, sample_count))
    for _ in range(WAVE_COUNT):
        direction_rad, phase_rad = rng.uniform(0, 2 * np.pi, 2)
        wave_number_rad_per_m = (
            2 * np.pi / heightfield.wavelength_m * rng.uniform(*WAVELENGTH_SPREAD)
        )
        phase_along_x = wave_number_rad_per_m * np.cos(direction_rad) * grid_m
        phase_along_y = wave_number_rad_per_m * np.sin(direction_rad) * grid_m
        heights += np.cos(phase_along_x[None, :] + phase_along_y[:, None] + phase_rad)
    heights -= heights.min()
    return heightfield.height_m * (heights / heights.max() - 0.5)
