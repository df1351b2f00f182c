"""The lifecycle has the transitions of one table."""

from typing import get_args

import pytest

from snakesim_hal.safety.lifecycle import LifecycleEvent, next_state
from snakesim_hal.wire.messages import LifecycleState

STATES = get_args(LifecycleState)
EVENTS = get_args(LifecycleEvent)
TRANSITIONS: dict[str, dict[str, str | None]] = {
    "disarmed": {
        "arm": "armed",
        "disarm": "disarmed",
        "fault": "fault",
        "estop": "estop",
        "reset": "disarmed",
    },
    "armed": {"arm": None, "disarm": "disarmed", "fault": "fault", "estop": "estop", "reset": None},
    "fault": {"arm": None, "disarm": None, "fault": "fault", "estop": "estop", "reset": "disarmed"},
    "estop": {"arm": None, "disarm": None, "fault": "estop", "estop": "estop", "reset": "disarmed"},
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("event", EVENTS)
def test_lifecycle_transition_equals_the_table(
    state: LifecycleState, event: LifecycleEvent
) -> None:
    assert next_state(state, event) == TRANSITIONS[state][event]
