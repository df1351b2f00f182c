"""The lifecycle, as one table."""

from typing import get_args

from snakesim_hal.safety.lifecycle import Event, after
from snakesim_hal.wire.messages import LifecycleState

STATES, EVENTS = get_args(LifecycleState), get_args(Event)


def test_only_arming_while_disarmed_leads_to_armed() -> None:
    assert [(s, e) for s in STATES for e in EVENTS if after(s, e) == "armed"] == [("disarmed", "arm")]


def test_only_clear_leads_out_of_a_latched_state() -> None:
    for state in ("fault", "estop"):
        out = {event for event in EVENTS if after(state, event) not in (None, "fault", "estop")}
        assert out == {"clear"}


def test_a_stop_is_possible_in_every_state() -> None:
    assert all(after(state, "estop") == "estop" for state in STATES)
    assert all(after(state, "fault") in ("fault", "estop") for state in STATES)
