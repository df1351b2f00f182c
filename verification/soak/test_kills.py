"""A handful of `python -m verification.soak.kills`, and that its judge sees what it is for."""

import signal
from dataclasses import replace
from itertools import islice
from pathlib import Path

import pytest

from verification.soak.killed_run import MOMENTS, SUPERVISOR, KillOutcome, KillTrial, ProcessKill
from verification.soak.kills import carry_out, draw, judge

TRIALS = list(islice(draw(11), 2 * len(MOMENTS)))


@pytest.mark.e2e
@pytest.mark.parametrize(
    "trial",
    [
        pytest.param(trial, marks=[pytest.mark.slow] if i not in (0, 3) else [])
        for i, trial in enumerate(TRIALS[3:10])
    ],
    ids=str,
)
def test_what_a_killed_run_leaves(tmp_path: Path, trial: KillTrial) -> None:
    _, wrong = carry_out(trial, tmp_path / "trial")
    assert wrong == []


def test_kills_of_one_seed_are_same_on_both_backends() -> None:
    assert list(islice(draw(11), 14)) == TRIALS
    assert {(trial.moment, trial.backend) for trial in TRIALS} == {
        (m, b) for m in MOMENTS for b in ("sim", "can")
    }


@pytest.mark.parametrize(
    ("outcome", "word"),
    [
        ({"code": 0}, "exit code 0 with None of 400 ticks armed"),
        ({"code": 130}, "nobody has interrupted"),
        ({"code": 1, "printed": "all is well"}, "no word of a fault"),
        ({"code": -11, "printed": "x"}, "exit code -11"),
        (
            {"code": 1, "printed": "fault: x\nTraceback (most recent call last):\nValueError: y"},
            "ValueError: y",
        ),
        ({"code": 1, "printed": "fault: x", "logs": {"host": "thread panicked"}}, "host: panicked"),
        ({"code": 1, "printed": "fault: x", "left_behind": ["12 python"]}, "left behind: 12"),
        ({"code": 1, "printed": "fault: x", "stop_answered": True}, "not on the disk"),
        (
            {"code": 1, "printed": "fault: x", "reset_answered": True, "stop_kept": True},
            "still on the disk",
        ),
        ({"code": 1, "printed": "fault: x", "stop_answered": True, "stop_kept": True}, None),
        ({"code": 130, "printed": "x", "interrupted": True}, None),
    ],
)
def test_the_judge_sees_what_is_wrong(outcome: dict[str, object], word: str | None) -> None:
    trial = replace(
        TRIALS[0], asked_s=8.0, moment="armed", hits=(ProcessKill("host", signal.SIGKILL, 0.1),)
    )
    wrong = judge(KillOutcome(trial, **outcome))  # pyright: ignore[reportArgumentType]
    assert any(word in what for what in wrong) if word else wrong == []
    assert SUPERVISOR not in str(trial)
