"""Wraps any backend, to inject faults of its joints, buses and simulator.

The wrapped backend is asked first, because it injects faults more realistically. A kind of fault that it does not
support is applied here to its samples if that is possible, or refused.
"""

import math
import time
from dataclasses import replace

import msgspec

from snakesim_hal.backend import Backend, SafeSetpoints, Samples
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.wire.messages import Fault, JointState, LifecycleState, RobotDescription

# Kinds of faults that are applied to samples here, see `fault_kinds`.
MUTE = "mute"  # the joint sends nothing: its last state is repeated as invalid, and its age grows
FREEZE = "freeze"  # the joint repeats its last state as valid, and the age of the state grows
WRONG_ANGLE = "wrong"  # the measured angle has an offset, which is the amount of the fault
NAN_ANGLE = "nan"  # the measured angle is NaN


class FaultyBackend(Backend):
    """Wraps a backend, and applies injected faults to its samples and its speed."""

    def __init__(self, inner: Backend) -> None:
        """Wrap a backend, and read its description, which must not change afterwards."""
        self._inner = inner
        self._description = inner.describe()
        # Faults that are applied here: by joint index, then by kind.
        self._active_faults: dict[int, dict[str, FaultInjection]] = {}
        # As returned, with the faults; None before the first sample.
        self._last_state: JointState | None = None
        # Of real time, for a slowed simulator; None: not slowed.
        self._speed_ratio: float | None = None

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Start or end a fault, in the wrapped backend if it supports the kind of fault, otherwise here.

        Args:
            injection: Fault.
            begins: True starts the fault, False ends it.

        Returns:
            Always True: a fault that is not supported raises an error.

        Raises:
            ConfigError: Neither the backend nor this wrapper supports this kind of fault.
        """
        if "host" in injection.kind_info.executors:
            self._set_slowdown(injection, begins)
            return True
        if self._inner.inject(injection, begins=begins):
            return True
        if "samples" in injection.kind_info.executors:
            self._set_sample_fault(injection, begins)
            return True
        raise ConfigError(
            f"backend {self._description.backend!r} cannot do {injection.kind} to {injection.target}",
            code="injection/not-supported",
        )

    def describe(self) -> RobotDescription:
        """Return the backend's description."""
        return self._description

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Return the backend's samples, with the active faults applied."""
        samples = self._inner.sample(tick, timestamp_ns)
        if self._active_faults:
            samples = replace(samples, joints=self._apply_faults(samples.joints))
        self._last_state = samples.joints
        return samples

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        self._inner.enact(setpoints, lifecycle)

    def advance(self) -> None:
        """Advance the backend by a tick. A slowed simulator then waits for the rest of the longer tick."""
        start_s = time.monotonic()
        self._inner.advance()
        if self._speed_ratio is not None:
            duration_s = self._description.period_ns * 1e-9 / self._speed_ratio
            time.sleep(max(start_s + duration_s - time.monotonic(), 0.0))

    def faults(self) -> list[Fault]:
        return self._inner.faults()

    def list_arming_obstacles(self) -> list[str]:
        return self._inner.list_arming_obstacles()

    def close(self) -> None:
        self._inner.close()

    # --- faults applied here ---------------------------------------------------------------------------------

    def _set_slowdown(self, injection: FaultInjection, begins: bool) -> None:
        """Start or end a slowdown of the simulator. Raises ConfigError for a backend that is no simulator."""
        if not self._description.emulated:
            raise ConfigError(
                f"backend {self._description.backend!r} has no simulation that could be slow",
                code="injection/not-supported",
            )
        self._speed_ratio = injection.amount if begins else None

    def _set_sample_fault(self, injection: FaultInjection, begins: bool) -> None:
        """Start or end a fault that is applied to the samples of one joint. Raises ConfigError for a missing joint."""
        joint_index = injection.target_index
        joint_count = len(self._description.joints)
        if joint_index >= joint_count:
            raise ConfigError(
                f"there is no {injection.target}; this robot has joint_1 to joint_{joint_count}",
                code="injection/unknown-target",
            )
        faults_by_kind = self._active_faults.setdefault(joint_index, {})
        if begins:
            faults_by_kind[injection.kind] = injection
        else:
            faults_by_kind.pop(injection.kind, None)
        if not faults_by_kind:
            del self._active_faults[joint_index]

    def _apply_faults(self, joints: JointState) -> JointState:
        """Return a joint state to which the active faults of its joints are applied.

        A joint that is mute or frozen repeats its last state, and the age of that state grows. A mute joint is invalid
        in addition.

        Args:
            joints: State as the wrapped backend has measured it.
        """
        angle_rad = list(joints.angle_rad)
        velocity_rad_s = list(joints.velocity_rad_s)
        torque_nm = list(joints.torque_nm)
        valid = list(joints.valid)
        age_ns = list(joints.age_ns)
        last_state = self._last_state
        for joint_index, faults_by_kind in self._active_faults.items():
            repeats_last_state = MUTE in faults_by_kind or FREEZE in faults_by_kind
            if repeats_last_state and last_state is not None:
                angle_rad[joint_index] = last_state.angle_rad[joint_index]
                velocity_rad_s[joint_index] = last_state.velocity_rad_s[joint_index]
                torque_nm[joint_index] = last_state.torque_nm[joint_index]
                valid[joint_index] = last_state.valid[joint_index]
                elapsed_ns = joints.timestamp_ns - last_state.timestamp_ns
                age_ns[joint_index] = last_state.age_ns[joint_index] + elapsed_ns
            elif WRONG_ANGLE in faults_by_kind:
                offset_rad = faults_by_kind[WRONG_ANGLE].amount
                assert offset_rad is not None, (
                    "the injector has filled in the default of the amount"
                )
                angle_rad[joint_index] += offset_rad
            if MUTE in faults_by_kind:
                valid[joint_index] = False
            if NAN_ANGLE in faults_by_kind:
                angle_rad[joint_index] = math.nan
        return msgspec.structs.replace(
            joints,
            angle_rad=angle_rad,
            velocity_rad_s=velocity_rad_s,
            torque_nm=torque_nm,
            valid=valid,
            age_ns=age_ns,
        )
