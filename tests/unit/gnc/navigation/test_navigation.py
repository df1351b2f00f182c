"""Tests plans along a known path, and locomotion intents: who requests which motion, and how long it is valid."""

from typing import Any

import pytest

from snakesim_gnc.navigation.intents import MAX_VALIDITY_NS, DesiredMotion, IntentTracker
from snakesim_gnc.navigation.known_path import KnownPath
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import KnownObstacle, LocomotionIntent, WorldModel
from snakesim_testing.gnc.stage import make_world

MISSION_M_S = 0.2
MISSION = DesiredMotion(MISSION_M_S)
SECOND_NS = 10**9
ROUTE = Route([(0.0, 0.0), (1.0, 0.0), (10.0, 0.0)])
PEG = KnownObstacle(
    name="peg", shape="cylinder", position_w=(2.0, 0.1, 0.1), radius_m=0.05, height_m=0.2
)


def make_intent(time_s: float, **changes: Any) -> LocomotionIntent:
    """Return an intent of ann for 0.1 m/s, sent at this time, with changes."""
    return LocomotionIntent(
        **{
            "timestamp_ns": round(time_s * SECOND_NS),
            "requester": "ann",
            "speed_m_s": 0.1,
            **changes,
        }
    )


def make_world_at(tail_x_m: float, timestamp_ns: int = 0) -> WorldModel:
    """Return a world model in which the tail is at this x."""
    return make_world(timestamp_ns=timestamp_ns, base_position_w=(tail_x_m, 0.0, 0.0))


def choose_speed(
    intents: IntentTracker, newest: LocomotionIntent | None, time_s: float
) -> tuple[float, str]:
    """Return the speed in m/s that the newest intent leads to at this time, and its reason."""
    motion = intents.choose_motion(newest, round(time_s * SECOND_NS))
    return motion.speed_m_s, motion.reason


def test_trajectory_age_is_that_of_its_world_model() -> None:
    planner = KnownPath(ROUTE, [PEG], 0.15)
    blind = planner.update(0, None, MISSION)
    assert blind.assumed_obstacle_friction == 0.15
    assert blind.timestamp_ns is None
    assert blind.push_points == []
    assert not blind.finished
    timestamp_ns = 18 * 10**7
    planned = planner.update(20, make_world_at(0.5, timestamp_ns=timestamp_ns), MISSION)
    assert planned.tick == 20
    assert planned.timestamp_ns == timestamp_ns
    assert planned.push_points == ["peg"]
    # With the same world model, a later plan is no newer.
    planned_later = planner.update(40, make_world_at(0.5, timestamp_ns=timestamp_ns), MISSION)
    assert planned_later.timestamp_ns == timestamp_ns


def test_navigation_stops_at_the_end_of_path() -> None:
    trajectory = KnownPath(ROUTE, []).update(0, make_world_at(10.0), MISSION)
    assert trajectory.finished
    assert trajectory.speed_m_s == 0.0
    assert trajectory.reason == "the path is finished"


def test_intent_expires_after_its_validity_and_robot_stops() -> None:
    intents = IntentTracker(MISSION_M_S)
    assert choose_speed(intents, None, 0.0) == (MISSION_M_S, "")
    first = make_intent(1.0)
    assert choose_speed(intents, first, 1.2) == (0.1, "as ann wants it")
    assert choose_speed(intents, first, 2.0) == (0.1, "as ann wants it")
    speed_m_s, reason = choose_speed(intents, first, 2.2)
    assert speed_m_s == 0.0
    assert reason.startswith("the intent of ann has expired: it is 1.2 s old, valid for 1 s")
    # The robot does not return to its mission.
    speed_m_s, reason = choose_speed(intents, None, 60.0)
    assert speed_m_s == 0.0
    assert "send a new one to go on" in reason
    assert choose_speed(intents, make_intent(60.0, requester="bob", speed_m_s=None), 60.1) == (
        MISSION_M_S,
        "as bob wants it",
    )
    assert choose_speed(intents, make_intent(60.2, go=False), 60.3) == (0.0, "ann wants it to stop")


def test_intent_validity_is_shortened_but_never_extended_beyond_maximum() -> None:
    intents = IntentTracker(MISSION_M_S)
    brief = make_intent(0.0, valid_for_ns=SECOND_NS // 2)
    assert choose_speed(intents, brief, 0.5)[0] == 0.1
    assert choose_speed(intents, brief, 0.6)[0] == 0.0

    intents = IntentTracker(MISSION_M_S)
    endless = make_intent(0.0, valid_for_ns=2**62)
    assert choose_speed(intents, endless, MAX_VALIDITY_NS / SECOND_NS)[0] == 0.1
    speed_m_s, reason = choose_speed(intents, endless, MAX_VALIDITY_NS / SECOND_NS + 0.1)
    assert speed_m_s == 0.0
    assert "valid for 5 s" in reason


@pytest.mark.parametrize(
    ("time_s", "expected_reason"),
    [(20.2, "stamped 10.2 s ahead of the robot's clock"), (8.0, "has expired: it is 2 s old")],
)
def test_intent_with_future_or_old_timestamp_is_refused(
    time_s: float, expected_reason: str
) -> None:
    intents = IntentTracker(MISSION_M_S)
    speed_m_s, reason = choose_speed(intents, make_intent(time_s), 10.0)
    assert speed_m_s == MISSION_M_S
    assert expected_reason in reason

    valid = make_intent(10.0)
    assert choose_speed(intents, valid, 10.1)[0] == 0.1
    # A refused intent does not replace the valid one, and does not prolong it.
    assert choose_speed(intents, make_intent(time_s, speed_m_s=5.0), 10.2) == (
        0.1,
        "as ann wants it",
    )
    assert choose_speed(intents, make_intent(time_s, speed_m_s=5.0), 11.5)[0] == 0.0


def test_intent_slightly_ahead_of_the_clock_is_accepted() -> None:
    assert choose_speed(IntentTracker(MISSION_M_S), make_intent(1.09), 1.0)[0] == 0.1


@pytest.mark.parametrize("speed_m_s", [10.1, -11.0, 1e5])
def test_navigation_intent_speed_is_limited_by_mission(speed_m_s: float) -> None:
    requested = make_intent(1.0, speed_m_s=speed_m_s)
    chosen_m_s, reason = choose_speed(IntentTracker(MISSION_M_S), requested, 1.0)
    assert chosen_m_s == MISSION_M_S
    assert f"asks for {speed_m_s:g} m/s, at most 10 m/s" in reason


def test_intent_direction_holds_while_standing_until_mission_resumes() -> None:
    intents = IntentTracker(MISSION_M_S)
    assert intents.choose_motion(make_intent(0.0, heading_w_rad=1.5), 0).heading_w_rad == 1.5
    expired = intents.choose_motion(None, 2 * SECOND_NS)
    assert expired.speed_m_s == 0.0
    # The robot stops on its present path.
    assert expired.heading_w_rad == 1.5
    assert intents.choose_motion(make_intent(2.1, go=False), 2_100_000_000).heading_w_rad == 1.5
    assert intents.choose_motion(make_intent(2.2), 2_200_000_000).heading_w_rad is None


def test_intent_before_a_robot_restart_is_ignored_afterwards() -> None:
    intents = IntentTracker(MISSION_M_S)
    assert choose_speed(intents, make_intent(50.0), 50.1)[0] == 0.1
    intents.reset()
    speed_m_s, reason = choose_speed(intents, None, 0.0)
    assert speed_m_s == 0.0
    assert "the intent of ann was for another start of the robot" in reason
    assert choose_speed(intents, None, 50.1)[0] == 0.0

    fresh = IntentTracker(MISSION_M_S)
    fresh.reset()
    assert choose_speed(fresh, None, 0.0) == (MISSION_M_S, "")


def test_intent_sent_before_a_stop_does_not_move_robot() -> None:
    intents = IntentTracker(MISSION_M_S)
    assert choose_speed(intents, make_intent(1.0, valid_for_ns=5 * SECOND_NS), 1.1)[0] == 0.1
    stop = make_intent(2.0, go=False, valid_for_ns=5 * SECOND_NS)
    assert choose_speed(intents, stop, 2.1) == (0.0, "ann wants it to stop")
    delayed = make_intent(1.5, valid_for_ns=5 * SECOND_NS, speed_m_s=0.3)
    assert choose_speed(intents, delayed, 2.2)[0] == 0.0, (
        "the network delayed this intent, which was sent before the stop"
    )
    assert choose_speed(intents, make_intent(1.5, requester="bob"), 2.3) == (
        0.1,
        "as bob wants it",
    ), "other requesters have clocks of their own"
    assert choose_speed(intents, make_intent(1.9, go=False), 2.4)[0] == 0.0, (
        "a stop counts in any order"
    )
    intents.reset()
    assert choose_speed(intents, make_intent(0.1), 0.2)[0] == 0.1
