"""Gaits on flat ground, in the simulator: where they carry the body, and a robot that cannot do them."""

from typing import Any

import numpy as np
import pytest

from snakesim_gnc.control.gaits.axis_waves import RaisedHead, Rolling, Sidewinding
from snakesim_hal.controller import Controller
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.run.in_process import InProcessResult, simulate
from snakesim_testing.gnc.stage import make_stage


def on_flat_ground(*sets: str) -> InProcessResult:
    result = simulate(load_scenario("mamba_flat", [parse_set_option(text) for text in sets]).config)
    assert result.summary.ended == "complete"
    return result


def moved_m(record: RunRecord) -> np.ndarray:
    """Of the middle of the body, x and y; it lies along x at first."""
    rows = np.flatnonzero(record.has_pose)[[0, -1]]
    first, last = (record.find_body_points_w(int(row)) for row in rows)
    assert first is not None
    assert last is not None
    return (last - first).mean(axis=0)[:2]


@pytest.mark.parametrize(
    ("pitch_rad", "side"), [(0.2, -1.0), pytest.param(-0.2, 1.0, marks=pytest.mark.slow)]
)
def test_sidewinding_travels_sideways_to_the_requested_side(pitch_rad: float, side: float) -> None:
    along, across = moved_m(on_flat_ground("duration_s=5", f"control.pitch_rad={pitch_rad}").record)
    assert side * across > 0.8
    assert abs(along) < 0.6 * abs(across)


def test_rolling_travels_sideways() -> None:
    record = on_flat_ground("controller=rolling", "duration_s=5").record
    assert np.hypot(*moved_m(record)) > 0.4


@pytest.mark.slow
def test_raised_head_is_level_above_ground_and_looks_around() -> None:
    record = on_flat_ground("controller=raised_head", "duration_s=7").record
    shapes = [record.find_body_points_w(k) for k in range(400, 650)]
    heads = np.array([nodes[-2:] for nodes in shapes if nodes is not None])
    assert heads[..., 2].min() > 0.09
    assert np.abs(heads[:, 1, 2] - heads[:, 0, 2]).max() < 0.03
    run = heads[:, 1] - heads[:, 0]
    assert np.ptp(np.unwrap(np.arctan2(run[:, 1], run[:, 0]))) > 0.4


def test_at_speed_zero_a_gait_stands() -> None:
    result = on_flat_ground("controller=rolling", "mission.speed_m_s=0", "duration_s=2")
    assert np.hypot(*moved_m(result.record)) < 0.005


@pytest.mark.parametrize("gait", [Sidewinding, Rolling, RaisedHead])
def test_gait_of_bent_robot_keeps_shape_and_states_reason(gait: type[Controller[Any]]) -> None:
    stage = make_stage()
    controller = gait(stage.robot, gait.Parameters())
    commands = [controller.update(stage.make_observation(tick, 0.3)) for tick in range(200)]
    targets = [command.setpoints.target for command in commands]
    assert all(
        "no joints that turn up and down" in command.telemetry.reason for command in commands
    )
    assert np.abs(targets[0]).max() > 0.2
    assert np.abs(np.array(targets) - targets[0]).max() < 1e-9
