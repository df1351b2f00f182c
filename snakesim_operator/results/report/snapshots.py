"""A snapshot of a run at one time: what is known of it, and how the forces balance in it.

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
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import reported_at_s

MIN_CONTACTS = 3  # fewer contact forces cannot balance
MAX_GAP_FRACTION = 0.05  # of the commanded force; a polygon with a larger gap is not balanced
SIMULTANEOUS_S = 0.021  # measured forces this far from the solved ones still count as simultaneous


@dataclass(frozen=True)
class Balance:
    """Forces that a controller solved for, tail to head; world frame, on the ground plane."""

    contacts: list[WorldContact]
    size_n: list[float]
    contact_n: Floats  # (k, 2)
    tether_n: Floats  # (2,), f_s: the commanded force, the other way round

    @property
    def resultant_n(self) -> Floats:
        """The sum of the contact forces, (2,): what drives the snake."""
        return self.contact_n.sum(axis=0)

    @property
    def commanded_n(self) -> float:
        """The force along the path that the controller aims at."""
        return float(np.hypot(*self.tether_n))

    @property
    def gap_n(self) -> float:
        """The gap that keeps the polygon from closing."""
        return float(np.hypot(*(self.resultant_n + self.tether_n)))

    @property
    def corners_n(self) -> Floats:
        """The corners of the polygon head to tail, (k + 2, 2): f_s from the origin, then the contact forces."""
        forces = np.vstack([self.tether_n, self.contact_n])
        return np.vstack([[0.0, 0.0], np.cumsum(forces, axis=0)])

    def measured_force_n(self, measured: list[WorldContact], index: int) -> float | None:
        """Return the measured force at a push-point, or None if no contact was measured there."""
        push_point = self.contacts[index]
        forces_n = [np.hypot(*contact.force_w[:2]) for contact in measured if is_measured(push_point, [contact])]
        return float(sum(forces_n)) if forces_n else None

    def force_classes(self, measured: list[WorldContact]) -> tuple[list[str], str]:
        """Return the CSS classes of each contact force, and of the resultant.

        A force is drawn as "unmeasured" if no contact was measured there, the resultant if that holds for any of them.
        """
        contact_classes: list[str] = []
        all_measured = True
        for contact in self.contacts:
            if is_measured(contact, measured):
                contact_classes.append("solved")
            else:
                contact_classes.append("solved unmeasured")
                all_measured = False
        return contact_classes, "resultant" if all_measured else "resultant unmeasured"


@dataclass(frozen=True)
class Snapshot:
    """One moment of a run."""

    time_s: float  # on the time axis
    row: int  # of the record
    state: ControlState | None
    balance: Balance | None
    measured_contacts: list[WorldContact]
    propulsion_joint: int | None


def balance_of(state: ControlState) -> Balance | None:
    """Return the contact forces that the controller solved for, with the propulsion force that they balance.

    Args:
        state: A message of the controller.

    Returns:
        The forces in order of their places from tail to head; None if the controller solved for none, or if the
        direction of travel at the first push-point is unknown.
    """
    solved = list(zip(state.push_points, state.desired_force_n, strict=False))
    if len(solved) < MIN_CONTACTS or not state.propulsion_n:
        return None
    solved.sort(key=lambda pair: pair[0].body_s_m)
    contacts = [contact for contact, _ in solved]
    sizes_n = [size_n for _, size_n in solved]
    normals = np.array([contact.normal_w[:2] for contact in contacts])
    tangent = np.array(contacts[0].tangent_w[:2])
    tangent_length = float(np.hypot(*tangent))
    if tangent_length < 1e-6:
        return None
    return Balance(
        contacts=contacts,
        size_n=sizes_n,
        contact_n=normals * np.array(sizes_n)[:, None],
        tether_n=-state.propulsion_n * tangent / tangent_length,
    )


def balanced_snapshots(record: RunRecord, begin_s: float = 0.0, end_s: float = math.inf) -> list[Snapshot]:
    """Return the moments of locomotion with a propulsion joint at which the controller's solved forces balance.

    Args:
        record: The recorded run.
        begin_s: Messages of the controller before this time are left out, in s.
        end_s: Messages of the controller after this time are left out, in s.

    Returns:
        The snapshots whose pose is known, in order of time.
    """
    if not len(record.time_s):
        return []
    snapshots: list[Snapshot] = []
    for state in record.control:
        time_s = reported_at_s(record, state)
        if not begin_s <= time_s <= end_s:
            continue
        if state.propulsion_joint is None or state.state != "Locomoting":
            continue
        balance = balance_of(state)
        if balance is None or not _is_balanced(balance):
            continue
        snapshot = _make_snapshot(record, time_s, state, balance)
        is_pose_known = record.nodes_w(snapshot.row) is not None
        if is_pose_known:
            snapshots.append(snapshot)
    return snapshots


def _is_balanced(balance: Balance) -> bool:
    """Return whether the polygon closes, and every contact is pushed and not pulled."""
    return not (balance.gap_n > MAX_GAP_FRACTION * balance.commanded_n or min(balance.size_n) <= 0)


def find_snapshot(record: RunRecord, time_s: float) -> Snapshot | None:
    """Return a moment without solved forces, or None if the pose is unknown then."""
    row = record.row_at(float(record.time_s[0]) + time_s)
    if record.nodes_w(row) is None:
        return None
    earlier = [state for state in record.control if reported_at_s(record, state) <= time_s]
    last_state = earlier[-1] if earlier else None
    return _make_snapshot(record, time_s, last_state, None)


def measured_along_n(snapshot: Snapshot, direction_w: Floats) -> float:
    """Return how much the measured contact forces push along a direction, (2,) of any length."""
    unit = direction_w / max(float(np.hypot(*direction_w)), 1e-12)
    return sum(float(np.dot(contact.force_w[:2], unit)) for contact in snapshot.measured_contacts)


def count_unmeasured(snapshot: Snapshot) -> int:
    """Count the solved contacts at which no sensor measured a force."""
    if snapshot.balance is None:
        return 0
    return sum(not is_measured(contact, snapshot.measured_contacts) for contact in snapshot.balance.contacts)


def _make_snapshot(record: RunRecord, time_s: float, state: ControlState | None, balance: Balance | None) -> Snapshot:
    robot_time_s = float(record.time_s[0]) + time_s
    tolerance_s = SIMULTANEOUS_S if balance is not None else 3 * SIMULTANEOUS_S
    world = _find_world_near(record, robot_time_s, tolerance_s)
    names = [joint.name for joint in record.description.joints]
    propelling = state.propulsion_joint if state is not None else None
    return Snapshot(
        time_s=time_s,
        row=record.row_at(robot_time_s),
        state=state,
        balance=balance,
        measured_contacts=world.contacts if world is not None else [],
        propulsion_joint=names.index(propelling) if propelling in names else None,
    )


def _find_world_near(record: RunRecord, at_s: float, within_s: float) -> World | None:
    """Return the world model whose timestamp is nearest, if that is within a tolerance."""
    nearest = min(record.worlds, key=lambda world: abs(world.timestamp_ns * 1e-9 - at_s), default=None)
    if nearest is None or abs(nearest.timestamp_ns * 1e-9 - at_s) > within_s:
        return None
    return nearest
