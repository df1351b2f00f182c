"""What a path search is asked for, what it returns, and what grows its paths. Pure.

Points are in the world frame.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats


@dataclass(frozen=True)
class SearchedPath:
    """A path that the search found."""

    points_w: Floats  # (n + 1, 2) one for every STEP_M
    margins_n: Floats  # (n + 1,) propulsion margin of the body with its head there
    cost_m: float


@dataclass(frozen=True)
class SearchTask:
    """The goal of one search, and the body from which it starts."""

    origin_w: Floats  # (2,) the head of the measured body; moments are about it
    travel_direction_rad: float
    travel_direction_w: Floats  # (2,) unit vector
    # (a, 3) drag of each arc of the body that the start node has, tail to head.
    initial_drag_m: Floats
    # For a search of the whole body.
    initial_body_w: Floats | None = None  # (a + 1, 2) where the body lies, tail to head
    max_sideways_m: float = np.inf  # how far the path may be from where the body lies
    failed_w: Floats | None = None  # (k, 2) points of paths on which the body got stuck here
