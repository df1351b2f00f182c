"""The interface of a backend.

A backend is opened from the run's settings, asked for samples once a tick, given setpoints once a tick, and advanced
by one period at a time. It never sees Zenoh or leases: the host handles those, for every backend alike.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import msgspec

from snakesim_hal.wire.messages import ClockMode, Description, Fault, JointState, LifecycleState, Message, Mode

if TYPE_CHECKING:
    from snakesim_hal.model.fault_kinds import Injection
    from snakesim_hal.model.scenario import RunConfig


@dataclass(frozen=True)
class SafeSetpoints:
    """SafeSetpoints of all joints from now on, tail to head, after the limiter.

    Only the limiter creates them, so the type checker proves that no backend gets setpoints that were not limited.
    Controllers return `snakesim_hal.wire.setpoints.RequestedSetpoints` instead.
    """

    mode: list[Mode]
    target: list[float]  # rad, rad/s or N·m, as the mode says
    torque_limit_nm: list[float]
    isolated: frozenset[int] = frozenset()  # indices of isolated joints, which are passive here and to be switched off


@dataclass(frozen=True)
class Samples:
    """Sensor samples of one tick. `others` holds only those that were due: key -> message."""

    joints: JointState
    others: Mapping[str, Message] = field(default_factory=dict[str, Message])
    encoded: Mapping[str, bytes] = field(default_factory=dict[str, bytes])  # `others`; filled in by the host


class Backend(Protocol):
    """A robot, simulated or real."""

    def describe(self) -> Description:
        """The description of the robot; available right after opening."""
        ...

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Read every sensor that is due at `tick`. Raises BackendError when it has no valid state any more."""
        ...

    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """Hand setpoints to the motors; they hold until the next call.

        The setpoints are safe in every state, so a simulator needs no more. A robot whose modules have states of their
        own makes them follow `lifecycle`: armed on "armed", and stopped by itself on anything else.
        """
        ...

    def advance(self) -> None:
        """Let one control period pass: a simulator steps, a driver sends and listens. Raises BackendError."""
        ...

    def faults(self) -> list[Fault]:
        """Faults detected since the last call; empty in normal operation."""
        ...

    def close(self) -> None:
        """Make the joints safe and release all resources. Called once, also after an error."""
        ...


@runtime_checkable
class Injectable(Protocol):
    """A backend that injects faults itself, more realistically than the host could."""

    def inject(self, injection: "Injection", *, begins: bool) -> bool:
        """Begin or end an injected fault; False when this backend has no such fault. Raises ConfigError."""
        ...


class BackendFactory(Protocol):
    """The object of an entry point in the group `snakesim.backends`: usually the backend's class."""

    Settings: type[msgspec.Struct]  # the scenario's [backends.<name>] section

    def check(self, config: "RunConfig", settings: Any) -> tuple[ClockMode, ...]:
        """The supported clock modes, the preferred one first; a real robot supports real time only. Opens nothing.

        Raises ConfigError for a run that this backend does not support at any clock mode, so that nothing is started.
        """
        ...

    def __call__(self, config: "RunConfig", settings: Any) -> Backend:
        """Open the backend for a run."""
        ...
