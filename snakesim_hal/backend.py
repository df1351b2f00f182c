"""What a backend implements.

A backend is opened from the run's settings, asked for samples once a tick, given set-points once a tick, and told
when to let a period pass. It never sees Zenoh or leases: the host does those, for every backend alike.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import msgspec

from snakesim_hal.wire.messages import Description, Fault, JointState, LifecycleState, Message, Mode, Pace

if TYPE_CHECKING:
    from snakesim_hal.model.injection import Injection
    from snakesim_hal.model.scenario import RunConfig


@dataclass(frozen=True)
class SetPoints:
    """What the joints are to do from now on, tail to head; already inside every limit."""

    mode: list[Mode]
    target: list[float]  # rad, rad/s or N·m, as the mode says
    torque_limit_nm: list[float]
    isolated: frozenset[int] = frozenset()  # joints that are set aside: passive here, and to be switched off


@dataclass(frozen=True)
class Samples:
    """What the sensors gave for one tick. `others` holds only what was due: key -> message."""

    joints: JointState
    others: Mapping[str, Message] = field(default_factory=dict[str, Message])


class Backend(Protocol):
    """A robot, simulated or real."""

    def describe(self) -> Description:
        """The robot as this backend has it; readable at once after opening."""
        ...

    def sample(self, tick: int, stamp_ns: int) -> Samples:
        """Read every sensor that is due at `tick`. Raises BackendError when no state can be trusted any more."""
        ...

    def enact(self, set_points: SetPoints, lifecycle: LifecycleState) -> None:
        """Hand set-points to the motors; they hold until the next call.

        The set-points are safe in every state, so a simulator needs no more. A robot whose modules have states of their
        own makes them follow `lifecycle`: armed on "armed", and stopped by itself on anything else.
        """
        ...

    def advance(self) -> None:
        """Let one control period pass: a simulator steps, a driver sends and listens. Raises BackendError."""
        ...

    def faults(self) -> list[Fault]:
        """Faults found since the last call; empty when all is well."""
        ...

    def close(self) -> None:
        """Make the joints safe and let go of everything. Called once, also after an error."""
        ...


@runtime_checkable
class Injectable(Protocol):
    """A backend that can let things go wrong by itself, more truly than the host could for it."""

    def inject(self, injection: "Injection", *, begins: bool) -> bool:
        """Begin or end a fault on request; False when this backend knows no such fault. Raises ConfigError."""
        ...


class BackendFactory(Protocol):
    """What stands behind an entry point in the group `snakesim.backends`: usually the backend's class."""

    Settings: type[msgspec.Struct]  # the scenario's [backends.<name>] section

    def check(self, config: "RunConfig", settings: Any) -> tuple[Pace, ...]:
        """Which paces it could keep, the preferred one first; a real robot waits for nobody. Opens nothing.

        Raises ConfigError for a run that this backend cannot do, whatever the pace, so that nothing is started for it.
        """
        ...

    def __call__(self, config: "RunConfig", settings: Any) -> Backend:
        """Open the backend for a run."""
        ...
