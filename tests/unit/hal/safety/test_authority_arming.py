"""Who may move the robot: arming. Case by case; test_authority_machine.py tries every order of everything."""

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_hal.safety.authority import Authority
from snakesim_hal.safety.cables import Cables
from snakesim_hal.wire.freshness import FRESH_NS
from snakesim_hal.wire.messages import Fault, LeaseRequest, Mode
from tests.unit.hal.rig import LEASE_NS, command
from tests.unit.hal.safety.authority_rig import ARM, CLEAR, DISARM, ESTOP, JOINTS, ROBOT, Rig, armed, commanded, modes

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


def test_a_first_command_may_use_the_whole_torque() -> None:
    rig = armed()
    assert rig.tick_with(0.1).setpoints.torque_limit_nm == [4.0] * JOINTS


def test_the_very_first_decision_is_passive() -> None:
    assert modes(Authority(ROBOT).decide()) == {Mode.PASSIVE}


def test_a_decision_stays_as_it_is() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Rig().pass_tick().sequence = 1  # pyright: ignore[reportAttributeAccessIssue]


def test_right_after_arming_the_pose_is_held_until_a_new_command_comes() -> None:
    rig = armed()
    decision = rig.pass_tick()
    assert decision.sequence is None  # the command from before arming is not enacted
    assert modes(decision) == {Mode.POSITION} and decision.setpoints.target == [0.1] * JOINTS
    assert rig.tick_with(0.11).setpoints.target == pytest.approx([0.11] * JOINTS)


def test_arming_needs_commands_that_still_come() -> None:
    """Asking keeps the lease while disarmed, but whoever only asks does not command."""
    rig = commanded()
    for _ in range(2):
        rig.pass_tick(5)
        assert rig.authority.on_lease(LeaseRequest(action="renew", holder="control", epoch=1), rig.now_ns).ok
    answer = rig.arm()
    assert not answer.ok and answer.reason == "no commands from control any more"
    rig.send(0.1)
    rig.now_ns += LEASE_NS
    assert rig.arm().ok


@pytest.mark.parametrize("mode", [Mode.VELOCITY, Mode.TORQUE])
def test_arming_is_refused_to_a_stream_that_moves(mode: Mode) -> None:
    rig = commanded([0.1, 0.0, 0.1], [Mode.POSITION, mode, Mode.PASSIVE])
    reason = f"joint_2 is commanded in mode {mode.name.lower()}; it must hold its position at arming"
    assert rig.arm().reason == reason and rig.authority.state == "disarmed"


def test_a_passive_stream_may_be_armed_whatever_its_targets() -> None:
    assert commanded(99.0, Mode.PASSIVE).arm().ok


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


def test_after_a_disarm_arming_needs_a_new_command() -> None:
    rig = armed()
    rig.tick_with(0.1)
    rig.authority.on_lifecycle(DISARM, rig.now_ns)
    rig.authority.decide()
    assert rig.arm().reason == "no commands from control yet"
    rig.send(0.1)
    assert rig.arm().ok


def test_a_new_holder_of_the_lease_must_command_itself_from_sequence_0_on() -> None:
    rig = commanded()
    assert rig.acquire("teleop", 200).ok
    assert rig.arm().reason == "no commands from teleop yet"
    assert rig.send(0.1, sequence=0) is None and rig.arm().ok


def test_while_disarmed_it_does_not_matter_which_arming_a_command_names() -> None:
    rig = armed()
    rig.authority.on_lifecycle(DISARM, rig.now_ns)
    for arm_session in (0, 1, 2):
        assert rig.send(0.1, arm_session=arm_session) is None


def test_arming_begins_a_new_term_of_the_lease() -> None:
    rig = commanded()
    rig.now_ns += LEASE_NS - 1
    assert rig.arm().ok and rig.authority.lease.expires_ns == 2 * LEASE_NS - 1


def test_a_lease_that_ran_out_is_free_before_a_tick_has_noticed() -> None:
    rig = armed()
    rig.now_ns += LEASE_NS
    assert not rig.acquire("teleop").ok
    rig.now_ns += 1
    answer = rig.acquire("teleop")
    assert answer.ok and answer.lifecycle == "disarmed" and rig.authority.reason == "lease passed to teleop"


def test_a_command_that_names_no_arming_never_moves_an_armed_robot() -> None:
    rig = armed()
    rig.pass_tick()
    bare = command(ROBOT, 0.2, tick=rig.tick, sequence=50, lease_epoch=rig.authority.lease.epoch)
    assert rig.authority.offer_command(bare, now_ns=rig.now_ns, tick=rig.tick, age_ns=0) == "before_arming"
    assert rig.authority.rejected_counts == {"before_arming": 1}
    assert rig.pass_tick().setpoints.target == pytest.approx([0.1] * JOINTS)


def test_a_command_that_was_under_way_when_the_robot_was_armed_is_nobodys_mistake() -> None:
    rig = Rig()
    rig.tick = 7
    rig.observe(0.1, tick=7)
    rig.acquire()
    rig.send(0.1)
    assert rig.arm().ok
    assert rig.send(0.1, arm_session=0) == "before_arming"
    assert rig.authority.standby_count == 2 and not rig.authority.rejected_counts
    rig.tick = 8
    assert rig.send(0.1, arm_session=0) == "before_arming"
    assert rig.authority.standby_count == 2 and rig.authority.rejected_counts == {"before_arming": 1}


@pytest.mark.parametrize("wrong", [{"arm_session": 0}, {"arm_session": 2}, {"layout": "other"}, {"tick": 10**6}])
def test_a_refused_command_does_not_make_the_next_good_one_a_replay(wrong: dict[str, Any]) -> None:
    rig = armed()
    rig.pass_tick()
    assert rig.send(0.2, sequence=2**60, **wrong) is not None
    assert rig.send(0.11) is None
    assert rig.pass_tick().sequence == rig.sequence


def test_what_counted_in_an_earlier_arming_does_not_count_in_the_next() -> None:
    rig = armed()
    rig.send(0.2)
    assert rig.authority.decide(rig.tick).sequence == rig.sequence
    rig.authority.on_lifecycle(DISARM, rig.now_ns)
    rig.pass_tick()
    rig.send(0.1)
    assert rig.arm().ok and rig.authority.arm_session == 2
    assert rig.authority.decide(rig.tick).sequence is None
    assert rig.authority.decide().sequence is None


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


def test_before_the_first_arming_nobody_needs_to_be_told() -> None:
    """In lockstep there are no decisions before it."""
    rig = Rig()
    rig.authority.on_estop(ESTOP, 0)
    rig.authority.on_lifecycle(CLEAR, 0)
    rig.observe()
    rig.acquire()
    rig.send()
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
