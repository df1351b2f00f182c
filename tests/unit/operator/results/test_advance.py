"""What the summary tells of a mission's goal: measured on runs whose end is known from elsewhere."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from snakesim_hal.model.scenario import KeyOverride, load_scenario
from snakesim_operator.results.summary import summarize_run
from snakesim_operator.run.in_process import InProcessResult, simulate

HEADING = {"kind": "heading", "distance_m": 0.3}


@cache
def simulate_run(controller: str, duration_s: float = 2.5, goal: str = "") -> InProcessResult:
    goals = {
        "heading": HEADING,
        "too far": {**HEADING, "distance_m": 50.0},
        "backward": {**HEADING, "heading_rad": np.pi},
        "points": {"kind": "waypoints", "points_m": [[1.7, 0.0], [1.9, 0.0]], "within_m": 0.05},
    }
    asked = {
        "controller": controller,
        "duration_s": duration_s,
        **({"mission.goal": goals[goal]} if goal else {}),
    }
    return simulate(
        load_scenario(
            "peg_row", [KeyOverride(key, value, "--set") for key, value in asked.items()]
        ).config
    )


def center_m(result: InProcessResult, row: int) -> float:
    """Along x; all links of this robot weigh the same."""
    nodes = result.record.find_body_points_w(row)
    assert nodes is not None
    return float(np.mean(0.5 * (nodes[:-1, 0] + nodes[1:, 0])))


def test_a_goal_is_reached_when_the_whole_body_has_advanced() -> None:
    result = simulate_run("path_following", goal="heading")
    reported, record = result.summary, result.record
    assert reported.reached_goal is True
    assert reported.goal_m == reported.advance_m == 0.3
    assert reported.goal_reached_s is not None
    assert reported.advance_m_s == pytest.approx(0.3 / reported.goal_reached_s)
    row = record.find_nearest_row(record.time_s[0] + reported.goal_reached_s)
    assert center_m(result, row) - center_m(result, 0) == pytest.approx(0.3, abs=0.01)
    used_j = np.abs(record.torque_nm * record.velocity_rad_s)[: row + 1].sum() * 0.01
    assert reported.energy_j_per_m == pytest.approx(used_j / 0.3, rel=0.02)
    assert reported.stalled_s == 0


@pytest.mark.slow
def test_advance_goal_out_of_reach_is_not_reached() -> None:
    reported = simulate_run("path_following", goal="too far").summary
    assert reported.reached_goal is False
    assert reported.goal_reached_s is None
    assert reported.goal_m == 50
    assert reported.advance_m is not None
    assert 0.4 < reported.advance_m < 1


@pytest.mark.slow
def test_advance_backward_is_zero() -> None:
    reported = simulate_run("path_following", goal="backward").summary
    assert reported.reached_goal is False
    assert reported.advance_m == pytest.approx(0, abs=0.01)
    assert reported.energy_j_per_m is None


@pytest.mark.slow
def test_points_are_passed_by_the_head() -> None:
    result = simulate_run("path_following", goal="points")
    reported, nodes = result.summary, result.record.find_body_points_w(0)
    assert nodes is not None
    head = nodes[-1, :2]
    assert reported.goal_m == pytest.approx(np.hypot(1.7 - head[0], head[1]) + 0.2)
    assert reported.reached_goal is True
    assert reported.goal_reached_s is not None
    last = result.record.find_body_points_w(
        result.record.find_nearest_row(result.record.time_s[0] + reported.goal_reached_s)
    )
    assert last is not None
    assert np.hypot(1.9 - last[-1, 0], last[-1, 1]) < 0.06


@pytest.mark.slow
def test_advance_of_standing_body_is_all_stalled() -> None:
    reported = simulate_run("hold", goal="heading").summary
    assert reported.stalled_s == pytest.approx(2.5 - 1.0, abs=0.2)
    assert reported.reached_goal is False


def test_advance_without_goal_is_forward_distance() -> None:
    reported = simulate_run("path_following").summary
    assert reported.goal_m is reported.reached_goal is None
    assert reported.advance_m == pytest.approx(reported.net_displacement_m, rel=0.02)


def test_the_work_of_torque_joints_is_told_apart() -> None:
    pushed, followed = (
        simulate_run("obstacle_triplet").summary,
        simulate_run("path_following").summary,
    )
    assert followed.torque_joints_j == 0
    assert followed.position_joints_j
    assert pushed.torque_joints_j is not None
    assert pushed.torque_joints_j > 1
    assert pushed.energy_j is not None
    assert pushed.energy_j > pushed.torque_joints_j


@pytest.mark.slow
def test_advance_of_run_ending_at_goal_keeps_its_numbers() -> None:
    whole = simulate_run("path_following", goal="heading")
    short = simulate(whole.record.config, until_goal=True)
    assert short.summary.ended == "complete"
    assert len(short.record.time_s) < len(whole.record.time_s)
    for name in ("goal_reached_s", "advance_m", "energy_j_per_m", "stalled_s"):
        assert getattr(short.summary, name) == getattr(whole.summary, name), name


def test_advance_of_sideways_travel_has_metrics_along_both_directions() -> None:
    """Along its first heading it hardly advances, and per metre of that its energy says nothing."""
    straight = simulate_run("path_following")
    record = straight.record
    # As if it had gone to its left, by a quarter of a turn.
    turned = record.position_w_m[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]
    sideways = summarize_run(dataclasses.replace(record, position_w_m=turned), "complete")
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
    expected = (sideways.net_displacement_m or 0.0) / 2.5 / length_m
    assert sideways.displacement_body_lengths_s == pytest.approx(expected, rel=0.02)
    ahead = straight.summary
    assert ahead.heading_energy_j_per_m == pytest.approx(
        ahead.displacement_energy_j_per_m, rel=0.02
    )
    assert ahead.heading_body_lengths_s == pytest.approx(
        ahead.displacement_body_lengths_s, rel=0.02
    )
