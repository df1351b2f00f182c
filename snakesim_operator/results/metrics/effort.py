"""What an advance cost, in numbers that robots of any size share: energy, contact, torque and time. Pure."""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.model.outlines import Outlines
from snakesim_hal.model.solids import GRAVITY_M_S2
from snakesim_operator.results.metrics.advance import MIN_DISTANCE_M, Advance, energy_j, energy_j_per_m
from snakesim_operator.results.metrics.form_closure import contacts_beside, form_closure_margin
from snakesim_operator.results.record import RunRecord


@dataclass(frozen=True)
class Effort:
    """Until the goal was reached, or the end. None: unknown, or not enough of an advance to say."""

    body_lengths_s: float | None = None
    cost_of_transport: float | None = None  # energy over weight times advance
    propulsive_efficiency: float | None = None  # friction of the whole weight over the advance, over energy
    jam_ratio: float | None = None  # share of the time in which it stood
    impulse_n_s_per_m: float | None = None  # of all contacts, over the advance
    torque_headroom: float | None = None  # share of its limit that the joint with least had left, in 95 % of the ticks
    form_closure: float | None = None  # share of the time in which obstacles held it, had its joints been stiff
    planning_fraction: float | None = None  # of navigation's turns: in which it searched for a path

    @staticmethod
    def of(record: RunRecord, advance: Advance | None, *, has_power: bool) -> "Effort":
        """has_power: torques and speeds are known."""
        if advance is None or advance.until_s <= 0:
            return Effort()
        links, ground = record.description.links, record.config.scene.ground
        per_m = energy_j_per_m(record, advance) if has_power else None
        transport = None if per_m is None else per_m / (GRAVITY_M_S2 * sum(link.mass_kg for link in links))
        rubs = transport is not None and transport > 0 and ground.heightfield is None
        length_m = sum(link.length_m for link in links)
        return Effort(
            body_lengths_s=advance.reached_m / advance.until_s / length_m,
            cost_of_transport=transport,
            propulsive_efficiency=ground.friction / transport if rubs and transport else None,
            jam_ratio=min(advance.stalled_s / advance.until_s, 1.0),
            impulse_n_s_per_m=_impulse_n_s_per_m(record, advance),
            torque_headroom=_headroom(record, advance),
            form_closure=_form_closure(record, advance),
            planning_fraction=_planning_fraction(record, advance),
        )


@dataclass(frozen=True)
class Directions:
    """A whole run along two directions: the first heading of the body, and its net displacement.

    None: unknown, or over too short a distance to say.

    A body that travels sideways goes far, and hardly along its heading.
    """

    heading_advance_m: float | None = None
    heading_energy_j_per_m: float | None = None
    heading_body_lengths_s: float | None = None
    heading_cost_of_transport: float | None = None
    displacement_energy_j_per_m: float | None = None
    displacement_body_lengths_s: float | None = None
    displacement_cost_of_transport: float | None = None

    @staticmethod
    def of(
        record: RunRecord, advance: Advance | None, net_m: float | None, known_s: float, *, has_power: bool
    ) -> "Directions":
        """net_m: the net displacement, within known_s. has_power: torques and speeds are known."""
        if advance is None or net_m is None or known_s <= 0:
            return Directions()
        links = record.description.links
        length_m = sum(link.length_m for link in links)
        weight_n = GRAVITY_M_S2 * sum(link.mass_kg for link in links)
        used_j = energy_j(record) if has_power else None
        heading_m = float(advance.along_heading_m[-1])
        heading_j_per_m = _over(used_j, heading_m)
        displacement_j_per_m = _over(used_j, net_m)
        return Directions(
            heading_advance_m=heading_m,
            heading_energy_j_per_m=heading_j_per_m,
            heading_body_lengths_s=heading_m / known_s / length_m,
            heading_cost_of_transport=None if heading_j_per_m is None else heading_j_per_m / weight_n,
            displacement_energy_j_per_m=displacement_j_per_m,
            displacement_body_lengths_s=net_m / known_s / length_m,
            displacement_cost_of_transport=None if displacement_j_per_m is None else displacement_j_per_m / weight_n,
        )


def _over(used_j: float | None, distance_m: float) -> float | None:
    """Energy per metre; None when it is unknown, and over a distance that is too short to say."""
    if used_j is None or distance_m < MIN_DISTANCE_M:
        return None
    return used_j / distance_m


def _impulse_n_s_per_m(record: RunRecord, advance: Advance) -> float | None:
    """From the contacts in guidance's worlds, twenty a second; None without a sensor of contacts."""
    if not record.feels_contacts or advance.reached_m < MIN_DISTANCE_M:
        return None
    begin_ns = record.time_s[0] * 1e9
    worlds = [one for one in record.worlds if 0 <= (one.timestamp_ns - begin_ns) * 1e-9 <= advance.until_s]
    if len(worlds) < 2:
        return None
    sums_n = [sum(float(np.linalg.norm(contact.force_w)) for contact in one.contacts) for one in worlds]
    return float(np.trapezoid(sums_n, [one.timestamp_ns * 1e-9 for one in worlds])) / advance.reached_m


def _form_closure(record: RunRecord, advance: Advance) -> float | None:
    """Of the obstacles where the scene places them, ten times a second."""
    links = record.description.links
    radius_m, half_m = links[0].radius_m, 0.5 * sum(link.length_m for link in links)
    outlines = Outlines.of([placed.obstacle for placed in record.placed if not placed.walkable])
    if not len(outlines):
        return 0.0
    last = int(np.searchsorted(record.time_s, record.time_s[0] + advance.until_s))
    rows = range(0, last, max(round(0.1e9 / record.description.period_ns), 1))
    known = [nodes[:, :2] for row in rows if (nodes := record.nodes_w(row)) is not None]
    margins = [form_closure_margin(*contacts_beside(nodes, radius_m, outlines), half_m) for nodes in known]
    return sum(margin > 0.0 for margin in margins) / len(margins) if margins else None


def _planning_fraction(record: RunRecord, advance: Advance) -> float | None:
    period_s, begin_s = record.description.period_ns * 1e-9, record.time_s[0]
    nodes = [n for tick, n in record.searched_nodes.items() if 0 <= tick * period_s - begin_s <= advance.until_s]
    return sum(n > 0 for n in nodes) / len(nodes) if nodes else None


def _headroom(record: RunRecord, advance: Advance) -> float | None:
    limits_nm = np.array([joint.torque_limit_nm for joint in record.description.joints])
    shares = (np.abs(record.torque_nm) / limits_nm)[record.time_s - record.time_s[0] <= advance.until_s]
    known = shares[np.isfinite(shares).all(axis=1)]
    return float(1.0 - np.percentile(known.max(axis=1), 95)) if len(known) else None
