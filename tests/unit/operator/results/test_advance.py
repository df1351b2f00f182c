"""Checks the numbers of a summary about the goal of a mission, on simulated runs with a known motion."""

import dataclasses
from functools import cache
from typing import Any

import numpy as np
import pytest

from snakesim_hal.model.scenario import KeyOverride, load_scenario
from snakesim_operator.results.summary import summarize_run
from snakesim_operator.run.in_process import InProcessResult, simulate

GOAL_M = 0.3
DURATION_S = 2.5
HEADING_GOAL = {"kind": "heading", "distance_m": GOAL_M}


GOALS: dict[str, dict[str, Any]] = {
    "heading": HEADING_GOAL,
    "too far": {**HEADING_GOAL, "distance_m": 50.0},
    "backward": {**HEADING_GOAL, "heading_rad": np.pi},
    "points": {"kind": "waypoints", "points_m": [[1.7, 0.0], [1.9, 0.0]], "within_m": 0.05},
}


@cache
def simulate_run(controller: str, goal: str = "") -> InProcessResult:
    """Simulate the scenario `peg_row` with this controller, and with this goal of GOALS if there is one."""
    values: dict[str, Any] = {"controller": controller, "duration_s": DURATION_S}
    if goal:
        values["mission.goal"] = GOALS[goal]
    overrides = [KeyOverride(key, value, "--set") for key, value in values.items()]
    return simulate(load_scenario("peg_row", overrides).config)


def find_center_x_m(result: InProcessResult, row: int) -> float:
    """Return x of the center of mass in a row; all links of this robot have the same mass."""
    nodes = result.record.find_body_points_w(row)
    assert nodes is not None
    return float(np.mean(0.5 * (nodes[:-1, 0] + nodes[1:, 0])))


def test_advance_reaches_goal_when_whole_body_has_advanced() -> None:
    result = simulate_run("path_following", goal="heading")
    summary = result.summary
    record = result.record
    assert summary.reached_goal is True
    assert summary.goal_m == summary.advance_m == GOAL_M
    assert summary.goal_reached_s is not None
    assert summary.advance_m_s == pytest.approx(GOAL_M / summary.goal_reached_s)
    row = record.find_nearest_row(record.time_s[0] + summary.goal_reached_s)
    advance_m = find_center_x_m(result, row) - find_center_x_m(result, 0)
    assert advance_m == pytest.approx(GOAL_M, abs=0.01)
    period_s = 0.01
    energy_j = np.abs(record.torque_nm * record.velocity_rad_s)[: row + 1].sum() * period_s
    assert summary.energy_j_per_m == pytest.approx(energy_j / GOAL_M, rel=0.02)
    assert summary.stalled_s == 0


@pytest.mark.slow
def test_advance_goal_out_of_reach_is_not_reached() -> None:
    summary = simulate_run("path_following", goal="too far").summary
    assert summary.reached_goal is False
    assert summary.goal_reached_s is None
    assert summary.goal_m == 50
    assert summary.advance_m is not None
    assert 0.4 < summary.advance_m < 1


@pytest.mark.slow
def test_advance_backward_is_zero() -> None:
    summary = simulate_run("path_following", goal="backward").summary
    assert summary.reached_goal is False
    assert summary.advance_m == pytest.approx(0, abs=0.01)
    assert summary.energy_j_per_m is None


@pytest.mark.slow
def test_advance_to_points_is_that_of_the_head() -> None:
    result = simulate_run("path_following", goal="points")
    summary = result.summary
    start_nodes = result.record.find_body_points_w(0)
    assert start_nodes is not None
    head_x, head_y = start_nodes[-1, :2]
    assert summary.goal_m == pytest.approx(np.hypot(1.7 - head_x, head_y) + 0.2)
    assert summary.reached_goal is True
    assert summary.goal_reached_s is not None
    goal_row = result.record.find_nearest_row(result.record.time_s[0] + summary.goal_reached_s)
    goal_nodes = result.record.find_body_points_w(goal_row)
    assert goal_nodes is not None
    assert np.hypot(1.9 - goal_nodes[-1, 0], goal_nodes[-1, 1]) < 0.06


@pytest.mark.slow
def test_advance_of_stationary_body_is_all_stalled() -> None:
    summary = simulate_run("hold", goal="heading").summary
    assert summary.stalled_s == pytest.approx(DURATION_S - 1.0, abs=0.2)
    assert summary.reached_goal is False


def test_advance_without_goal_is_forward_distance() -> None:
    summary = simulate_run("path_following").summary
    assert summary.goal_m is summary.reached_goal is None
    assert summary.advance_m == pytest.approx(summary.net_displacement_m, rel=0.02)


def test_summary_separates_work_of_torque_and_position_joints() -> None:
    with_torque = simulate_run("obstacle_triplet").summary
    position_only = simulate_run("path_following").summary
    assert position_only.torque_joints_j == 0
    assert position_only.position_joints_j
    assert with_torque.torque_joints_j is not None
    assert with_torque.torque_joints_j > 1
    assert with_torque.energy_j is not None
    assert with_torque.energy_j > with_torque.torque_joints_j


@pytest.mark.slow
def test_advance_of_run_ending_at_goal_keeps_its_numbers() -> None:
    full_run = simulate_run("path_following", goal="heading")
    short_run = simulate(full_run.record.config, until_goal=True)
    assert short_run.summary.ended == "complete"
    assert len(short_run.record.time_s) < len(full_run.record.time_s)
    for name in ("goal_reached_s", "advance_m", "energy_j_per_m", "stalled_s"):
        assert getattr(short_run.summary, name) == getattr(full_run.summary, name), name


def test_advance_of_sideways_travel_has_metrics_along_both_directions() -> None:
    """The run hardly advances along its first heading, so the energy per meter of that advance is unknown."""
    straight = simulate_run("path_following")
    record = straight.record
    # Rotate the motion by a quarter turn to the left, and keep the heading.
    rotated_w_m = record.position_w_m[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]
    sideways = summarize_run(dataclasses.replace(record, position_w_m=rotated_w_m), "complete")
    assert sideways.net_displacement_m == pytest.approx(
        straight.summary.net_displacement_m, rel=0.1
    )
    assert sideways.heading_advance_m is not None
    assert sideways.heading_advance_m < 0.1
    assert sideways.heading_energy_j_per_m is None
    assert sideways.displacement_energy_j_per_m == pytest.approx(
        (straight.summary.energy_j or 0.0) / (sideways.net_displacement_m or 1.0)
    )
    length_m = sum(link.length_m for link in record.description.links)
    expected = (sideways.net_displacement_m or 0.0) / DURATION_S / length_m
    assert sideways.displacement_body_lengths_s == pytest.approx(expected, rel=0.02)
    forward = straight.summary
    assert forward.heading_energy_j_per_m == pytest.approx(
        forward.displacement_energy_j_per_m, rel=0.02
    )
    assert forward.heading_body_lengths_s == pytest.approx(
        forward.displacement_body_lengths_s, rel=0.02
    )
