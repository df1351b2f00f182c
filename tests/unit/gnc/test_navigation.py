"""Navigation: where the snake shall go, how old the plan is, and how long anybody's intent counts."""

from typing import Any

import pytest

from snakesim_gnc.navigation.intents import MAX_VALIDITY_NS, DesiredMotion, IntentTracker
from snakesim_gnc.navigation.known_path import KnownPath
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import KnownObstacle, LocomotionIntent, WorldModel
from snakesim_testing.gnc.stage import make_world

MISSION_M_S = 0.2
MISSION = DesiredMotion(MISSION_M_S)
SECOND = 10**9
ROUTE = Route([(0.0, 0.0), (1.0, 0.0), (10.0, 0.0)])
PEG = KnownObstacle(
    name="peg", shape="cylinder", position_w=(2.0, 0.1, 0.1), radius_m=0.05, height_m=0.2
)


def intent(at_s: float, **more: Any) -> LocomotionIntent:
    return LocomotionIntent(
        **{"timestamp_ns": round(at_s * SECOND), "requester": "ann", "speed_m_s": 0.1, **more}
    )


def world(tail_x_m: float, timestamp_ns: int = 0) -> WorldModel:
    return make_world(timestamp_ns=timestamp_ns, base_position_w=(tail_x_m, 0.0, 0.0))


def desired(
    intents: IntentTracker, newest: LocomotionIntent | None, at_s: float
) -> tuple[float, str]:
    found = intents.choose_motion(newest, round(at_s * SECOND))
    return found.speed_m_s, found.reason


def test_trajectory_age_is_that_of_its_world_model() -> None:
    planner = KnownPath(ROUTE, [PEG], 0.15)
    blind = planner.update(0, None, MISSION)
    assert blind.assumed_obstacle_friction == 0.15
    assert blind.timestamp_ns is None
    assert blind.push_points == []
    assert not blind.finished
    seen = planner.update(20, world(0.5, timestamp_ns=18 * 10**7), MISSION)
    assert seen.tick == 20
    assert seen.timestamp_ns == 18 * 10**7
    assert seen.push_points == ["peg"]
    again = planner.update(40, world(0.5, timestamp_ns=18 * 10**7), MISSION)
    # Guidance has said nothing new: nor has the plan become new.
    assert again.timestamp_ns == 18 * 10**7


def test_navigation_stops_at_the_end_of_path() -> None:
    there = KnownPath(ROUTE, []).update(0, world(10.0), MISSION)
    assert there.finished
    assert there.speed_m_s == 0.0
    assert there.reason == "the path is finished"


def test_intent_expires_after_its_validity_and_robot_stops() -> None:
    intents = IntentTracker(MISSION_M_S)
    assert desired(intents, None, 0.0) == (MISSION_M_S, "")
    asked = intent(1.0)
    assert desired(intents, asked, 1.2) == (0.1, "as ann wants it")
    assert desired(intents, asked, 2.0) == (0.1, "as ann wants it")
    speed, why = desired(intents, asked, 2.2)
    assert speed == 0.0
    assert why.startswith("the intent of ann has expired: it is 1.2 s old, valid for 1 s")
    speed, why = desired(intents, None, 60.0)  # it does not go back to its mission
    assert speed == 0.0
    assert "send a new one to go on" in why
    assert desired(intents, intent(60.0, requester="bob", speed_m_s=None), 60.1) == (
        MISSION_M_S,
        "as bob wants it",
    )
    assert desired(intents, intent(60.2, go=False), 60.3) == (0.0, "ann wants it to stop")


def test_intent_validity_is_shortened_but_never_extended_beyond_maximum() -> None:
    intents, brief = IntentTracker(MISSION_M_S), intent(0.0, valid_for_ns=SECOND // 2)
    assert desired(intents, brief, 0.5)[0] == 0.1
    assert desired(intents, brief, 0.6)[0] == 0.0
    intents, endless = IntentTracker(MISSION_M_S), intent(0.0, valid_for_ns=2**62)
    assert desired(intents, endless, MAX_VALIDITY_NS / SECOND)[0] == 0.1
    speed, why = desired(intents, endless, MAX_VALIDITY_NS / SECOND + 0.1)
    assert speed == 0.0
    assert "valid for 5 s" in why


@pytest.mark.parametrize(
    ("at_s", "words"),
    [(20.2, "stamped 10.2 s ahead of the robot's clock"), (8.0, "has expired: it is 2 s old")],
)
def test_intent_with_future_or_old_timestamp_is_refused(at_s: float, words: str) -> None:
    intents = IntentTracker(MISSION_M_S)
    speed, why = desired(intents, intent(at_s), 10.0)
    assert speed == MISSION_M_S
    assert words in why  # nobody has taken over from the mission
    good = intent(10.0)
    assert desired(intents, good, 10.1)[0] == 0.1
    # The good one goes on.
    assert desired(intents, intent(at_s, speed_m_s=5.0), 10.2) == (0.1, "as ann wants it")
    assert desired(intents, intent(at_s, speed_m_s=5.0), 11.5)[0] == 0.0  # and ends when it says


def test_a_clock_that_the_sender_heard_first_is_no_future() -> None:
    assert desired(IntentTracker(MISSION_M_S), intent(1.09), 1.0)[0] == 0.1


@pytest.mark.parametrize("speed_m_s", [10.1, -11.0, 1e5])
def test_navigation_intent_speed_is_limited_by_mission(speed_m_s: float) -> None:
    speed, why = desired(IntentTracker(MISSION_M_S), intent(1.0, speed_m_s=speed_m_s), 1.0)
    assert speed == MISSION_M_S
    assert f"asks for {speed_m_s:g} m/s, at most 10 m/s" in why


def test_intent_direction_holds_while_standing_until_mission_resumes() -> None:
    intents = IntentTracker(MISSION_M_S)
    assert intents.choose_motion(intent(0.0, heading_w_rad=1.5), 0).heading_w_rad == 1.5
    expired = intents.choose_motion(None, 2 * SECOND)
    assert expired.speed_m_s == 0.0
    assert expired.heading_w_rad == 1.5  # it stops on the path that it is on
    assert intents.choose_motion(intent(2.1, go=False), 2_100_000_000).heading_w_rad == 1.5
    assert intents.choose_motion(intent(2.2), 2_200_000_000).heading_w_rad is None


def test_intent_before_a_robot_restart_is_ignored_afterwards() -> None:
    intents, asked = IntentTracker(MISSION_M_S), intent(50.0)
    assert desired(intents, asked, 50.1)[0] == 0.1
    intents.reset()
    speed, why = desired(intents, None, 0.0)
    assert speed == 0.0
    assert "the intent of ann was for another start of the robot" in why
    assert desired(intents, None, 50.1)[0] == 0.0
    fresh = IntentTracker(MISSION_M_S)
    fresh.reset()
    assert desired(fresh, None, 0.0) == (MISSION_M_S, "")


def test_intent_sent_before_a_stop_does_not_move_robot() -> None:
    intents = IntentTracker(MISSION_M_S)
    assert desired(intents, intent(1.0, valid_for_ns=5 * SECOND), 1.1)[0] == 0.1
    assert desired(intents, intent(2.0, go=False, valid_for_ns=5 * SECOND), 2.1) == (
        0.0,
        "ann wants it to stop",
    )
    late = intent(1.5, valid_for_ns=5 * SECOND, speed_m_s=0.3)
    assert desired(intents, late, 2.2)[0] == 0.0, (
        "held back by the network, and valid by its stamp alone"
    )
    assert desired(intents, intent(1.5, requester="bob"), 2.3) == (0.1, "as bob wants it"), (
        "others have clocks of their own"
    )
    assert desired(intents, intent(1.9, go=False), 2.4)[0] == 0.0, "a stop counts in any order"
    intents.reset()
    assert desired(intents, intent(0.1), 0.2)[0] == 0.1
