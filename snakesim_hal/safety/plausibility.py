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
from numpy.typing import NDArray

from snakesim_hal.safety.limiter import Applied, Floats, JointLimits, Measured
from snakesim_hal.wire.messages import Fault, JointState, Mode

Mask = NDArray[np.bool_]
Columns = tuple[list[float], list[float], list[float]]  # angle, velocity, torque

SPEED_MARGIN = 2.0  # an external load may turn a joint faster than its motor
SLACK_RAD = 0.05  # for noise
AGREEING = 5  # samples in a row at a new place, until it is accepted
FROZEN_SHARE = 0.25  # of max_step_rad: a target that moves this far changes the torque of a joint that does not follow
AT_LIMIT = 0.95  # of the torque limit
LONGEST_CAUSE = 400


@dataclass(frozen=True)
class ImplausibleState:
    """An implausible joint state: its fault, and the joints concerned."""

    fault: Fault
    joints: Mask


class PlausibilityCheck:
    """The last good state of every joint, and the checks of the newest."""

    def __init__(self, limits: JointLimits) -> None:
        self._limits = limits
        count = len(limits.joints)
        self._columns = np.zeros((3, count))  # angle, velocity, torque: the last good ones
        self._good_s = np.zeros((2, count))  # when they were taken, by both clocks
        self._known: Mask = np.zeros(count, dtype=np.bool_)  # whether there ever were any
        self._ordinary: Columns | None = None  # the last state, if all of it was good and no joint had jumped
        self._passed: tuple[JointState, int, Applied | None] | None = None  # it, if no check has looked at it
        self._jumps = _JumpDetector(count, SPEED_MARGIN * limits.speed_rad_s)
        self._frozen = _FrozenDetector(limits)

    @property
    def measured(self) -> Measured:
        """The last good state of every joint; zeros for one that never had any."""
        return Measured(*self._columns)

    def take(self, joints: JointState, *, now_ns: int, applied: Applied | None, aside: Mask) -> ImplausibleState | None:
        """Take a joint state; returns what is implausible, or None.

        now_ns: safety time. After a delay of the host, more time has passed than its ticks show.
        applied: the last setpoints of an armed robot; None: the robot is not armed.
        aside: isolated joints.
        """
        count = len(self._known)
        if not joints.is_of(count):
            cause = f"no joint state of {count} joints"
            return ImplausibleState(
                Fault(tick=joints.tick, what="state_invalid", cause=cause), np.ones_like(self._known)
            )
        newest: Columns = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm)
        columns = np.array(newest)
        if self._is_ordinary(joints):
            self._columns, self._ordinary, self._passed = columns, newest, (joints, now_ns, applied)
            return None
        self._look_back()
        taken_s = _taken_s(joints, now_ns)
        fresh = np.array(joints.age_ns, dtype=np.float64) <= self._limits.oldest_state_ns
        sound: Mask = np.isfinite(columns).all(axis=0) & fresh & np.array(joints.valid)
        elapsed_s = (taken_s - self._good_s).max(axis=0)
        jump_rad = np.where(sound, columns[0], 0.0) - self._columns[0]
        jumped = sound & self._known & (np.abs(jump_rad) > self._jumps.reach_rad(elapsed_s))
        settled = self._jumps.settled(jumped, columns[0], taken_s)
        self._ordinary = newest if sound.all() and not jumped.any() else None
        if applied is None:
            jumped &= ~settled
        good = sound & ~jumped
        self._columns = np.where(good, columns, self._columns)
        self._good_s = np.where(good, taken_s, self._good_s)
        self._known |= good
        frozen = self._frozen.look(columns, taken_s[0], applied)
        if not np.count_nonzero(~good | frozen):
            return None
        unknown, jumped, frozen = ~sound & ~aside, jumped & ~aside, frozen & ~aside
        if unknown.any():
            return self._implausible(joints.tick, "state_invalid", "no valid and fresh state of ", unknown)
        if jumped.any():
            tails = [
                f" by {by:+.2f} rad in {within * 1e3:.0f} ms" for by, within in zip(jump_rad, elapsed_s, strict=True)
            ]
            return self._implausible(
                joints.tick, "state_invalid", "faster than any joint turns: a jump of ", jumped, tails
            )
        if frozen.any():
            return self._implausible(
                joints.tick, "joint_frozen", "the same state repeated while its target moves: ", frozen
            )
        return None

    def _look_back(self) -> None:
        """Take what the checks need of the state before, if that was ordinary: only now does anything depend on it."""
        if self._passed is None:
            return
        joints, now_ns, applied = self._passed
        self._passed = None
        self._good_s = _taken_s(joints, now_ns)
        self._frozen.moved(self._columns, applied)

    def _is_ordinary(self, joints: JointState) -> bool:
        """Whether every joint is fresh, near its last angle and new, as nearly always: then no check can fail.

        On plain numbers: for a dozen joints that is several times faster than on vectors.
        """
        if self._ordinary is None or not all(joints.valid) or max(joints.age_ns) > self._limits.oldest_state_ns:
            return False
        for angle, velocity, torque, last, last_velocity, last_torque in zip(
            joints.angle_rad, joints.velocity_rad_s, joints.torque_nm, *self._ordinary, strict=True
        ):
            if not (abs(angle - last) <= SLACK_RAD and math.isfinite(velocity) and math.isfinite(torque)):
                return False
            if angle == last and velocity == last_velocity and torque == last_torque:
                return False
        return True

    def _implausible(
        self, tick: int, what: str, words: str, which: Mask, tails: list[str] | None = None
    ) -> ImplausibleState:
        found = np.flatnonzero(which).tolist()
        names = [self._limits.joints[i].name for i in found]
        labels = names if tails is None else [name + tails[i] for name, i in zip(names, found, strict=True)]
        cause = (words + ", ".join(labels))[:LONGEST_CAUSE]
        joint = names[0] if len(names) == 1 else None
        return ImplausibleState(Fault(tick=tick, what=what, cause=cause, joint=joint, reach="joint"), which)


def _taken_s(joints: JointState, now_ns: int) -> Floats:
    """When each joint's state was taken, by stamp and by safety time, (2, n_joints)."""
    ages_ns = np.array(joints.age_ns, dtype=np.float64)
    return (np.array([[joints.timestamp_ns], [now_ns]], dtype=np.float64) - ages_ns) * 1e-9


def readable(joints: JointState, good: Measured) -> JointState:
    """A joint state for publishing: NaN or infinity would make a reader reject the states of all joints.

    The last good value replaces it, marked invalid. A state of another number of joints is unchanged.
    """
    columns = (joints.angle_rad, joints.velocity_rad_s, joints.torque_nm)
    if all(all(map(math.isfinite, column)) for column in columns) or not joints.is_of(len(good.angle_rad)):
        return joints
    kept = (good.angle_rad.tolist(), good.velocity_rad_s.tolist(), good.torque_nm.tolist())
    sound = [all(map(math.isfinite, values)) for values in zip(*columns, strict=True)]
    angle, velocity, torque = (
        [value if fine else last for value, fine, last in zip(column, sound, before, strict=True)]
        for column, before in zip(columns, kept, strict=True)
    )
    valid = [valid and fine for valid, fine in zip(joints.valid, sound, strict=True)]
    return msgspec.structs.replace(joints, angle_rad=angle, velocity_rad_s=velocity, torque_nm=torque, valid=valid)


class _JumpDetector:
    """Rejected angles: whether they agree with one another."""

    def __init__(self, count: int, speed_rad_s: Floats) -> None:
        self._speed_rad_s = speed_rad_s
        self._angle_rad = np.zeros(count)
        self._taken_s = np.zeros((2, count))
        self._in_a_row = np.zeros(count, dtype=np.int64)

    def reach_rad(self, elapsed_s: Floats) -> Floats:
        """Maximum turn of a joint in this time, (n_joints,)."""
        return SLACK_RAD + self._speed_rad_s * np.maximum(elapsed_s, 0.0)

    def settled(self, strayed: Mask, angle_rad: Floats, taken_s: Floats) -> Mask:
        """Take the newest angles, of which some have jumped; returns which of those have settled at a new place."""
        if not np.count_nonzero(strayed):
            self._in_a_row[:] = 0
            return strayed
        elapsed_s = taken_s - self._taken_s
        follows = np.abs(np.where(strayed, angle_rad, 0.0) - self._angle_rad) <= self.reach_rad(elapsed_s.max(axis=0))
        repeated = follows & (elapsed_s[0] <= 0)  # a repeated sample is not new information
        counted = np.where(follows, self._in_a_row + ~repeated, 1)
        self._in_a_row = np.where(strayed, counted, 0)
        self._angle_rad, self._taken_s = np.where(strayed, angle_rad, 0.0), taken_s
        return strayed & (self._in_a_row >= AGREEING)


class _FrozenDetector:
    """For how long joints have repeated a state, and how far their targets have moved meanwhile."""

    def __init__(self, limits: JointLimits) -> None:
        self._lease_s = limits.lease_ns * 1e-9
        self._far_rad = FROZEN_SHARE * limits.max_step_rad
        count = len(limits.joints)
        self._columns = np.full((3, count), np.nan)
        self._followed: Mask = np.zeros(count, dtype=np.bool_)  # whether the joint had a position target before
        self._low_rad, self._high_rad = np.zeros(count), np.zeros(count)
        self._never_s = np.full(count, np.inf)
        self._far_since_s = self._never_s  # since when a target has been far from where it was at the start

    def moved(self, columns: Floats, applied: Applied | None) -> None:
        """Take states of which none repeats the one before, (3, n_joints), and what was applied."""
        self._columns = columns
        if applied is None:
            self._followed = np.zeros_like(self._followed)
            return
        self._followed = applied.mode == Mode.POSITION
        self._low_rad = self._high_rad = applied.target
        self._far_since_s = self._never_s

    def look(self, columns: Floats, taken_s: Floats, applied: Applied | None) -> Mask:
        """Take the newest states, (3, n_joints), and what was applied; returns which joints are frozen."""
        follows = np.zeros_like(self._followed) if applied is None else applied.mode == Mode.POSITION
        same = (columns == self._columns).all(axis=0) & follows & self._followed
        if applied is None or not np.count_nonzero(same):
            self.moved(columns, applied)
            return same
        self._columns, self._followed, target = columns, follows, applied.target
        self._low_rad = np.where(same, np.minimum(self._low_rad, target), target)
        self._high_rad = np.where(same, np.maximum(self._high_rad, target), target)
        far = same & (self._high_rad - self._low_rad > self._far_rad)
        self._far_since_s = np.where(far, np.minimum(self._far_since_s, taken_s), self._never_s)
        long = taken_s - self._far_since_s > self._lease_s
        free = np.abs(columns[2]) < AT_LIMIT * applied.torque_limit_nm
        return far & long & free
