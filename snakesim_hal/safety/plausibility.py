"""Plausibility checks of joint states: an angle that a joint cannot have reached is rejected. Pure.

Three checks, joint by joint. A value that fails one of the first two is rejected, and the last good value stays;
isolated joints are not checked:

unknown   not valid, not finite, or older than three periods (and 30 ms, and its delay; at most a lease)
jumped    further from the last good angle than twice the speed limit allows in the time between, plus a margin.
          A value that stays at the new place is accepted after a few samples, but never while the robot is armed
frozen    angle, velocity and torque stay bit-identical for more than a lease after the position target has
          moved so far that the torque must have changed, and the torque is not at its limit
"""

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety.joint_limits import Applied, JointLimits, Mask, Measured
from snakesim_hal.wire.messages import Fault, JointState, Mode

Columns = tuple[list[float], list[float], list[float]]  # angle, velocity, torque

SPEED_MARGIN = 2.0  # an external load may turn a joint faster than its motor
SLACK_RAD = 0.05  # noise of an angle
SETTLED_SAMPLES = 5  # samples in a row at a new place, until it is accepted
# Fraction of max_step_rad: a target that moves this far changes the torque of a joint that does not follow.
FROZEN_TARGET_FRACTION = 0.25
SATURATED_TORQUE_FRACTION = 0.95  # of the torque limit: from there on a constant torque proves nothing
MAX_CAUSE_LENGTH = 400  # characters; a fault's cause has at most 500


@dataclass(frozen=True)
class ImplausibleState:
    """An implausible joint state: its fault, and the joints concerned."""

    fault: Fault
    joints: Mask


class PlausibilityCheck:
    """The last good state of every joint, and the checks of the newest one."""

    def __init__(self, limits: JointLimits) -> None:
        self._limits = limits
        count = len(limits.joints)

        # The last good state of every joint.
        self._columns = np.zeros((3, count))  # angle, velocity, torque
        self._good_s = np.zeros((2, count))  # when they were measured, by both clocks
        self._known: Mask = np.zeros(count, dtype=np.bool_)  # whether there ever was one

        # The shortcut for ordinary states.
        self._ordinary: Columns | None = None  # the last state, if all of it was good and no joint had jumped
        self._unchecked: tuple[JointState, int, Applied | None] | None = None  # it, if no check has processed it

        self._jumps = _JumpDetector(count, SPEED_MARGIN * limits.speed_rad_s)
        self._frozen = _FrozenDetector(limits)

    @property
    def measured(self) -> Measured:
        """The last good state of every joint; zeros for a joint that never had one."""
        return Measured(*self._columns)

    def check(
        self, joints: JointState, *, now_ns: int, applied: Applied | None, isolated: Mask
    ) -> ImplausibleState | None:
        """Check a joint state, and store its plausible values as the last good ones.

        Args:
            joints: the newest joint state.
            now_ns: safety time. After a delay of the host, more time has passed than its ticks show.
            applied: the last setpoints of an armed robot; None if the robot is not armed.
            isolated: (n_joints,) True for joints that are not checked.

        Returns:
            The fault and the joints that it concerns, or None if every joint is plausible.
        """
        count = len(self._known)
        if not joints.has_joint_count(count):
            fault = Fault(tick=joints.tick, what="state_invalid", cause=f"no joint state of {count} joints")
            return ImplausibleState(fault, np.ones_like(self._known))
        if self._is_ordinary(joints):
            newest: Columns = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm)
            self._columns = np.array(newest)
            self._ordinary = newest
            self._unchecked = (joints, now_ns, applied)
            return None
        self._process_unchecked_state()
        return self._check_each_joint(joints, now_ns=now_ns, applied=applied, isolated=isolated)

    def _check_each_joint(
        self, joints: JointState, *, now_ns: int, applied: Applied | None, isolated: Mask
    ) -> ImplausibleState | None:
        """Check each joint of a state for missing values, jumps and frozen values, and store the good values.

        This is the slow path of `check`, for states that its shortcut does not accept.

        Args:
            joints: the newest joint state.
            now_ns: safety time.
            applied: the last setpoints of an armed robot; None if the robot is not armed.
            isolated: (n_joints,) True for joints whose faults are ignored.

        Returns:
            The first of the three faults that any joint has, or None.
        """
        newest: Columns = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm)
        columns = np.array(newest)
        measured_s = _measurement_times_s(joints, now_ns)
        plausible = self._find_plausible(joints, columns)

        # Find angles that are too far from the last good one. While the robot is not armed, an angle that stays at its
        # new place for some samples is accepted.
        elapsed_s = (measured_s - self._good_s).max(axis=0)
        jump_rad = np.where(plausible, columns[0], 0.0) - self._columns[0]
        jumped = plausible & self._known & (np.abs(jump_rad) > self._jumps.max_turn_rad(elapsed_s))
        settled = self._jumps.find_settled(jumped, columns[0], measured_s)
        self._ordinary = None
        if plausible.all() and not jumped.any():
            self._ordinary = newest
        if applied is None:
            jumped = jumped & ~settled

        # Store the good values.
        is_good = plausible & ~jumped
        self._columns = np.where(is_good, columns, self._columns)
        self._good_s = np.where(is_good, measured_s, self._good_s)
        self._known |= is_good

        # Report the first fault of the joints that are not isolated.
        frozen = self._frozen.find_frozen(columns, measured_s[0], applied)
        if not np.count_nonzero(~is_good | frozen):
            return None
        unknown = ~plausible & ~isolated
        if unknown.any():
            return self._make_unknown(joints.tick, unknown)
        jumped = jumped & ~isolated
        if jumped.any():
            return self._make_jumped(joints.tick, jumped, jump_rad, elapsed_s)
        frozen = frozen & ~isolated
        if frozen.any():
            return self._make_frozen(joints.tick, frozen)
        return None

    def _process_unchecked_state(self) -> None:
        """Pass the ordinary state before to the detectors: only now does anything depend on it."""
        if self._unchecked is None:
            return
        joints, now_ns, applied = self._unchecked
        self._unchecked = None
        self._good_s = _measurement_times_s(joints, now_ns)
        self._frozen.restart(self._columns, applied)

    def _is_ordinary(self, joints: JointState) -> bool:
        """Return whether every joint is fresh, near its last angle and new, as nearly always: then no check can fail.

        The loop runs on plain floats: for a dozen joints that is several times faster than vectors.
        """
        if self._ordinary is None or not all(joints.valid) or max(joints.age_ns) > self._limits.oldest_state_ns:
            return False
        for angle, velocity, torque, last_angle, last_velocity, last_torque in zip(
            joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, *self._ordinary, strict=True
        ):
            # Written so that NaN is not ordinary.
            if not (abs(angle - last_angle) <= SLACK_RAD and math.isfinite(velocity) and math.isfinite(torque)):
                return False
            if angle == last_angle and velocity == last_velocity and torque == last_torque:
                return False
        return True

    def _find_plausible(self, joints: JointState, columns: Floats) -> Mask:
        """Return which joints have a valid, finite and fresh state, (n_joints,)."""
        fresh = np.array(joints.age_ns, dtype=np.float64) <= self._limits.oldest_state_ns
        finite = np.isfinite(columns).all(axis=0)
        return finite & fresh & np.array(joints.valid)

    def _make_unknown(self, tick: int, joints: Mask) -> ImplausibleState:
        names = self._find_names(joints)
        return _make_implausible(tick, "state_invalid", "no valid and fresh state of ", joints, names, names)

    def _make_jumped(self, tick: int, joints: Mask, jump_rad: Floats, elapsed_s: Floats) -> ImplausibleState:
        names = self._find_names(joints)
        labels: list[str] = []
        for name, i in zip(names, np.flatnonzero(joints).tolist(), strict=True):
            labels.append(f"{name} by {jump_rad[i]:+.2f} rad in {elapsed_s[i] * 1e3:.0f} ms")
        words = "faster than any joint turns: a jump of "
        return _make_implausible(tick, "state_invalid", words, joints, names, labels)

    def _make_frozen(self, tick: int, joints: Mask) -> ImplausibleState:
        names = self._find_names(joints)
        words = "the same state repeated while its target moves: "
        return _make_implausible(tick, "joint_frozen", words, joints, names, names)

    def _find_names(self, joints: Mask) -> list[str]:
        return [self._limits.joints[i].name for i in np.flatnonzero(joints).tolist()]


def _make_implausible(
    tick: int, what: str, words: str, joints: Mask, names: list[str], labels: list[str]
) -> ImplausibleState:
    """Return the fault of some joints. `labels` has one entry a joint for the text, `names` their plain names."""
    cause = (words + ", ".join(labels))[:MAX_CAUSE_LENGTH]
    joint = None
    if len(names) == 1:
        joint = names[0]
    return ImplausibleState(Fault(tick=tick, what=what, cause=cause, joint=joint, reach="joint"), joints)


def _measurement_times_s(joints: JointState, now_ns: int) -> Floats:
    """Return when each joint's state was measured, by its timestamp and by safety time, (2, n_joints)."""
    ages_ns = np.array(joints.age_ns, dtype=np.float64)
    return (np.array([[joints.timestamp_ns], [now_ns]], dtype=np.float64) - ages_ns) * 1e-9


def replace_unreadable(joints: JointState, last_good: Measured) -> JointState:
    """Replace NaN and infinite values of a joint state, so that it can be published.

    A single value that is not finite would make a reader reject the states of all joints. Every joint with such a value
    gets its last good state, and is marked as not valid.

    Args:
        joints: the newest joint state.
        last_good: the last good state of every joint.

    Returns:
        The joint state, unchanged if all its values are finite or if it has a wrong number of joints.
    """
    columns = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm)
    all_finite = all(all(map(math.isfinite, column)) for column in columns)
    if all_finite or not joints.has_joint_count(len(last_good.angle_rad)):
        return joints
    angle_rad = list(joints.angle_rad)
    velocity_rad_s = list(joints.velocity_rad_s)
    torque_nm = list(joints.torque_nm)
    valid = list(joints.valid)
    for i, joint_values in enumerate(zip(*columns, strict=True)):
        if all(map(math.isfinite, joint_values)):
            continue
        angle_rad[i] = float(last_good.angle_rad[i])
        velocity_rad_s[i] = float(last_good.velocity_rad_s[i])
        torque_nm[i] = float(last_good.torque_nm[i])
        valid[i] = False
    return msgspec.structs.replace(
        joints, angle_rad=angle_rad, velocity_rad_s=velocity_rad_s, torque_nm=torque_nm, valid=valid
    )


class _JumpDetector:
    """Decides whether rejected angles agree with one another."""

    def __init__(self, count: int, speed_rad_s: Floats) -> None:
        self._speed_rad_s = speed_rad_s
        # The last rejected angles.
        self._angle_rad = np.zeros(count)
        self._measured_s = np.zeros((2, count))
        self._in_a_row = np.zeros(count, dtype=np.int64)

    def max_turn_rad(self, elapsed_s: Floats) -> Floats:
        """Return the maximum turn of each joint in this time, (n_joints,)."""
        return SLACK_RAD + self._speed_rad_s * np.maximum(elapsed_s, 0.0)

    def find_settled(self, jumped: Mask, angle_rad: Floats, measured_s: Floats) -> Mask:
        """Process the newest angles, and find the joints that have settled at a new place after a jump.

        A joint has settled if SETTLED_SAMPLES rejected angles in a row are near one another.

        Args:
            jumped: (n_joints,) True for joints whose newest angle is too far from the last good one.
            angle_rad: (n_joints,) the newest angles; only those of joints that jumped are used.
            measured_s: (2, n_joints) when the angles were measured, by the timestamps and by safety time.

        Returns:
            (n_joints,) True for joints that have jumped and settled.
        """
        if not np.count_nonzero(jumped):
            self._in_a_row[:] = 0
            return jumped
        newest_rad = np.where(jumped, angle_rad, 0.0)
        elapsed_s = measured_s - self._measured_s
        is_near_last = np.abs(newest_rad - self._angle_rad) <= self.max_turn_rad(elapsed_s.max(axis=0))
        is_repeated = is_near_last & (elapsed_s[0] <= 0)  # a repeated sample is not new information
        sample_count = np.where(is_near_last, self._in_a_row + ~is_repeated, 1)
        self._in_a_row = np.where(jumped, sample_count, 0)
        self._angle_rad = newest_rad
        self._measured_s = measured_s
        return jumped & (self._in_a_row >= SETTLED_SAMPLES)


class _FrozenDetector:
    """Measures for how long joints have repeated a state, and how far their targets have moved meanwhile."""

    def __init__(self, limits: JointLimits) -> None:
        count = len(limits.joints)
        self._lease_s = limits.lease_ns * 1e-9
        self._far_rad = FROZEN_TARGET_FRACTION * limits.max_step_rad
        self._columns = np.full((3, count), np.nan)
        self._followed: Mask = np.zeros(count, dtype=np.bool_)  # whether the joint had a position target before
        # The range of the targets since the state has been the same.
        self._low_rad = np.zeros(count)
        self._high_rad = np.zeros(count)
        self._never_s = np.full(count, np.inf)
        self._far_since_s = self._never_s  # since when that range has been wide

    def restart(self, columns: Floats, applied: Applied | None) -> None:
        """Process states of which none repeats the one before, (3, n_joints), and the setpoints applied."""
        self._columns = columns
        if applied is None:
            self._followed = np.zeros_like(self._followed)
            return
        self._followed = applied.mode == Mode.POSITION
        self._low_rad = applied.target
        self._high_rad = applied.target
        self._far_since_s = self._never_s

    def find_frozen(self, columns: Floats, measured_s: Floats, applied: Applied | None) -> Mask:
        """Process the newest states, and find the joints whose measurements are frozen.

        A joint is frozen if it repeats the same state to the bit for more than a lease after its position target has
        moved far, unless its torque is at the limit: then a constant torque is plausible.

        Args:
            columns: (3, n_joints) angle in rad, velocity in rad/s and torque in N·m.
            measured_s: (n_joints,) when they were measured, by their timestamp.
            applied: the last setpoints of an armed robot; None if the robot is not armed.

        Returns:
            (n_joints,) True for frozen joints.
        """
        if applied is None:
            self.restart(columns, None)
            return np.zeros_like(self._followed)
        in_position_mode = applied.mode == Mode.POSITION
        is_same = (columns == self._columns).all(axis=0) & in_position_mode & self._followed
        if not np.count_nonzero(is_same):
            self.restart(columns, applied)
            return is_same

        # The range of the targets since the state has been the same.
        target_rad = applied.target
        self._columns = columns
        self._followed = in_position_mode
        self._low_rad = np.where(is_same, np.minimum(self._low_rad, target_rad), target_rad)
        self._high_rad = np.where(is_same, np.maximum(self._high_rad, target_rad), target_rad)

        has_moved_far = is_same & (self._high_rad - self._low_rad > self._far_rad)
        self._far_since_s = np.where(has_moved_far, np.minimum(self._far_since_s, measured_s), self._never_s)
        lasts_a_lease = measured_s - self._far_since_s > self._lease_s
        has_free_torque = np.abs(columns[2]) < SATURATED_TORQUE_FRACTION * applied.torque_limit_nm
        return has_moved_far & lasts_a_lease & has_free_torque
