"""Compares desired with measured forces: aligned in time, and only while the body locomotes."""

import dataclasses

import msgspec
import numpy as np
import pytest

from snakesim_hal.wire.messages import ControlState, WorldContact
from snakesim_operator.results.metrics.force_tracking import measure_force_tracking
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import summarize_run

PERIOD_NS = 50_000_000


def make_state(
    cycle: int,
    desired_force_n: list[float],
    measured_force_n: list[float | None],
    *,
    moves: bool = True,
) -> ControlState:
    """Make the state of a controller with a push-point for each desired force."""
    points = [
        WorldContact(
            link=0,
            obstacle=f"peg_{i}",
            body_s_m=0.1 * i,
            position_w=(0.0, 0.0, 0.0),
            normal_w=(0.0, 1.0, 0.0),
            tangent_w=(1.0, 0.0, 0.0),
            force_w=(0.0, 1.0, 0.0),
        )
        for i in range(len(desired_force_n))
    ]
    return ControlState(
        tick=5 * cycle,
        timestamp_ns=cycle * PERIOD_NS,
        controller="any",
        state="Locomoting" if moves else "NotLocomoting",
        reason="",
        push_points=points,
        desired_force_n=desired_force_n,
        measured_force_n=measured_force_n,
    )


def test_force_tracking_accepts_forces_slightly_after_solution():
    desired_n = np.random.default_rng(1).uniform(2.0, 20.0, (60, 3)).tolist()
    delay = 2  # cycles by which the measured forces follow the desired ones
    measured_n = [[0.0] * 3] * delay + desired_n[:-delay]
    tracking = measure_force_tracking(
        [make_state(cycle, desired_n[cycle], measured_n[cycle]) for cycle in range(60)]
    )
    assert tracking is not None
    assert tracking.correlation == pytest.approx(1.0)
    assert tracking.median_error == pytest.approx(0.0)
    assert tracking.no_contact_fraction == 0.0


def test_force_tracking_counts_push_points_without_contact_while_moving():
    moving = [make_state(cycle, [4.0, 10.0, 0.2], [3.0, 0.0, 9.0]) for cycle in range(20)]
    tracking = measure_force_tracking(moving)
    assert tracking is not None
    assert tracking.no_contact_fraction == 0.5
    assert tracking.median_error == pytest.approx((0.25 + 1.0) / 2)
    # While the body is stationary, friction may carry the whole force.
    stationary = [make_state(cycle, [4.0], [0.0], moves=False) for cycle in range(20)]
    assert measure_force_tracking(stationary) is None
    without_sensor = [make_state(cycle, [4.0], []) for cycle in range(20)]
    assert measure_force_tracking(without_sensor) is None
    unmeasured = [make_state(cycle, [4.0], [None]) for cycle in range(20)]
    assert measure_force_tracking(unmeasured) is None


@pytest.mark.slow
def test_summary_has_force_tracking_if_forces_were_measured(record: RunRecord):
    assert any(
        state.measured_force_n and max(force or 0.0 for force in state.measured_force_n) > 1.0
        for state in record.control_states
    )
    summary = summarize_run(record, "complete")
    assert summary.desired_force_correlation is not None
    assert -1.0 <= summary.desired_force_correlation <= 1.0
    assert summary.desired_force_error is not None
    assert summary.empty_push_points is not None
    assert summary.desired_force_error > 0.0
    assert 0.0 < summary.empty_push_points < 0.5
    unmeasured_states = [
        msgspec.structs.replace(state, measured_force_n=[]) for state in record.control_states
    ]
    unmeasured = dataclasses.replace(record, control_states=unmeasured_states)
    assert summarize_run(unmeasured, "complete").desired_force_error is None
