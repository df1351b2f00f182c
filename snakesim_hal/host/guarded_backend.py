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
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import EncodedMessage
from snakesim_hal.wire.custom_sample import CustomMessage, find_custom_messages
from snakesim_hal.wire.messages import Fault, LifecycleState, RobotDescription
from snakesim_hal.wire.outgoing import encode_checked, encode_unchecked

MethodT = TypeVar("MethodT", bound=Callable[..., Any])


def _convert_exceptions(method: MethodT) -> MethodT:
    """Decorate a method of `GuardedBackend` so that every foreign exception becomes a BackendError with its name.

    SnakesimError and its subclasses pass unchanged. An interrupted call gets the code `backend/step-timeout`.
    """

    @functools.wraps(method)
    def call_converting_exceptions(self: "GuardedBackend", *args: Any, **kwargs: Any) -> Any:
        try:
            return method(self, *args, **kwargs)
        except SnakesimError:
            raise
        except StepTooLongError as error:
            call_name = f"{self.name}.{method.__name__}"
            raise BackendError(
                f"{call_name} did not return in time: it was in {describe_interrupted_line(error)}",
                code="backend/step-timeout",
            ) from error
        except (Exception, SystemExit) as error:  # third-party code, which must not end the host
            call_name = f"{self.name}.{method.__name__}"
            raise BackendError(f"{call_name} failed: {type(error).__name__}: {error}") from error

    return call_converting_exceptions  # pyright: ignore[reportReturnType]


class GuardedBackend(Backend):
    """A backend around another."""

    def __init__(self, inner: Backend) -> None:
        """Wrap a backend; nothing of it is called yet."""
        self._inner = inner
        self.name = type(inner).__name__
        self._sensor_keys: list[str] | None = None  # None: not read yet
        self._custom_messages: dict[str, CustomMessage] = {}  # custom messages, by key

    @_convert_exceptions
    def describe(self) -> RobotDescription:
        return self._inner.describe()

    @_convert_exceptions
    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        """Return the backend's samples, with every message encoded except the joint state."""
        samples = self._inner.sample(tick, timestamp_ns)
        encoded: dict[str, EncodedMessage] = {}
        key = keys.JOINTS  # key of the message that is being encoded, for the error
        try:
            # Only that it can be encoded: the safety core checks joint by joint whether the values are plausible.
            encode_unchecked(samples.joints)
            for key, message in samples.by_key.items():
                if key not in self._find_sensor_keys():
                    known = ", ".join(self._find_sensor_keys())
                    raise WireError(
                        "unknown_key", f"not a sensor of its description, which has {known}"
                    )
                encoded[key] = encode_checked(key, message, self._custom_messages.get(key))
        except WireError as error:
            raise BackendError(
                f"{self.name}.sample: {key} cannot be published: {error.detail}"
            ) from None
        return Samples(samples.joints, samples.by_key, encoded)

    @_convert_exceptions
    def enact(self, setpoints: SafeSetpoints, lifecycle: LifecycleState) -> None:
        self._inner.enact(setpoints, lifecycle)

    @_convert_exceptions
    def advance(self) -> None:
        self._inner.advance()

    @_convert_exceptions
    def faults(self) -> list[Fault]:
        return self._inner.faults()

    @_convert_exceptions
    def list_arming_obstacles(self) -> list[str]:
        return self._inner.list_arming_obstacles()

    @_convert_exceptions
    def close(self) -> None:
        self._inner.close()

    @_convert_exceptions
    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        """Begin or end a fault that the backend injects itself; return False if it does not support the fault."""
        return self._inner.inject(injection, begins=begins)

    def _find_sensor_keys(self) -> list[str]:
        """Return the keys of the described sensors. The description is read at the first call."""
        if self._sensor_keys is None:
            robot = self._inner.describe()
            self._custom_messages = find_custom_messages(robot)
            self._sensor_keys = [sensor.key for sensor in robot.sensors]
        return self._sensor_keys
