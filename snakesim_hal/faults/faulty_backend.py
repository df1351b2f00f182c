"""Wraps any backend, with injected faults of its joints, buses and simulator.

The backend comes first: it injects faults more realistically. Other kinds are applied to its samples here, if
possible, or refused.
"""

import time
from dataclasses import replace

import msgspec

from snakesim_hal.backend import Backend, Injectable, Samples
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.wire.messages import Description, JointState

NO_NUMBER = float("nan")


class FaultyBackend:
    """A `snakesim_hal.backend.Backend` around another."""

    def __init__(self, inner: Backend) -> None:
        self._inner = inner
        self._description = inner.describe()
        self._on: dict[int, dict[str, Injection]] = {}  # joint -> kind -> fault applied here
        self._last: JointState | None = None  # as returned
        self._share: float | None = None  # of real time, speed of a slowed simulator
        self.enact, self.faults, self.close = inner.enact, inner.faults, inner.close  # as the backend does

    def inject(self, injection: Injection, begins: bool) -> None:
        """Begin or end a fault. Raises ConfigError for one that cannot be had here."""
        if "host" in injection.about.by:
            self._slow_down(injection, begins)
        elif isinstance(self._inner, Injectable) and self._inner.inject(injection, begins=begins):
            return
        elif "samples" in injection.about.by:
            self._disturb(injection, begins)
        else:
            raise ConfigError(f"backend {self._description.backend!r} cannot do {injection.kind} to {injection.target}")

    def describe(self) -> Description:
        """As the backend does."""
        return self._description

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """The backend's samples, with the active faults applied."""
        samples = self._inner.sample(tick, timestamp_ns)
        if self._on:
            samples = replace(samples, joints=self._disturbed(samples.joints))
        self._last = samples.joints
        return samples

    def advance(self) -> None:
        """As the backend does, at a share of real time if requested."""
        began = time.monotonic()
        self._inner.advance()
        if self._share is not None:
            takes_s = self._description.period_ns * 1e-9 / self._share
            time.sleep(max(began + takes_s - time.monotonic(), 0.0))

    # --- faults applied here ---------------------------------------------------------------------------------

    def _slow_down(self, injection: Injection, begins: bool) -> None:
        if not self._description.emulated:
            raise ConfigError(f"backend {self._description.backend!r} has no simulation that could be slow")
        self._share = injection.amount if begins else None

    def _disturb(self, injection: Injection, begins: bool) -> None:
        joint, count = injection.number, len(self._description.joints)
        if joint >= count:
            raise ConfigError(f"there is no {injection.target}; this robot has joint_1 to joint_{count}")
        kinds = self._on.setdefault(joint, {})
        if begins:
            kinds[injection.kind] = injection
        else:
            kinds.pop(injection.kind, None)
        if not kinds:
            del self._on[joint]

    def _disturbed(self, joints: JointState) -> JointState:
        angle, velocity, torque = list(joints.angle_rad), list(joints.velocity_rad_s), list(joints.torque_nm)
        valid, age = list(joints.valid), list(joints.age_ns)
        for joint, kinds in self._on.items():
            last = self._last
            if last is not None and ("mute" in kinds or "freeze" in kinds):
                angle[joint], velocity[joint] = last.angle_rad[joint], last.velocity_rad_s[joint]
                torque[joint], valid[joint] = last.torque_nm[joint], last.valid[joint]
                age[joint] = last.age_ns[joint] + joints.timestamp_ns - last.timestamp_ns
            elif "wrong" in kinds:
                angle[joint] += kinds["wrong"].amount or 0.0
            if "mute" in kinds:
                valid[joint] = False
            if "nan" in kinds:
                angle[joint] = NO_NUMBER
        return msgspec.structs.replace(
            joints, angle_rad=angle, velocity_rad_s=velocity, torque_nm=torque, valid=valid, age_ns=age
        )
