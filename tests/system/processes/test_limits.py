"""A trial without progress ends: by robot time if the robot is stuck, and by wall time if its code never returns."""

import time
from pathlib import Path

import pytest

from snakesim_operator.features.evaluate.case import (
    GAVE_UP_FIELD,
    CaseOutcome,
    compute_code_digest,
    run_case,
)
from snakesim_operator.features.evaluate.suite import EvaluationSuite, make_cases

ENDLESS_CODE = """
from snakesim_gnc.control.hold import HoldPose


class Endless(HoldPose):
    def update(self, observation):
        while True:
            pass
"""


def run_first_trial(
    controller: str, duration_s: float = 4, give_up_s: float = 12.0, limit_s: float = 600.0
) -> CaseOutcome:
    """Run the first trial of a suite with this controller and these limits."""
    goal = {"kind": "heading", "distance_m": 0.3}
    settings = {"duration_s": duration_s, "mission.goal": goal}
    suite = EvaluationSuite(scenario="peg_row", set=settings, give_up_s=give_up_s, limit_s=limit_s)
    case = make_cases(suite, "here", [controller], 1, first_field=1)[0]
    return run_case(case.config, compute_code_digest(), case.stall_timeout_s, case.timeout_s)


@pytest.mark.slow
def test_trial_without_progress_is_given_up() -> None:
    numbers = run_first_trial("hold", give_up_s=1.0).numbers
    assert numbers[GAVE_UP_FIELD] is True
    assert numbers["reached_goal"] is False
    assert isinstance(numbers["duration_s"], float)
    assert 1.0 <= numbers["duration_s"] < 2.0


@pytest.mark.slow
def test_trial_with_progress_is_not_given_up() -> None:
    numbers = run_first_trial("path_following", give_up_s=1.0).numbers
    assert numbers[GAVE_UP_FIELD] is False
    assert numbers["reached_goal"] is True


@pytest.mark.slow
def test_trial_with_endless_code_is_stopped_and_next_one_runs(tmp_path: Path) -> None:
    (tmp_path / "endless.py").write_text(ENDLESS_CODE)
    start_s = time.monotonic()
    outcome = run_first_trial(f"{tmp_path}/endless.py:Endless", limit_s=3.0)
    assert outcome.error == "stopped after 3 s of wall time; the suite's `limit_s` allows no more"
    assert time.monotonic() - start_s < 30
    assert run_first_trial("hold", duration_s=0.2).error is None
