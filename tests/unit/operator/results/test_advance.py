"""What the summary tells of a mission's goal: measured on runs whose end is known from elsewhere."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from snakesim_hal.model.scenario import Override, load
from snakesim_operator.results.summary import summarise
from snakesim_operator.run.in_process import Result, simulate

HEADING = {"kind": "heading", "distance_m": 0.3}


@cache
def ran(controller: str, duration_s: float = 2.5, goal: str = "") -> Result:
    goals = {
        "heading": HEADING,
        "too far": {**HEADING, "distance_m": 50.0},
        "backward": {**HEADING, "heading_rad": np.pi},
        "points": {"kind": "waypoints", "points_m": [[1.7, 0.0], [1.9, 0.0]], "within_m": 0.05},
    }
    asked = {"controller": controller, "duration_s": duration_s, **({"mission.goal": goals[goal]} if goal else {})}
    return simulate(load("peg_row", [Override(key, value, "--set") for key, value in asked.items()]).config)


def center_m(result: Result, row: int) -> float:
    """Along x; all links of this robot weigh the same."""
    nodes = result.record.nodes_w(row)
    assert nodes is not None
    return float(np.mean(0.5 * (nodes[:-1, 0] + nodes[1:, 0])))


def test_a_goal_is_crossed_when_the_whole_body_has_advanced() -> None:
    result = ran("path_following", goal="heading")
    reported, record = result.summary, result.record
    assert reported.crossed is True and reported.goal_m == reported.advance_m == 0.3
    assert reported.crossed_s is not None and reported.advance_m_s == pytest.approx(0.3 / reported.crossed_s)
    row = record.row_at(record.time_s[0] + reported.crossed_s)
    assert center_m(result, row) - center_m(result, 0) == pytest.approx(0.3, abs=0.01)
    used_j = np.abs(record.torque_nm * record.velocity_rad_s)[: row + 1].sum() * 0.01
    assert reported.energy_j_per_m == pytest.approx(used_j / 0.3, rel=0.02)
    assert reported.stalled_s == 0


@pytest.mark.slow
def test_a_goal_out_of_reach_is_not() -> None:
    reported = ran("path_following", goal="too far").summary
    assert reported.crossed is False and reported.crossed_s is None and reported.goal_m == 50
    assert reported.advance_m is not None and 0.4 < reported.advance_m < 1


@pytest.mark.slow
def test_the_wrong_way_is_no_advance() -> None:
    reported = ran("path_following", goal="backward").summary
    assert (
        reported.crossed is False
        and reported.advance_m == pytest.approx(0, abs=0.01)
        and reported.energy_j_per_m is None
    )


@pytest.mark.slow
def test_points_are_passed_by_the_head() -> None:
    result = ran("path_following", goal="points")
    reported, nodes = result.summary, result.record.nodes_w(0)
    assert nodes is not None
    head = nodes[-1, :2]
    assert reported.goal_m == pytest.approx(np.hypot(1.7 - head[0], head[1]) + 0.2)
    assert reported.crossed is True and reported.crossed_s is not None
    last = result.record.nodes_w(result.record.row_at(result.record.time_s[0] + reported.crossed_s))
    assert last is not None and np.hypot(1.9 - last[-1, 0], last[-1, 1]) < 0.06


@pytest.mark.slow
def test_who_stands_has_stalled_all_the_time() -> None:
    reported = ran("hold", goal="heading").summary
    assert reported.stalled_s == pytest.approx(2.5 - 1.0, abs=0.2) and reported.crossed is False


def test_without_a_goal_it_is_the_way_ahead() -> None:
    reported = ran("path_following").summary
    assert reported.goal_m is reported.crossed is None and reported.advance_m == pytest.approx(
        reported.net_displacement_m, rel=0.02
    )


def test_the_work_of_torque_joints_is_told_apart() -> None:
    pushed, followed = ran("obstacle_triplet").summary, ran("path_following").summary
    assert followed.torque_joints_j == 0 and followed.position_joints_j
    assert pushed.torque_joints_j is not None and pushed.torque_joints_j > 1
    assert pushed.energy_j is not None and pushed.energy_j > pushed.torque_joints_j


@pytest.mark.slow
def test_advance_of_run_ending_at_goal_keeps_its_numbers() -> None:
    whole = ran("path_following", goal="heading")
    short = simulate(whole.record.config, until_goal=True)
    assert short.summary.ended == "complete" and len(short.record.time_s) < len(whole.record.time_s)
    for name in ("crossed_s", "advance_m", "energy_j_per_m", "stalled_s"):
        assert getattr(short.summary, name) == getattr(whole.summary, name), name


def test_advance_of_sideways_travel_has_metrics_along_both_directions() -> None:
    """Along its first heading it hardly advances, and per metre of that its energy says nothing."""
    straight = ran("path_following")
    record = straight.record
    turned = record.position_w[:, [1, 0, 2]] * [-1.0, 1.0, 1.0]  # as if it had gone to its left, by a quarter of a turn
    sideways = summarise(dataclasses.replace(record, position_w=turned), "complete")
    assert sideways.net_displacement_m == pytest.approx(straight.summary.net_displacement_m, rel=0.1)
    assert sideways.heading_advance_m is not None and sideways.heading_advance_m < 0.1
    assert sideways.heading_energy_j_per_m is None
    assert sideways.displacement_energy_j_per_m == pytest.approx(
        (straight.summary.energy_j or 0.0) / (sideways.net_displacement_m or 1.0)
    )
    length_m = sum(link.length_m for link in record.description.links)
    expected = (sideways.net_displacement_m or 0.0) / 2.5 / length_m
    assert sideways.displacement_body_lengths_s == pytest.approx(expected, rel=0.02)
    ahead = straight.summary
    assert ahead.heading_energy_j_per_m == pytest.approx(ahead.displacement_energy_j_per_m, rel=0.02)
    assert ahead.heading_body_lengths_s == pytest.approx(ahead.displacement_body_lengths_s, rel=0.02)
