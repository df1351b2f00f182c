"""`snakesim robot arm --wait` waits only for conditions that end without the operator."""

import time
from typing import Any

import pytest

from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_operator.base.targets import RobotSelection
from snakesim_operator.robot_commands import command

WAIT_S = 30.0


def test_arm_wait_retries_until_the_robot_is_ready(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes: list[Any] = [
        NotConnectedError("no robot"),
        command.NotReadyError("waiting for control"),
        command.NotReadyError("waiting for control"),
        0,
    ]

    def arm_once(*_: Any, **__: Any) -> int:
        """Return or raise the next outcome."""
        outcome = outcomes.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    monkeypatch.setattr(command, "_arm_once", arm_once)
    monkeypatch.setattr(command, "RETRY_PERIOD_S", 0.001)
    lines: list[str] = []
    assert command.arm_robot("row", "sim", RobotSelection(), lines.append, wait_s=WAIT_S) == 0
    assert lines == ["waiting: no robot", "waiting: waiting for control"], "each reason once"


def test_arm_wait_ends_with_a_permanent_refusal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any, **__: Any) -> int:
        raise RefusedError("state is fault")

    monkeypatch.setattr(command, "_arm_once", refuse)
    start_s = time.monotonic()
    with pytest.raises(RefusedError, match="state is fault"):
        command.arm_robot("row", "sim", RobotSelection(), wait_s=WAIT_S)
    assert time.monotonic() - start_s < 10.0


def test_arm_without_wait_ends_with_the_first_refusal(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> int:
        raise command.NotReadyError("waiting for control")

    monkeypatch.setattr(command, "_arm_once", refuse)
    with pytest.raises(command.NotReadyError):
        command.arm_robot("row", "sim", RobotSelection())
