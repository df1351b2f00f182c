"""Checks which valid requests the fuzzing client withholds."""

from typing import Literal

import pytest

from snakesim_hal.wire import keys
from snakesim_hal.wire.codec import encode, format_encoding
from snakesim_hal.wire.messages import (
    EstopRequest,
    FaultRequest,
    LeaseRequest,
    LifecycleRequest,
    Message,
    ParametersRequest,
    SimulatorRequest,
    TickDone,
)
from verification.fuzz.effects import EffectDetector, HeldCommand

HELD = HeldCommand(epoch=7, sequence=100)
# Of each of these, `effects` decides which ones have an effect.
REQUESTS_WITH_EFFECTS = {
    EstopRequest,
    FaultRequest,
    LeaseRequest,
    LifecycleRequest,
    SimulatorRequest,
}
# Whether a recorder has received all messages, and parameters, which the controller of the fuzzed run does not have.
REQUESTS_WITHOUT_EFFECT = {ParametersRequest, TickDone}


def describe_effect(message: Message) -> str | None:
    """Return what a valid message would do to the robot."""
    return EffectDetector(HELD).describe_effect(encode(message), format_encoding(type(message)))


def test_every_kind_of_request_is_considered() -> None:
    requests = {row.message for row in keys.SPACE if row.kind == "query"}
    assert requests == REQUESTS_WITH_EFFECTS | REQUESTS_WITHOUT_EFFECT


@pytest.mark.parametrize("action", ["pause", "resume", "step", "speed", "reset"])
def test_valid_simulator_request_is_withheld(
    action: Literal["pause", "resume", "step", "speed", "reset"],
) -> None:
    assert describe_effect(SimulatorRequest(action=action)) == (
        f"a request to {action} the simulator"
    )


def test_release_of_another_lease_is_sent() -> None:
    request = LeaseRequest(action="release", holder="control", epoch=HELD.epoch + 1)
    assert describe_effect(request) is None
