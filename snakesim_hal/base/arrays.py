"""Names of array types, and the choice of samples. Shape and unit stand where an array is used."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def choose_even_indices(count: int, max_count: int) -> Ints:
    """Return at most `max_count` indices of `count` values: evenly spaced, ascending, with the first and the last."""
    chosen_count = min(count, max_count)
    return np.arange(chosen_count) * (count - 1) // max(chosen_count - 1, 1)
