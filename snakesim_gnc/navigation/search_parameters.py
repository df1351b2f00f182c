"""The robot and the costs of the path search. `beam` has the equation of the cost. Pure."""

from dataclasses import dataclass


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
    weak_margin_cost_near: float = 15.0  # instead of `weak_margin_cost`, over the first `near_m` ahead of the head
    near_m: float = 0.3
    failed_path_cost: float = 1.0
    sideways_cost: float = 0.5
