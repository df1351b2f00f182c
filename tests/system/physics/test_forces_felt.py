"""`obstacle_aided` and what it pushes off: forces that come true, and no obstacle at all."""

from functools import partial
from typing import Any

import pytest

import snakesim
from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.metrics.force_tracking import measure_force_tracking

ROUGH = {"scene.pegs_along_route.0.friction": 0.3, "mission.assumed_obstacle_friction": 0.3}
FIELD: dict[str, Any] = {"scene.random_field.0.seed": 5413, "seed": 5413}


slow = partial(pytest.param, marks=pytest.mark.slow)


@pytest.mark.parametrize(
    ("scenario", "also", "correlation", "error", "empty"),
    [
        ("triplet", {}, 0.9, 0.2, 0.05),
        slow("triplet", {"backend": "can"}, 0.9, 0.2, 0.05),
        slow("peg_row", {}, 0.65, 0.3, 0.05),
        slow("peg_row", {"mission.speed_m_s": 0.1}, 0.9, 0.2, 0.05),
        slow("peg_row", ROUGH, 0.8, 0.23, 0.05),
        slow("surveyed_clutter", FIELD, 0.3, 0.35, 0.15),
    ],
)
def test_requested_obstacle_forces_are_reached_while_moving(
    scenario: str, also: dict[str, Any], correlation: float, error: float, empty: float
):
    result = snakesim.run(scenario, controller="obstacle_aided", duration=6, set=also)
    found = measure_force_tracking(result.record.control_states)
    assert found is not None
    assert found.correlation is not None
    assert found.correlation > correlation
    assert found.median_error < error
    assert found.no_contact_fraction < empty


def test_drives_without_torque_mode_push_by_their_shape():
    only_position = {"robot.drive.modes": ["position"]}
    found = snakesim.run("peg_row", controller="obstacle_aided", duration=4, set=only_position)
    assert (found.summary.advance_m or 0.0) > 0.7
    assert JointMode.TORQUE not in found.record.mode


@pytest.mark.slow
def test_body_without_push_points_moves_towards_goal():
    alone = {"scene.random_field": [], "scene.pegs_along_route": [], "start.on_route": False}
    found = snakesim.run(
        "surveyed_clutter", controller="obstacle_aided", duration=6, set=alone
    ).summary
    assert "in search of contacts" in (found.reported_reason or "")
    assert (found.advance_m or 0.0) > 0.2  # 0.00 with a wave that travels to the tail
