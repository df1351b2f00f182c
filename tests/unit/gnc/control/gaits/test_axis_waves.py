"""Tests where gaits of alternating joints carry a simulated body on flat ground, and what a planar robot does."""

from typing import Any

import numpy as np
import pytest

from snakesim_gnc.control.gaits.axis_waves import RaisedHead, Rolling, Sidewinding
from snakesim_hal.controller import Controller
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import InProcessResult, simulate
from snakesim_testing.gnc.stage import make_stage


def simulate_on_flat_ground(*options: str) -> InProcessResult:
    """Run the scenario of flat ground with these overrides."""
    overrides = [parse_set_option(option) for option in options]
    result = simulate(load_scenario("mamba_flat", overrides).config)
    assert result.summary.ended == "complete"
    return result


def measure_displacement_m(record: RunRecord) -> np.ndarray:
    """Return x and y by which the middle of the body moved. The body lies along x at the start."""
    rows = np.flatnonzero(record.has_pose)[[0, -1]]
    first, last = (record.find_body_points_w(int(row)) for row in rows)
    assert first is not None
    assert last is not None
    return (last - first).mean(axis=0)[:2]


@pytest.mark.parametrize(
    ("pitch_rad", "side"), [(0.2, -1.0), pytest.param(-0.2, 1.0, marks=pytest.mark.slow)]
)
def test_sidewinding_travels_sideways_to_the_requested_side(pitch_rad: float, side: float) -> None:
    result = simulate_on_flat_ground("duration_s=5", f"control.pitch_rad={pitch_rad}")
    along_m, across_m = measure_displacement_m(result.record)
    assert side * across_m > 0.8
    assert abs(along_m) < 0.6 * abs(across_m)


def test_rolling_travels_sideways() -> None:
    record = simulate_on_flat_ground("controller=rolling", "duration_s=5").record
    assert np.hypot(*measure_displacement_m(record)) > 0.4


@pytest.mark.slow
def test_raised_head_is_level_above_ground_and_looks_around() -> None:
    record = simulate_on_flat_ground("controller=raised_head", "duration_s=7").record
    bodies_w = [record.find_body_points_w(row) for row in range(400, 650)]
    # The rear and the front end of the last link.
    heads_w = np.array([body_w[-2:] for body_w in bodies_w if body_w is not None])
    assert heads_w[..., 2].min() > 0.09
    assert np.abs(heads_w[:, 1, 2] - heads_w[:, 0, 2]).max() < 0.03
    directions_w = heads_w[:, 1] - heads_w[:, 0]
    headings_rad = np.unwrap(np.arctan2(directions_w[:, 1], directions_w[:, 0]))
    assert np.ptp(headings_rad) > 0.4


def test_gait_at_speed_zero_does_not_move() -> None:
    result = simulate_on_flat_ground("controller=rolling", "mission.speed_m_s=0", "duration_s=2")
    assert np.hypot(*measure_displacement_m(result.record)) < 0.005


@pytest.mark.parametrize("gait", [Sidewinding, Rolling, RaisedHead])
def test_gait_of_planar_robot_keeps_shape_and_states_reason(gait: type[Controller[Any]]) -> None:
    stage = make_stage()
    controller = gait(stage.robot, gait.Parameters())
    commands = [controller.update(stage.make_observation(tick, 0.3)) for tick in range(200)]
    targets_rad = [command.setpoints.target for command in commands]
    assert all(
        "no joints that turn up and down" in command.telemetry.reason for command in commands
    )
    assert np.abs(targets_rad[0]).max() > 0.2
    assert np.abs(np.array(targets_rad) - targets_rad[0]).max() < 1e-9
