"""A6: commands that were not sent in the knowledge of this arming do not count, and keep no right one out."""

import time
from typing import Any

import pytest

from verification.attack.effort import effort
from verification.attack.limits import beyond_limits
from verification.attack.means.wire import POSITION
from verification.attack.robot import AttackedRobot
from verification.attack.stranger import FIRST, NetworkStranger

TIMES = range(effort(1, 20))


def applied_of_strangers(operator: NetworkStranger) -> list[int]:
    rows = [heard.message["sequence"] for heard in operator.heard("hal/applied")]
    return [sequence for sequence in rows if sequence is not None and sequence >= FIRST]


@pytest.mark.parametrize("_time", TIMES)
@pytest.mark.parametrize("kind", ["left_out", "none", "before", "after"])
def test_a6_command_of_no_or_another_arming_is_never_applied(
    robot: AttackedRobot, kind: str, _time: int
) -> None:
    operator = robot.operator
    operator.receive("sensor/joints")
    operator.stand_by()
    operator.forget()
    clock = operator.next("hal/clock")
    late = operator.command(clock)
    match kind:
        case "left_out":
            del late["arm_session"]
        case "none":
            late["arm_session"] = None
        case "after":
            late["arm_session"] += 2
    assert operator.request("arm")["ok"]
    for i in range(20):
        tick = operator.next("hal/clock")["tick"]
        operator.put("actuator/joints", {**late, "tick": tick, "sequence": FIRST + i})
    operator.put("actuator/joints", late)
    assert applied_of_strangers(operator) == []
    lives_on(robot)


def lives_on(robot: AttackedRobot) -> None:
    """The right controller is not blocked as a replayer: what it sends goes on being applied."""
    operator = robot.operator
    rejected = operator.next("hal/status")["commands_rejected"].get("replayed", 0)
    assert operator.follows(), (
        f"{operator.status()['reason']}; {operator.status()['commands_rejected']}"
    )
    now = operator.next("hal/status")
    assert (
        now["lifecycle"] == "armed" and now["commands_rejected"].get("replayed", 0) == rejected
    ), now


WRONG: tuple[dict[str, Any], ...] = (
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


def test_a6_wrong_command_with_high_sequence_blocks_no_right_one(robot: AttackedRobot) -> None:
    operator = robot.operator
    operator.receive("sensor/joints")
    for changes in WRONG:
        operator.forget()
        for i in range(effort(5, 100)):
            wrong = operator.command(operator.next("hal/clock"), sequence=2**61 + i, **changes)
            operator.put("actuator/joints", wrong)
        lives_on(robot)
        assert applied_of_strangers(operator) == [], changes


def test_a6_perfect_forgery_stays_within_limits_and_ends_with_sender(robot: AttackedRobot) -> None:
    """What remains: epoch, arming and sequence are there to read, and who forges all three commands the robot."""
    operator = robot.operator
    operator.receive("sensor/joints")
    about = operator.newest("hal/description")
    for i in range(50):
        wild = [(-1) ** (i + joint) * 1e5 for joint in range(len(about["joints"]))]
        clock = operator.next("hal/clock")
        forged = operator.command(clock, sequence=FIRST + i, target=wild, valid_for_ns=2**62)
        operator.put("actuator/joints", {**forged, "torque_limit_nm": [1e5] * len(wild)})
    time.sleep(0.3)
    rows = [heard.message for heard in operator.heard("hal/applied")]
    assert applied_of_strangers(operator), "the attack itself did not work"
    assert beyond_limits(about, rows) == []
    # The controller was kept out by the higher sequence; when the stranger falls silent, the lease runs out.
    operator.until(
        lambda: operator.lifecycle() != "armed" or applied_of_strangers(operator), "an end", 1.0
    )
    operator.recover()
