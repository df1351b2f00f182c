"""A case that gets nowhere ends: in robot time when it is stuck, in wall time whatever its code does."""

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

ENDLESS = """
from snakesim_gnc.control.hold import HoldPose


class Endless(HoldPose):
    def update(self, observation):
        while True:
            pass
"""


def ran(
    controller: str, duration_s: float = 4, give_up_s: float = 12.0, limit_s: float = 600.0
) -> CaseOutcome:
    """What comes of the first case."""
    goal = {"kind": "heading", "distance_m": 0.3}
    always = {"duration_s": duration_s, "mission.goal": goal}
    suite = EvaluationSuite(scenario="peg_row", set=always, give_up_s=give_up_s, limit_s=limit_s)
    case = make_cases(suite, "here", [controller], 1, first_field=1)[0]
    return run_case(case.config, compute_code_digest(), case.stall_timeout_s, case.timeout_s)


@pytest.mark.slow
def test_who_comes_no_further_is_given_up() -> None:
    reported = ran("hold", give_up_s=1.0).numbers
    assert reported[GAVE_UP_FIELD] is True
    assert reported["reached_goal"] is False
    assert isinstance(reported["duration_s"], float)
    assert 1.0 <= reported["duration_s"] < 2.0


@pytest.mark.slow
def test_who_comes_on_is_not() -> None:
    reported = ran("path_following", give_up_s=1.0).numbers
    assert reported[GAVE_UP_FIELD] is False
    assert reported["reached_goal"] is True


@pytest.mark.slow
def test_endless_code_is_stopped_and_the_worker_goes_on(tmp_path: Path) -> None:
    (tmp_path / "endless.py").write_text(ENDLESS)
    began = time.monotonic()
    stopped = ran(f"{tmp_path}/endless.py:Endless", limit_s=3.0)
    assert stopped.error == "stopped after 3 s of wall time; the suite's `limit_s` allows no more"
    assert time.monotonic() - began < 30
    assert ran("hold", duration_s=0.2).error is None
