"""Chooses some of many samples, for figures and reports that could not show all of them."""

import numpy as np
from numpy.typing import NDArray


def choose_even_indices(count: int, max_count: int) -> NDArray[np.int64]:
    """Return at most `max_count` indices of `count` values: evenly spaced, ascending, with the first and the last."""
    chosen_count = min(count, max_count)
    return np.arange(chosen_count) * (count - 1) // max(chosen_count - 1, 1)
