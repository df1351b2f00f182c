"""Computes the effort of an advance as metrics that do not depend on the robot's size: energy, torque and time."""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.model.scene_file.friction import compute_surface_friction
from snakesim_operator.results.metrics.advance import (
    MIN_DISTANCE_M,
    ForwardProgress,
    compute_energy_j_per_m,
)
from snakesim_operator.results.metrics.form_closure import (
    compute_form_closure_margin,
    find_body_contacts,
)
from snakesim_operator.results.run_log import RunRecord

FORM_CLOSURE_PERIOD_NS = 0.1e9  # form closure is expensive to compute, and changes slowly
HEADROOM_PERCENTILE = 95


@dataclass(frozen=True)
class EffortMetrics:
    """Effort until the goal or the end of the run. A metric is None if it is unknown or the advance is too short."""

    body_lengths_s: float | None = None
    cost_of_transport: float | None = None  # energy over weight times advance
    # Friction of the whole weight over the advance, over energy.
    propulsive_efficiency: float | None = None
    jam_ratio: float | None = None  # fraction of the time in which the body was stationary
    impulse_n_s_per_m: float | None = None  # of all contacts, over the advance
    # Fraction of its limit that every joint had left, in 95 % of the ticks.
    torque_headroom: float | None = None
    # Fraction of the time in which obstacles would have held a stiff body.
    form_closure: float | None = None
    # Fraction of navigation's cycles in which it searched for a path.
    planning_fraction: float | None = None

    @staticmethod
    def from_run(
        record: RunRecord, progress: ForwardProgress | None, *, has_torque_and_velocity: bool
    ) -> "EffortMetrics":
        """Compute how fast a run advanced along its route, and at what effort.

        Args:
            record: The recorded run.
            progress: Advance of the body; None if the pose is unknown.
            has_torque_and_velocity: Whether joint torques and velocities are known, so that energy can be computed.

        Returns:
            The metrics. A metric is None if it is unknown; all of them are None if the pose is unknown.
        """
        if progress is None or progress.goal_or_end_s <= 0:
            return EffortMetrics()
        cost_of_transport = None
        if has_torque_and_velocity:
            cost_of_transport = _compute_cost_of_transport(record, progress)
        return EffortMetrics(
            body_lengths_s=progress.final_advance_m
            / progress.goal_or_end_s
            / get_body_length_m(record),
            cost_of_transport=cost_of_transport,
            propulsive_efficiency=compute_propulsive_efficiency(record, cost_of_transport),
            jam_ratio=min(progress.stationary_duration_s / progress.goal_or_end_s, 1.0),
            impulse_n_s_per_m=_compute_contact_impulse_n_s_per_m(record, progress),
            torque_headroom=_compute_torque_headroom(record, progress),
            form_closure=_compute_form_closure_fraction(record, progress),
            planning_fraction=_compute_planning_fraction(record, progress),
        )


def get_body_length_m(record: RunRecord) -> float:
    """Return the length of the straight body in m."""
    return sum(link.length_m for link in record.description.links)


def get_weight_n(record: RunRecord) -> float:
    """Return the weight of the body in N."""
    return record.config.scene.gravity_m_s2 * sum(link.mass_kg for link in record.description.links)


def compute_propulsive_efficiency(
    record: RunRecord, cost_of_transport: float | None
) -> float | None:
    """Compute the energy that dragging the robot over flat ground takes, divided by the energy that its joints used.

    Dragging takes the weight times the coefficient of friction for forward sliding, per meter.

    Args:
        record: The recorded run.
        cost_of_transport: Energy divided by weight times advance; None if it is unknown.

    Returns:
        The efficiency, or None if the cost of transport is unknown or the ground is not flat and level.
    """
    scene = record.config.scene
    ground = scene.ground
    is_flat = ground.heightfield is None and not scene.pipe and not scene.stairs and not scene.gaps
    is_level = is_flat and ground.slope_rad == 0.0 and scene.fluid is None
    if cost_of_transport is None or cost_of_transport <= 0 or not is_level:
        return None
    robot = record.config.robot
    friction = compute_surface_friction(ground.friction, ground, robot.skin, robot.wheels)
    return friction.forward / cost_of_transport


def _compute_cost_of_transport(record: RunRecord, progress: ForwardProgress) -> float | None:
    """Return energy divided by weight times advance, or None if the advance is too short."""
    energy_j_per_m = compute_energy_j_per_m(record, progress)
    if energy_j_per_m is None:
        return None
    return energy_j_per_m / get_weight_n(record)


def _compute_contact_impulse_n_s_per_m(
    record: RunRecord, progress: ForwardProgress
) -> float | None:
    """Integrate the forces of all contacts over time, and divide the impulse by the progress.

    The contacts are those in the world models of guidance, twenty per second. Returns None if the robot has no contact
    sensor, if the advance is too short, or if fewer than two world models are known.
    """
    if not record.has_contact_sensors or progress.final_advance_m < MIN_DISTANCE_M:
        return None
    start_ns = record.time_s[0] * 1e9
    times_s: list[float] = []
    force_sums_n: list[float] = []
    for world in record.worlds:
        if 0 <= (world.timestamp_ns - start_ns) * 1e-9 <= progress.goal_or_end_s:
            times_s.append(world.timestamp_ns * 1e-9)
            force_sums_n.append(
                sum(float(np.linalg.norm(contact.force_w)) for contact in world.contacts)
            )
    if len(times_s) < 2:
        return None
    return float(np.trapezoid(force_sums_n, times_s)) / progress.final_advance_m


def _compute_form_closure_fraction(record: RunRecord, progress: ForwardProgress) -> float | None:
    """Return the fraction of the time in which the obstacles beside the body hold it in form closure.

    The obstacles are those of the scene, at their initial positions. Poses are sampled every FORM_CLOSURE_PERIOD_NS,
    until the goal was reached or the end of the run.

    Args:
        record: The recorded run.
        progress: Advance of the body, with its end.

    Returns:
        A value between 0 and 1. It is 0 if the scene has no obstacles, and None if no sampled pose is known.
    """
    outlines = ObstacleOutlines.from_obstacles(
        [placed.obstacle for placed in record.placed_obstacles if not placed.walkable]
    )
    if not len(outlines):
        return 0.0
    radius_m = record.description.links[0].radius_m
    half_length_m = 0.5 * get_body_length_m(record)
    end_time_s = record.time_s[0] + progress.goal_or_end_s
    end_row = int(np.searchsorted(record.time_s, end_time_s))
    row_step = max(round(FORM_CLOSURE_PERIOD_NS / record.description.period_ns), 1)
    margins: list[float] = []
    for row in range(0, end_row, row_step):
        body_points_w = record.find_body_points_w(row)
        if body_points_w is None:
            continue
        contact_points_w, normals_w = find_body_contacts(body_points_w[:, :2], radius_m, outlines)
        margins.append(compute_form_closure_margin(contact_points_w, normals_w, half_length_m))
    if not margins:
        return None
    closed_count = sum(margin > 0.0 for margin in margins)
    return closed_count / len(margins)


def _compute_planning_fraction(record: RunRecord, progress: ForwardProgress) -> float | None:
    """Return the fraction of the cycles of navigation in which it searched for a path; None if no cycle is recorded."""
    period_s = record.description.period_ns * 1e-9
    start_s = record.time_s[0]
    node_counts: list[int] = []
    for tick, node_count in record.searched_nodes_by_tick.items():
        if 0 <= tick * period_s - start_s <= progress.goal_or_end_s:
            node_counts.append(node_count)
    if not node_counts:
        return None
    return sum(count > 0 for count in node_counts) / len(node_counts)


def _compute_torque_headroom(record: RunRecord, progress: ForwardProgress) -> float | None:
    """Return the fraction of its torque limit that the most loaded joint had left in 95 % of the ticks.

    Returns None if the torques of all joints are known at no tick.
    """
    limits_nm = np.array([joint.torque_limit_nm for joint in record.description.joints])
    is_before_goal = record.time_s - record.time_s[0] <= progress.goal_or_end_s
    torque_ratio: Floats = (np.abs(record.torque_nm) / limits_nm)[is_before_goal]
    known_torque_ratio = torque_ratio[np.isfinite(torque_ratio).all(axis=1)]
    if not len(known_torque_ratio):
        return None
    return float(1.0 - np.percentile(known_torque_ratio.max(axis=1), HEADROOM_PERCENTILE))
