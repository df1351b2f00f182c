"""The four states of the paper's Figure 6, and what counts as moving."""

import numpy as np
import pytest

from snakesim_gnc.control.service.advance import RecentAdvance
from snakesim_gnc.control.service.states import determine_locomotion_state

READY = {"usable_push_points": 3, "recent_displacement_m": 0.1}


@pytest.mark.parametrize(
    ("change", "state", "word"),
    [
        ({}, "Locomoting", "pushing"),
        ({"usable_push_points": None}, "Locomoting", "moving"),
        ({"usable_push_points": 2}, "NotLocomoting", "2 usable push-points, 3 are needed"),
        ({"usable_push_points": 0, "obstruction_reason": "lost"}, "NotLocomoting", "lost"),
        ({"obstruction_reason": "jammed: x"}, "NotLocomoting", "jammed: x"),
        (
            {"recent_displacement_m": 0.004},
            "NotLocomoting",
            "standing still: less than 20 mm in 1 s",
        ),
        (
            {"recent_displacement_m": 0.004, "usable_push_points": None},
            "NotLocomoting",
            "standing still",
        ),
        (
            {"recent_displacement_m": 0.004, "standstill_reason": "contacts lost"},
            "NotLocomoting",
            "contacts lost",
        ),
        ({"standstill_reason": "contacts lost"}, "Locomoting", "pushing"),
        (
            {"recent_displacement_m": None},
            "NotLocomoting",
            "the motion of the body is not measured",
        ),
        ({"missing_inputs": "sensor/pose is 1 s old"}, "NotLocomoting", "sensor/pose is 1 s old"),
        ({"rest_reason": "speed zero"}, "Idle", "no motion intended: speed zero"),
        ({"is_armed": False}, "Idle", "the robot is not armed"),
        (
            {"is_armed": False, "missing_inputs": "sensor/joints is old"},
            "Idle",
            "not armed; sensor/joints is old",
        ),
        (
            {"silence_reason": "no clock from the HAL for 1 s"},
            "PowerOff",
            "no clock from the HAL for 1 s",
        ),
    ],
)
def test_states_have_a_reason(change, state, word):
    found, reason = determine_locomotion_state(**{**READY, **change})
    assert found == state
    assert word in reason


def advanced(speed_m_s, seconds, noise_m=0.0, every_s=0.02):
    rng, advance, far = np.random.default_rng(1), RecentAdvance(), []
    for tick in range(round(seconds / every_s)):
        x, y, z = (rng.standard_normal(3) * noise_m).tolist()
        advance.add_center(tick * every_s, (x + speed_m_s * tick * every_s, y, z))
        far.append(advance.distance_m)
    return far


def test_the_advance_is_that_of_the_last_second():
    far = advanced(0.1, 5.0)
    assert far[0] == 0.0
    assert far[-1] == pytest.approx(0.1, rel=0.03)
    # Soon after the start.
    assert next(i for i, metres in enumerate(far) if metres >= 0.005) * 0.02 < 0.3


def test_noise_is_no_advance():
    assert max(advanced(0.0, 100.0, noise_m=0.001)) < 0.005


def test_a_body_that_stops_stands_still_a_second_later():
    advance = RecentAdvance()
    for tick in range(300):
        advance.add_center(tick * 0.02, (0.1 * min(tick * 0.02, 2.0), 0.0, 0.0))
        if tick * 0.02 > 3.4:
            assert advance.distance_m is not None
            assert advance.distance_m < 0.005


def test_states_are_unknown_before_first_sample_and_after_a_gap():
    advance = RecentAdvance()
    assert advance.distance_m is None
    advance.add_center(0.0, (0.0, 0.0, 0.0))
    advance.add_center(5.0, (1.0, 0.0, 0.0))
    assert advance.distance_m == 0.0
    advance.add_center(4.0, (9.0, 0.0, 0.0))  # comes too late to say anything
    assert advance.distance_m == 0.0
