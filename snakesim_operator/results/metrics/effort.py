"""What an advance cost, in numbers that do not depend on the robot's size: energy, contact, torque and time."""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.model.solids import GRAVITY_M_S2
from snakesim_operator.results.metrics.advance import MIN_DISTANCE_M, Advance, energy_j_per_m
from snakesim_operator.results.metrics.form_closure import contacts_beside, form_closure_margin
from snakesim_operator.results.run_log import RunRecord

FORM_CLOSURE_PERIOD_NS = 0.1e9  # form closure is expensive to compute, and changes slowly
HEADROOM_PERCENTILE = 95


@dataclass(frozen=True)
class Effort:
    """Effort until the goal was reached, or the end. None: unknown, or the advance is too short to tell."""

    body_lengths_s: float | None = None
    cost_of_transport: float | None = None  # energy over weight times advance
    propulsive_efficiency: float | None = None  # friction of the whole weight over the advance, over energy
    jam_ratio: float | None = None  # fraction of the time in which the body was stationary
    impulse_n_s_per_m: float | None = None  # of all contacts, over the advance
    torque_headroom: float | None = None  # fraction of its limit that every joint had left, in 95 % of the ticks
    form_closure: float | None = None  # fraction of the time in which obstacles would have held a stiff body
    planning_fraction: float | None = None  # fraction of navigation's cycles in which it searched for a path

    @staticmethod
    def from_run(record: RunRecord, advance: Advance | None, *, has_power: bool) -> "Effort":
        """Compute how fast a run advanced along its route, and at what effort.

        Args:
            record: The recorded run.
            advance: How the run advanced; None: the pose is unknown.
            has_power: Whether torques and speeds are known, so that the energy can be computed.

        Returns:
            The values; None where they are unknown, which is all of them without a pose.
        """
        if advance is None or advance.until_s <= 0:
            return Effort()
        cost_of_transport = None
        if has_power:
            cost_of_transport = _cost_of_transport(record, advance)
        return Effort(
            body_lengths_s=advance.reached_m / advance.until_s / body_length_m(record),
            cost_of_transport=cost_of_transport,
            propulsive_efficiency=propulsive_efficiency(record, cost_of_transport),
            jam_ratio=min(advance.stalled_s / advance.until_s, 1.0),
            impulse_n_s_per_m=_impulse_n_s_per_m(record, advance),
            torque_headroom=_torque_headroom(record, advance),
            form_closure=_form_closure_fraction(record, advance),
            planning_fraction=_planning_fraction(record, advance),
        )


def body_length_m(record: RunRecord) -> float:
    """Return the length of the straight body in m."""
    return sum(link.length_m for link in record.description.links)


def weight_n(record: RunRecord) -> float:
    """Return the weight of the body in N."""
    return GRAVITY_M_S2 * sum(link.mass_kg for link in record.description.links)


def propulsive_efficiency(record: RunRecord, cost_of_transport: float | None) -> float | None:
    """Return the energy that dragging the robot over flat ground costs, over the energy that its joints used.

    Dragging costs the weight times the friction. None: the cost of transport is unknown, or the ground is not flat.
    """
    ground = record.config.scene.ground
    is_flat = ground.heightfield is None
    if cost_of_transport is None or cost_of_transport <= 0 or not is_flat:
        return None
    return ground.friction / cost_of_transport


def _cost_of_transport(record: RunRecord, advance: Advance) -> float | None:
    """Return energy over weight times advance."""
    per_m = energy_j_per_m(record, advance)
    if per_m is None:
        return None
    return per_m / weight_n(record)


def _impulse_n_s_per_m(record: RunRecord, advance: Advance) -> float | None:
    """Integrate the forces of all contacts over time, and divide by the advance.

    The contacts are those in guidance's world models, twenty a second. None without a contact sensor.
    """
    if not record.feels_contacts or advance.reached_m < MIN_DISTANCE_M:
        return None
    begin_ns = record.time_s[0] * 1e9
    times_s: list[float] = []
    sums_n: list[float] = []
    for world in record.worlds:
        if 0 <= (world.timestamp_ns - begin_ns) * 1e-9 <= advance.until_s:
            times_s.append(world.timestamp_ns * 1e-9)
            sums_n.append(sum(float(np.linalg.norm(contact.force_w)) for contact in world.contacts))
    if len(times_s) < 2:
        return None
    return float(np.trapezoid(sums_n, times_s)) / advance.reached_m


def _form_closure_fraction(record: RunRecord, advance: Advance) -> float | None:
    """Return the fraction of the time in which the obstacles beside the body hold it in form closure.

    The obstacles are those of the scene, at their initial places. Poses are sampled every FORM_CLOSURE_PERIOD_NS, until
    the end of the advance.

    Returns:
        A value between 0 and 1; 0 if the scene has no obstacles; None if no sampled pose is known.
    """
    outlines = Outlines.from_obstacles([placed.obstacle for placed in record.placed if not placed.walkable])
    if not len(outlines):
        return 0.0
    radius_m = record.description.links[0].radius_m
    half_length_m = 0.5 * body_length_m(record)
    end_time_s = record.time_s[0] + advance.until_s
    end_row = int(np.searchsorted(record.time_s, end_time_s))
    row_step = max(round(FORM_CLOSURE_PERIOD_NS / record.description.period_ns), 1)
    margins: list[float] = []
    for row in range(0, end_row, row_step):
        nodes = record.nodes_w(row)
        if nodes is None:
            continue
        places_w, normals_w = contacts_beside(nodes[:, :2], radius_m, outlines)
        margins.append(form_closure_margin(places_w, normals_w, half_length_m))
    if not margins:
        return None
    closed_count = sum(margin > 0.0 for margin in margins)
    return closed_count / len(margins)


def _planning_fraction(record: RunRecord, advance: Advance) -> float | None:
    """Return the fraction of navigation's cycles in which it searched for a path."""
    period_s = record.description.period_ns * 1e-9
    begin_s = record.time_s[0]
    node_counts: list[int] = []
    for tick, node_count in record.searched_nodes.items():
        if 0 <= tick * period_s - begin_s <= advance.until_s:
            node_counts.append(node_count)
    if not node_counts:
        return None
    return sum(count > 0 for count in node_counts) / len(node_counts)


def _torque_headroom(record: RunRecord, advance: Advance) -> float | None:
    """Return the fraction of its limit that the hardest-worked joint had left in 95 % of the ticks."""
    limits_nm = np.array([joint.torque_limit_nm for joint in record.description.joints])
    until_goal = record.time_s - record.time_s[0] <= advance.until_s
    load_fraction: Floats = (np.abs(record.torque_nm) / limits_nm)[until_goal]
    known = load_fraction[np.isfinite(load_fraction).all(axis=1)]
    if not len(known):
        return None
    return float(1.0 - np.percentile(known.max(axis=1), HEADROOM_PERCENTILE))
