"""Solved against measured forces: aligned in time, judged only while the body locomotes, and in a run's summary."""

import dataclasses

import msgspec
import numpy as np
import pytest

from snakesim_hal.wire.messages import ControlState, WorldContact
from snakesim_operator.results.metrics.force_tracking import measure_force_tracking
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import summarize_run

EVERY_NS = 50_000_000


def state(
    k: int,
    desired_force_n: list[float],
    measured_force_n: list[float | None],
    *,
    moves: bool = True,
) -> ControlState:
    points = [
        WorldContact(
            link=0, obstacle=f"peg_{i}", body_s_m=0.1 * i, position_w=(0.0, 0.0, 0.0), normal_w=(0.0, 1.0, 0.0),
            tangent_w=(1.0, 0.0, 0.0), force_w=(0.0, 1.0, 0.0),
        )
        for i in range(len(desired_force_n))
    ]  # fmt: skip
    return ControlState(
        tick=5 * k, timestamp_ns=k * EVERY_NS, controller="any", state="Locomoting" if moves else "NotLocomoting",
        reason="", push_points=points, desired_force_n=desired_force_n, measured_force_n=measured_force_n,
    )  # fmt: skip


def test_force_tracking_accepts_forces_slightly_after_solution():
    solved = np.random.default_rng(1).uniform(2.0, 20.0, (60, 3)).tolist()
    found = measure_force_tracking(
        [state(k, solved[k], solved[k - 2] if k > 1 else [0.0] * 3) for k in range(60)]
    )
    assert found is not None
    assert found.correlation == pytest.approx(1.0)
    assert found.median_error == pytest.approx(0.0)
    assert found.no_contact_fraction == 0.0


def test_force_tracking_counts_empty_push_points_but_not_unjudged_ones():
    moving = [state(k, [4.0, 10.0, 0.2], [3.0, 0.0, 9.0]) for k in range(20)]
    found = measure_force_tracking(moving)
    assert found is not None
    assert found.no_contact_fraction == 0.5
    assert found.median_error == pytest.approx((0.25 + 1.0) / 2)
    assert (
        measure_force_tracking([state(k, [4.0], [0.0], moves=False) for k in range(20)]) is None
    )  # friction may take all of it
    # No sensor tells.
    assert measure_force_tracking([state(k, [4.0], []) for k in range(20)]) is None
    assert measure_force_tracking([state(k, [4.0], [None]) for k in range(20)]) is None


@pytest.mark.slow
def test_force_tracking_summary_states_how_well_forces_matched(record: RunRecord):
    assert any(
        one.measured_force_n and max(n or 0.0 for n in one.measured_force_n) > 1.0
        for one in record.control_states
    )
    summary = summarize_run(record, "complete")
    assert summary.desired_force_correlation is not None
    assert -1.0 <= summary.desired_force_correlation <= 1.0
    assert summary.desired_force_error is not None
    assert summary.empty_push_points is not None
    assert summary.desired_force_error > 0.0
    assert 0.0 < summary.empty_push_points < 0.5
    blind = [msgspec.structs.replace(one, measured_force_n=[]) for one in record.control_states]
    assert (
        summarize_run(
            dataclasses.replace(record, control_states=blind), "complete"
        ).desired_force_error
        is None
    )
