"""The robot and the costs of the path search. `beam` has the equation of the cost. Pure."""

import math
from dataclasses import dataclass

STEP_M = 0.05  # length of an arc
MAX_CONTACTS = 8  # of one body that a node stores, the newest
MAX_HEADING_ERROR_RAD = 1.75  # a path heads no farther away from the goal

# Of the nodes in one narrow cell only the cheapest is kept: they are the same for the robot.
CELL_M = 0.02
CELL_RAD = math.pi / 18
# A wide cell keeps a limited number of nodes, so that other ways round an obstacle stay in the search.
WIDE_CELL_M = 0.1
WIDE_CELL_RAD = 0.6
CANDIDATES_PER_KEPT_NODE = 3  # nodes whose contacts are computed, for each one that is kept

MIN_PUSH = -0.1  # n.g of a contact that counts for the margin: `path_fit` moves the body off those that brake more
MAX_FRONTAL = 0.35  # |n.t| of a contact with the side of the body; beyond, the head bumps
FAILED_PATH_M = 0.025  # a path farther than this from a failed one is another path


@dataclass(frozen=True)
class SearchParameters:
    """The robot and the costs of the search. Costs and rewards are meters of path for each meter of path."""

    # The robot.
    body_length_m: float
    radius_m: float
    segment_m: float  # length of a link: straight links cut the corners of the path by segment_m² |curvature| / 8
    # The space that is searched.
    curvatures_per_m: tuple[float, ...] = (-5.5, -3.7, -1.8, 0.0, 1.8, 3.7, 5.5)
    clearance_m: float = 0.004
    contact_distance_m: float = 0.02  # a smaller gap counts as a contact: `path_fit` will close it
    kept_nodes: int = 900
    kept_per_wide_cell: int = 16
    # The propulsion margin.
    assumed_obstacle_friction: float = 0.0  # Coulomb coefficient mu of the obstacles
    unused_tail_m: float = 0.2  # contacts this near to the tail end do not count
    unused_head_m: float = 0.1  # likewise to the head end
    wanted_margin_n: float = 40.0  # F_wanted
    # Costs of every path.
    push_reward: float = 2.4
    brake_cost: float = 1.0
    weak_margin_cost: float = 6.0
    curvature_change_cost_m: float = 0.02
    progress_reward: float = 1.2
    # Costs of a path on which the whole body is laid again.
    push_reward_of_body: float = 4.0  # instead of `push_reward`, up to where the head will lie
    # Instead of `weak_margin_cost`, over the first `near_m` ahead of the head.
    weak_margin_cost_near: float = 15.0
    near_m: float = 0.3
    failed_path_cost: float = 1.0
    sideways_cost: float = 0.5


def count_arcs_per_body(parameters: SearchParameters) -> int:
    """Return the length of the body as a number of arcs."""
    return round(parameters.body_length_m / STEP_M)
