"""A trial that makes no progress ends: in robot time if the robot is stuck, in wall time whatever its code does."""

import time
from pathlib import Path

import pytest

from snakesim_operator.features.evaluate.suite import EvaluationSuite
from snakesim_operator.features.evaluate.trial import (
    ENDED_BY_STALL_METRIC,
    TrialOutcome,
    compute_code_digest,
    run_trial,
)
from snakesim_operator.features.evaluate.trial_list import make_trials

ENDLESS = """
from snakesim_gnc.control.hold import HoldPose


class Endless(HoldPose):
    def update(self, observation):
        while True:
            pass
"""


def run_first_trial(
    controller: str,
    duration_s: float = 4,
    stall_timeout_s: float = 12.0,
    wall_timeout_s: float = 600.0,
) -> TrialOutcome:
    """Run the first trial of a suite with a goal at 0.3 m, in this process."""
    goal = {"kind": "heading", "distance_m": 0.3}
    suite = EvaluationSuite(
        scenario="peg_row",
        set={"duration_s": duration_s, "mission.goal": goal},
        stall_timeout_s=stall_timeout_s,
        wall_timeout_s=wall_timeout_s,
    )
    trial = make_trials(suite, "here", [controller], 1, first_seed=1)[0]
    return run_trial(
        trial.config, compute_code_digest(), trial.stall_timeout_s, trial.wall_timeout_s
    )


@pytest.mark.slow
def test_trial_without_advance_is_ended_by_the_stall_timeout() -> None:
    metrics = run_first_trial("hold", stall_timeout_s=1.0).metrics
    assert metrics[ENDED_BY_STALL_METRIC] is True
    assert metrics["reached_goal"] is False
    assert isinstance(metrics["duration_s"], float)
    assert 1.0 <= metrics["duration_s"] < 2.0


@pytest.mark.slow
def test_trial_that_advances_is_not_ended_by_the_stall_timeout() -> None:
    metrics = run_first_trial("path_following", stall_timeout_s=1.0).metrics
    assert metrics[ENDED_BY_STALL_METRIC] is False
    assert metrics["reached_goal"] is True


@pytest.mark.slow
def test_endless_controller_is_stopped_and_the_next_trial_runs(tmp_path: Path) -> None:
    (tmp_path / "endless.py").write_text(ENDLESS)
    start_s = time.monotonic()
    stopped = run_first_trial(f"{tmp_path}/endless.py:Endless", wall_timeout_s=3.0)
    assert (
        stopped.error
        == "stopped after 3 s of wall time; the suite's `wall_timeout_s` allows no more"
    )
    assert time.monotonic() - start_s < 30
    assert run_first_trial("hold", duration_s=0.2).error is None
