"""The four states of the paper's Figure 6."""

import pytest

from snakesim_gnc.control.states import locomotion_state

READY = {"hal_answers": True, "armed": True, "wants_to_move": True, "usable_push_points": 3}


@pytest.mark.parametrize(
    ("change", "state", "word"),
    [
        ({}, "Locomoting", "pushing"),
        ({"usable_push_points": None}, "Locomoting", "moving"),
        ({"usable_push_points": 2}, "NotLocomoting", "2 usable push-points, 3 are needed"),
        ({"usable_push_points": 0, "obstacle": "lost"}, "NotLocomoting", "lost"),
        ({"obstacle": "jammed: x"}, "NotLocomoting", "jammed: x"),
        ({"wants_to_move": False}, "Idle", "wants"),
        ({"armed": False}, "Idle", "not armed"),
        ({"hal_answers": False}, "PowerOff", "no clock"),
    ],
)
def test_state_and_reason(change, state, word):
    found, reason = locomotion_state(**{**READY, **change})
    assert found == state
    assert word in reason
