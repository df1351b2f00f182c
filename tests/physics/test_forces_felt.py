"""`obstacle_aided` and what it pushes off: forces that are felt, and no obstacle at all."""

import snakesim
from snakesim_operator.results.came_true import came_true

LISTENING = {
    "control.slides": 1.0,
    "control.servo_lag_s": 0.045,
    "control.empty_price": 40.0,
    "control.felt_push_s": 0.3,
    "control.push_ns_m": 15.0,
    "control.largest_look_ahead_m": 0.02,
    "control.lead_s": 0.02,
    "control.integral_per_s": 0.1,
    "control.speed_filter_s": 0.15,
}


def test_a_slow_body_that_feels_its_contacts_asks_hardly_anything_of_those_that_are_empty():
    slow = {"mission.speed_m_s": 0.05, **LISTENING}
    result = snakesim.run("peg_row", controller="obstacle_aided", duration=7, set=slow)
    found = came_true(result.record.control)
    assert found is not None
    assert found.empty < 0.1  # 0.45 without
    assert (result.summary.advance_m or 0.0) > 0.2


def test_a_body_that_nothing_can_push_moves_on_towards_its_goal():
    alone = {"scene.random_field": [], "scene.pegs_along_route": [], "start.on_route": False}
    found = snakesim.run("surveyed_clutter", controller="obstacle_aided", duration=6, set=alone).summary
    assert "in search of contacts" in (found.last_reason or "")
    assert (found.advance_m or 0.0) > 0.2  # 0.00 with a wave that travels to the tail
