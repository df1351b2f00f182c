"""Texts of unauthorized clients with control characters: no command prints them on a terminal."""

import json
import time

from verification.attack.client import NetworkClient
from verification.attack.robot import AttackedRobot
from verification.attack.terminal_output import (
    EVIL_TEXT,
    FALSE_LINE,
    assert_output_is_safe,
    find_control_characters,
)
from verification.attack.tools import wire

MAX_NAME_LENGTH = 60  # of EVIL_TEXT where a message allows only short names


def test_control_characters_of_stop_requester_reach_no_terminal(robot: AttackedRobot) -> None:
    printed_before = robot.run.printed()
    with NetworkClient(robot.endpoint) as attacker:
        attacker.query("hal/estop", {"requester": EVIL_TEXT})
    robot.operator.wait_for_lifecycle("estop")
    robot.run.wait_for("evil")
    assert "evil" in robot.run.run_tool("status").out
    echo = robot.run.run_tool("topic", "echo", "hal/status", "--count", "1")
    assert EVIL_TEXT in json.loads(echo.out)["message"]["reason"], echo.printed
    assert not find_control_characters(echo.printed), echo.printed
    assert_output_is_safe(robot, printed_before)


def test_control_characters_of_lease_holder_reach_no_terminal(robot: AttackedRobot) -> None:
    printed_before = robot.run.printed()
    with NetworkClient(robot.endpoint) as attacker:
        attacker.query("hal/lease", {"action": "acquire", "holder": EVIL_TEXT, "priority": 255})
        for action in ("disarm", "reset", "arm"):
            attacker.request_lifecycle(action, requester=EVIL_TEXT)
        time.sleep(0.3)
        assert_output_is_safe(robot, printed_before)


def test_control_characters_in_forged_streams_reach_no_terminal(robot: AttackedRobot) -> None:
    printed_before = robot.run.printed()
    evil_name = EVIL_TEXT[:MAX_NAME_LENGTH]
    fault = {
        "tick": 1,
        "what": evil_name,
        "cause": EVIL_TEXT,
        "joint": evil_name,
        "scope": "robot",
    }
    status = {
        **robot.operator.read_status(),
        "lifecycle": "fault",
        "reason": EVIL_TEXT,
        "faults": [fault],
        "injected": [EVIL_TEXT],
        "robot": EVIL_TEXT,
        "backend": EVIL_TEXT,
        "lease_holder": EVIL_TEXT,
        "alive": [EVIL_TEXT],
        "waiting_for": [EVIL_TEXT],
        "isolated": [EVIL_TEXT],
        "derated": {EVIL_TEXT: 0.5},
        "realtime_warnings": [EVIL_TEXT],
        "commands_rejected": {EVIL_TEXT: 1},
    }
    clock = robot.operator.wait_for_next("hal/clock")
    controller_state = {
        "tick": clock["tick"],
        "timestamp_ns": clock["timestamp_ns"],
        "controller": EVIL_TEXT,
        "state": "Idle",
        "reason": EVIL_TEXT,
        "propulsion_joint": EVIL_TEXT,
    }
    with NetworkClient(robot.endpoint) as attacker:
        status_publisher = attacker.publish_latched("hal/status", status)
        for _ in range(20):
            status_publisher.put(wire.encode(status))
            attacker.publish("control/state", controller_state)
            time.sleep(0.02)
        assert_output_is_safe(robot, printed_before)


def test_control_characters_in_a_namespace_reach_no_terminal(robot: AttackedRobot) -> None:
    printed_before = robot.run.printed()
    evil_namespace = f"evil\x1b[2J\r{FALSE_LINE}"
    answer = {"ok": True, "reason": EVIL_TEXT, "epoch": 0, "lifecycle": "estop"}
    status = {**robot.operator.read_status(), "reason": EVIL_TEXT}
    with NetworkClient(robot.endpoint, evil_namespace) as attacker:
        attacker.declare_token("alive/hal")
        attacker.answer_queries("hal/estop", answer)
        attacker.publish_latched("hal/status", status)
        assert_output_is_safe(robot, printed_before)
