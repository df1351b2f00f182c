"""A few trials of `python -m verification.soak.kills`, and tests of their judgement."""

import signal
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest

from verification.soak.kill_judgement import find_violations
from verification.soak.kill_trial import (
    BACKENDS,
    MOMENTS,
    SUPERVISOR,
    KillTrial,
    ProcessKill,
    draw_trials,
)
from verification.soak.killed_run import KillOutcome
from verification.soak.kills import carry_out

TRIALS = list(islice(draw_trials(11), 2 * len(MOMENTS)))
CARRIED_OUT_TRIALS = TRIALS[3:10]
FAST_INDICES = (0, 3)  # among the trials that are carried out; all others are slow tests
TRACEBACK = "fault: x\nTraceback (most recent call last):\nValueError: y"


@pytest.mark.e2e
@pytest.mark.parametrize(
    "trial",
    [
        pytest.param(trial, marks=[] if index in FAST_INDICES else [pytest.mark.slow])
        for index, trial in enumerate(CARRIED_OUT_TRIALS)
    ],
    ids=str,
)
def test_killed_run_leaves_nothing_wrong(tmp_path: Path, trial: KillTrial) -> None:
    _, violations = carry_out(trial, tmp_path / "trial")
    assert violations == []


def test_kills_of_one_seed_are_same_on_both_backends() -> None:
    assert list(islice(draw_trials(11), len(TRIALS))) == TRIALS
    expected = {(moment, backend) for moment in MOMENTS for backend in BACKENDS}
    assert {(trial.moment, trial.backend) for trial in TRIALS} == expected


@pytest.mark.parametrize(
    ("outcome", "expected_violation"),
    [
        ({"exit_code": 0}, "exit code 0 with None of 400 ticks armed"),
        ({"exit_code": 130}, "without an interrupt"),
        ({"exit_code": 1, "printed": "all is well"}, "without a message about a fault"),
        ({"exit_code": -11, "printed": "x"}, "exit code -11"),
        ({"exit_code": 1, "printed": TRACEBACK}, "ValueError: y"),
        (
            {"exit_code": 1, "printed": "fault: x", "logs": {"host": "thread panicked"}},
            "host: panicked",
        ),
        (
            {"exit_code": 1, "printed": "fault: x", "left_behind": ["12 python"]},
            "left behind: 12",
        ),
        ({"exit_code": 1, "printed": "fault: x", "stop_answered": True}, "not on the disk"),
        (
            {"exit_code": 1, "printed": "fault: x", "reset_answered": True, "stop_kept": True},
            "still on the disk",
        ),
        ({"exit_code": 1, "printed": "fault: x", "stop_answered": True, "stop_kept": True}, None),
        ({"exit_code": 130, "printed": "x", "interrupted": True}, None),
    ],
)
def test_kill_judgement_finds_what_is_wrong(
    outcome: dict[str, object], expected_violation: str | None
) -> None:
    kill = ProcessKill("host", signal.SIGKILL, 0.1)
    trial = replace(TRIALS[0], duration_s=8.0, moment="armed", kills=(kill,))
    violations = find_violations(KillOutcome(trial, **outcome))  # pyright: ignore[reportArgumentType]
    if expected_violation is None:
        assert violations == []
    else:
        assert any(expected_violation in violation for violation in violations)
    assert SUPERVISOR not in str(trial)
