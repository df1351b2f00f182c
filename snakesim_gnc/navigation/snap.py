"""Pulls a planned path to the obstacles to push off, away from those that brake, and smooths it. Pure."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.navigation.line import SPACING_M, evenly
from snakesim_gnc.navigation.obstacle_map import NONE, ObstacleMap
from snakesim_hal.base.arrays import Floats


@dataclass(frozen=True)
class Fit:
    """How a path shall lie between obstacles; lengths in metres."""

    radius_m: float
    segment_m: float
    push_gap_m: float = 0.004  # to what it pushes off: controllers close it; a path that presses moves a body by itself
    brake_gap_m: float = 0.012
    min_gap_m: float = 0.004
    touch_m: float = 0.005  # a gap that is smaller is a touch
    reach_m: float = 0.02  # a gap that is wider is left as it is
    smooth_m: float = 0.03  # bends are smoothed over this length
    hold: float = 40.0  # weight of a gap against staying where the path was
    rounds: int = 4


def snap(points_w: Floats, kept: int, obstacles: ObstacleMap, goal: Floats, fit: Fit) -> Floats:
    """The path (n, 2), evenly spaced, moved sideways; its first `kept` points stay where they are.

    goal: (2,) unit vector: a touch whose normal has a part along it pushes.
    """
    path = np.asarray(points_w, dtype=np.float64)
    for _ in range(fit.rounds):
        tangent = np.gradient(path, axis=0)
        tangent /= np.maximum(np.hypot(*tangent.T), 1e-9)[:, None]
        left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=-1)
        shift, weight = _wanted(path, tangent, left, obstacles, goal, fit)
        weight[:kept], shift[:kept] = 1e4, 0.0
        path = path + _solve(path, left, shift, weight, fit)[:, None] * left
        path = np.concatenate([path[:kept], evenly(path[max(kept - 1, 0) :])[1 if kept else 0 :]])
    return path


def _wanted(
    path: Floats, tangent: Floats, left: Floats, obstacles: ObstacleMap, goal: Floats, fit: Fit
) -> tuple[Floats, Floats]:
    """How far each point wants to go to the left, and how much."""
    near = obstacles.near(path[:, 0], path[:, 1])
    across = np.einsum("ij,ij->i", near.normal_w, left)
    heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    bend = np.gradient(heading) / SPACING_M
    cut = np.where(across * bend < 0, np.minimum(np.abs(bend), 6.0) * fit.segment_m**2 / 8, 0.0)
    gap = near.distance_m - fit.radius_m - 0.7 * cut
    push = near.normal_w @ goal
    beside = (near.obstacle != NONE) & (np.abs(across) > 0.9)
    target = np.where(push > 0.1, fit.push_gap_m, np.where(push < -0.1, fit.brake_gap_m, fit.min_gap_m))
    pulls = beside & (push > 0.1) & (gap < fit.reach_m) & _least_of_obstacle(near.obstacle, gap)
    moves = pulls | ((near.obstacle != NONE) & (gap < target))
    shift = np.where(moves, (target - gap) * np.sign(across), 0.0)
    return shift, np.where(moves, fit.hold * np.maximum(np.abs(across), 0.3), 0.0)


def _least_of_obstacle(obstacle: NDArray[np.intp], gap: Floats) -> NDArray[np.bool_]:
    """Where a run of points beside one obstacle is nearest to it, and its neighbors."""
    least = np.zeros(len(gap), dtype=bool)
    edges = np.flatnonzero(np.diff(obstacle)) + 1
    for first, last in zip([0, *edges], [*edges, len(gap)], strict=True):
        k = first + int(np.argmin(gap[first:last]))
        least[max(k - 1, first) : min(k + 2, last)] = True
    return least


def _solve(path: Floats, left: Floats, shift: Floats, weight: Floats, fit: Fit) -> Floats:
    """Least squares: third differences of the moved path, being moved at all, and the wanted shifts."""
    count, factors = len(path), (-1.0, 3.0, -3.0, 1.0)
    stiff = (fit.smooth_m / SPACING_M) ** 6
    matrix = np.diag(1.0 + weight)
    right = weight * shift
    rows = np.arange(count - 3)
    for axis in (0, 1):
        bent = [factor * left[k : count - 3 + k, axis] for k, factor in enumerate(factors)]  # of the moved path
        third = sum(factor * path[k : count - 3 + k, axis] for k, factor in enumerate(factors))
        for k, row in enumerate(bent):
            right[k : count - 3 + k] -= stiff * row * third
            for j, column in enumerate(bent):
                matrix[rows + k, rows + j] += stiff * row * column
    return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
