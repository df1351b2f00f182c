"""Who may move the robot: arming. Case by case; test_authority_machine.py tries every order of everything."""

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_hal.safety.cables import Cables
from snakesim_hal.wire.freshness import FRESH_NS
from snakesim_hal.wire.messages import Fault, LeaseRequest, Mode
from snakesim_testing.hal.authority_rig import ARM, CLEAR, DISARM, ESTOP, JOINTS, Rig, armed, commanded, modes
from snakesim_testing.hal.small_robots import LEASE_NS

# --- arming ----------------------------------------------------------------------------------------------------


def test_the_way_to_armed() -> None:
    rig = Rig()
    steps = [
        (lambda: None, ["no joint state yet", "nothing commands the robot: the lease is free"]),
        (lambda: rig.observe(0.1), ["nothing commands the robot: the lease is free"]),
        (rig.acquire, ["no commands from control yet"]),
        (lambda: rig.send(0.1), []),
    ]
    for step, against in steps:
        step()
        assert rig.authority.list_unmet_conditions(rig.now_ns) == against
        answer = rig.arm() if against else None
        assert answer is None or (not answer.ok and answer.reason == "; ".join(against))
        assert rig.authority.state == "disarmed"
    answer = rig.arm()
    assert answer.ok and answer.lifecycle == "armed" and rig.authority.arm_session == 1


def test_a_stopped_robot_is_armed_only_after_a_clear_and_says_so() -> None:
    rig = Rig()
    rig.authority.on_estop(ESTOP, rig.tick)
    assert "state is estop, must be disarmed; first `snakesim robot reset`" in rig.arm().reason
    assert rig.authority.on_lifecycle(CLEAR, rig.now_ns).ok
    rig.authority.fault(Fault(tick=rig.tick, what="test", cause="test"))
    assert "state is fault, must be disarmed; first `snakesim robot reset`" in rig.arm().reason
    assert "snakesim robot reset" not in armed().arm().reason


@pytest.mark.parametrize(
    ("change", "refusal", "words"),
    [
        ({"robot": None, "backend": None, "config_hash": None}, "wrong_robot", ["names None"]),
        ({"backend": None, "config_hash": None}, "wrong_backend", ["this backend is 'lag', the request names None"]),
        ({"robot": "other"}, "wrong_robot", ["this robot is 'worm'", "'other'"]),
        ({"backend": "can"}, "wrong_backend", ["this backend is 'lag'", "'can'"]),
        ({"config_hash": None}, "wrong_config", ["the request names none: read", "arm with its config_hash"]),
        ({"config_hash": "1" * 16}, "wrong_config", [f"{'0' * 16!r}, the request names {'1' * 16!r}"]),
    ],
)
def test_arming_names_robot_backend_and_configuration(change: dict[str, Any], refusal: str, words: list[str]) -> None:
    for rig in (commanded(), armed()):  # a robot in the wrong state, too, is told this first
        before = rig.authority.state
        answer = rig.authority.on_lifecycle(msgspec.structs.replace(ARM, **change), 0)
        assert answer.refusal == refusal and all(word in answer.reason for word in words)
        assert not answer.ok and rig.authority.state == before


BAD_STATES: list[tuple[dict[str, Any], str]] = [
    ({"valid": [True, False, True]}, "joint_2"),
    ({"age_ns": [0, 0, LEASE_NS + 1]}, "joint_3"),
    ({"angle": [0.0, float("nan"), 0.0]}, "joint_2"),
    ({"torque": [float("inf"), 0.0, 0.0]}, "joint_1"),
]


@pytest.mark.parametrize(("bad", "joint"), BAD_STATES)
def test_a_robot_that_does_not_know_its_joints_is_not_armed_and_does_not_stay_armed(
    bad: dict[str, Any], joint: str
) -> None:
    rig = commanded()
    rig.observe(**bad)
    answer = rig.arm()
    assert not answer.ok and answer.reason == f"no valid and fresh state of {joint}"
    rig.observe(0.1)
    assert rig.arm().ok
    rig.observe(**bad)
    decision = rig.tick_with(0.2)
    assert rig.authority.state == "fault" and decision.sequence is None
    assert [fault.what for fault in rig.authority.faults] == ["state_invalid"]
    assert joint in rig.authority.faults[0].cause
    assert np.isfinite(decision.setpoints.target).all()


@pytest.mark.parametrize("column", ["angle", "velocity", "torque", "valid", "age_ns"])
@pytest.mark.parametrize("length", [0, JOINTS - 1, JOINTS + 1])
def test_a_state_of_another_number_of_joints_is_no_state(column: str, length: int) -> None:
    rig = armed()
    values = [True] * length if column == "valid" else [0] * length
    rig.observe(**{column: values})
    decision = rig.pass_tick()
    assert rig.authority.state == "fault" and rig.authority.reason == "no joint state of 3 joints"
    assert decision.setpoints.target == [0.0] * JOINTS


def test_only_the_joints_that_are_not_known_are_named() -> None:
    rig = Rig()
    rig.observe(0.1, age_ns=[FRESH_NS, FRESH_NS + 1, 0])
    assert rig.authority.list_unmet_conditions(0)[0] == "no valid and fresh state of joint_2"


def test_what_is_told_of_a_long_robot_fits_into_a_message() -> None:
    rig = Rig(chain__modules=100)
    rig.observe(0.1, valid=[False] * 100)
    assert len(rig.authority.list_unmet_conditions(0)[0]) == 400
    rig.observe(0.1)
    rig.acquire()
    rig.send(9.0)
    assert len(rig.arm().reason) == 500


def test_a_state_at_the_end_of_its_time_is_still_good() -> None:
    rig = armed()
    rig.observe(0.1, age_ns=[FRESH_NS] * JOINTS)
    rig.tick_with(0.1)
    assert rig.authority.state == "armed"


def test_arming_is_refused_while_a_target_is_far_and_names_the_joint() -> None:
    rig = commanded([0.1, 0.6, 0.1])
    answer = rig.arm()
    assert not answer.ok and "joint_2 has a target +0.50 rad" in answer.reason and "0.3" in answer.reason
    rig.send(0.3)
    assert rig.arm().ok


def test_a_decision_stays_as_it_is() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Rig().pass_tick().sequence = 1  # pyright: ignore[reportAttributeAccessIssue]


def test_right_after_arming_the_pose_is_held_until_a_new_command_comes() -> None:
    rig = armed()
    decision = rig.pass_tick()
    assert decision.sequence is None  # the command from before arming is not enacted
    assert modes(decision) == {Mode.POSITION} and decision.setpoints.target == [0.1] * JOINTS
    assert rig.tick_with(0.11).setpoints.target == pytest.approx([0.11] * JOINTS)


@pytest.mark.parametrize("mode", [Mode.VELOCITY, Mode.TORQUE])
def test_arming_is_refused_to_a_stream_that_moves(mode: Mode) -> None:
    rig = commanded([0.1, 0.0, 0.1], [Mode.POSITION, mode, Mode.PASSIVE])
    reason = f"joint_2 is commanded in mode {mode.name.lower()}; it must hold its position at arming"
    assert rig.arm().reason == reason and rig.authority.state == "disarmed"


def test_what_is_sent_for_another_arming_neither_moves_the_robot_nor_keeps_the_lease() -> None:
    rig = armed()
    rig.tick_with(0.1, arm_session=1)
    for other in (0, 2, 0, 2):
        assert rig.send(0.2, arm_session=other) == "before_arming"
        assert rig.pass_tick().setpoints.target == pytest.approx([0.1] * JOINTS)
    rig.tick_with(0.2, arm_session=0)
    assert rig.authority.state == "fault" and rig.authority.faults[0].what == "lease_expired"
    assert rig.authority.rejected_counts == {"before_arming": 5}
    assert (rig.authority.accepted_count, rig.authority.standby_count) == (1, 1)


# --- stops that nobody has seen --------------------------------------------------------------------------------


@pytest.mark.parametrize("stop", ["estop", "fault", "disarm"])
def test_no_arming_before_the_motors_were_told_of_a_stop(stop: str) -> None:
    """Reset and armed again within one period, the backend would never have heard of it."""
    rig = armed()
    rig.tick_with(0.1)
    if stop == "estop":
        rig.authority.on_estop(ESTOP, rig.tick)
    elif stop == "fault":
        rig.authority.fault(Fault(tick=1, what="hot", cause="hot"))
    else:
        rig.authority.on_lifecycle(DISARM, rig.now_ns)
    if stop != "disarm":
        rig.pass_tick()  # told of the stop, but not that it was reset
        rig.authority.on_lifecycle(CLEAR, rig.now_ns)
    rig.acquire()
    rig.send(0.1)
    answer = rig.arm()
    assert (answer.ok, answer.refusal) == (False, "not_ready") and "have not received the stop" in answer.reason
    assert rig.authority.decide().setpoints.mode == [Mode.PASSIVE] * JOINTS
    assert rig.arm().ok


# --- a no in one word ------------------------------------------------------------------------------------------


def test_every_no_has_a_word() -> None:
    rig = armed()
    ask, authority = LeaseRequest, rig.authority
    answers = {
        "lease_held": authority.on_lease(ask(action="acquire", holder="teleop"), 0),
        "not_holder": authority.on_lease(ask(action="release", holder="teleop", epoch=1), 0),
        "wrong_state": rig.arm(),
    }
    assert authority.on_lease(ask(action="renew", holder="teleop", epoch=1), 0).refusal == "not_holder"
    assert authority.on_lifecycle(CLEAR, 0).refusal == "wrong_state"
    authority.on_estop(ESTOP, 0)
    assert authority.on_lifecycle(DISARM, 0).refusal == "wrong_state"
    rig = Rig()
    answers["not_ready"] = rig.arm()
    assert {word: answer.refusal for word, answer in answers.items()} == {word: word for word in answers}
    assert not any(answer.ok for answer in answers.values())
    assert rig.acquire().refusal is None


def test_a_robot_that_nobody_checked_is_armed_by_an_explicit_word_alone() -> None:
    rig = commanded(unchecked="nobody has checked it")
    refused = rig.arm()
    assert refused.refusal == "not_checked" and "nobody has checked it; to arm it" in refused.reason
    armed = rig.authority.on_lifecycle(msgspec.structs.replace(ARM, unchecked=True), rig.now_ns)
    assert armed.ok and ", unchecked" in rig.authority.reason


def test_a_cable_of_which_nobody_knows_how_far_it_is_wound_is_not_overruled_by_a_word() -> None:
    rig = commanded(unchecked="nobody has checked it", cables=Cables((), {}, {"joint_2": "unknown"}))
    refused = rig.authority.on_lifecycle(msgspec.structs.replace(ARM, unchecked=True), rig.now_ns)
    assert (refused.refusal, refused.reason) == ("cable", "joint_2: unknown")
