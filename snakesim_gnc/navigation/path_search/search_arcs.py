"""The arcs by which the path search goes from a node to its children. Pure.

In shapes, n is the number of parents and c the number of curvatures. Points and headings are in the world frame.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.navigation.obstacle_grid import CELL_ERROR_M, ObstacleGrid
from snakesim_gnc.navigation.path_search.search_nodes import NodeLayer
from snakesim_gnc.navigation.path_search.search_parameters import STEP_M, SearchParameters
from snakesim_hal.base.arrays import Floats

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class SearchArcs:
    """All children of a layer before they are thinned out: one row for each parent, one column for each curvature."""

    # Middles of the arcs.
    middle_x_m: Floats  # (n, c)
    middle_y_m: Floats
    middle_heading_rad: Floats
    # Ends of the arcs.
    end_x_m: Floats
    end_y_m: Floats
    end_heading_rad: Floats


class ArcTable:
    """The arcs of all curvatures, computed once."""

    def __init__(self, parameters: SearchParameters) -> None:
        """Precompute what all arcs of a search have in common: their ends, their middles, and the distances they need.

        Args:
            parameters: The robot's size and clearance, and the c curvatures among which each step of a path chooses.
        """
        self.curvatures_per_m = np.array(parameters.curvatures_per_m)  # (c,)

        # The distance from obstacles that the body needs. Straight links cut the corners of the path, so the inner side
        # of an arc needs more room. Most poses are decided by the approximate distance.
        corner_cut_m = parameters.segment_m**2 * np.abs(self.curvatures_per_m) / 8  # (c,)
        self.needed_m = parameters.radius_m + parameters.clearance_m
        self.needed_inside_m = self.needed_m + corner_cut_m  # (c,)
        self.surely_clear_m = self.needed_inside_m + CELL_ERROR_M  # (c,)
        self.surely_blocked_m = self.needed_m - CELL_ERROR_M

        # (2, c): the end and the middle of a child's arc, ahead and to the left of its parent. The chord of an arc
        # of length s and curvature k has the length s sinc(k s / 2) and the direction k s / 2.
        half_turn_rad = 0.5 * self.curvatures_per_m * STEP_M
        chord_m = STEP_M * np.sinc(half_turn_rad / np.pi)
        self.end_m = np.stack([chord_m * np.cos(half_turn_rad), chord_m * np.sin(half_turn_rad)])
        middle_chord_m = 0.5 * STEP_M * np.sinc(0.5 * half_turn_rad / np.pi)
        self.middle_m = np.stack(
            [
                middle_chord_m * np.cos(0.5 * half_turn_rad),
                middle_chord_m * np.sin(0.5 * half_turn_rad),
            ]
        )

    def make_arcs(self, parents: NodeLayer) -> SearchArcs:
        """Make the arcs with every curvature from every parent node."""
        cosine = np.cos(parents.heading_rad)[:, None]
        sine = np.sin(parents.heading_rad)[:, None]
        x_m = parents.x_m[:, None]
        y_m = parents.y_m[:, None]
        heading_rad = parents.heading_rad[:, None] + self.curvatures_per_m * STEP_M
        return SearchArcs(
            middle_x_m=x_m + cosine * self.middle_m[0] - sine * self.middle_m[1],
            middle_y_m=y_m + sine * self.middle_m[0] + cosine * self.middle_m[1],
            middle_heading_rad=heading_rad - 0.5 * self.curvatures_per_m * STEP_M,
            end_x_m=x_m + cosine * self.end_m[0] - sine * self.end_m[1],
            end_y_m=y_m + sine * self.end_m[0] + cosine * self.end_m[1],
            end_heading_rad=heading_rad,
        )

    def find_clear_poses(
        self, obstacles: ObstacleGrid, x_m: Floats, y_m: Floats, heading_rad: Floats
    ) -> Bools:
        """Find the poses on the arcs at which the body clears all obstacles.

        Most poses are decided by the approximate distance. The exact distance and its normal are computed only for the
        others.

        Args:
            obstacles: The map.
            x_m: (n, c) positions on the arcs in the world.
            y_m: (n, c) positions on the arcs in the world.
            heading_rad: (n, c) headings of the arcs at these positions.

        Returns:
            (n, c) whether the body clears all obstacles there.
        """
        approximate_m = obstacles.compute_approximate_distance_m(x_m, y_m)
        is_clear = approximate_m >= self.surely_clear_m
        undecided = np.nonzero(~is_clear & (approximate_m >= self.surely_blocked_m))
        nearest = obstacles.find_nearest(x_m[undecided], y_m[undecided])
        heading = heading_rad[undecided]
        curvature_index = undecided[1]
        normal_to_left = (
            np.cos(heading) * nearest.normal_w[:, 1] - np.sin(heading) * nearest.normal_w[:, 0]
        )
        is_inner_side = normal_to_left * np.sign(self.curvatures_per_m[curvature_index]) < 0
        needed_m = np.where(is_inner_side, self.needed_inside_m[curvature_index], self.needed_m)
        is_clear[undecided] = nearest.distance_m >= needed_m
        return is_clear
