"""A6: forged commands.

The host ignores a command of another arm session. A wrong command never prevents the controller's own commands. A
perfect forgery moves the robot within its limits.
"""

import time
from typing import Any

import pytest

from snakesim_testing.harness.wait import wait_until
from verification.attack.client import FIRST_FORGED_SEQUENCE
from verification.attack.effort import choose_effort
from verification.attack.limits import find_limit_violations
from verification.attack.robot import AttackedRobot
from verification.attack.robot_operator import Operator
from verification.attack.tools.wire import POSITION

REPETITIONS = range(choose_effort(1, 20))
HUGE_NS = 2**62
EXTREME = 1e5  # rad or Nm, far beyond every limit

# Changed fields that make a command wrong.
WRONG_FIELDS: tuple[dict[str, Any], ...] = (
    {"lease_epoch": 1},
    {"layout": "another"},
    {"mode": [POSITION], "target": [0.0]},
    {"target": [float("nan")] * 13},
    {"tick": 2**62},
    {"tick": 0},
    {"valid_for_ns": 0},
    {"mode": [9] * 13},
    {"torque_limit_nm": [-1.0] * 13},
)


def list_applied_forgeries(operator: Operator) -> list[int]:
    """Return the sequence numbers of the forged commands that were applied."""
    sequences = [setpoints["sequence"] for setpoints in operator.list_messages("hal/applied")]
    return [
        sequence
        for sequence in sequences
        if sequence is not None and sequence >= FIRST_FORGED_SEQUENCE
    ]


def count_replayed_commands(status: dict[str, Any]) -> int:
    """Return how many commands the host rejected because of an old sequence number."""
    return status["commands_rejected"].get("replayed", 0)


def assert_controller_is_followed(robot: AttackedRobot) -> None:
    """Fail unless the robot applies the commands of its controller, and rejects none as replayed."""
    operator = robot.operator
    status_before = operator.wait_for_next("hal/status")
    is_following = operator.is_following_controller()
    newest = operator.read_status()
    assert is_following, f"{newest['reason']}; rejected commands: {newest['commands_rejected']}"
    status = operator.wait_for_next("hal/status")
    assert status["lifecycle"] == "armed", status
    assert count_replayed_commands(status) == count_replayed_commands(status_before), status


@pytest.mark.parametrize("_repetition", REPETITIONS)
@pytest.mark.parametrize("arm_session", ["left_out", "none", "before", "after"])
def test_a6_command_of_another_arm_session_is_never_applied(
    robot: AttackedRobot, arm_session: str, _repetition: int
) -> None:
    operator = robot.operator
    operator.subscribe("sensor/joints")
    operator.disarm_robot()
    operator.discard_streams()
    command = operator.make_command(operator.wait_for_next("hal/clock"))
    match arm_session:
        case "left_out":
            del command["arm_session"]
        case "none":
            command["arm_session"] = None
        case "after":
            command["arm_session"] += 2
        case _:
            pass  # the clock of the disarmed robot has the session before
    assert operator.request_lifecycle("arm")["ok"]
    for i in range(20):
        tick = operator.wait_for_next("hal/clock")["tick"]
        sequence = FIRST_FORGED_SEQUENCE + i
        operator.publish("actuator/joints", {**command, "tick": tick, "sequence": sequence})
    operator.publish("actuator/joints", command)
    assert list_applied_forgeries(operator) == []
    assert_controller_is_followed(robot)


def test_a6_wrong_command_with_high_sequence_blocks_no_right_one(robot: AttackedRobot) -> None:
    operator = robot.operator
    operator.subscribe("sensor/joints")
    for fields in WRONG_FIELDS:
        operator.discard_streams()
        for i in range(choose_effort(5, 100)):
            clock = operator.wait_for_next("hal/clock")
            command = operator.make_command(clock, sequence=2**61 + i, **fields)
            operator.publish("actuator/joints", command)
        assert_controller_is_followed(robot)
        assert list_applied_forgeries(operator) == [], fields


def test_a6_perfect_forgery_stays_within_limits_and_ends_with_sender(robot: AttackedRobot) -> None:
    """Any client can read epoch, arm session and sequence. With all three, a forged command is applied."""
    operator = robot.operator
    operator.subscribe("sensor/joints")
    description = operator.read_newest("hal/description")
    joint_count = len(description["joints"])
    for i in range(50):
        extreme_targets = [(-1) ** (i + joint) * EXTREME for joint in range(joint_count)]
        command = operator.make_command(
            operator.wait_for_next("hal/clock"),
            sequence=FIRST_FORGED_SEQUENCE + i,
            target=extreme_targets,
            torque_limit_nm=[EXTREME] * joint_count,
            valid_for_ns=HUGE_NS,
        )
        operator.publish("actuator/joints", command)
    time.sleep(0.3)
    assert list_applied_forgeries(operator), "the attack itself did not work"
    assert find_limit_violations(description, operator.list_messages("hal/applied")) == []
    # The higher sequence blocks the controller. When the forged commands end, the lease expires.
    wait_until(
        lambda: operator.read_lifecycle() != "armed" or list_applied_forgeries(operator),
        "the end of the forged commands",
        1.0,
    )
    operator.recover_robot()
