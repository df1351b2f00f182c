"""A8 and A9: forged data for the services of a running robot.

It misleads the robot, but moves it beyond no limit and ends no process.
"""

import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from snakesim_testing.harness.wait import wait_until
from verification.attack.client import NetworkClient
from verification.attack.effort import FULL_EFFORT, choose_effort
from verification.attack.limits import find_limit_violations
from verification.attack.robot import AttackedRobot, start_armed_robot
from verification.attack.robot_operator import Operator
from verification.attack.tools.repetition import repeat_in_background

FORGERY_DURATION_S = choose_effort(3, 100) / 10
FORGERY_PERIOD_S = 0.005  # shorter than that of the real publisher
MISSING_SAMPLE_DURATION_S = 3.0  # a service waits 2 s for a promised sample
NS_PER_S = 10**9
HUGE = 2**62
SERVICES = ("control", "guidance", "navigation")
REALTIME_50_HZ = ("triplet", "--clock-mode", "realtime", "--set", "rate_hz=50")
LOCKSTEP_HOLD = ("triplet", "--controller", "hold", "--clock-mode", "lockstep")
LONG_RUN = ("--duration", "3600", "--stay")

# Speeds that only a forged message requests.
UNUSED_SPEED_M_S = 77.0
REJECTED_SPEED_M_S = 0.0123
FOLLOWED_SPEED_M_S = 0.0321


@pytest.fixture(scope="module")
def moving_robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AttackedRobot]:
    """A robot that moves along the path of its navigation."""
    home = tmp_path_factory.mktemp("moving")
    with start_armed_robot(home, *REALTIME_50_HZ, *LONG_RUN) as robot:
        robot.operator.subscribe(
            "sensor/joints", "guidance/world", "navigation/trajectory", "actuator/joints"
        )
        yield robot


def assert_robot_withstands(
    robot: AttackedRobot,
    key: str,
    forgeries: dict[str, dict[str, Any]],
    duration_s: float = FORGERY_DURATION_S,
) -> None:
    """Fail if a forged message moves the robot beyond its limits, ends a process, or prevents that it recovers.

    Args:
        robot: Attacked robot.
        key: Key on which the forged messages are published.
        forgeries: Changed fields by name of the forgery. The other fields are those of a real message; tick and
            timestamp are those of the newest clock.
        duration_s: Time in s for which each forgery is repeated.
    """
    operator = robot.operator
    operator.recover_robot()
    health = robot.record_health()
    description = operator.read_newest("hal/description")
    real_message = operator.wait_for_next(key)
    with NetworkClient(robot.endpoint) as attacker:

        def make_forger(fields: dict[str, Any]) -> Callable[[], None]:
            def publish_forgery() -> None:
                # A forged clock must not read its own forgeries.
                clock = real_message if key == "hal/clock" else operator.read_newest("hal/clock")
                time_fields = {"tick": clock["tick"], "timestamp_ns": clock["timestamp_ns"]}
                attacker.publish(key, {**real_message, **time_fields, **fields})

            return publish_forgery

        for name, fields in forgeries.items():
            operator.discard_streams()
            with repeat_in_background(make_forger(fields), FORGERY_PERIOD_S):
                time.sleep(duration_s)
            applied_setpoints = operator.list_messages("hal/applied")
            assert find_limit_violations(description, applied_setpoints) == [], name
            robot.assert_unharmed(health, f"after {key}, {name}")
            operator.recover_robot()
    robot.assert_unharmed(health)


# --- intents ----------------------------------------------------------------------------------------------------------


def make_intent(timestamp_ns: int, speed_m_s: float) -> dict[str, Any]:
    """Return an operator's intent that requests a speed."""
    return {
        "timestamp_ns": timestamp_ns,
        "requester": "attacker",
        "speed_m_s": speed_m_s,
        "go": True,
    }


def collect_trajectory_speeds(operator: Operator, start_ns: int, end_ns: int) -> set[float]:
    """Return the speeds in m/s of all trajectories in an interval of robot time, after waiting for its end."""

    def list_trajectories() -> list[dict[str, Any]]:
        return [
            trajectory
            for trajectory in operator.list_messages("navigation/trajectory")
            if trajectory["timestamp_ns"] is not None and trajectory["timestamp_ns"] >= start_ns
        ]

    wait_until(
        lambda: any(trajectory["timestamp_ns"] >= end_ns for trajectory in list_trajectories()),
        "trajectories after the interval",
    )
    return {
        trajectory["speed_m_s"]
        for trajectory in list_trajectories()
        if trajectory["timestamp_ns"] < end_ns
    }


@pytest.mark.parametrize("age_s", [60.0, -60.0], ids=["old", "future"])
def test_a9_an_intent_of_another_time_is_not_followed(
    moving_robot: AttackedRobot, age_s: float
) -> None:
    operator = moving_robot.operator
    operator.recover_robot()
    now_ns = operator.wait_for_next("hal/clock")["timestamp_ns"]
    # An intent from the start of the robot must be older than the validity of an intent.
    while now_ns < 3 * NS_PER_S:
        time.sleep(0.1)
        now_ns = operator.wait_for_next("hal/clock")["timestamp_ns"]
    intent_ns = max(now_ns - round(age_s * NS_PER_S), 0)
    operator.publish("operator/intent", make_intent(intent_ns, REJECTED_SPEED_M_S))
    speeds = collect_trajectory_speeds(operator, now_ns, now_ns + NS_PER_S)
    assert REJECTED_SPEED_M_S not in speeds, f"navigation follows an intent that is {age_s:g} s old"


def test_a9_an_intent_ends_after_its_validity(moving_robot: AttackedRobot) -> None:
    operator = moving_robot.operator
    operator.recover_robot()
    last_intent_ns = 0

    def is_intent_followed() -> bool:
        """Publish the intent again every 0.5 s, because a busy computer may read it too late."""
        nonlocal last_intent_ns
        now_ns = operator.read_newest("hal/clock")["timestamp_ns"]
        if now_ns > last_intent_ns + NS_PER_S // 2:
            last_intent_ns = now_ns
            intent = make_intent(now_ns, FOLLOWED_SPEED_M_S)
            operator.publish("operator/intent", {**intent, "valid_for_ns": NS_PER_S})
        trajectories = operator.list_messages("navigation/trajectory")
        return any(trajectory["speed_m_s"] == FOLLOWED_SPEED_M_S for trajectory in trajectories)

    wait_until(is_intent_followed, "a trajectory that follows the intent")
    speeds_after = collect_trajectory_speeds(
        operator, last_intent_ns + 3 * NS_PER_S // 2, last_intent_ns + 5 * NS_PER_S // 2
    )
    assert speeds_after == {0.0}, "navigation must not return to its mission by itself"


# --- streams: a client misleads the robot, within its limits ----------------------------------------------------------


def test_a8_a_forged_trajectory_is_followed_within_the_limits(moving_robot: AttackedRobot) -> None:
    circle = [[10.0 * math.cos(i / 10), 10.0 * math.sin(i / 10)] for i in range(200)]
    line = [[i / 1e3, 0.0] for i in range(20_000)]
    forgeries = {
        "elsewhere": {"path_id": 7, "path_w": circle, "speed_m_s": UNUSED_SPEED_M_S},
        "far": {"path_id": 8, "path_w": [[1e6, -1e6], [-1e6, 1e6]], "speed_m_s": 1e5},
        "long": {"path_id": 9, "path_w": line, "speed_m_s": -1e5},
        "nan": {"path_w": [[float("nan"), 0.0], [0.0, 0.0]]},
        "one point": {"path_id": 10, "path_w": [[0.0, 0.0]] * 20_000},
        "hardly any length": {"path_id": 11, "path_w": [[0.0, 0.0], [1e-300, 0.0]]},
        "unknown obstacles": {"push_points": ["unknown"] * 512, "path_id": HUGE},
        "future": {"tick": HUGE, "timestamp_ns": HUGE},
        "past": {"tick": 0, "timestamp_ns": 0},
    }
    assert_robot_withstands(moving_robot, "navigation/trajectory", forgeries)


def test_a8_a_forged_world_breaks_no_limit(moving_robot: AttackedRobot) -> None:
    forgeries: dict[str, dict[str, Any]] = {
        "elsewhere": {"base_position_w": [1e6, 1e6, 0.0]},
        "no rotation": {"base_orientation_wxyz": [0.0, 0.0, 0.0, 0.0]},
        "no contacts": {"base_confidence": 0.0, "contacts": []},
        "no obstacles": {"obstacles": []},
        "past": {"tick": 0, "timestamp_ns": 0},
    }
    assert_robot_withstands(moving_robot, "guidance/world", forgeries)


def test_a8_a_world_of_the_future_ends_no_process(moving_robot: AttackedRobot) -> None:
    forgeries = {"future": {"tick": HUGE, "timestamp_ns": HUGE}}
    assert_robot_withstands(moving_robot, "guidance/world", forgeries)


def test_a8_forged_joints_break_no_limit(moving_robot: AttackedRobot) -> None:
    forgeries: dict[str, dict[str, Any]] = {
        "elsewhere": {"angle_rad": [1e4] * 13},
        "fast": {"angle_rad": [0.0] * 13, "velocity_rad_s": [1e5] * 13},
        "nan": {"angle_rad": [float("nan")] * 13},
        "one joint": {"angle_rad": [0.0]},
        "invalid": {"valid": [False] * 13},
        "old": {"age_ns": [HUGE] * 13},
        "future": {"tick": HUGE, "timestamp_ns": HUGE},
    }
    assert_robot_withstands(moving_robot, "sensor/joints", forgeries)


def test_a8_a_forged_clock_stops_the_robot_at_most(moving_robot: AttackedRobot) -> None:
    promised_ticks = {"sensor/joints": HUGE, "guidance": HUGE, "navigation": HUGE}
    forgeries: dict[str, dict[str, Any]] = {
        "future": {"tick": HUGE, "timestamp_ns": HUGE},
        "past": {"tick": 0, "timestamp_ns": 0},
        "armed often": {"lifecycle": "armed", "arm_session": HUGE},
        "disarmed": {"lifecycle": "disarmed"},
        "another lease": {"lease_epoch": HUGE},
        "no lease": {"lease_epoch": 0},
        "no period": {"period_ns": 0},
        "promises": {"newest": promised_ticks},
    }
    assert_robot_withstands(moving_robot, "hal/clock", forgeries)


def test_a8_clock_of_another_mode_ends_no_process(moving_robot: AttackedRobot) -> None:
    """The services know from their own configuration whether they run in lockstep."""
    forgeries = {"lockstep": {"clock_mode": "lockstep"}}
    duration_s = max(FORGERY_DURATION_S, MISSING_SAMPLE_DURATION_S)
    assert_robot_withstands(moving_robot, "hal/clock", forgeries, duration_s)


@pytest.mark.parametrize(
    "lifecycle", ["armed", "fault", "estop", "disarmed"] if FULL_EFFORT else ["estop"]
)
def test_a8_a_forged_status_moves_nothing(robot: AttackedRobot, lifecycle: str) -> None:
    operator = robot.operator
    operator.disarm_robot()
    arm_session = operator.wait_for_next("hal/clock")["arm_session"]
    forged_status = {
        **operator.read_status(),
        "lifecycle": lifecycle,
        "ready_to_arm": True,
        "reason": "forged",
    }
    with (
        NetworkClient(robot.endpoint) as attacker,
        repeat_in_background(
            lambda: attacker.publish("hal/status", forged_status), FORGERY_PERIOD_S
        ),
    ):
        time.sleep(FORGERY_DURATION_S)
        assert operator.wait_for_next("hal/clock")["arm_session"] == arm_session
        stop_command = robot.run.run_tool("estop")
    operator.discard_streams()
    assert operator.wait_for_next("hal/clock")["lifecycle"] == "estop", stop_command.printed


def test_a8_forged_service_answers_at_most_stop_lockstep_run(tmp_path: Path) -> None:
    with start_armed_robot(tmp_path, *LOCKSTEP_HOLD, *LONG_RUN) as robot:
        health = robot.record_health()
        operator = robot.operator
        with NetworkClient(robot.endpoint) as attacker:
            for service in (*SERVICES, "unknown"):
                attacker.publish(f"hal/done/{service}", {"tick": HUGE})

            def answer_for_services() -> None:
                tick = operator.read_newest("hal/clock")["tick"] + 2
                for service in SERVICES:
                    attacker.publish(f"hal/done/{service}", {"tick": tick})

            with repeat_in_background(answer_for_services, FORGERY_PERIOD_S):
                time.sleep(FORGERY_DURATION_S)
        operator.recover_robot()
        robot.assert_unharmed(health)
