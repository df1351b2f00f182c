"""Payloads that a fuzzed run must not get, because they are right: they would do what they say.

An emergency stop that is well formed stops the robot; that is no finding. What is held back here is valid to the last
byte, under the right encoding, and would have an effect: everything else is sent.
"""

from dataclasses import dataclass
from typing import Any

from snakesim_hal.base.errors import ConfigError, WireError
from snakesim_hal.model import fault_kinds as injection
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.wire.codec import MessageDecoder, format_encoding
from snakesim_hal.wire.messages import (
    VERSIONS,
    Clock,
    EstopRequest,
    FaultRequest,
    JointCommand,
    LeaseRequest,
    LifecycleRequest,
    Message,
    RobotStatus,
)

PRIORITY = 100  # of a controller that asks for nothing else


@dataclass(frozen=True)
class HeldCommand:
    """What the robot's rightful controller holds while the fuzzing goes on."""

    epoch: int
    sequence: int  # the newest of its commands that was overheard; it is replayed


class EffectiveSamples:
    """Knows which samples are effective."""

    def __init__(self, live: HeldCommand) -> None:
        self._live = live
        self._decoders: dict[str, MessageDecoder[Any]] = {
            format_encoding(message): MessageDecoder(message) for message in VERSIONS
        }

    def effect(self, payload: bytes, encoding: str) -> str | None:
        """What a sample would do by right, in a few words; None when it may be sent."""
        decoder = self._decoders.get(encoding)
        if decoder is None:
            return None
        try:
            return self._effect_of(decoder.decode(payload, encoding))
        except WireError:
            return None

    def _effect_of(self, message: Message) -> str | None:
        live = self._live
        match message:
            case Clock():  # the services have no other time
                return "a valid clock"
            case RobotStatus():  # whoever looks at the run has no other news
                return "a valid status"
            case EstopRequest():
                return "an emergency stop"
            case LifecycleRequest(action="disarm" | "finish" | "reset"):
                # A reset, because it would cover up a fault.
                return f"a request to {message.action}"
            case LeaseRequest(action="acquire") if message.priority > PRIORITY:
                return "a claim of higher priority"
            case LeaseRequest(action="release" | "renew") if message.epoch == live.epoch:
                return f"a {message.action} of the live lease"
            case JointCommand() if (
                message.lease_epoch == live.epoch and message.sequence > live.sequence
            ):
                return "a command under the live lease"
            case FaultRequest() if _is_known(message):
                return "a fault on request"
            case _:
                return None


def _is_known(request: FaultRequest) -> bool:
    try:
        injection.validate_and_complete_injection(FaultInjection(request.kind, request.target))
    except ConfigError:
        return False
    return True
