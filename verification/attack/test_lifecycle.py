"""A12 and A13: requests that change the lifecycle state of a robot.

The robot reports which client requested a change. A client that ends a run does not complete it. An emergency stop
belongs to the robot: it continues in the next run until an operator resets it.
"""

import json
from pathlib import Path

import pytest

from snakesim_testing.harness.wait import wait_until
from verification.attack.client import NetworkClient
from verification.attack.command import HOLD_POSE, HOLD_POSE_FOR_AN_HOUR, start_run
from verification.attack.robot import AttackedRobot, connect_operator

INTERRUPTED = 130  # exit code of a run after Ctrl-C


def test_a12_requesters_of_disarm_arm_and_reset_are_reported(robot: AttackedRobot) -> None:
    operator = robot.operator
    with NetworkClient(robot.endpoint) as attacker:

        def request_as_mallory(action: str) -> None:
            answer = attacker.request_lifecycle(action, requester="mallory")
            assert answer["ok"], action
            # A status from before the change may still be on its way.
            wait_until(
                lambda: operator.read_status()["lifecycle"] == answer["lifecycle"],
                f"a status after {action}",
            )
            reason = operator.read_reason()
            assert "mallory" in reason, f"after {action}: {reason!r}"

        request_as_mallory("disarm")
        wait_until(lambda: operator.read_status()["ready_to_arm"], "ready to arm")
        request_as_mallory("arm")
        operator.request_emergency_stop()
        request_as_mallory("reset")


def test_a12_a_run_that_a_client_finishes_is_not_complete(tmp_path: Path) -> None:
    with (
        start_run(tmp_path, *HOLD_POSE, "--duration", "20") as run,
        connect_operator(run) as operator,
    ):
        operator.wait_for_lifecycle("armed")
        with NetworkClient(run.endpoint) as attacker:
            answer = attacker.request_lifecycle("finish", requester="mallory")
        code = run.end()
        ending = json.loads((run.out / "summary.json").read_text())["ended"]
    assert code == 1, f"exit code {code}, answer {answer}: {run.printed()}"
    assert "finished on request" in ending and ending.endswith("of 20 s"), ending
    assert "mallory" in run.printed(), run.printed()


def test_a12_request_without_requester_is_from_unnamed_client(robot: AttackedRobot) -> None:
    with NetworkClient(robot.endpoint) as attacker:
        assert attacker.query("hal/lifecycle", {"action": "disarm"})[0]["ok"]
    assert "an unnamed client" in robot.operator.wait_for_next("hal/status")["reason"]


@pytest.mark.slow  # tests/system/commands/test_operator.py tests quickly that a stop outlives the host
def test_a13_stop_outlives_run_and_folder_until_reset(tmp_path: Path) -> None:
    with (
        start_run(tmp_path, *HOLD_POSE_FOR_AN_HOUR, name="one") as run,
        connect_operator(run) as operator,
    ):
        operator.recover_robot()
        assert run.run_tool("estop").code == 0
        assert run.interrupt() == INTERRUPTED
    with (
        start_run(tmp_path, *HOLD_POSE_FOR_AN_HOUR, name="two") as run,
        connect_operator(run) as operator,
    ):
        with pytest.raises(AssertionError, match="not within"):
            operator.wait_for_lifecycle("armed", 2.0)
        status = operator.wait_for_next("hal/status")
        assert status["lifecycle"] == "estop", status["reason"]
        operator.recover_robot()  # an operator resets and arms the robot
        assert run.interrupt() == INTERRUPTED
    with (
        start_run(tmp_path, *HOLD_POSE_FOR_AN_HOUR, name="three") as run,
        connect_operator(run) as operator,
    ):
        operator.wait_for_lifecycle("armed")
