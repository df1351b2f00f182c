"""Wraps any backend: every exception inside becomes a `BackendError` that names the call.

So an I/O error, or a defect in a third-party backend, leads to a safe stop with a record, and never to an uncontrolled
end of the host.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

from snakesim_hal.backend import Backend, Injectable, Samples, SetPoints
from snakesim_hal.errors import BackendError, SnakesimError
from snakesim_hal.model.injection import Injection
from snakesim_hal.wire.messages import Description, Fault, LifecycleState

MethodT = TypeVar("MethodT", bound=Callable[..., Any])


def _guarded(method: MethodT) -> MethodT:
    @functools.wraps(method)
    def call(self: "GuardedBackend", *arguments: Any, **named: Any) -> Any:
        try:
            return method(self, *arguments, **named)
        except SnakesimError:
            raise
        except Exception as error:  # third-party code, which must not end the host
            where = f"{self.name}.{method.__name__}"
            raise BackendError(f"{where} failed: {type(error).__name__}: {error}") from error

    return call  # pyright: ignore[reportReturnType]


class GuardedBackend:
    """A `snakesim_hal.backend.Backend` around another."""

    def __init__(self, inner: Backend) -> None:
        self._inner = inner
        self.name = type(inner).__name__

    @_guarded
    def describe(self) -> Description:
        """As the backend does."""
        return self._inner.describe()

    @_guarded
    def sample(self, tick: int, stamp_ns: int) -> Samples:
        """As the backend does."""
        return self._inner.sample(tick, stamp_ns)

    @_guarded
    def enact(self, set_points: SetPoints, lifecycle: LifecycleState) -> None:
        """As the backend does."""
        self._inner.enact(set_points, lifecycle)

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
