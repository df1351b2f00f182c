"""Wraps any backend: every exception inside becomes a `BackendError` that names the call, or the sensor.

Samples are encoded here, and what is encoded is decoded as a reader will: a message that no reader would accept is an
error of its backend, not a stream that stops without a word. So is a sample of a sensor that was not described.

So an I/O error, or a defect in a third-party backend, leads to a safe stop with a record, and never to an uncontrolled
end of the host.
"""

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

from snakesim_hal.backend import Backend, Injectable, SafeSetpoints, Samples
from snakesim_hal.base.errors import BackendError, SnakesimError, WireError
from snakesim_hal.base.step_limit import StepTooLongError, place_of
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Description, Fault, LifecycleState
from snakesim_hal.wire.outgoing import checked, packed
from snakesim_hal.wire.own_sample import OwnKind, own_kinds

MethodT = TypeVar("MethodT", bound=Callable[..., Any])


def _guarded(method: MethodT) -> MethodT:
    @functools.wraps(method)
    def call(self: "GuardedBackend", *arguments: Any, **named: Any) -> Any:
        try:
            return method(self, *arguments, **named)
        except SnakesimError:
            raise
        except StepTooLongError as error:
            where = f"{self.name}.{method.__name__}"
            raise BackendError(f"{where} did not return in time: it was in {place_of(error)}") from error
        except (Exception, SystemExit) as error:  # third-party code, which must not end the host
            where = f"{self.name}.{method.__name__}"
            raise BackendError(f"{where} failed: {type(error).__name__}: {error}") from error

    return call  # pyright: ignore[reportReturnType]


class GuardedBackend:
    """A `snakesim_hal.backend.Backend` around another."""

    def __init__(self, inner: Backend) -> None:
        self._inner = inner
        self.name = type(inner).__name__
        self._keys: list[str] | None = None
        self._own: dict[str, OwnKind] = {}

    @_guarded
    def describe(self) -> Description:
        """As the backend does."""
        return self._inner.describe()

    @_guarded
    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """As the backend does, with the bytes of every message beside the joints."""
        samples = self._inner.sample(tick, timestamp_ns)
        key, encoded = keys.JOINTS, dict[str, bytes]()
        try:
            packed(samples.joints)  # whether their values are plausible is judged joint by joint
            for key, message in samples.others.items():
                if key not in self._described():
                    known = ", ".join(self._described())
                    raise WireError("unknown_key", f"not a sensor of its description, which has {known}")
                encoded[key] = checked(key, message, self._own.get(key))
        except WireError as error:
            raise BackendError(f"{self.name}.sample: {key} cannot be published: {error.detail}") from None
        return replace(samples, encoded=encoded)

    @_guarded
    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        """As the backend does."""
        self._inner.enact(setpoints, lifecycle)

    @_guarded
    def advance(self) -> None:
        """As the backend does."""
        self._inner.advance()

    @_guarded
    def faults(self) -> list[Fault]:
        """As the backend does."""
        return self._inner.faults()

    @_guarded
    def close(self) -> None:
        """As the backend does."""
        self._inner.close()

    @_guarded
    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """As the backend does, if it injects faults itself."""
        return isinstance(self._inner, Injectable) and self._inner.inject(injection, begins=begins)

    def _described(self) -> list[str]:
        """Keys of its sensors."""
        if self._keys is None:
            robot = self._inner.describe()
            self._keys, self._own = [sensor.key for sensor in robot.sensors], own_kinds(robot)
        return self._keys
