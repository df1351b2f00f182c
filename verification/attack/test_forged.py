"""A8, A9: what services hear from a stranger. It may lead the robot astray, but not beyond its limits."""

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from verification.attack.effort import FULL, effort
from verification.attack.limits import beyond_limits
from verification.attack.means.repeating import repeating
from verification.attack.robot import AttackedRobot, standing
from verification.attack.stranger import NetworkStranger

FORGED_S = effort(3, 100) / 10
EVERY_S = 0.005  # faster than who should say it
NS = 10**9
ABSURD_M_S = 77.0
SERVICES = ("control", "guidance", "navigation")


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttackedRobot]:
    """A robot that goes where navigation says."""
    home = tmp_path_factory.mktemp("moving")
    arguments = (
        "triplet",
        "--clock-mode",
        "realtime",
        "--set",
        "rate_hz=50",
        "--duration",
        "3600",
        "--stay",
    )
    with standing(home, *arguments) as robot:
        robot.operator.receive(
            "sensor/joints", "guidance/world", "navigation/trajectory", "actuator/joints"
        )
        yield robot


def holds(
    robot: AttackedRobot, key: str, variants: dict[str, dict[str, Any]], each_s: float = FORGED_S
) -> None:
    """Under each forgery nothing leaves its limits and nobody dies; afterwards the robot can be used as before.

    What is forged is the newest honest message with these changes, and the clock's tick and time unless they change.
    """
    operator = robot.operator
    operator.recover()
    before, about, honest = robot.health(), operator.newest("hal/description"), operator.next(key)
    with NetworkStranger(robot.endpoint) as stranger:
        for name, changes in variants.items():
            operator.forget()

            def forge(changes: dict[str, Any] = changes) -> None:
                now = honest if key == "hal/clock" else operator.newest("hal/clock")
                stranger.put(
                    key,
                    {**honest, "tick": now["tick"], "timestamp_ns": now["timestamp_ns"], **changes},
                )

            with repeating(forge, EVERY_S):
                time.sleep(each_s)
            rows = [heard.message for heard in operator.heard("hal/applied")]
            assert beyond_limits(about, rows) == [], name
            robot.unharmed(before, f"after {key}, {name}")
            operator.recover()
    robot.unharmed(before)


# --- intents ----------------------------------------------------------------------------------------------------------


def intent(timestamp_ns: int, speed_m_s: float, valid_s: float | None = None) -> dict[str, Any]:
    said: dict[str, Any] = {
        "timestamp_ns": timestamp_ns,
        "requester": "stranger",
        "speed_m_s": speed_m_s,
        "go": True,
    }
    return said if valid_s is None else {**said, "valid_for_ns": round(valid_s * NS)}


def speeds(operator: NetworkStranger, from_ns: int, to_ns: int) -> set[float]:
    """Of trajectories in a stretch of the robot's time, however long that takes."""

    def told() -> list[dict[str, Any]]:
        messages = [heard.message for heard in operator.heard("navigation/trajectory")]
        return [
            one
            for one in messages
            if one["timestamp_ns"] is not None and one["timestamp_ns"] >= from_ns
        ]

    operator.until(
        lambda: any(one["timestamp_ns"] >= to_ns for one in told()), "trajectories of later"
    )
    return {one["speed_m_s"] for one in told() if one["timestamp_ns"] < to_ns}


@pytest.mark.parametrize("age_s", [60.0, -60.0], ids=["old", "future"])
def test_a9_an_intent_of_another_time_is_not_followed(moving: AttackedRobot, age_s: float) -> None:
    operator = moving.operator
    operator.recover()
    while (
        now_ns := operator.next("hal/clock")["timestamp_ns"]
    ) < 3 * NS:  # what is as old as the robot must be old
        time.sleep(0.1)
    operator.put("operator/intent", intent(max(now_ns - round(age_s * NS), 0), 0.0123))
    assert 0.0123 not in speeds(operator, now_ns, now_ns + NS), (
        f"an intent that is {age_s:g} s old is followed"
    )


def test_a9_an_intent_ends_after_its_validity(moving: AttackedRobot) -> None:
    operator, said_ns = moving.operator, [0]
    operator.recover()

    def followed() -> bool:
        """Said until it is: a busy computer may read it when it has ended."""
        if (now_ns := operator.newest("hal/clock")["timestamp_ns"]) > said_ns[-1] + NS // 2:
            said_ns.append(now_ns)
            operator.put("operator/intent", intent(now_ns, 0.0321, valid_s=1.0))
        return any(
            heard.message["speed_m_s"] == 0.0321
            for heard in operator.heard("navigation/trajectory")
        )

    operator.until(followed, "an intent that is followed")
    after = speeds(operator, said_ns[-1] + 3 * NS // 2, said_ns[-1] + 5 * NS // 2)
    assert after == {0.0}, "it does not go back to its mission by itself"


# --- what remains: a stranger leads the robot astray, within its limits -----------------------------------------------


CIRCLE = [[10.0 * math.cos(i / 10), 10.0 * math.sin(i / 10)] for i in range(200)]


def test_a8_a_forged_trajectory_is_followed_within_the_limits(moving: AttackedRobot) -> None:
    variants = {
        "elsewhere": {"path_id": 7, "path_w": CIRCLE, "speed_m_s": ABSURD_M_S},
        "far": {"path_id": 8, "path_w": [[1e6, -1e6], [-1e6, 1e6]], "speed_m_s": 1e5},
        "long": {
            "path_id": 9,
            "path_w": [[i / 1e3, 0.0] for i in range(20_000)],
            "speed_m_s": -1e5,
        },
        "nan": {"path_w": [[float("nan"), 0.0], [0.0, 0.0]]},
        "one point": {"path_id": 10, "path_w": [[0.0, 0.0]] * 20_000},
        "hardly any length": {"path_id": 11, "path_w": [[0.0, 0.0], [1e-300, 0.0]]},
        "unknown obstacles": {"push_points": ["nobody"] * 512, "path_id": 2**62},
        "future": {"tick": 2**62, "timestamp_ns": 2**62},
        "past": {"tick": 0, "timestamp_ns": 0},
    }
    holds(moving, "navigation/trajectory", variants)


def test_a8_a_forged_world_ends_nobody_and_breaks_no_limit(moving: AttackedRobot) -> None:
    variants = {
        "elsewhere": {"base_position_w": [1e6, 1e6, 0.0]},
        "no rotation": {"base_orientation_wxyz": [0.0, 0.0, 0.0, 0.0]},
        "no contacts": {"base_confidence": 0.0, "contacts": []},
        "no obstacles": {"obstacles": []},
        "past": {"tick": 0, "timestamp_ns": 0},
    }
    holds(moving, "guidance/world", variants)


def test_a8_a_world_of_the_future_ends_nobody(moving: AttackedRobot) -> None:
    holds(moving, "guidance/world", {"future": {"tick": 2**62, "timestamp_ns": 2**62}})


def test_a8_forged_joints_break_no_limit(moving: AttackedRobot) -> None:
    variants = {
        "elsewhere": {"angle_rad": [1e4] * 13},
        "fast": {"angle_rad": [0.0] * 13, "velocity_rad_s": [1e5] * 13},
        "nan": {"angle_rad": [float("nan")] * 13},
        "one joint": {"angle_rad": [0.0]},
        "invalid": {"valid": [False] * 13},
        "old": {"age_ns": [2**62] * 13},
        "future": {"tick": 2**62, "timestamp_ns": 2**62},
    }
    holds(moving, "sensor/joints", variants)


def test_a8_a_forged_clock_stops_the_robot_at_most(moving: AttackedRobot) -> None:
    variants = {
        "future": {"tick": 2**62, "timestamp_ns": 2**62},
        "past": {"tick": 0, "timestamp_ns": 0},
        "armed often": {"lifecycle": "armed", "arm_session": 2**62},
        "disarmed": {"lifecycle": "disarmed"},
        "another lease": {"lease_epoch": 2**62},
        "no lease": {"lease_epoch": 0},
        "no period": {"period_ns": 0},
        "promises": {"newest": {"sensor/joints": 2**62, "guidance": 2**62, "navigation": 2**62}},
    }
    holds(moving, "hal/clock", variants)


def test_a8_a_clock_of_another_pace_ends_nobody(moving: AttackedRobot) -> None:
    """Services know from their own configuration whether they run in lockstep."""
    # A service waits two seconds for what it was promised.
    holds(moving, "hal/clock", {"lockstep": {"clock_mode": "lockstep"}}, each_s=max(FORGED_S, 3.0))


@pytest.mark.parametrize(
    "lifecycle", ["armed", "fault", "estop", "disarmed"] if FULL else ["estop"]
)
def test_a8_a_forged_status_moves_nothing(robot: AttackedRobot, lifecycle: str) -> None:
    operator = robot.operator
    operator.stand_by()
    armings = operator.next("hal/clock")["arm_session"]
    forged = {**operator.status(), "lifecycle": lifecycle, "ready_to_arm": True, "reason": "forged"}
    with (
        NetworkStranger(robot.endpoint) as stranger,
        repeating(lambda: stranger.put("hal/status", forged), EVERY_S),
    ):
        time.sleep(FORGED_S)
        assert operator.next("hal/clock")["arm_session"] == armings
        stopped = robot.run.run_tool("estop")
    operator.forget()
    assert operator.next("hal/clock")["lifecycle"] == "estop", stopped.printed


def test_a8_forged_service_answers_at_most_stop_lockstep_run(tmp_path: Path) -> None:
    arguments = (
        "triplet",
        "--controller",
        "hold",
        "--clock-mode",
        "lockstep",
        "--duration",
        "3600",
        "--stay",
    )
    with standing(tmp_path, *arguments) as robot:
        before, operator = robot.health(), robot.operator

        with NetworkStranger(robot.endpoint) as stranger:
            for name in (*SERVICES, "nobody"):
                stranger.put(f"hal/done/{name}", {"tick": 2**62})

            def answer() -> None:
                tick = operator.newest("hal/clock")["tick"] + 2
                for name in SERVICES:
                    stranger.put(f"hal/done/{name}", {"tick": tick})

            with repeating(answer, EVERY_S):
                time.sleep(FORGED_S)
        operator.recover()
        robot.unharmed(before)
