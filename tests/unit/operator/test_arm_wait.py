"""`snakesim robot arm --wait` waits for what passes by itself, and for nothing else."""

import time
from typing import Any

import pytest

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_operator.base.targets import RobotSelection
from snakesim_operator.robot_commands import command


def test_arming_is_tried_again_until_the_robot_is_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes: list[Any] = [
        NotConnectedError("no robot"),
        command.NotReadyError("waiting for control"),
        command.NotReadyError("waiting for control"),
        0,
    ]

    def try_once(*_: Any, **__: Any) -> int:
        outcome = outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(command, "_arm_once", try_once)
    monkeypatch.setattr(command, "RETRY_PERIOD_S", 0.001)
    printed: list[str] = []
    assert command.arm_robot("row", "sim", RobotSelection(), printed.append, wait_s=30.0) == 0
    assert printed == ["waiting: no robot", "waiting: waiting for control"], "each reason once"


def test_a_refusal_that_does_not_pass_by_itself_ends_the_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any, **__: Any) -> int:
        raise RefusedError("state is fault")

    monkeypatch.setattr(command, "_arm_once", refuse)
    began_s = time.monotonic()
    with pytest.raises(RefusedError, match="state is fault"):
        command.arm_robot("row", "sim", RobotSelection(), wait_s=30.0)
    assert time.monotonic() - began_s < 10.0


def test_without_wait_the_first_refusal_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> int:
        raise command.NotReadyError("waiting for control")

    monkeypatch.setattr(command, "_arm_once", refuse)
    with pytest.raises(command.NotReadyError):
        command.arm_robot("row", "sim", RobotSelection())
