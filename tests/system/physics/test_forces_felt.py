"""`obstacle_aided` reaches the contact forces that it requests, and also moves without torque mode or obstacles."""

from functools import partial
from typing import Any

import pytest

import snakesim
from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.metrics.force_tracking import measure_force_tracking

ROUGH_PEGS = {"scene.pegs_along_route.0.friction": 0.3, "mission.assumed_obstacle_friction": 0.3}
RANDOM_SCENE: dict[str, Any] = {"scene.random_field.0.seed": 5413, "seed": 5413}

slow = partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("scenario", "settings", "min_correlation", "max_error", "max_no_contact_fraction"),
    [
        ("triplet", {}, 0.9, 0.2, 0.05),
        slow("triplet", {"backend": "can"}, 0.9, 0.2, 0.05),
        slow("peg_row", {}, 0.65, 0.3, 0.05),
        slow("peg_row", {"mission.speed_m_s": 0.1}, 0.9, 0.2, 0.05),
        slow("peg_row", ROUGH_PEGS, 0.8, 0.23, 0.05),
        slow("surveyed_clutter", RANDOM_SCENE, 0.3, 0.35, 0.15),
    ],
)
def test_requested_obstacle_forces_are_reached_while_moving(
    scenario: str,
    settings: dict[str, Any],
    min_correlation: float,
    max_error: float,
    max_no_contact_fraction: float,
):
    result = snakesim.run(scenario, controller="obstacle_aided", duration=6, set=settings)
    tracking = measure_force_tracking(result.record.control_states)
    assert tracking is not None
    assert tracking.correlation is not None
    assert tracking.correlation > min_correlation
    assert tracking.median_error < max_error
    assert tracking.no_contact_fraction < max_no_contact_fraction


@pytest.mark.heavy
def test_obstacle_aided_without_torque_mode_advances_in_position_mode():
    position_mode_only = {"robot.drive.modes": ["position"]}
    result = snakesim.run(
        "peg_row", controller="obstacle_aided", duration=4, set=position_mode_only
    )
    assert (result.summary.advance_m or 0.0) > 0.7
    assert JointMode.TORQUE not in result.record.mode


@pytest.mark.slow
def test_body_without_push_points_moves_towards_goal():
    no_obstacles = {
        "scene.random_field": [],
        "scene.pegs_along_route": [],
        "start.on_route": False,
    }
    summary = snakesim.run(
        "surveyed_clutter", controller="obstacle_aided", duration=6, set=no_obstacles
    ).summary
    assert "in search of contacts" in (summary.reported_reason or "")
    # With a wave that travels to the tail, the advance is 0.00 m.
    assert (summary.advance_m or 0.0) > 0.2
