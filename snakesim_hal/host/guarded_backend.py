"""Wraps any backend: every exception inside becomes a `BackendError` that names the call, or the sensor.

An I/O error, or a defect in a third-party backend, therefore leads to a safe stop with a record, and never to an
uncontrolled end of the host.

Samples are encoded here, and decoded again as a reader will: a message that no reader would accept is an error of its
backend, because otherwise a stream would stop without a message. So is a sample of a sensor that was not described.

The host's thread makes every call.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

from snakesim_hal.backend import Backend, SafeSetpoints, Samples
from snakesim_hal.base.errors import BackendError, SnakesimError, WireError
from snakesim_hal.base.step_limit import StepTooLongError, describe_interrupted_line
from snakesim_hal.model.fault_kinds import Injection
from snakesim_hal.wire import keys
from snakesim_hal.wire.custom_sample import CustomMessage, find_custom_messages
from snakesim_hal.wire.messages import Description, Fault, LifecycleState
from snakesim_hal.wire.outgoing import encode_checked, encode_unchecked

MethodT = TypeVar("MethodT", bound=Callable[..., Any])


def _guarded(method: MethodT) -> MethodT:
    """Return a method that raises a BackendError for every exception that is not ours."""

    @functools.wraps(method)
    def call(self: "GuardedBackend", *arguments: Any, **named: Any) -> Any:
        try:
            return method(self, *arguments, **named)
        except SnakesimError:
            raise
        except StepTooLongError as error:
            where = f"{self.name}.{method.__name__}"
            raise BackendError(
                f"{where} did not return in time: it was in {describe_interrupted_line(error)}",
                code="backend/step-timeout",
            ) from error
        except (Exception, SystemExit) as error:  # third-party code, which must not end the host
            where = f"{self.name}.{method.__name__}"
            raise BackendError(f"{where} failed: {type(error).__name__}: {error}") from error

    return call  # pyright: ignore[reportReturnType]


class GuardedBackend(Backend):
    """A backend around another."""

    def __init__(self, inner: Backend) -> None:
        """Wrap a backend; nothing of it is called yet."""
        self._inner = inner
        self.name = type(inner).__name__
        self._sensor_keys: list[str] | None = None  # None: not read yet
        self._custom_messages: dict[str, CustomMessage] = {}  # custom messages, by key

    @_guarded
    def describe(self) -> Description:
        return self._inner.describe()

    @_guarded
    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Return the backend's samples, with the bytes of every message except the joint state."""
        samples = self._inner.sample(tick, timestamp_ns)
        encoded: dict[str, bytes] = {}
        key = keys.JOINTS  # of the message in work, for the error
        try:
            encode_unchecked(samples.joints)  # the host judges joint by joint whether the values are plausible
            for key, message in samples.others.items():
                if key not in self._find_sensor_keys():
                    known = ", ".join(self._find_sensor_keys())
                    raise WireError("unknown_key", f"not a sensor of its description, which has {known}")
                encoded[key] = encode_checked(key, message, self._custom_messages.get(key))
        except WireError as error:
            raise BackendError(f"{self.name}.sample: {key} cannot be published: {error.detail}") from None
        return Samples(samples.joints, samples.others, encoded)

    @_guarded
    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        self._inner.enact(setpoints, lifecycle)

    @_guarded
    def advance(self) -> None:
        self._inner.advance()

    @_guarded
    def faults(self) -> list[Fault]:
        return self._inner.faults()

    @_guarded
    def list_arming_obstacles(self) -> list[str]:
        return self._inner.list_arming_obstacles()

    @_guarded
    def close(self) -> None:
        self._inner.close()

    @_guarded
    def inject(self, injection: Injection, *, begins: bool) -> bool:
        """Begin or end a fault that the backend injects itself; return False if it does not have it."""
        return self._inner.inject(injection, begins=begins)

    def _find_sensor_keys(self) -> list[str]:
        """Return the keys of the described sensors. The description is read at the first call."""
        if self._sensor_keys is None:
            robot = self._inner.describe()
            self._custom_messages = find_custom_messages(robot)
            self._sensor_keys = [sensor.key for sensor in robot.sensors]
        return self._sensor_keys
