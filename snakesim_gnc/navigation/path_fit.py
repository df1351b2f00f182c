"""Fits a planned path to the obstacles beside it, and smooths it. Pure.

The path is pulled towards the obstacles that the body will push off, and away from those that brake it. Each point
moves sideways only. Several rounds of a linear least-squares problem give the shifts.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.geometry.planar import SPACING_M, resample_evenly
from snakesim_gnc.navigation.obstacle_grid import NO_OBSTACLE, ObstacleGrid
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]

FIXED_WEIGHT = 1e4  # of points that must not move
MIN_LENGTH_M = 1e-9  # avoids a division by zero where points coincide
# Part of a contact's normal along the goal: with more it pushes, with less than its negative it brakes.
MIN_PROPULSION_PART = 0.1
# Part of a normal across the path: with more the obstacle is beside the path.
MIN_SIDEWAYS_PART = 0.9
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
    points_w: Floats,
    fixed_point_count: int,
    obstacles: ObstacleGrid,
    goal_w: Floats,
    parameters: PathFitParameters,
) -> Floats:
    """Move the points of a path sideways until it has the desired gaps to the obstacles beside it.

    A shift changes the directions of the path and which obstacle is nearest to a point, so the shifts are computed
    again for the shifted path, `parameters.rounds` times. Shifted points are no longer evenly spaced; each round ends
    with new points, because the smoothing of the next round assumes even spacing.

    Args:
        points_w: (n, 2) the path, evenly spaced, m.
        fixed_point_count: Number of points at its beginning that stay where they are.
        obstacles: The obstacles of the map.
        goal_w: (2,) unit vector of the direction of travel.
        parameters: Gaps and weights.

    Returns:
        The path, evenly spaced: an array of shape (count, 2), whose number of points may differ from n.
    """
    path_w = np.asarray(points_w, dtype=np.float64)
    for _ in range(parameters.rounds):
        tangents = _compute_tangents(path_w)
        left_directions = np.stack([-tangents[:, 1], tangents[:, 0]], axis=-1)
        # What the obstacles ask of each point. The fixed points are asked to stay, with a weight above all others.
        desired_shifts_m, weights = _find_desired_shifts(
            path_w, tangents, left_directions, obstacles, goal_w, parameters
        )
        desired_shifts_m[:fixed_point_count] = 0.0
        weights[:fixed_point_count] = FIXED_WEIGHT
        # The compromise between these shifts and a smooth path.
        shifts_m = _solve_shifts_m(path_w, left_directions, desired_shifts_m, weights, parameters)
        path_w = path_w + shifts_m[:, None] * left_directions
        path_w = _resample_after_fixed_points(path_w, fixed_point_count)
    return path_w


def _compute_tangents(path_w: Floats) -> Floats:
    """Return the unit vectors along a path, (n, 2), by central differences of its points (n, 2)."""
    differences_m = np.gradient(path_w, axis=0)
    lengths_m = np.hypot(differences_m[:, 0], differences_m[:, 1])
    return differences_m / np.maximum(lengths_m, MIN_LENGTH_M)[:, None]


def _resample_after_fixed_points(path_w: Floats, fixed_point_count: int) -> Floats:
    """Return the path with the fixed points as they are, and evenly spaced points after them."""
    if not fixed_point_count:
        return resample_evenly(path_w)
    resampled_rest = resample_evenly(path_w[fixed_point_count - 1 :])
    return np.concatenate([path_w[:fixed_point_count], resampled_rest[1:]])


def _find_desired_shifts(
    path_w: Floats,
    tangents: Floats,
    left_directions: Floats,
    obstacles: ObstacleGrid,
    goal_w: Floats,
    parameters: PathFitParameters,
) -> tuple[Floats, Floats]:
    """Return how far each point of a path should move to the left for its desired gap, and the weight of that.

    A point moves if its gap is too small, or if it is the nearest one to an obstacle that the body can push off. The
    desired gap depends on whether the obstacle pushes the body towards the goal, away from it, or neither.

    Args:
        path_w: (n, 2) points of the path in the world, m.
        tangents: (n, 2) unit vectors along the path.
        left_directions: (n, 2) unit vectors to the left of the path.
        obstacles: The obstacles of the map.
        goal_w: (2,) unit vector of the direction of travel.
        parameters: Gaps and weights.

    Returns:
        The shifts in m, left positive, and their weights, (n,) each. Points that need not move have the weight 0.
    """
    nearest = obstacles.find_nearest(path_w[:, 0], path_w[:, 1])
    is_near = nearest.obstacle_index != NO_OBSTACLE
    # Components of the obstacle's unit normal, (n,): to the left of the path, and in the direction of travel.
    sideways_part = np.einsum("ij,ij->i", nearest.normal_w, left_directions)
    propulsion_part = nearest.normal_w @ goal_w
    does_push = propulsion_part > MIN_PROPULSION_PART
    does_brake = propulsion_part < -MIN_PROPULSION_PART

    # The gap that the body has now, and the gap that it should have, (n,) in m.
    corner_cut_m = _compute_corner_cut_m(tangents, sideways_part, parameters.segment_m)
    gap_m = nearest.distance_m - parameters.radius_m - CORNER_CUT_SCALE * corner_cut_m
    desired_gap_m = np.full(len(path_w), parameters.min_gap_m)
    desired_gap_m[does_push] = parameters.push_gap_m
    desired_gap_m[does_brake] = parameters.brake_gap_m

    # The points that must move, (n,).
    is_too_close = is_near & (gap_m < desired_gap_m)
    is_push_point = (
        is_near
        & (np.abs(sideways_part) > MIN_SIDEWAYS_PART)
        & does_push
        & (gap_m < parameters.max_pull_m)
        & _find_points_near_local_minima(nearest.obstacle_index, gap_m)
    )
    is_moved = is_push_point | is_too_close

    # To widen a gap, a point moves along the normal, which is to the left if the obstacle is on the right.
    shifts_m = np.where(is_moved, (desired_gap_m - gap_m) * np.sign(sideways_part), 0.0)
    weights = parameters.gap_weight * np.maximum(np.abs(sideways_part), MIN_SIDEWAYS_WEIGHT)
    return shifts_m, np.where(is_moved, weights, 0.0)


def _compute_corner_cut_m(tangents: Floats, sideways_part: Floats, segment_m: float) -> Floats:
    """Compute by how much a straight link is nearer than the path to an obstacle on the inner side of a bend.

    It is segment² |curvature| / 8 at the middle of a link.

    Args:
        tangents: (n, 2) unit vectors along the path.
        sideways_part: (n,) component of the obstacle's normal to the left of the path.
        segment_m: Length of a link.

    Returns:
        (n,) distances in m; 0 for obstacles on the outer side.
    """
    headings_rad = np.unwrap(np.arctan2(tangents[:, 1], tangents[:, 0]))
    curvature_per_m = np.gradient(headings_rad) / SPACING_M
    is_inner_side = sideways_part * curvature_per_m < 0
    cut_m = np.minimum(np.abs(curvature_per_m), MAX_CURVATURE_PER_M) * segment_m**2 / 8
    return np.where(is_inner_side, cut_m, 0.0)


def _find_points_near_local_minima(obstacle_index: NDArray[np.intp], gap_m: Floats) -> Bools:
    """Find the point nearest to each obstacle, together with its two neighbors on the path.

    Args:
        obstacle_index: (n,) index of the obstacle nearest to each point. A run of equal indices is one pass beside an
            obstacle.
        gap_m: (n,) gap between body and obstacle at each point.

    Returns:
        (n,) whether each point has the smallest gap of its run, or is next to such a point in the run.
    """
    is_near_minimum = np.zeros(len(gap_m), dtype=bool)
    # A run begins at 0 and wherever the index changes, and ends where the next run begins.
    change_indices = np.flatnonzero(np.diff(obstacle_index)) + 1
    run_starts = [0, *change_indices]
    run_ends = [*change_indices, len(gap_m)]
    for run_start, run_end in zip(run_starts, run_ends, strict=True):
        lowest_index = run_start + int(np.argmin(gap_m[run_start:run_end]))
        first_index = max(lowest_index - 1, run_start)
        last_index = min(lowest_index + 1, run_end - 1)
        is_near_minimum[first_index : last_index + 1] = True
    return is_near_minimum


def _solve_shifts_m(
    path_w: Floats,
    left_directions: Floats,
    desired_m: Floats,
    weights: Floats,
    parameters: PathFitParameters,
) -> Floats:
    """Return the shifts u to the left, (n,) in m, that are the best compromise of smoothness and desired gaps.

    They minimize

        sum_i u_i² + w_i (u_i - v_i)² + k |third difference of (p + u l)|²,   k = (smoothing / spacing)^6

    The sum is quadratic in u. Its derivative is zero where A u = b, which is solved here.

    Args:
        path_w: (n, 2) points p of the path, m.
        left_directions: (n, 2) unit vectors l to the left of the path.
        desired_m: (n,) shifts v that give the desired gaps.
        weights: (n,) weights w.
        parameters: Length over which the path is smoothed.
    """
    difference_count = len(path_w) - 3
    stiffness = (parameters.smoothing_m / SPACING_M) ** 6
    # A and b without the third differences.
    matrix = np.diag(1.0 + weights)
    right_side = weights * desired_m
    # Third difference d depends on the points d to d + 3, one for each factor.
    difference_indices = np.arange(difference_count)
    for axis in (0, 1):
        # Of the path as it is, (difference_count,).
        third_differences = sum(
            factor * path_w[offset : difference_count + offset, axis]
            for offset, factor in enumerate(THIRD_DIFFERENCE)
        )
        # How much each third difference changes with the shift of its first, second, third and fourth point.
        derivatives = [
            factor * left_directions[offset : difference_count + offset, axis]
            for offset, factor in enumerate(THIRD_DIFFERENCE)
        ]
        for row_offset, row_derivative in enumerate(derivatives):
            right_side[row_offset : difference_count + row_offset] -= (
                stiffness * row_derivative * third_differences
            )
            for column_offset, column_derivative in enumerate(derivatives):
                matrix[difference_indices + row_offset, difference_indices + column_offset] += (
                    stiffness * row_derivative * column_derivative
                )
    return np.asarray(np.linalg.solve(matrix, right_side), dtype=np.float64)
