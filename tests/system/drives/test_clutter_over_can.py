"""Through clutter with the CAN backend: the same guidance, navigation and control on emulated joint modules."""

import numpy as np
import pytest

from snakesim_operator.results.metrics.advance import ForwardProgress
from snakesim_operator.run.in_process import InProcessResult, simulate
from snakesim_testing.runs.whole_run import load_run_config

LOST_S = 3.0


def over_can(*sets: str) -> InProcessResult:
    """The shipped scenario with nothing changed but the backend and these."""
    return simulate(load_run_config("surveyed_clutter", "backend=can", *sets), until_goal=True)


@pytest.mark.slow
def test_clutter_run_over_can_continues_without_lost_joint() -> None:
    reported = over_can(
        "duration_s=6", "robot.safety.max_isolated_joints=1", f'faults=["mute:joint_7@{LOST_S}"]'
    )
    assert reported.summary.ended == "complete"
    assert list(reported.record.host.isolated) == ["joint_7"]
    advance = ForwardProgress.from_run(reported.record)
    assert advance is not None
    before_m = float(np.interp(LOST_S, advance.time_s, advance.max_advance_m))
    assert before_m > 0.4, "it moved before"
    assert advance.max_advance_m[-1] > before_m + 0.2, "and moves on"


@pytest.mark.slow
def test_it_crosses() -> None:
    reported = over_can().summary
    assert reported.reached_goal is True
    assert not reported.faults
