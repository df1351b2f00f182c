"""Fits a planned path to the obstacles beside it, and smooths it. Pure.

The path is pulled towards the obstacles that the body will push off, and away from those that brake it. Each point
moves sideways only. Several rounds of a linear least-squares problem give the shifts.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import SPACING_M, space_evenly
from snakesim_gnc.navigation.obstacle_grid import NO_OBSTACLE, ObstacleGrid
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]

FIXED_WEIGHT = 1e4  # of points that must not move
MIN_PUSH = 0.1  # part of a contact's normal along the goal: with more it pushes, with less than its negative it brakes
MIN_SIDEWAYS = 0.9  # part of a normal across the path: with more the obstacle is beside the path
MIN_SIDEWAYS_WEIGHT = 0.3  # of an obstacle that is ahead rather than beside
MAX_CURVATURE_PER_M = 6.0  # a sharper bend is noise of the differences
CORNER_CUT_SCALE = 0.7  # part of the largest corner cut that counts, because few contacts are at the middle of a link
THIRD_DIFFERENCE = (-1.0, 3.0, -3.0, 1.0)


@dataclass(frozen=True)
class PathFitParameters:
    """How a path lies between obstacles."""

    # The robot.
    radius_m: float
    segment_m: float  # length of a link
    # Wanted gaps between the body and an obstacle.
    push_gap_m: float = 0.004  # that the body pushes off; controllers close it, and a path that presses moves a body
    brake_gap_m: float = 0.012
    min_gap_m: float = 0.004
    # Gaps that count.
    contact_gap_m: float = 0.005  # a smaller gap is a contact
    max_pull_m: float = 0.02  # a wider gap stays as it is
    # The least-squares problem.
    smoothing_m: float = 0.03  # bends are smoothed over this length
    gap_weight: float = 40.0  # of a wanted gap, against staying where the path was
    rounds: int = 4


def fit_path(
    points_w: Floats, fixed_points: int, obstacles: ObstacleGrid, goal_w: Floats, parameters: PathFitParameters
) -> Floats:
    """Move the points of a path sideways until it has the desired gaps to the obstacles beside it.

    Args:
        points_w: (n, 2) the path, evenly spaced, m.
        fixed_points: number of points at its beginning that stay where they are.
        obstacles: the obstacles of the map.
        goal_w: (2,) unit vector of the direction of travel.
        parameters: gaps and weights.

    Returns:
        (m, 2) the path, evenly spaced.
    """
    path = np.asarray(points_w, dtype=np.float64)
    for _ in range(parameters.rounds):
        chords = np.gradient(path, axis=0)
        tangents = chords / np.maximum(np.hypot(chords[:, 0], chords[:, 1]), 1e-9)[:, None]
        left = np.stack([-tangents[:, 1], tangents[:, 0]], axis=-1)
        shift_m, weight = _find_desired_shifts(path, tangents, left, obstacles, goal_w, parameters)
        shift_m[:fixed_points] = 0.0
        weight[:fixed_points] = FIXED_WEIGHT
        path = path + _solve_shifts_m(path, left, shift_m, weight, parameters)[:, None] * left
        path = _space_evenly_after(path, fixed_points)
    return path


def _space_evenly_after(path: Floats, fixed_points: int) -> Floats:
    """Return the path with evenly spaced points after the fixed ones."""
    if not fixed_points:
        return space_evenly(path)
    rest = space_evenly(path[fixed_points - 1 :])
    return np.concatenate([path[:fixed_points], rest[1:]])


def _find_desired_shifts(
    path: Floats,
    tangents: Floats,
    left: Floats,
    obstacles: ObstacleGrid,
    goal_w: Floats,
    parameters: PathFitParameters,
) -> tuple[Floats, Floats]:
    """Return how far each point of a path should move to the left for its desired gap, and the weight of that.

    A point moves if its gap is too small, or if it is the nearest one to an obstacle that the body can push off. The
    desired gap depends on whether the obstacle pushes the body towards the goal, away from it, or neither.

    Args:
        path: (n, 2) points of the path in the world, m.
        tangents: (n, 2) unit vectors along the path.
        left: (n, 2) unit vectors to the left of the path.
        obstacles: the obstacles of the map.
        goal_w: (2,) unit vector of the direction of travel.
        parameters: gaps and weights.

    Returns:
        The shifts in m, left positive, and their weights, (n,) each. Points that need not move have the weight 0.
    """
    nearest = obstacles.find_nearest(path[:, 0], path[:, 1])
    is_near = nearest.obstacle != NO_OBSTACLE
    sideways = np.einsum("ij,ij->i", nearest.normal_w, left)
    push = nearest.normal_w @ goal_w
    corner_cut_m = _corner_cut_m(tangents, sideways, parameters.segment_m)
    gap_m = nearest.distance_m - parameters.radius_m - CORNER_CUT_SCALE * corner_cut_m
    desired_gap_m = np.where(
        push > MIN_PUSH,
        parameters.push_gap_m,
        np.where(push < -MIN_PUSH, parameters.brake_gap_m, parameters.min_gap_m),
    )
    is_too_close = is_near & (gap_m < desired_gap_m)
    is_push_point = (
        is_near
        & (np.abs(sideways) > MIN_SIDEWAYS)
        & (push > MIN_PUSH)
        & (gap_m < parameters.max_pull_m)
        & _find_local_minima(nearest.obstacle, gap_m)
    )
    is_moved = is_push_point | is_too_close
    shift_m = np.where(is_moved, (desired_gap_m - gap_m) * np.sign(sideways), 0.0)
    weight = parameters.gap_weight * np.maximum(np.abs(sideways), MIN_SIDEWAYS_WEIGHT)
    return shift_m, np.where(is_moved, weight, 0.0)


def _corner_cut_m(tangents: Floats, sideways: Floats, segment_m: float) -> Floats:
    """Return by how much a straight link is nearer than the path to an obstacle on the inner side of a bend, (n,).

    It is segment² |curvature| / 8 at the middle of a link. sideways: part of the obstacle's normal to the left, (n,).
    """
    headings_rad = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    curvature_per_m = np.gradient(headings_rad) / SPACING_M
    is_inner_side = sideways * curvature_per_m < 0
    cut_m = np.minimum(np.abs(curvature_per_m), MAX_CURVATURE_PER_M) * segment_m**2 / 8
    return np.where(is_inner_side, cut_m, 0.0)


def _find_local_minima(obstacle: NDArray[np.intp], gap_m: Floats) -> Bools:
    """Return which points, (n,), are nearest to their obstacle in a run of points beside it, or next to that point."""
    is_minimum = np.zeros(len(gap_m), dtype=bool)
    edges = np.flatnonzero(np.diff(obstacle)) + 1
    for first, end in zip([0, *edges], [*edges, len(gap_m)], strict=True):
        lowest = first + int(np.argmin(gap_m[first:end]))
        is_minimum[max(lowest - 1, first) : min(lowest + 2, end)] = True
    return is_minimum


def _solve_shifts_m(
    path: Floats, left: Floats, desired_m: Floats, weight: Floats, parameters: PathFitParameters
) -> Floats:
    """Return the shifts u to the left, (n,) in m, with which the path is smooth and has the desired gaps.

    They minimize

        sum_i u_i² + w_i (u_i - v_i)² + k |third difference of (p + u l)|²,   k = (smoothing / spacing)^6

    Args:
        path: (n, 2) points p of the path, m.
        left: (n, 2) unit vectors l to the left of the path.
        desired_m: (n,) shifts v that give the desired gaps.
        weight: (n,) weights w.
        parameters: length over which the path is smoothed.
    """
    count = len(path)
    window = count - 3
    stiffness = (parameters.smoothing_m / SPACING_M) ** 6
    matrix = np.diag(1.0 + weight)
    right_side = weight * desired_m
    rows = np.arange(window)
    for axis in (0, 1):
        # Column j of the third difference in this axis, as it depends on the shift of point i + j.
        columns = [factor * left[j : window + j, axis] for j, factor in enumerate(THIRD_DIFFERENCE)]
        third_difference = sum(factor * path[j : window + j, axis] for j, factor in enumerate(THIRD_DIFFERENCE))
        for i, row in enumerate(columns):
            right_side[i : window + i] -= stiffness * row * third_difference
            for j, column in enumerate(columns):
                matrix[rows + i, rows + j] += stiffness * row * column
    return np.asarray(np.linalg.solve(matrix, right_side), dtype=np.float64)
