"""Wraps any backend, with injected faults of its joints, buses and simulator.

The backend comes first: it injects faults more realistically. Other kinds are applied to its samples here, if
possible, or refused.
"""

import time
from dataclasses import replace

import msgspec

from snakesim_hal.backend import Backend, SafeSetpoints, Samples
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.wire.messages import Description, Fault, JointState, LifecycleState

NO_NUMBER = float("nan")


class FaultyBackend(Backend):
    """A backend around another."""

    def __init__(self, inner: Backend) -> None:
        """Wrap a backend; its description is read once."""
        self._inner = inner
        self._description = inner.describe()
        self._active: dict[int, dict[str, Injection]] = {}  # joint index -> kind -> fault applied here
        self._last: JointState | None = None  # as returned, with the faults
        self._speed_ratio: float | None = None  # of real time, for a slowed simulator; None: not slowed

    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Begin or end a fault.

        Returns:
            True.

        Raises:
            ConfigError: Neither the backend nor this wrapper can carry it out.
        """
        if "host" in injection.about.by:
            self._slow_down(injection, begins)
            return True
        if self._inner.inject(injection, begins=begins):
            return True
        if "samples" in injection.about.by:
            self._change_samples(injection, begins)
            return True
        raise ConfigError(
            f"backend {self._description.backend!r} cannot do {injection.kind} to {injection.target}",
            code="injection/not-supported",
        )

    def describe(self) -> Description:
        """Return the backend's description."""
        return self._description

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Return the backend's samples, with the active faults applied."""
        samples = self._inner.sample(tick, timestamp_ns)
        if self._active:
            samples = replace(samples, joints=self._apply_faults(samples.joints))
        self._last = samples.joints
        return samples

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        self._inner.enact(setpoints, lifecycle)

    def advance(self) -> None:
        """Advance the backend by a tick. A slowed simulator then waits for the rest of the longer tick."""
        began_s = time.monotonic()
        self._inner.advance()
        if self._speed_ratio is not None:
            duration_s = self._description.period_ns * 1e-9 / self._speed_ratio
            time.sleep(max(began_s + duration_s - time.monotonic(), 0.0))

    def faults(self) -> list[Fault]:
        return self._inner.faults()

    def list_arming_obstacles(self) -> list[str]:
        return self._inner.list_arming_obstacles()

    def close(self) -> None:
        self._inner.close()

    # --- faults applied here ---------------------------------------------------------------------------------

    def _slow_down(self, injection: Injection, begins: bool) -> None:
        if not self._description.emulated:
            raise ConfigError(
                f"backend {self._description.backend!r} has no simulation that could be slow",
                code="injection/not-supported",
            )
        self._speed_ratio = injection.amount if begins else None

    def _change_samples(self, injection: Injection, begins: bool) -> None:
        """Begin or end a fault that is applied to the samples of one joint."""
        joint = injection.number
        count = len(self._description.joints)
        if joint >= count:
            raise ConfigError(
                f"there is no {injection.target}; this robot has joint_1 to joint_{count}",
                code="injection/unknown-target",
            )
        kinds = self._active.setdefault(joint, {})
        if begins:
            kinds[injection.kind] = injection
        else:
            kinds.pop(injection.kind, None)
        if not kinds:
            del self._active[joint]

    def _apply_faults(self, joints: JointState) -> JointState:
        """Return a joint state with the active faults of its joints."""
        angle_rad = list(joints.angle_rad)
        velocity_rad_s = list(joints.velocity_rad_s)
        torque_nm = list(joints.torque_nm)
        valid = list(joints.valid)
        age_ns = list(joints.age_ns)
        last = self._last
        for joint, kinds in self._active.items():
            repeats_last = "mute" in kinds or "freeze" in kinds
            if repeats_last and last is not None:
                angle_rad[joint] = last.angle_rad[joint]
                velocity_rad_s[joint] = last.velocity_rad_s[joint]
                torque_nm[joint] = last.torque_nm[joint]
                valid[joint] = last.valid[joint]
                age_ns[joint] = last.age_ns[joint] + joints.timestamp_ns - last.timestamp_ns
            elif "wrong" in kinds:
                angle_rad[joint] += kinds["wrong"].amount or 0.0
            if "mute" in kinds:
                valid[joint] = False
            if "nan" in kinds:
                angle_rad[joint] = NO_NUMBER
        return msgspec.structs.replace(
            joints, angle_rad=angle_rad, velocity_rad_s=velocity_rad_s, torque_nm=torque_nm, valid=valid, age_ns=age_ns
        )
