"""Makes snapshots of a run: the state at one time, and the balance of the desired contact forces.

The balance is the paper's equation (10), f_s + f_1 + f_2 + f_3 = 0, with f_s = -F t_1: the tether of the static
model pulls the tail back along the tangent at o_1. So the contact forces add up to -f_s, and that sum, the resultant
propulsion force, points forward along the path at o_1. It also acts through o_1, because the moments balance too (11).
"""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import ControlState, WorldContact, WorldModel
from snakesim_operator.results.metrics.force_tracking import is_contact_measured
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import get_report_time_s

MIN_CONTACTS = 3  # fewer contact forces cannot be in balance
# Gap of the force polygon over the commanded force; with a larger gap, the forces are not balanced.
MAX_GAP_FRACTION = 0.05
# Maximum time between desired and measured forces that count as simultaneous.
SIMULTANEOUS_S = 0.021


@dataclass(frozen=True)
class ForceBalance:
    """Contact forces that a controller desired, from tail to head, in the ground plane of the world frame."""

    contacts: list[WorldContact]
    magnitudes_n: list[float]
    contact_forces_n: Floats  # (k, 2)
    tether_force_n: Floats  # (2,), f_s: the commanded force with opposite sign

    @property
    def resultant_force_n(self) -> Floats:
        """Sum of the contact forces, (2,), which propels the robot."""
        return self.contact_forces_n.sum(axis=0)

    @property
    def commanded_force_n(self) -> float:
        """Magnitude of the propulsion force along the path that the controller commands, in N."""
        return float(np.hypot(*self.tether_force_n))

    @property
    def closure_error_n(self) -> float:
        """Gap by which the force polygon does not close, in N; 0 if the forces balance exactly."""
        return float(np.hypot(*(self.resultant_force_n + self.tether_force_n)))

    @property
    def corners_n(self) -> Floats:
        """Corners of the force polygon in N, (k + 2, 2): f_s starts at the origin, then follows each contact force."""
        forces = np.vstack([self.tether_force_n, self.contact_forces_n])
        return np.vstack([[0.0, 0.0], np.cumsum(forces, axis=0)])

    def find_measured_force_n(self, measured: list[WorldContact], index: int) -> float | None:
        """Return the measured force at a push-point in N, or None if no contact was measured there.

        Args:
            measured: The measured contacts.
            index: Index of the push-point.
        """
        push_point = self.contacts[index]
        forces_n = [
            np.hypot(*contact.force_w[:2])
            for contact in measured
            if is_contact_measured(push_point, [contact])
        ]
        return float(sum(forces_n)) if forces_n else None

    def find_css_classes(self, measured: list[WorldContact]) -> tuple[list[str], str]:
        """Find the CSS classes of each contact force, and of the resultant.

        A force without a measured contact has the class "unmeasured". The resultant has it if any force has it.
        """
        contact_classes: list[str] = []
        all_measured = True
        for contact in self.contacts:
            if is_contact_measured(contact, measured):
                contact_classes.append("solved")
            else:
                contact_classes.append("solved unmeasured")
                all_measured = False
        return contact_classes, "resultant" if all_measured else "resultant unmeasured"


@dataclass(frozen=True)
class RunSnapshot:
    """State of a run at one time."""

    time_s: float  # on the time axis
    row: int  # index of the tick in the record
    state: ControlState | None
    force_balance: ForceBalance | None
    measured_contacts: list[WorldContact]
    propulsion_joint: int | None


def make_force_balance(state: ControlState) -> ForceBalance | None:
    """Make the balance of the contact forces that the controller desired, and of the propulsion force.

    Args:
        state: A message of the controller.

    Returns:
        The forces in their order from tail to head; None if the controller desired fewer than MIN_CONTACTS forces, or
        if the direction of travel at the first push-point is unknown.
    """
    desired = list(zip(state.push_points, state.desired_force_n, strict=False))
    if len(desired) < MIN_CONTACTS or not state.propulsion_n:
        return None
    desired.sort(key=lambda pair: pair[0].body_s_m)
    contacts = [contact for contact, _ in desired]
    magnitudes_n = [magnitude_n for _, magnitude_n in desired]
    normals = np.array([contact.normal_w[:2] for contact in contacts])
    tangent = np.array(contacts[0].tangent_w[:2])
    tangent_length = float(np.hypot(*tangent))
    if tangent_length < 1e-6:
        return None
    return ForceBalance(
        contacts=contacts,
        magnitudes_n=magnitudes_n,
        contact_forces_n=normals * np.array(magnitudes_n)[:, None],
        tether_force_n=-state.propulsion_n * tangent / tangent_length,
    )


def find_snapshots_with_force_balance(
    record: RunRecord, start_s: float = 0.0, end_s: float = math.inf
) -> list[RunSnapshot]:
    """Find the snapshots during locomotion with a propulsion joint in which the desired forces balance.

    Args:
        record: The recorded run.
        start_s: Messages of the controller before this time are left out, in s.
        end_s: Messages of the controller after this time are left out, in s.

    Returns:
        The snapshots whose pose is known, in order of time.
    """
    if not len(record.time_s):
        return []
    snapshots: list[RunSnapshot] = []
    for state in record.control_states:
        time_s = get_report_time_s(record, state)
        if not start_s <= time_s <= end_s:
            continue
        if state.propulsion_joint is None or state.state != "Locomoting":
            continue
        balance = make_force_balance(state)
        if balance is None or not _is_balanced(balance):
            continue
        snapshot = _make_snapshot(record, time_s, state, balance)
        is_pose_known = record.find_body_points_w(snapshot.row) is not None
        if is_pose_known:
            snapshots.append(snapshot)
    return snapshots


def _is_balanced(balance: ForceBalance) -> bool:
    """Return whether the force polygon closes, and every contact force pushes."""
    is_closed = not balance.closure_error_n > MAX_GAP_FRACTION * balance.commanded_force_n
    return is_closed and not min(balance.magnitudes_n) <= 0


def find_snapshot(record: RunRecord, time_s: float) -> RunSnapshot | None:
    """Find the snapshot at a time on the time axis, without desired forces; None if the pose is unknown then."""
    row = record.find_nearest_row(float(record.time_s[0]) + time_s)
    if record.find_body_points_w(row) is None:
        return None
    earlier = [
        state for state in record.control_states if get_report_time_s(record, state) <= time_s
    ]
    last_state = earlier[-1] if earlier else None
    return _make_snapshot(record, time_s, last_state, None)


def project_measured_force_n(snapshot: RunSnapshot, direction_w: Floats) -> float:
    """Project the sum of the measured contact forces onto a direction, (2,) of any length. The result is in N."""
    unit = direction_w / max(float(np.hypot(*direction_w)), 1e-12)
    return sum(float(np.dot(contact.force_w[:2], unit)) for contact in snapshot.measured_contacts)


def count_unmeasured_contacts(snapshot: RunSnapshot) -> int:
    """Count the desired contact forces at whose obstacles no contact was measured."""
    if snapshot.force_balance is None:
        return 0
    return sum(
        not is_contact_measured(contact, snapshot.measured_contacts)
        for contact in snapshot.force_balance.contacts
    )


def _make_snapshot(
    record: RunRecord, time_s: float, state: ControlState | None, balance: ForceBalance | None
) -> RunSnapshot:
    robot_time_s = float(record.time_s[0]) + time_s
    tolerance_s = SIMULTANEOUS_S if balance is not None else 3 * SIMULTANEOUS_S
    world = _find_world_near(record, robot_time_s, tolerance_s)
    names = [joint.name for joint in record.description.joints]
    propelling = state.propulsion_joint if state is not None else None
    return RunSnapshot(
        time_s=time_s,
        row=record.find_nearest_row(robot_time_s),
        state=state,
        force_balance=balance,
        measured_contacts=world.contacts if world is not None else [],
        propulsion_joint=names.index(propelling) if propelling in names else None,
    )


def _find_world_near(
    record: RunRecord, robot_time_s: float, tolerance_s: float
) -> WorldModel | None:
    """Return the world model whose timestamp is nearest to a robot time, or None if none is within a tolerance in s."""
    nearest = min(
        record.worlds, key=lambda world: abs(world.timestamp_ns * 1e-9 - robot_time_s), default=None
    )
    if nearest is None or abs(nearest.timestamp_ns * 1e-9 - robot_time_s) > tolerance_s:
        return None
    return nearest
