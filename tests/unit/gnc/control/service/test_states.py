"""Tests the four locomotion states of the paper's Figure 6, and the recent advance of the body."""

import numpy as np
import pytest

from snakesim_gnc.control.service.advance import RecentAdvance
from snakesim_gnc.control.service.states import determine_locomotion_state

MOVING = {"usable_push_points": 3, "recent_displacement_m": 0.1}
PERIOD_S = 0.02  # from one position of the body's center to the next
STANDSTILL_M = 0.005  # a body that advances less in a second stands still


@pytest.mark.parametrize(
    ("changes", "expected_state", "expected_reason"),
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
def test_locomotion_state_has_a_reason(changes, expected_state, expected_reason):
    state, reason = determine_locomotion_state(**{**MOVING, **changes})
    assert state == expected_state
    assert expected_reason in reason


def measure_advances_m(speed_m_s, duration_s, noise_m=0.0):
    """Return the recent advance after each position of a body at constant speed, whose positions are noisy."""
    random = np.random.default_rng(1)
    advance = RecentAdvance()
    distances_m = []
    for sample in range(round(duration_s / PERIOD_S)):
        x, y, z = (random.standard_normal(3) * noise_m).tolist()
        time_s = sample * PERIOD_S
        advance.add_center(time_s, (x + speed_m_s * sample * PERIOD_S, y, z))
        distances_m.append(advance.distance_m)
    return distances_m


def test_recent_advance_is_that_of_the_last_second():
    distances_m = measure_advances_m(0.1, 5.0)
    assert distances_m[0] == 0.0
    assert distances_m[-1] == pytest.approx(0.1, rel=0.03)
    # The advance exceeds a standstill soon after the start.
    first_moving = next(i for i, distance_m in enumerate(distances_m) if distance_m >= STANDSTILL_M)
    assert first_moving * PERIOD_S < 0.3


def test_recent_advance_of_standing_body_ignores_noise():
    assert max(measure_advances_m(0.0, 100.0, noise_m=0.001)) < STANDSTILL_M


def test_recent_advance_is_zero_soon_after_body_stops():
    stop_s = 2.0
    advance = RecentAdvance()
    for sample in range(300):
        time_s = sample * PERIOD_S
        advance.add_center(time_s, (0.1 * min(time_s, stop_s), 0.0, 0.0))
        if time_s > stop_s + 1.4:
            assert advance.distance_m is not None
            assert advance.distance_m < STANDSTILL_M


def test_recent_advance_is_unknown_at_start_and_zero_after_gap():
    advance = RecentAdvance()
    assert advance.distance_m is None
    advance.add_center(0.0, (0.0, 0.0, 0.0))
    advance.add_center(5.0, (1.0, 0.0, 0.0))
    assert advance.distance_m == 0.0
    # A position that arrives too late is ignored.
    advance.add_center(4.0, (9.0, 0.0, 0.0))
    assert advance.distance_m == 0.0
