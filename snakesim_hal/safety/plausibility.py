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
from itertools import chain

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointLimits, JointMask, MeasuredState
from snakesim_hal.wire.messages import Fault, JointMode, JointState

Columns = tuple[list[float], list[float], list[float]]  # angle, velocity, torque

SPEED_MARGIN = 2.0  # an external load may turn a joint faster than its motor
ANGLE_NOISE_MARGIN_RAD = 0.05  # noise of an angle
SETTLED_SAMPLE_COUNT = 5  # samples in a row at a new place, until it is accepted
# Fraction of max_step_rad: a target that moves this far changes the torque of a joint that does not follow.
FROZEN_TARGET_FRACTION = 0.25
# Of the torque limit: from there on a constant torque proves nothing.
SATURATED_TORQUE_FRACTION = 0.95
MAX_CAUSE_LENGTH = 400  # characters; a fault's cause has at most 500


@dataclass(frozen=True)
class ImplausibleState:
    """An implausible joint state: its fault, and the joints concerned."""

    fault: Fault
    joints: JointMask


class PlausibilityChecker:
    """The last good state of every joint, and the checks of the newest one."""

    def __init__(self, limits: JointLimits) -> None:
        self._limits = limits
        count = len(limits.joints)

        # The last good state of every joint.
        self._last_good_columns = np.zeros((3, count))  # angle, velocity, torque
        # Times of measurement, by timestamp and by safety time.
        self._last_good_times_s = np.zeros((2, count))
        # Whether a good state was ever measured.
        self._has_good_state: JointMask = np.zeros(count, dtype=np.bool_)

        # The shortcut for ordinary states, which cannot fail any check.
        # The last state if all joints were plausible and none had jumped; otherwise None.
        self._last_ordinary_columns: Columns | None = None
        # The last ordinary state, its safety time and the setpoints, until the detectors have processed them.
        self._unprocessed_state: tuple[JointState, int, AppliedSetpoints | None] | None = None

        self._jump_detector = _JumpDetector(count, SPEED_MARGIN * limits.speed_rad_s)
        self._frozen_detector = _FrozenDetector(limits)

    @property
    def measured(self) -> MeasuredState:
        """Last good state of every joint; zeros for a joint without a good state."""
        return MeasuredState(*self._last_good_columns)

    def check(
        self,
        joints: JointState,
        *,
        now_ns: int,
        applied: AppliedSetpoints | None,
        isolated: JointMask,
    ) -> ImplausibleState | None:
        """Check a joint state, and store its plausible values as the last good ones.

        Args:
            joints: Newest joint state.
            now_ns: Safety time in ns. After a delay of the host, more time has passed than its ticks show.
            applied: Last setpoints of an armed robot. None if the robot is not armed.
            isolated: (n_joints,) mask of the joints whose faults are ignored.

        Returns:
            The fault and the joints that it concerns, or None if every joint is plausible.
        """
        count = len(self._has_good_state)
        if not joints.has_joint_count(count):
            fault = Fault(
                tick=joints.tick, what="state_invalid", cause=f"no joint state of {count} joints"
            )
            return ImplausibleState(fault, np.ones_like(self._has_good_state))
        if self._is_ordinary(joints):
            newest: Columns = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm)
            self._last_good_columns = np.array(newest)
            self._last_ordinary_columns = newest
            self._unprocessed_state = (joints, now_ns, applied)
            return None
        self._process_postponed_state()
        return self._check_joints(joints, now_ns=now_ns, applied=applied, isolated=isolated)

    def _check_joints(
        self,
        joints: JointState,
        *,
        now_ns: int,
        applied: AppliedSetpoints | None,
        isolated: JointMask,
    ) -> ImplausibleState | None:
        """Check each joint of a state for missing values, jumps and frozen values, and store the good values.

        This is the slow path of `check`, for states that its shortcut does not accept.

        Args:
            joints: Newest joint state.
            now_ns: Safety time in ns.
            applied: Last setpoints of an armed robot. None if the robot is not armed.
            isolated: (n_joints,) mask of the joints whose faults are ignored.

        Returns:
            The most severe problem with its joints: a missing value, a jump, or a frozen value. None if there is none.
        """
        newest: Columns = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm)
        columns = np.array(newest)
        measurement_times_s = _compute_measurement_times_s(joints, now_ns)
        plausible = self._find_plausible_joints(joints, columns)

        # Find angles that are too far from the last good one. While the robot is not armed, an angle that stays at its
        # new place for some samples is accepted.
        elapsed_s = (measurement_times_s - self._last_good_times_s).max(axis=0)
        jump_rad = np.where(plausible, columns[0], 0.0) - self._last_good_columns[0]
        is_too_far = np.abs(jump_rad) > self._jump_detector.compute_max_rotation_rad(elapsed_s)
        jumped = plausible & self._has_good_state & is_too_far
        settled = self._jump_detector.find_settled(jumped, columns[0], measurement_times_s)
        self._last_ordinary_columns = None
        if plausible.all() and not jumped.any():
            self._last_ordinary_columns = newest
        if applied is None:
            jumped = jumped & ~settled

        # Store the good values.
        is_good = plausible & ~jumped
        self._last_good_columns = np.where(is_good, columns, self._last_good_columns)
        self._last_good_times_s = np.where(is_good, measurement_times_s, self._last_good_times_s)
        self._has_good_state |= is_good

        # Report the first fault of the joints that are not isolated.
        frozen = self._frozen_detector.find_frozen(columns, measurement_times_s[0], applied)
        if not np.count_nonzero(~is_good | frozen):
            return None
        unknown = ~plausible & ~isolated
        if unknown.any():
            return self._make_unknown_state(joints.tick, unknown)
        jumped = jumped & ~isolated
        if jumped.any():
            return self._make_jumped_state(joints.tick, jumped, jump_rad, elapsed_s)
        frozen = frozen & ~isolated
        if frozen.any():
            return self._make_frozen_state(joints.tick, frozen)
        return None

    def _process_postponed_state(self) -> None:
        """Pass the last ordinary state to the detectors. This is postponed until a check depends on it."""
        if self._unprocessed_state is None:
            return
        joints, now_ns, applied = self._unprocessed_state
        self._unprocessed_state = None
        self._last_good_times_s = _compute_measurement_times_s(joints, now_ns)
        self._frozen_detector.restart(self._last_good_columns, applied)

    def _is_ordinary(self, joints: JointState) -> bool:
        """Return whether every joint is fresh, near its last angle, and has new values. Then no check can fail.

        The loop runs on plain floats: for a dozen joints that is several times faster than vectors.
        """
        if (
            self._last_ordinary_columns is None
            or not all(joints.valid)
            or max(joints.age_ns) > self._limits.max_state_age_ns
        ):
            return False
        for angle, velocity, torque, last_angle, last_velocity, last_torque in zip(
            joints.angle_rad,
            joints.velocity_rad_s,
            joints.torque_nm,
            *self._last_ordinary_columns,
            strict=True,
        ):
            # Written so that NaN is not ordinary.
            if not (
                abs(angle - last_angle) <= ANGLE_NOISE_MARGIN_RAD
                and math.isfinite(velocity)
                and math.isfinite(torque)
            ):
                return False
            if angle == last_angle and velocity == last_velocity and torque == last_torque:
                return False
        return True

    def _find_plausible_joints(self, joints: JointState, columns: Floats) -> JointMask:
        """Return a mask of the joints with a valid, finite and fresh state, (n_joints,)."""
        fresh = np.array(joints.age_ns, dtype=np.float64) <= self._limits.max_state_age_ns
        finite = np.isfinite(columns).all(axis=0)
        return finite & fresh & np.array(joints.valid)

    def _make_unknown_state(self, tick: int, joints: JointMask) -> ImplausibleState:
        names = self._get_joint_names(joints)
        return _make_implausible_state(
            tick, "state_invalid", "no valid and fresh state of ", joints, names, names
        )

    def _make_jumped_state(
        self, tick: int, joints: JointMask, jump_rad: Floats, elapsed_s: Floats
    ) -> ImplausibleState:
        names = self._get_joint_names(joints)
        labels: list[str] = []
        for name, i in zip(names, np.flatnonzero(joints).tolist(), strict=True):
            labels.append(f"{name} by {jump_rad[i]:+.2f} rad in {elapsed_s[i] * 1e3:.0f} ms")
        words = "faster than any joint turns: a jump of "
        return _make_implausible_state(tick, "state_invalid", words, joints, names, labels)

    def _make_frozen_state(self, tick: int, joints: JointMask) -> ImplausibleState:
        names = self._get_joint_names(joints)
        words = "the same state repeated while its target moves: "
        return _make_implausible_state(tick, "joint_frozen", words, joints, names, names)

    def _get_joint_names(self, joints: JointMask) -> list[str]:
        return [self._limits.joints[i].name for i in np.flatnonzero(joints).tolist()]


def _make_implausible_state(
    tick: int, what: str, words: str, joints: JointMask, names: list[str], labels: list[str]
) -> ImplausibleState:
    """Return the fault of some joints. `labels` has one entry a joint for the text, `names` their plain names."""
    cause = (words + ", ".join(labels))[:MAX_CAUSE_LENGTH]
    joint = None
    if len(names) == 1:
        joint = names[0]
    return ImplausibleState(
        Fault(tick=tick, what=what, cause=cause, joint=joint, scope="joint"), joints
    )


def _compute_measurement_times_s(joints: JointState, now_ns: int) -> Floats:
    """Return when each joint's state was measured, by its timestamp and by safety time, (2, n_joints)."""
    ages_ns = np.array(joints.age_ns, dtype=np.float64)
    return (np.array([[joints.timestamp_ns], [now_ns]], dtype=np.float64) - ages_ns) * 1e-9


def replace_non_finite_values(joints: JointState, last_good: MeasuredState) -> JointState:
    """Replace NaN and infinite values of a joint state, so that it can be published.

    A single value that is not finite would make a reader reject the states of all joints. Every joint with such a value
    gets its last good state, and is marked as not valid.

    Args:
        joints: The newest joint state.
        last_good: The last good state of every joint.

    Returns:
        The joint state, unchanged if all its values are finite or if it has a wrong number of joints.
    """
    columns = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm)
    all_finite = all(map(math.isfinite, chain(*columns)))
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
        self._max_speed_rad_s = speed_rad_s
        # The last rejected angles.
        self._last_rejected_rad = np.zeros(count)
        self._last_rejected_times_s = np.zeros((2, count))
        self._consecutive_count = np.zeros(count, dtype=np.int64)

    def compute_max_rotation_rad(self, elapsed_s: Floats) -> Floats:
        """Return the maximum plausible rotation of each joint in these times, (n_joints,)."""
        return ANGLE_NOISE_MARGIN_RAD + self._max_speed_rad_s * np.maximum(elapsed_s, 0.0)

    def find_settled(self, jumped: JointMask, angle_rad: Floats, measured_s: Floats) -> JointMask:
        """Store the newest rejected angles, and find the joints that have settled at a new place after a jump.

        A joint has settled if SETTLED_SAMPLE_COUNT rejected angles in a row are near one another.

        Args:
            jumped: (n_joints,) True for joints whose newest angle is too far from the last good one.
            angle_rad: (n_joints,) the newest angles; only those of joints that jumped are used.
            measured_s: (2, n_joints) times of the measurements, by the timestamps and by safety time.

        Returns:
            (n_joints,) True for joints that have jumped and settled.
        """
        newest_rad = np.where(jumped, angle_rad, 0.0)
        elapsed_s = measured_s - self._last_rejected_times_s
        is_near_last = np.abs(
            newest_rad - self._last_rejected_rad
        ) <= self.compute_max_rotation_rad(elapsed_s.max(axis=0))
        is_repeated = is_near_last & (elapsed_s[0] <= 0)  # a repeated sample is not new information
        sample_count = np.where(is_near_last, self._consecutive_count + ~is_repeated, 1)
        self._consecutive_count = np.where(jumped, sample_count, 0)
        self._last_rejected_rad = newest_rad
        self._last_rejected_times_s = measured_s
        return jumped & (self._consecutive_count >= SETTLED_SAMPLE_COUNT)


class _FrozenDetector:
    """Measures for how long joints have repeated a state, and how far their targets have moved meanwhile."""

    def __init__(self, limits: JointLimits) -> None:
        count = len(limits.joints)
        self._lease_s = limits.lease_ns * 1e-9
        self._min_target_range_rad = FROZEN_TARGET_FRACTION * limits.max_step_rad
        self._last_columns = np.full((3, count), np.nan)
        self._had_position_target: JointMask = np.zeros(count, dtype=np.bool_)  # in the last period
        # The range of the targets since the state has been the same.
        self._lowest_target_rad = np.zeros(count)
        self._highest_target_rad = np.zeros(count)
        self._never_times_s = np.full(count, np.inf)
        self._wide_range_since_s = self._never_times_s  # times from which that range has been wide

    def restart(self, columns: Floats, applied: AppliedSetpoints | None) -> None:
        """Store joint states that differ from the previous ones, and restart the measurement of repetitions.

        Args:
            columns: (3, n_joints) angle in rad, velocity in rad/s and torque in N·m.
            applied: Last setpoints of an armed robot. None if the robot is not armed.
        """
        self._last_columns = columns
        if applied is None:
            self._had_position_target = np.zeros_like(self._had_position_target)
            return
        self._had_position_target = applied.mode == JointMode.POSITION
        self._lowest_target_rad = applied.target
        self._highest_target_rad = applied.target
        self._wide_range_since_s = self._never_times_s

    def find_frozen(
        self, columns: Floats, measured_s: Floats, applied: AppliedSetpoints | None
    ) -> JointMask:
        """Store the newest states, and find the joints whose measurements are frozen.

        A joint is frozen if it repeats the same state to the bit for more than a lease after its position target has
        moved far, unless its torque is at the limit: then a constant torque is plausible.

        Args:
            columns: (3, n_joints) angle in rad, velocity in rad/s and torque in N·m.
            measured_s: (n_joints,) times of the measurements, by their timestamp.
            applied: Last setpoints of an armed robot. None if the robot is not armed.

        Returns:
            (n_joints,) True for frozen joints.
        """
        if applied is None:
            self.restart(columns, None)
            return np.zeros_like(self._had_position_target)
        is_in_position_mode = applied.mode == JointMode.POSITION
        is_repeated = (
            (columns == self._last_columns).all(axis=0)
            & is_in_position_mode
            & self._had_position_target
        )
        if not np.count_nonzero(is_repeated):
            self.restart(columns, applied)
            return is_repeated

        # The range of the targets since the state has been the same.
        target_rad = applied.target
        self._last_columns = columns
        self._had_position_target = is_in_position_mode
        self._lowest_target_rad = np.where(
            is_repeated, np.minimum(self._lowest_target_rad, target_rad), target_rad
        )
        self._highest_target_rad = np.where(
            is_repeated, np.maximum(self._highest_target_rad, target_rad), target_rad
        )

        has_wide_target_range = is_repeated & (
            self._highest_target_rad - self._lowest_target_rad > self._min_target_range_rad
        )
        earliest_s = np.minimum(self._wide_range_since_s, measured_s)
        self._wide_range_since_s = np.where(has_wide_target_range, earliest_s, self._never_times_s)
        is_longer_than_lease = measured_s - self._wide_range_since_s > self._lease_s
        is_torque_unsaturated = (
            np.abs(columns[2]) < SATURATED_TORQUE_FRACTION * applied.torque_limit_nm
        )
        return has_wide_target_range & is_longer_than_lease & is_torque_unsaturated
