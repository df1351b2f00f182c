"""Finds the payloads that a fuzzed run must not get, because they are valid and would rightly have an effect.

A valid emergency stop stops the robot, and that is no finding. The fuzzing client withholds payloads that are valid to
the last byte, have the right encoding, and would have an effect. It sends everything else.
"""

from dataclasses import dataclass
from typing import Any

from snakesim_hal.base.errors import ConfigError, WireError
from snakesim_hal.model import fault_kinds
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
    SimulatorRequest,
)

CONTROLLER_PRIORITY = 100  # of the lease of a controller that requests no other priority


@dataclass(frozen=True)
class HeldCommand:
    """The lease of the controller that rightfully commands the robot during the fuzzing."""

    epoch: int
    sequence: int  # of its newest command that was overheard, which the client replays


class EffectDetector:
    """Detects samples that would have an effect."""

    def __init__(self, held: HeldCommand) -> None:
        self._held = held
        self._decoders: dict[str, MessageDecoder[Any]] = {
            format_encoding(message): MessageDecoder(message) for message in VERSIONS
        }

    def describe_effect(self, payload: bytes, encoding: str) -> str | None:
        """Return what a sample would rightly do, in a few words; None if it may be sent."""
        decoder = self._decoders.get(encoding)
        if decoder is None:
            return None
        try:
            message = decoder.decode(payload, encoding)
        except WireError:
            return None
        return self._describe_message(message)

    def _describe_message(self, message: Message) -> str | None:
        held = self._held
        match message:
            case Clock():  # the services have no other time
                return "a valid clock"
            case RobotStatus():  # observers of the run have no other news
                return "a valid status"
            case EstopRequest():
                return "an emergency stop"
            case LifecycleRequest(action="disarm" | "finish" | "reset"):
                # A reset would hide a fault.
                return f"a request to {message.action}"
            case SimulatorRequest():  # any client may change the time of a simulator
                return f"a request to {message.action} the simulator"
            case LeaseRequest(action="acquire") if message.priority > CONTROLLER_PRIORITY:
                return "a claim of higher priority"
            case LeaseRequest(action="release" | "renew") if message.epoch == held.epoch:
                return f"a {message.action} of the live lease"
            case JointCommand() if _is_next_command(message, held):
                return "a command under the live lease"
            case FaultRequest() if _is_known_fault(message):
                return "a fault on request"
            case _:
                return None


def _is_next_command(command: JointCommand, held: HeldCommand) -> bool:
    return command.lease_epoch == held.epoch and command.sequence > held.sequence


def _is_known_fault(request: FaultRequest) -> bool:
    injection = FaultInjection(request.kind, request.target)
    try:
        fault_kinds.validate_and_complete_injection(injection)
    except ConfigError:
        return False
    return True
