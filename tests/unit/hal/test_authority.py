"""Who may move the robot: whatever comes in, in whatever order, nothing moves that may not."""

from typing import Any

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from snakesim_hal.authority import MAX_FAULTS_KEPT, Authority, Decision
from snakesim_hal.messages import (
    Answer,
    EstopRequest,
    Fault,
    JointCommand,
    LeaseRequest,
    LifecycleRequest,
    LifecycleState,
    Mode,
)
from tests.unit.hal.rig import LEASE_NS, PERIOD_NS, command, description, state

ROBOT = description()
JOINTS = len(ROBOT.joints)
ARM = LifecycleRequest(action="arm", robot="worm", backend="lag")
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

    def observe(self, *values: Any, **other: Any) -> None:
        self.authority.observe(state(self.robot, *values, **other))

    def acquire(self, holder: str = "control", priority: int = 100) -> Answer:
        return self.authority.on_lease(LeaseRequest(action="acquire", holder=holder, priority=priority), self.now_ns)

    def send(self, target: Any = 0.0, mode: Any = Mode.POSITION, **other: Any) -> str | None:
        self.sequence += 1
        values = {"sequence": self.sequence, "lease_epoch": self.authority.lease.epoch, "tick": self.tick, **other}
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
        (lambda: None, ["no joint state yet", "nobody holds the lease"]),
        (lambda: rig.observe(0.1), ["nobody holds the lease"]),
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
    ],
)
def test_arming_names_the_robot_and_the_backend(request_: LifecycleRequest, words: list[str]) -> None:
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
    rig.authority.observe(state(rig.robot, **bad))
    answer = rig.arm()
    assert not answer.ok and answer.reason == f"no valid and fresh state of {joint}"
    rig.observe()
    assert rig.arm().ok
    rig.authority.observe(state(rig.robot, **bad))
    rig.send(0.2)
    decision = rig.pass_tick()
    assert rig.authority.state == "fault" and decision.sequence is None
    assert [fault.what for fault in rig.authority.faults] == ["state_invalid"]
    assert joint in rig.authority.faults[0].cause
    assert np.isfinite(decision.set_points.target).all()


def test_arming_is_refused_while_a_target_is_far_and_names_the_joint() -> None:
    rig = Rig()
    rig.observe(0.1)
    rig.acquire()
    rig.send([0.1, 0.6, 0.1])
    answer = rig.arm()
    assert not answer.ok and "joint_2 is asked to go +0.50 rad" in answer.reason and "0.3" in answer.reason
    rig.send(0.3)
    assert rig.arm().ok


def test_right_after_arming_the_pose_is_held_until_a_new_command_comes() -> None:
    rig = armed()
    decision = rig.pass_tick()
    assert decision.sequence is None  # the command from before arming is not enacted
    assert modes(decision) == {Mode.POSITION} and decision.set_points.target == [0.1] * JOINTS
    rig.send(0.11)
    assert rig.pass_tick().set_points.target == pytest.approx([0.11] * JOINTS)


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
    assert fault.cause == "lease of control expired: no good command for 50 ms"
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


def test_faults_are_kept_up_to_a_limit_the_first_ones_first() -> None:
    rig = Rig()
    for i in range(100):
        rig.authority.fault(Fault(tick=i, what="hot", cause="hot"))
    assert [fault.tick for fault in rig.authority.faults] == list(range(MAX_FAULTS_KEPT))


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


# --- any order of everything -----------------------------------------------------------------------------------

HOLDERS = st.sampled_from(["control", "teleop"])


class AnythingMayHappen(RuleBasedStateMachine):
    """Requests, commands, states and time in any order; a plain model says what may never happen."""

    def __init__(self) -> None:
        super().__init__()
        self.authority = Authority(ROBOT)
        self.now_ns = 0
        self.tick = 0
        self.sequence = 0
        self.state_good = False
        self.angles = [0.0] * JOINTS
        self.last_good_command_ns: int | None = None  # while armed; None: not commanded since arming
        self.armed_at_ns = 0
        self.cleared = True  # since the last fault or estop
        self.last: Decision | None = None
        self.before: LifecycleState = "disarmed"

    def moved_to(self) -> None:
        """Check a change of the lifecycle that just happened."""
        now = self.authority.state
        if now == "armed":
            assert self.before == "armed", "only the rule `arm` may arm"
        if self.before in ("fault", "estop"):
            assert now in ("fault", "estop"), "only the rule `clear` may lead out"
        if now in ("fault", "estop"):
            self.cleared = False
        self.before = now

    @rule(
        angle=st.lists(st.floats(-1.6, 1.6), min_size=JOINTS, max_size=JOINTS),
        torque=st.floats(-5, 5),
        trouble=st.sampled_from([None, None, None, None, "valid", "age", "nan"]),
    )
    def observe(self, angle: list[float], torque: float, trouble: str | None) -> None:
        seen = state(
            ROBOT,
            [float("nan"), *angle[1:]] if trouble == "nan" else angle,
            torque=torque,
            valid=[trouble != "valid"] * JOINTS,
            age_ns=[LEASE_NS + 1 if trouble == "age" else 0] * JOINTS,
        )
        self.authority.observe(seen)
        self.state_good = trouble is None
        if trouble != "nan":
            self.angles = angle
        self.moved_to()

    @rule(
        who=HOLDERS, action=st.sampled_from(["acquire", "renew", "release"]), priority=st.sampled_from([50, 100, 200])
    )
    def lease(self, who: str, action: Any, priority: int) -> None:
        held = self.authority.lease
        live = held.live(self.now_ns)
        answer = self.authority.on_lease(
            LeaseRequest(action=action, holder=who, epoch=held.epoch, priority=priority), self.now_ns
        )
        if live and action == "acquire":
            assert answer.ok == (priority > held.priority)
        if answer.ok and action in ("acquire", "release"):
            assert self.authority.state != "armed", "the robot stops when the lease changes hands"
        self.moved_to()

    @rule(
        wanted=st.lists(
            st.floats(-1e5, 1e5) | st.floats(-2, 2) | st.just(float("nan")), min_size=JOINTS, max_size=JOINTS
        ),
        mode=st.lists(st.sampled_from(list(Mode)), min_size=JOINTS, max_size=JOINTS),
        epoch=st.sampled_from([0, 0, 0, 0, 0, -1, 1]),
        replay=st.sampled_from([False, False, False, True]),
        age_ns=st.sampled_from([0, 0, 0, LEASE_NS, LEASE_NS + 1]),
        near=st.booleans(),
    )
    def command(self, wanted: list[float], mode: list[Mode], epoch: int, replay: bool, age_ns: int, near: bool) -> None:
        self.sequence += not replay
        if near:
            wanted, mode = list(self.angles), [Mode.POSITION] * JOINTS
        lease, state_before = self.authority.lease, self.authority.state
        asked = command(
            ROBOT, wanted, mode, sequence=self.sequence, tick=self.tick, lease_epoch=max(lease.epoch + epoch, 0)
        )
        refusal = self.authority.offer(asked, now_ns=self.now_ns, tick=self.tick, age_ns=age_ns)
        if refusal is None:
            assert lease.live(self.now_ns) and epoch == 0 and age_ns <= LEASE_NS
            assert np.isfinite(wanted).all()
            if state_before == "armed":
                self.last_good_command_ns = self.now_ns
        else:
            assert self.authority.lease == lease, "a refused command renews nothing"
        self.moved_to()

    @rule(robot=st.sampled_from(["worm", "worm", "worm", "other", None]))
    def arm(self, robot: str | None) -> None:
        before, lease = self.authority.state, self.authority.lease
        answer = self.authority.on_lifecycle(LifecycleRequest(action="arm", robot=robot, backend="lag"), self.now_ns)
        if answer.ok:
            assert before == "disarmed" and self.cleared and self.state_good and robot == "worm"
            assert lease.live(self.now_ns)
            self.last_good_command_ns, self.armed_at_ns = None, self.now_ns
        self.before = self.authority.state

    @rule(action=st.sampled_from(["disarm", "finish"]))
    def disarm(self, action: Any) -> None:
        self.authority.on_lifecycle(LifecycleRequest(action=action), self.now_ns)
        assert self.authority.state != "armed"
        self.moved_to()

    @precondition(lambda self: self.authority.state != "armed")
    @rule()
    def clear(self) -> None:
        assert self.authority.on_lifecycle(CLEAR, self.now_ns).ok
        assert self.authority.state == "disarmed"
        self.cleared, self.before = True, "disarmed"

    @rule()
    def estop(self) -> None:
        self.authority.on_estop(ESTOP, self.tick)
        assert self.authority.state == "estop"
        self.moved_to()

    @rule()
    def backend_fault(self) -> None:
        self.authority.fault(Fault(tick=self.tick, what="hot", cause="hot"))
        assert self.authority.state in ("fault", "estop") and self.authority.lease.holder is None
        self.moved_to()

    @rule(who=HOLDERS)
    def gone(self, who: str) -> None:
        if self.authority.lease.holder == who:
            self.authority.holder_gone(f"{who} is gone")
        self.moved_to()

    @rule(periods=st.sampled_from([1, 1, 1, 1, 4, 7]))
    def pass_time(self, periods: int) -> None:
        """A tick of the host."""
        self.now_ns += periods * PERIOD_NS
        self.tick += periods
        self.authority.expire(self.now_ns, self.tick)
        decision = self.authority.decide()
        self.moved_to()
        if self.authority.state == "armed":
            assert self.state_good and self.authority.lease.live(self.now_ns)
            assert self.now_ns - (self.last_good_command_ns or self.armed_at_ns) <= LEASE_NS
        if decision.sequence is not None:
            assert self.authority.state == "armed" and self.last_good_command_ns is not None
        self.check_limits(decision)
        self.last = decision

    def check_limits(self, decision: Decision) -> None:
        points = decision.set_points
        match self.authority.state:
            case "disarmed" | "estop":
                assert set(points.mode) == {Mode.PASSIVE} and decision.sequence is None
            case "fault" if set(points.mode) != {Mode.PASSIVE}:  # this robot damps what was moving
                assert set(points.mode) == {Mode.VELOCITY} and points.target == [0.0] * JOINTS
        for i, (mode, target, torque_limit) in enumerate(
            zip(points.mode, points.target, points.torque_limit_nm, strict=True)
        ):
            assert 0.0 <= torque_limit <= 4.0
            if mode == Mode.POSITION:
                assert -1.5 <= target <= 1.5
                if decision.sequence is not None:  # a held pose stays where it was when the robot was armed
                    assert abs(target - self.angles[i]) <= 0.3 + 1e-9
            elif mode == Mode.VELOCITY:
                assert abs(target) <= 5.0
            elif mode == Mode.TORQUE:
                assert abs(target) <= torque_limit
            else:
                assert target == 0.0
            if self.last is not None and self.last.set_points.mode[i] == mode:
                step = abs(target - self.last.set_points.target[i])
                if mode == Mode.VELOCITY and decision.sequence is not None:
                    assert step <= 1.0 + 1e-9
                elif mode == Mode.TORQUE:
                    assert step <= 0.8 + 1e-9

    @invariant()
    def never_armed_with_an_uncleared_stop(self) -> None:
        assert self.authority.state != "armed" or self.cleared


AnythingMayHappen.TestCase.settings = settings(max_examples=150, stateful_step_count=40, deadline=None)
TestAnythingMayHappen = AnythingMayHappen.TestCase


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
