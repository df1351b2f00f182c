"""What is known of one instant of a run, and how the forces balance in it.

The balance is the paper's equation (10), f_s + f_1 + f_2 + f_3 = 0, with f_s = -F t_1: the tether of the static
model pulls the tail back along the tangent at o_1. So the contact forces add up to -f_s, and that sum, the resultant
propulsion force, points forward along the path at o_1. It also acts through o_1, because the moments balance too (11).
"""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import ControlState, World, WorldContact
from snakesim_operator.results.metrics.force_tracking import is_measured
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.time_axis import reported_at_s

NEEDED = 3
WORLD_WITHIN_S = 0.021  # measured forces this far from the solved ones still count as simultaneous


@dataclass(frozen=True)
class Balance:
    """Forces that a controller solved for, tail to head; world frame, on the ground plane."""

    contacts: list[WorldContact]
    size_n: list[float]
    contact_n: Floats  # (k, 2)
    tether_n: Floats  # (2,), f_s: the commanded force, the other way round

    @property
    def resultant_n(self) -> Floats:
        """Sum of the contact forces, (2,): what drives the snake."""
        return self.contact_n.sum(axis=0)

    @property
    def commanded_n(self) -> float:
        """The force along the path that the controller aims at."""
        return float(np.hypot(*self.tether_n))

    @property
    def gap_n(self) -> float:
        """How far the polygon is from closing."""
        return float(np.hypot(*(self.resultant_n + self.tether_n)))

    def measured_force_n(self, felt: list[WorldContact], index: int) -> float | None:
        """The measured force at a push-point; None when none was felt there."""
        there = [np.hypot(*one.force_w[:2]) for one in felt if is_measured(self.contacts[index], [one])]
        return float(sum(there)) if there else None

    def kinds(self, felt: list[WorldContact]) -> list[str]:
        """How each contact force and last the resultant is drawn: as asked for unless felt, the sum if all are felt."""
        there = [is_measured(contact, felt) for contact in self.contacts]
        asked = ["" if one else " asked" for one in (*there, all(there))]
        return [*(f"solved{one}" for one in asked[:-1]), f"resultant{asked[-1]}"]

    @property
    def corners_n(self) -> Floats:
        """Corners of the polygon head to tail, (k + 2, 2): f_s from the origin, then the contact forces."""
        return np.vstack([[0.0, 0.0], np.cumsum(np.vstack([self.tether_n, self.contact_n]), axis=0)])


@dataclass(frozen=True)
class Instant:
    """One moment of a run."""

    time_s: float  # on the time axis
    row: int  # of the record
    state: ControlState | None
    balance: Balance | None
    felt: list[WorldContact]  # measured
    propulsion_joint: int | None


def balance_of(state: ControlState) -> Balance | None:
    """The solved forces; None when the controller solved for none."""
    pairs = list(zip(state.push_points, state.desired_force_n, strict=False))
    if len(pairs) < NEEDED or not state.propulsion_n:
        return None
    pairs.sort(key=lambda pair: pair[0].body_s_m)
    contacts = [contact for contact, _ in pairs]
    normals = np.array([contact.normal_w[:2] for contact in contacts])
    sizes = [size for _, size in pairs]
    tangent = np.array(contacts[0].tangent_w[:2])
    length = float(np.hypot(*tangent))
    if length < 1e-6:
        return None
    return Balance(contacts, sizes, normals * np.array(sizes)[:, None], -state.propulsion_n * tangent / length)


def balanced_instants(record: RunRecord, begin_s: float = 0.0, end_s: float = math.inf) -> list[Instant]:
    """Every moment of locomotion, of those reported within a time, whose solved forces balance; in order of time."""
    if not len(record.time_s):
        return []
    found: list[Instant] = []
    for state in record.control:
        balance = balance_of(state) if begin_s <= reported_at_s(record, state) <= end_s else None
        if balance is None or state.propulsion_joint is None or state.state != "Locomoting":
            continue
        if balance.gap_n > 0.05 * balance.commanded_n or min(balance.size_n) <= 0:
            continue
        instant = _instant(record, reported_at_s(record, state), state, balance)
        if record.nodes_w(instant.row) is not None:
            found.append(instant)
    return found


def instant_at(record: RunRecord, time_s: float) -> Instant | None:
    """A moment as it was, without solved forces; None when the pose is unknown then."""
    row = record.row_at(float(record.time_s[0]) + time_s)
    if record.nodes_w(row) is None:
        return None
    earlier = [state for state in record.control if reported_at_s(record, state) <= time_s]
    return _instant(record, time_s, earlier[-1] if earlier else None, None)


def measured_along_n(instant: Instant, direction_w: Floats) -> float:
    """How much the measured contact forces push along a direction, (2,) of any length."""
    unit = direction_w / max(float(np.hypot(*direction_w)), 1e-12)
    return sum(float(np.dot(contact.force_w[:2], unit)) for contact in instant.felt)


def _instant(record: RunRecord, time_s: float, state: ControlState | None, balance: Balance | None) -> Instant:
    at_s = float(record.time_s[0]) + time_s
    names = [joint.name for joint in record.description.joints]
    joint = state.propulsion_joint if state is not None else None
    world = _world_near(record, at_s, WORLD_WITHIN_S if balance is not None else 3 * WORLD_WITHIN_S)
    return Instant(
        time_s=time_s,
        row=record.row_at(at_s),
        state=state,
        balance=balance,
        felt=world.contacts if world is not None else [],
        propulsion_joint=names.index(joint) if joint in names else None,
    )


def _world_near(record: RunRecord, at_s: float, within_s: float) -> World | None:
    near = min(record.worlds, key=lambda world: abs(world.timestamp_ns * 1e-9 - at_s), default=None)
    return near if near is not None and abs(near.timestamp_ns * 1e-9 - at_s) <= within_s else None


def unmeasured(instant: Instant) -> int:
    """How many solved contacts no sensor felt."""
    if instant.balance is None:
        return 0
    return sum(not is_measured(contact, instant.felt) for contact in instant.balance.contacts)
