"""A12, A13: who asked for it is told, a stranger completes nobody's run, and a stop belongs to the robot."""

import json
from pathlib import Path

import pytest

from verification.attack.command import HOLDING, STANDING, running
from verification.attack.robot import AttackedRobot, joined
from verification.attack.stranger import NetworkStranger


def test_a12_requesters_of_disarm_clear_and_arm_are_reported(robot: AttackedRobot) -> None:
    operator = robot.operator
    with NetworkStranger(robot.endpoint) as stranger:
        for action, before in (("disarm", None), ("arm", "ready"), ("reset", "estop")):
            if before == "estop":
                operator.ask("hal/estop", {"requester": "operator"})
            elif before == "ready":
                operator.until(lambda: operator.status()["ready_to_arm"], "ready to arm")
            assert stranger.request(action, requester="mallory")["ok"], action
            why = operator.next("hal/status")["reason"]
            assert "mallory" in why, f"after {action}: {why!r}"


def test_a12_a_run_that_a_stranger_finishes_is_not_complete(tmp_path: Path) -> None:
    with running(tmp_path, *HOLDING, "--duration", "20") as run, joined(run) as operator:
        operator.until(lambda: operator.lifecycle() == "armed", "armed")
        with NetworkStranger(run.endpoint) as stranger:
            answer = stranger.request("finish", requester="mallory")
        code = run.end()
        summary = json.loads((run.out / "summary.json").read_text())
    assert code == 1, f"exit code {code}, answered {answer}: {run.printed()}"
    assert "finished on request" in summary["ended"] and summary["ended"].endswith("of 20 s"), (
        summary["ended"]
    )
    assert "mallory" in run.printed(), run.printed()


def test_a12_a_request_without_a_name_is_not_anonymous(robot: AttackedRobot) -> None:
    """Whoever leaves out who he is, is told as unknown; nothing is put into his mouth."""
    with NetworkStranger(robot.endpoint) as stranger:
        assert stranger.ask("hal/lifecycle", {"action": "disarm"})[0]["ok"]
    assert "an unnamed client" in robot.operator.next("hal/status")["reason"]


@pytest.mark.slow  # tests/system/commands/test_operator.py has the quick one: a stop that outlives the host
def test_a13_stop_outlives_run_and_folder_until_reset(tmp_path: Path) -> None:
    with running(tmp_path, *STANDING, name="one") as run, joined(run) as operator:
        operator.recover()
        assert run.run_tool("estop").code == 0
        assert run.interrupt() == 130
    with running(tmp_path, *STANDING, name="two") as run, joined(run) as operator:
        with pytest.raises(AssertionError, match="not within"):
            operator.until(lambda: operator.lifecycle() == "armed", "armed", 2.0)
        status = operator.next("hal/status")
        assert status["lifecycle"] == "estop", status["reason"]
        operator.recover()  # reset and armed by a person, it moves
        assert run.interrupt() == 130
    with running(tmp_path, *STANDING, name="three") as run, joined(run) as operator:
        operator.until(lambda: operator.lifecycle() == "armed", "armed")
