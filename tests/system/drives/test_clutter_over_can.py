"""A robot of emulated joint modules on CAN crosses clutter with the unchanged guidance, navigation and control."""

import numpy as np
import pytest

from snakesim_operator.results.metrics.advance import ForwardProgress
from snakesim_operator.run.in_process import InProcessResult, simulate
from snakesim_testing.runs.whole_run import load_run_config

FAULT_TIME_S = 3.0


def run_clutter_over_can(*options: str) -> InProcessResult:
    """Run the shipped scenario with the CAN backend and these options."""
    return simulate(load_run_config("surveyed_clutter", "backend=can", *options), until_goal=True)


@pytest.mark.slow
def test_clutter_run_over_can_continues_without_lost_joint() -> None:
    result = run_clutter_over_can(
        "duration_s=6",
        "robot.safety.max_isolated_joints=1",
        f'faults=["mute:joint_7@{FAULT_TIME_S}"]',
    )
    assert result.summary.ended == "complete"
    assert list(result.record.host.isolated) == ["joint_7"]
    advance = ForwardProgress.from_run(result.record)
    assert advance is not None
    before_m = float(np.interp(FAULT_TIME_S, advance.time_s, advance.max_advance_m))
    assert before_m > 0.4, "the snake did not move before the fault"
    assert advance.max_advance_m[-1] > before_m + 0.2, "the snake did not move after the fault"


@pytest.mark.slow
def test_clutter_run_over_can_reaches_the_goal() -> None:
    summary = run_clutter_over_can().summary
    assert summary.reached_goal is True
    assert not summary.faults
