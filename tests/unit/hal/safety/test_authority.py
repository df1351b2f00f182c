"""Who may move the robot, case by case; test_authority_machine.py tries every order of everything."""

import dataclasses
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_hal.safety.authority import COMMANDS_KEPT, Authority, Decision
from snakesim_hal.safety.fault_log import MAX_FAULTS_KEPT
from snakesim_hal.safety.gate import FRESH_NS
from snakesim_hal.wire.messages import (
    Answer,
    EstopRequest,
    Fault,
    JointCommand,
    LeaseRequest,
    LifecycleRequest,
    LifecycleState,
    Mode,
    Power,
)
from tests.unit.hal.rig import LEASE_NS, PERIOD_NS, command, description, state

ROBOT = description()
JOINTS = len(ROBOT.joints)
ARM = LifecycleRequest(action="arm", robot="worm", backend="lag", config_hash=ROBOT.config_hash)
DISARM, CLEAR, FINISH = (LifecycleRequest(action=action) for action in ("disarm", "clear", "finish"))
ESTOP = EstopRequest(who="a person")


class Rig:
    """An authority with a clock; every step is one a host would take."""

    def __init__(self, **robot: Any) -> None:
        self.robot = description(**robot)
        self.authority = Authority(self.robot)
        self.now_ns = 0
        self.tick = 0
        self.sequence = 0
        self.stamp_ns = 0

    def observe(self, *values: Any, **other: Any) -> None:
        """A state so much later than the one before that the joints may have come from anywhere."""
        self.stamp_ns += 10**9
        self.authority.observe(state(self.robot, *values, stamp_ns=self.stamp_ns, **other))

    def acquire(self, holder: str = "control", priority: int = 100) -> Answer:
        return self.authority.on_lease(LeaseRequest(action="acquire", holder=holder, priority=priority), self.now_ns)

    def send(self, target: Any = 0.0, mode: Any = Mode.POSITION, **other: Any) -> str | None:
        self.sequence += 1
        authority = self.authority
        values = {"sequence": self.sequence, "lease_epoch": authority.lease.epoch, "arming": authority.arming, **other}
        values = {"tick": self.tick, **values}
        asked = command(self.robot, target, mode, **values)
        return self.authority.offer(asked, now_ns=self.now_ns, tick=self.tick, age_ns=0)

    def arm(self) -> Answer:
        return self.authority.on_lifecycle(ARM, self.now_ns)

    def pass_tick(self, periods: int = 1) -> Decision:
        self.now_ns += periods * PERIOD_NS
        self.tick += periods
        self.authority.expire(self.now_ns, self.tick)
        return self.authority.decide()


def armed(**robot: Any) -> Rig:
    rig = Rig(**robot)
    rig.observe(0.1)
    assert rig.acquire().ok and rig.send(0.1) is None
    assert rig.arm().ok
    return rig


def modes(decision: Decision) -> set[Mode]:
    return set(decision.set_points.mode)


# --- arming ----------------------------------------------------------------------------------------------------


def test_the_way_to_armed() -> None:
    rig = Rig()
    steps = [
        (lambda: None, ["no joint state yet", "the lease is free"]),
        (lambda: rig.observe(0.1), ["the lease is free"]),
        (rig.acquire, ["no commands from control yet"]),
        (lambda: rig.send(0.1), []),
    ]
    for step, against in steps:
        step()
        assert rig.authority.against_arming(rig.now_ns) == against
        answer = rig.arm() if against else None
        assert answer is None or (not answer.ok and answer.reason == "; ".join(against))
        assert rig.authority.state == "disarmed"
    answer = rig.arm()
    assert answer.ok and answer.lifecycle == "armed" and rig.authority.arming == 1


@pytest.mark.parametrize(
    ("request_", "words"),
    [
        (LifecycleRequest(action="arm"), ["names None"]),
        (LifecycleRequest(action="arm", robot="worm"), ["this backend is 'lag', the request names None"]),
        (LifecycleRequest(action="arm", robot="other", backend="lag"), ["this robot is 'worm'", "'other'"]),
        (LifecycleRequest(action="arm", robot="worm", backend="can"), ["this backend is 'lag'", "'can'"]),
        (msgspec.structs.replace(ARM, config_hash=None), ["the request names none", "arm with its config_hash"]),
        (msgspec.structs.replace(ARM, config_hash="1" * 16), [f"{'0' * 16!r}, the request names {'1' * 16!r}"]),
    ],
)
def test_arming_names_robot_backend_and_configuration(request_: LifecycleRequest, words: list[str]) -> None:
    rig = Rig()
    rig.observe()
    rig.acquire()
    rig.send()
    answer = rig.authority.on_lifecycle(request_, 0)
    assert not answer.ok and all(word in answer.reason for word in words) and rig.authority.state == "disarmed"


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
    rig = Rig()
    rig.observe()
    rig.acquire()
    rig.send()
    rig.observe(**bad)
    answer = rig.arm()
    assert not answer.ok and answer.reason == f"no valid and fresh state of {joint}"
    rig.observe()
    assert rig.arm().ok
    rig.observe(**bad)
    rig.send(0.2)
    decision = rig.pass_tick()
    assert rig.authority.state == "fault" and decision.sequence is None
    assert [fault.what for fault in rig.authority.faults] == ["state_invalid"]
    assert joint in rig.authority.faults[0].cause
    assert np.isfinite(decision.set_points.target).all()


@pytest.mark.parametrize("column", ["angle", "velocity", "torque", "valid", "age_ns"])
@pytest.mark.parametrize("length", [0, JOINTS - 1, JOINTS + 1])
def test_a_state_of_another_number_of_joints_is_no_state(column: str, length: int) -> None:
    rig = armed()
    values = [True] * length if column == "valid" else [0] * length
    rig.observe(**{column: values})
    decision = rig.pass_tick()
    assert rig.authority.state == "fault" and rig.authority.why == "no joint state of 3 joints"
    assert decision.set_points.target == [0.0] * JOINTS


def test_only_the_joints_that_are_not_known_are_named() -> None:
    rig = Rig()
    rig.observe(0.1, age_ns=[FRESH_NS, FRESH_NS + 1, 0])
    assert rig.authority.against_arming(0)[0] == "no valid and fresh state of joint_2"


def test_what_is_told_of_a_long_robot_fits_into_a_message() -> None:
    rig = Rig(chain__modules=100)
    rig.observe(0.1, valid=[False] * 100)
    assert len(rig.authority.against_arming(0)[0]) == 400
    rig.observe(0.1)
    rig.acquire()
    rig.send(9.0)
    assert len(rig.arm().reason) == 500


def test_a_state_at_the_end_of_its_time_is_still_good() -> None:
    rig = armed()
    rig.observe(0.1, age_ns=[FRESH_NS] * JOINTS)
    rig.send(0.1)
    rig.pass_tick()
    assert rig.authority.state == "armed"


def test_arming_is_refused_while_a_target_is_far_and_names_the_joint() -> None:
    rig = Rig()
    rig.observe(0.1)
    rig.acquire()
    rig.send([0.1, 0.6, 0.1])
    answer = rig.arm()
    assert not answer.ok and "joint_2 has a target +0.50 rad" in answer.reason and "0.3" in answer.reason
    rig.send(0.3)
    assert rig.arm().ok


def test_a_first_command_may_use_the_whole_torque() -> None:
    rig = armed()
    rig.send(0.1)
    assert rig.pass_tick().set_points.torque_limit_nm == [4.0] * JOINTS


def test_the_very_first_decision_is_passive() -> None:
    assert modes(Authority(ROBOT).decide()) == {Mode.PASSIVE}


def test_a_decision_stays_as_it_is() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Rig().pass_tick().sequence = 1  # pyright: ignore[reportAttributeAccessIssue]


def test_right_after_arming_the_pose_is_held_until_a_new_command_comes() -> None:
    rig = armed()
    decision = rig.pass_tick()
    assert decision.sequence is None  # the command from before arming is not enacted
    assert modes(decision) == {Mode.POSITION} and decision.set_points.target == [0.1] * JOINTS
    rig.send(0.11)
    assert rig.pass_tick().set_points.target == pytest.approx([0.11] * JOINTS)


def test_arming_needs_commands_that_still_come() -> None:
    """Asking keeps the lease while disarmed, but whoever only asks does not command."""
    rig = Rig()
    rig.observe(0.1)
    rig.acquire()
    rig.send(0.1)
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
    rig = Rig()
    rig.observe(0.1)
    rig.acquire()
    rig.send([0.1, 0.0, 0.1], [Mode.POSITION, mode, Mode.PASSIVE])
    reason = f"joint_2 is commanded in mode {mode.name.lower()}; it must hold its position at arming"
    assert rig.arm().reason == reason and rig.authority.state == "disarmed"


def test_a_passive_stream_may_be_armed_whatever_its_targets() -> None:
    rig = Rig()
    rig.observe(0.1)
    rig.acquire()
    rig.send(99.0, Mode.PASSIVE)
    assert rig.arm().ok


def test_what_is_sent_for_another_arming_neither_moves_the_robot_nor_keeps_the_lease() -> None:
    rig = armed()
    rig.send(0.1, arming=1)
    rig.pass_tick()
    for other in (0, 2, 0, 2):
        assert rig.send(0.2, arming=other) == "before_arming"
        assert rig.pass_tick().set_points.target == pytest.approx([0.1] * JOINTS)
    rig.send(0.2, arming=0)
    rig.pass_tick()
    assert rig.authority.state == "fault" and rig.authority.faults[0].what == "lease_expired"
    assert rig.authority.rejected == {"before_arming": 5}
    assert (rig.authority.accepted, rig.authority.standby) == (1, 1)


def test_while_disarmed_it_does_not_matter_which_arming_a_command_names() -> None:
    rig = armed()
    rig.authority.on_lifecycle(DISARM, rig.now_ns)
    for arming in (0, 1, 2):
        assert rig.send(0.1, arming=arming) is None


def test_arming_begins_a_new_term_of_the_lease() -> None:
    rig = Rig()
    rig.observe(0.1)
    rig.acquire()
    rig.send(0.1)
    rig.now_ns += LEASE_NS - 1
    assert rig.arm().ok and rig.authority.lease.expires_ns == 2 * LEASE_NS - 1


def test_a_lease_that_ran_out_is_free_before_a_tick_has_noticed() -> None:
    rig = armed()
    rig.now_ns += LEASE_NS
    assert not rig.acquire("teleop").ok
    rig.now_ns += 1
    answer = rig.acquire("teleop")
    assert answer.ok and answer.lifecycle == "disarmed" and rig.authority.why == "lease passed to teleop"


def test_a_command_that_names_no_arming_never_moves_an_armed_robot() -> None:
    rig = armed()
    rig.pass_tick()
    bare = JointCommand(
        tick=rig.tick,
        sequence=50,
        lease_epoch=rig.authority.lease.epoch,
        layout=ROBOT.layout,
        valid_for_ns=LEASE_NS,
        mode=[Mode.POSITION] * JOINTS,
        target=[0.2] * JOINTS,
    )
    assert rig.authority.offer(bare, now_ns=rig.now_ns, tick=rig.tick, age_ns=0) == "before_arming"
    assert rig.authority.rejected == {"before_arming": 1}
    assert rig.pass_tick().set_points.target == pytest.approx([0.1] * JOINTS)


def test_a_command_that_was_under_way_when_the_robot_was_armed_is_nobodys_mistake() -> None:
    rig = Rig()
    rig.tick = 7
    rig.observe(0.1, tick=7)
    rig.acquire()
    rig.send(0.1)
    assert rig.arm().ok
    assert rig.send(0.1, arming=0) == "before_arming"
    assert rig.authority.standby == 2 and not rig.authority.rejected
    rig.tick = 8
    assert rig.send(0.1, arming=0) == "before_arming"
    assert rig.authority.standby == 2 and rig.authority.rejected == {"before_arming": 1}


@pytest.mark.parametrize("wrong", [{"arming": 0}, {"arming": 2}, {"layout": "other"}, {"tick": 10**6}])
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
    assert rig.arm().ok and rig.authority.arming == 2
    assert rig.authority.decide(rig.tick).sequence is None
    assert rig.authority.decide().sequence is None


# --- lockstep: what counts is told by ticks --------------------------------------------------------------------


def test_in_lockstep_a_command_waits_for_its_tick() -> None:
    rig = armed()
    rig.send(0.11, tick=0)
    rig.tick = 1
    rig.send(0.12, tick=1)
    assert rig.authority.decide(0).set_points.target == pytest.approx([0.11] * JOINTS)
    assert rig.authority.decide(1).set_points.target == pytest.approx([0.12] * JOINTS)


def test_in_lockstep_the_last_command_goes_on_when_a_flood_has_pushed_it_out() -> None:
    """Falling back to the pose at arming would be a jump that no gate has limited."""
    rig = armed()
    before = rig.authority.decide(0)
    for tick in range(5):
        rig.tick = tick
        rig.send(0.3)
        before = rig.authority.decide(tick)
    rig.tick = 5
    for _ in range(COMMANDS_KEPT + 1):
        rig.send(0.1)
    decision = rig.authority.decide(4)
    assert decision.sequence == before.sequence and decision.set_points.target == pytest.approx([0.3] * JOINTS)


# --- the lease -------------------------------------------------------------------------------------------------


def test_commands_keep_the_lease_and_silence_ends_it_with_a_fault() -> None:
    rig = armed()
    for _ in range(20):
        assert rig.send(0.1) is None
        assert rig.pass_tick().sequence == rig.sequence
    for _ in range(LEASE_NS // PERIOD_NS - 1):  # the last command goes on for one term
        assert rig.pass_tick().sequence == rig.sequence
    decision = rig.pass_tick()
    assert rig.authority.state == "fault" and decision.sequence is None
    assert modes(decision) == {Mode.VELOCITY} and decision.set_points.target == [0.0] * JOINTS
    (fault,) = rig.authority.faults
    assert (fault.what, fault.tick) == ("lease_expired", rig.tick)
    assert fault.cause == "lease of control expired: no accepted command for 50 ms"
    assert rig.authority.lease.holder is None


@pytest.mark.parametrize(
    "wrong",
    [{"lease_epoch": 0}, {"layout": "other"}, {"sequence": 1}, {"target": [float("nan")] * JOINTS}, {"tick": 10**6}],
)
def test_refused_commands_neither_keep_the_lease_nor_reach_a_motor(wrong: dict[str, Any]) -> None:
    rig = armed()
    rig.send(0.1)
    rig.pass_tick()
    good = rig.sequence
    for _ in range(4):
        assert rig.send(**{"target": 0.2, **wrong}) is not None
        decision = rig.pass_tick()
        assert decision.sequence == good and decision.set_points.target == pytest.approx([0.1] * JOINTS)
    rig.send(**{"target": 0.2, **wrong})
    rig.pass_tick()
    assert rig.authority.state == "fault"
    assert sum(rig.authority.rejected.values()) == 5


def test_asking_to_renew_is_not_commanding() -> None:
    """A process whose controller hangs but whose lease thread lives must not keep the last set-points going."""
    rig = armed()
    rig.send(0.1)
    for _ in range(10):
        renew = LeaseRequest(action="renew", holder="control", epoch=rig.authority.lease.epoch)
        rig.authority.on_lease(renew, rig.now_ns)
        rig.pass_tick()
    assert rig.authority.state == "fault" and rig.authority.faults[0].what == "lease_expired"


def test_disarmed_the_lease_can_be_kept_by_asking_and_simply_runs_out() -> None:
    rig = Rig()
    rig.observe()
    rig.acquire()
    for _ in range(20):
        answer = rig.authority.on_lease(LeaseRequest(action="renew", holder="control", epoch=1), rig.now_ns)
        assert answer.ok and answer.epoch == 1
        rig.pass_tick(3)
    rig.pass_tick(3)
    assert rig.authority.lease.holder is None and rig.authority.state == "disarmed" and not rig.authority.faults


def test_preemption_stops_the_robot_and_voids_what_the_old_holder_sends() -> None:
    rig = armed()
    rig.send(0.1)
    rig.pass_tick()
    assert not rig.acquire("teleop").ok and rig.authority.state == "armed"
    answer = rig.acquire("teleop", priority=200)
    assert answer.ok and answer.epoch == 2 and answer.lifecycle == "disarmed"
    assert modes(rig.pass_tick()) == {Mode.PASSIVE}
    assert rig.send(0.1, lease_epoch=1) == "wrong_epoch"
    assert rig.arm().reason == "no commands from teleop yet"
    rig.send(0.1, sequence=1)  # a new holder counts from its own beginning
    assert rig.arm().ok


def test_a_released_lease_stops_the_robot_without_a_fault() -> None:
    rig = armed()
    rig.send(0.1)
    rig.authority.on_lease(LeaseRequest(action="release", holder="control", epoch=1), rig.now_ns)
    assert rig.authority.state == "disarmed" and not rig.authority.faults
    assert modes(rig.pass_tick()) == {Mode.PASSIVE}


def test_a_holder_that_is_gone_frees_the_lease_but_explains_nothing_away() -> None:
    rig = armed()
    rig.authority.on_estop(ESTOP, 3)
    rig.authority.holder_gone("control is gone")
    assert rig.authority.lease.holder is None and "a person" in rig.authority.why
    rig.authority.on_lifecycle(CLEAR, rig.now_ns)
    rig.acquire()
    rig.authority.holder_gone("control is gone")
    assert rig.authority.why == "control is gone"
    rig = armed()
    rig.authority.holder_gone("control is gone")  # armed, only the lease decides
    assert rig.authority.lease.holder == "control" and rig.authority.state == "armed"


# --- stops -----------------------------------------------------------------------------------------------------


def test_an_estop_is_latched_and_only_clear_and_arm_lead_back() -> None:
    rig = armed()
    rig.send(0.2)
    rig.pass_tick()
    assert rig.authority.on_estop(ESTOP, rig.tick).ok
    for _ in range(3):
        rig.send(0.2)
        decision = rig.pass_tick()
        assert modes(decision) == {Mode.PASSIVE} and decision.sequence is None
    assert not rig.arm().ok and not rig.authority.on_lifecycle(DISARM, rig.now_ns).ok
    assert rig.authority.on_lifecycle(CLEAR, rig.now_ns).ok
    rig.send(0.2)
    assert modes(rig.pass_tick()) == {Mode.PASSIVE}
    assert rig.arm().ok
    assert rig.pass_tick().set_points.target == [0.1] * JOINTS  # resumes from the measured pose


@pytest.mark.parametrize(
    ("action", "mode", "target"),
    [("passive", Mode.PASSIVE, 0.0), ("damp", Mode.VELOCITY, 0.0), ("hold", Mode.POSITION, 0.4)],
)
def test_a_fault_takes_the_robots_safe_action(action: str, mode: Mode, target: float) -> None:
    rig = armed(safety__action=action)
    rig.observe(0.4)
    rig.authority.fault(Fault(tick=1, what="hot", cause="joint_2 is hot"))
    for angle in (0.4, 0.6, 0.9):  # what the joint does afterwards does not move the pose that is held
        rig.observe(angle)
        decision = rig.pass_tick()
        assert modes(decision) == {mode} and decision.set_points.target == [target] * JOINTS
    assert rig.authority.lease.holder is None
    assert rig.acquire("control").lifecycle != "armed" and not rig.arm().ok


def test_a_fault_that_reaches_nothing_is_listed_and_stops_nothing() -> None:
    rig = armed()
    rig.authority.fault(Fault(tick=1, what="sample_late", cause="sensor/depth/head", reach="none"))
    assert rig.authority.state == "armed" and rig.authority.lease.holder is not None
    assert [(fault.what, fault.reach) for fault in rig.authority.faults] == [("sample_late", "none")]


@pytest.mark.parametrize("action", ["passive", "damp", "hold"])
def test_a_fault_while_disarmed_switches_no_motor_on(action: str) -> None:
    rig = Rig(safety__action=action)
    rig.observe(0.7)
    rig.authority.fault(Fault(tick=1, what="hot", cause="joint_2 is hot"))
    assert set(rig.pass_tick().set_points.mode) == {Mode.PASSIVE}


def test_a_fault_is_held_where_the_joints_were_when_it_came() -> None:
    rig = armed(safety__action="hold")
    rig.observe(0.7)
    rig.authority.fault(Fault(tick=1, what="hot", cause="joint_2 is hot"))
    rig.observe(0.2)
    assert rig.pass_tick().set_points.target == [0.7] * JOINTS


def test_a_held_pose_stays_inside_the_angle_limits() -> None:
    rig = armed(safety__action="hold")
    rig.observe(1.9)
    rig.authority.fault(Fault(tick=1, what="hot", cause="hot"))
    assert rig.pass_tick().set_points.target == [1.5] * JOINTS


def test_a_fault_does_not_turn_an_estop_into_something_milder() -> None:
    rig = armed()
    rig.authority.on_estop(ESTOP, 1)
    rig.authority.fault(Fault(tick=2, what="hot", cause="hot"))
    assert rig.authority.state == "estop" and "a person" in rig.authority.why
    assert [fault.what for fault in rig.authority.faults] == ["estop", "hot"]


def test_faults_are_kept_up_to_a_limit_the_first_and_the_newest() -> None:
    rig = Rig()
    for i in range(100):
        rig.authority.fault(Fault(tick=i, what="hot", cause="hot"))
    assert [fault.tick for fault in rig.authority.faults] == [*range(16), *range(84, 100)]
    assert rig.authority.since_clear.left_out == rig.authority.since_start.left_out == 68
    assert (MAX_FAULTS_KEPT, COMMANDS_KEPT) == (32, 1024)  # a status holds 64 faults
    rig.authority.on_lifecycle(CLEAR, 0)
    assert rig.authority.faults == [] and rig.authority.since_clear.left_out == 0
    assert len(rig.authority.since_start.kept) == MAX_FAULTS_KEPT and rig.authority.since_start.left_out == 68


def test_a_fault_is_explained_in_as_many_words_as_a_message_holds() -> None:
    rig = armed()
    rig.authority.fault(Fault(tick=1, what="hot", cause="x" * 501))
    assert rig.authority.why == rig.authority.faults[0].cause == "x" * 500
    rig = armed()
    rig = armed()
    rig.authority.fault(Fault(tick=1, what="hot", cause=""))
    assert rig.authority.why == "hot"
    rig.authority.fault(Fault(tick=2, what="cold", cause="what follows from it explains nothing"))
    assert rig.authority.why == "hot" and len(rig.authority.faults) == 2


def test_the_first_fault_is_why_and_what_it_brings_about_is_listed() -> None:
    rig = armed()
    for what in ("bus_off", *["watchdog"] * 40):
        rig.authority.fault(Fault(tick=1, what=what, cause=f"because of {what}"))
    assert rig.authority.why == rig.authority.faults[0].cause == "because of bus_off"
    assert rig.authority.faults[1].cause == "because of watchdog"


def test_a_note_stops_nothing() -> None:
    rig = armed()
    rig.authority.note(Fault(tick=1, what="service_lost", cause="guidance is gone"))
    assert rig.authority.state == "armed" and len(rig.authority.faults) == 1


@pytest.mark.parametrize(("state_", "ok"), [("disarmed", True), ("armed", False), ("fault", True), ("estop", True)])
def test_clear(state_: LifecycleState, ok: bool) -> None:
    rig = armed()
    if state_ == "disarmed":
        rig.authority.on_lifecycle(DISARM, 0)
    elif state_ == "fault":
        rig.authority.fault(Fault(tick=1, what="hot", cause="hot"))
    elif state_ == "estop":
        rig.authority.on_estop(ESTOP, 1)
    answer = rig.authority.on_lifecycle(CLEAR, 0)
    assert answer.ok == ok and answer.lifecycle == ("disarmed" if ok else "armed")
    assert not rig.authority.faults


def test_finishing_disarms_and_hides_no_fault() -> None:
    rig = armed()
    assert rig.authority.on_lifecycle(FINISH, 0).lifecycle == "disarmed"
    rig.authority.fault(Fault(tick=1, what="hot", cause="hot"))
    assert rig.authority.on_lifecycle(FINISH, 0).lifecycle == "fault"


def test_what_the_gate_changes_is_counted_by_limit() -> None:
    rig = armed()
    rig.observe(0.1)
    rig.pass_tick()
    rig.send([0.1, 1.0, 2.0])
    decision = rig.pass_tick()
    assert decision.limited == {1: "angle_rate", 2: "angle"}
    assert rig.authority.limited == {"angle_rate": 1, "angle": 1}


def test_a_lease_epoch_is_never_accepted_twice() -> None:
    """Old commands of an earlier holder stay void, however often the lease changes hands."""
    rig = Rig()
    rig.observe()
    old: list[JointCommand] = []
    for _ in range(5):
        assert rig.acquire().ok
        epoch = rig.authority.lease.epoch
        assert all(rig.authority.offer(c, now_ns=rig.now_ns, tick=rig.tick, age_ns=0) == "wrong_epoch" for c in old)
        old.append(command(rig.robot, sequence=10**6, lease_epoch=epoch))
        rig.pass_tick(10)


# --- what is not believed --------------------------------------------------------------------------------------


def test_a_glitch_of_an_encoder_moves_no_motor_and_stops_the_robot() -> None:
    rig = armed(safety__action="hold")
    rig.observe(0.1)
    rig.send(0.1)
    rig.pass_tick()
    rig.stamp_ns += PERIOD_NS - 10**9
    rig.observe([0.1, 0.9, 0.1])
    rig.send([0.1, 0.9, 0.1])
    decision = rig.pass_tick()
    (fault,) = rig.authority.faults
    assert (fault.what, fault.joint, fault.tick) == ("state_invalid", "joint_2", rig.tick)
    assert "joint_2 by +0.80 rad" in fault.cause
    assert decision.set_points.target == pytest.approx([0.1] * JOINTS)


def test_a_glitch_stands_against_arming() -> None:
    rig = Rig()
    rig.observe(0.1)
    rig.acquire()
    rig.send(0.1)
    rig.stamp_ns += PERIOD_NS - 10**9
    rig.observe([0.1, 0.9, 0.1])
    assert "joint_2 by +0.80 rad" in rig.arm().reason
    rig.observe(0.1)
    assert rig.arm().ok


def test_time_that_the_host_knows_of_counts() -> None:
    rig = armed()
    rig.authority.observe(state(rig.robot, 0.9, stamp_ns=rig.stamp_ns), rig.stamp_ns + 10**9)
    rig.pass_tick()
    assert rig.authority.state == "armed"


def test_a_frozen_joint_stops_an_armed_robot() -> None:
    rig = armed()
    for k in range(12):
        rig.stamp_ns += PERIOD_NS - 10**9
        rig.observe(0.1, 0.0, [0.1, 0.5, 0.1 * k])
        rig.send([0.1, 0.1 + 0.02 * k, 0.1 + 0.02 * k])
        rig.pass_tick()
    assert [(fault.what, fault.joint) for fault in rig.authority.faults] == [("joint_frozen", "joint_2")]


# --- heat, supply and leaks ------------------------------------------------------------------------------------


def hear(rig: Rig, motor_c: list[float], volts: float = 24.0, valid: list[bool] | None = None) -> None:
    power = Power(
        tick=rig.tick,
        stamp_ns=0,
        voltage_v=[volts] * JOINTS,
        current_a=[0.0] * JOINTS,
        motor_c=motor_c,
        board_c=[20.0] * JOINTS,
        leak=[False] * JOINTS,
        valid=valid or [True] * JOINTS,
    )
    rig.authority.observe_power(power, rig.now_ns)


def test_heat_derates_then_stops_and_must_be_gone_before_the_next_arming() -> None:
    rig = armed()
    hear(rig, [20.0, 92.5, 20.0])
    rig.send(0.1)
    decision = rig.pass_tick()
    assert decision.set_points.torque_limit_nm == pytest.approx([4.0, 2.4, 4.0])
    assert decision.limited == {1: "thermal"} and rig.authority.limited == {"thermal": 1}
    assert rig.authority.derated == {"joint_2": pytest.approx(0.6)}
    hear(rig, [20.0, 110.0, 20.0])
    decision = rig.pass_tick()
    assert [(fault.what, fault.joint) for fault in rig.authority.faults] == [("overheated", "joint_2")]
    assert decision.set_points.torque_limit_nm == pytest.approx([4.0, 0.8, 4.0])  # also of the safe action
    rig.authority.on_lifecycle(CLEAR, rig.now_ns)
    rig.acquire()
    rig.send(0.1)
    rig.pass_tick()
    answer = rig.arm()
    assert rig.authority.state == "disarmed" and answer.refusal == "not_ready" and "joint_2 is at 110" in answer.reason
    hear(rig, [20.0, 70.0, 20.0])
    rig.pass_tick()
    rig.send(0.1)
    assert rig.arm().ok and rig.authority.derated == {}


def test_who_tells_nothing_of_its_health_is_noted() -> None:
    rig = Rig()
    hear(rig, [20.0] * JOINTS)
    rig.pass_tick(301)
    assert [fault.what for fault in rig.authority.faults] == ["power_unknown"] and rig.authority.state == "disarmed"


def test_a_weak_supply_stops_an_armed_robot_within_50_ms() -> None:
    rig = armed()
    hear(rig, [20.0] * JOINTS, volts=12.0)
    for _ in range(5):
        assert rig.authority.state == "armed"
        rig.send(0.1)
        rig.pass_tick()
    assert {fault.what for fault in rig.authority.faults} == {"undervoltage"}


# --- stops that nobody has seen --------------------------------------------------------------------------------


@pytest.mark.parametrize("stop", ["estop", "fault", "disarm"])
def test_no_arming_before_the_motors_were_told_of_a_stop(stop: str) -> None:
    """Cleared and armed again within one period, the backend would never have heard of it."""
    rig = armed()
    rig.send(0.1)
    rig.pass_tick()
    if stop == "estop":
        rig.authority.on_estop(ESTOP, rig.tick)
    elif stop == "fault":
        rig.authority.fault(Fault(tick=1, what="hot", cause="hot"))
    else:
        rig.authority.on_lifecycle(DISARM, rig.now_ns)
    if stop != "disarm":
        rig.pass_tick()  # told of the stop, but not that it was cleared
        rig.authority.on_lifecycle(CLEAR, rig.now_ns)
    rig.acquire()
    rig.send(0.1)
    answer = rig.arm()
    assert (answer.ok, answer.refusal) == (False, "not_ready") and "have not received the stop" in answer.reason
    assert rig.authority.decide().set_points.mode == [Mode.PASSIVE] * JOINTS
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
    for word, change in (("robot", {"robot": "x"}), ("backend", {"backend": "x"}), ("config", {"config_hash": "x"})):
        asked = msgspec.structs.replace(ARM, **change)
        answers[f"wrong_{word}"] = rig.authority.on_lifecycle(asked, 0)
    answers["not_ready"] = rig.arm()
    assert {word: answer.refusal for word, answer in answers.items()} == {word: word for word in answers}
    assert not any(answer.ok for answer in answers.values())
    assert rig.acquire().refusal is None


def test_what_matters_most_is_the_word() -> None:
    rig = armed()
    for change, word in (
        ({"config_hash": None, "backend": None, "robot": None}, "wrong_robot"),
        ({"config_hash": None, "backend": None}, "wrong_backend"),
        ({"config_hash": None}, "wrong_config"),
        ({}, "wrong_state"),
    ):
        assert rig.authority.on_lifecycle(msgspec.structs.replace(ARM, **change), 0).refusal == word


# --- what is told ----------------------------------------------------------------------------------------------


def test_what_never_became_a_command_is_counted_by_reason() -> None:
    rig = armed()
    rig.authority.reject("malformed")
    assert rig.authority.rejected == {"malformed": 1} and rig.authority.state == "armed"


def test_what_is_published_of_a_joint_without_a_number_is_its_last_good_state() -> None:
    rig = armed()
    told = rig.authority.readable(state(rig.robot, [0.2, float("nan"), 0.2]))
    assert told.angle_rad == [0.2, 0.1, 0.2] and told.valid == [True, False, True]
