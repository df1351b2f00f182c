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

from snakesim_hal.backend import Backend, Injectable, Samples, SetPoints
from snakesim_hal.errors import BackendError, SnakesimError, WireError
from snakesim_hal.model.injection import Injection
from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import Decoder, encode, encoding_of
from snakesim_hal.wire.messages import VERSIONS, Description, Fault, LifecycleState, Message

MethodT = TypeVar("MethodT", bound=Callable[..., Any])


def _guarded(method: MethodT) -> MethodT:
    @functools.wraps(method)
    def call(self: "GuardedBackend", *arguments: Any, **named: Any) -> Any:
        try:
            return method(self, *arguments, **named)
        except SnakesimError:
            raise
        except (Exception, SystemExit) as error:  # third-party code, which must not end the host
            where = f"{self.name}.{method.__name__}"
            raise BackendError(f"{where} failed: {type(error).__name__}: {error}") from error

    return call  # pyright: ignore[reportReturnType]


class GuardedBackend:
    """A `snakesim_hal.backend.Backend` around another."""

    def __init__(self, inner: Backend) -> None:
        self._inner = inner
        self.name = type(inner).__name__
        self._decoders: dict[str, Decoder[Any]] = {}

    @_guarded
    def describe(self) -> Description:
        """As the backend does."""
        return self._inner.describe()

    @_guarded
    def sample(self, tick: int, stamp_ns: int) -> Samples:
        """As the backend does, with the bytes of every message beside the joints."""
        samples = self._inner.sample(tick, stamp_ns)
        self._encode(keys.JOINTS, samples.joints)  # whether their values are plausible is judged joint by joint
        encoded: dict[str, bytes] = {}
        for key, message in samples.others.items():
            payload = encoded[key] = self._encode(key, message)
            decoder = self._decoder(key)
            try:
                decoder.decode(payload, encoding_of(type(message)))
            except WireError as error:
                raise self._wrong(key, str(error)) from None
        return replace(samples, encoded=encoded)

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

    def _encode(self, key: str, message: Message) -> bytes:
        if type(message) not in VERSIONS:
            raise self._wrong(key, f"a {type(message).__name__} is no message")
        try:
            return encode(message)
        except (TypeError, ValueError, OverflowError, RecursionError) as error:
            raise self._wrong(key, f"{type(error).__name__}: {error}") from None

    def _decoder(self, key: str) -> Decoder[Any]:
        """Of a described sensor's key."""
        if key not in self._decoders:
            described = [sensor.key for sensor in self._inner.describe().sensors]
            message = keys.message_at(key)
            if key not in described or message is None:
                raise self._wrong(key, f"not a sensor of its description, which has {', '.join(described)}")
            self._decoders[key] = Decoder(message)
        return self._decoders[key]

    def _wrong(self, key: str, why: str) -> BackendError:
        return BackendError(f"{self.name}.sample: {key} cannot be published: {why}")
