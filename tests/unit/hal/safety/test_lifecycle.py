"""The lifecycle, as one table."""

from typing import get_args

import pytest

from snakesim_hal.safety.lifecycle import Event, after
from snakesim_hal.wire.messages import LifecycleState

STATES, EVENTS = get_args(LifecycleState), get_args(Event)
TABLE: dict[str, dict[str, str | None]] = {
    "disarmed": {"arm": "armed", "disarm": "disarmed", "fault": "fault", "estop": "estop", "clear": "disarmed"},
    "armed": {"arm": None, "disarm": "disarmed", "fault": "fault", "estop": "estop", "clear": None},
    "fault": {"arm": None, "disarm": None, "fault": "fault", "estop": "estop", "clear": "disarmed"},
    "estop": {"arm": None, "disarm": None, "fault": "estop", "estop": "estop", "clear": "disarmed"},
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("event", EVENTS)
def test_transition(state: LifecycleState, event: Event) -> None:
    assert after(state, event) == TABLE[state][event]


def test_the_table_is_complete() -> None:
    assert set(TABLE) == set(STATES) and all(set(row) == set(EVENTS) for row in TABLE.values())


def test_only_arming_while_disarmed_leads_to_armed() -> None:
    assert [(s, e) for s in STATES for e in EVENTS if after(s, e) == "armed"] == [("disarmed", "arm")]


def test_only_clear_leads_out_of_a_latched_state() -> None:
    for state in ("fault", "estop"):
        out = {event for event in EVENTS if after(state, event) not in (None, "fault", "estop")}
        assert out == {"clear"}


def test_a_stop_is_possible_in_every_state() -> None:
    assert all(after(state, "estop") == "estop" for state in STATES)
    assert all(after(state, "fault") in ("fault", "estop") for state in STATES)
