"""One joint fails: what the robot file says then, case by case."""

from typing import Any

import pytest

from snakesim_hal.safety.fault_log import MAX_FAULTS
from snakesim_hal.wire.messages import Fault, JointMode
from snakesim_testing.hal.authority_rig import (
    DISARM,
    ESTOP,
    JOINT_COUNT,
    RESET,
    AuthorityRig,
    make_armed_rig,
    report_power,
)

SAYS_NO = [True, False, True]  # joint_2 has no valid state


def armed_without_joint_2(**robot: Any) -> AuthorityRig:
    """An armed robot that has lost joint_2."""
    rig = make_armed_rig(safety__max_isolated_joints=1, **robot)
    rig.observe(0.1, valid=SAYS_NO)
    rig.run_tick_with_command(0.1)
    assert rig.authority.state == "armed"
    assert rig.authority.isolated_joints == ["joint_2"]
    return rig


def fault_in(joint: str | None = "joint_2", scope: Any = "joint") -> Fault:
    return Fault(
        tick=3, what="module_frozen", cause=f"{joint} repeats itself", joint=joint, scope=scope
    )


def test_by_default_one_joint_stops_the_robot() -> None:
    rig = make_armed_rig()
    rig.observe(0.1, valid=SAYS_NO)
    rig.pass_tick()
    assert rig.authority.state == "fault"
    assert rig.authority.isolated_joints == []
    (fault,) = rig.authority.faults
    assert fault.joint == "joint_2"
    assert fault.scope == "robot"


def test_isolation_failed_joint_is_passive_while_others_continue() -> None:
    rig = armed_without_joint_2()
    (fault,) = rig.authority.faults
    assert fault.what == "state_invalid"
    assert fault.joint == "joint_2"
    assert fault.scope == "joint"
    assert rig.authority.reason == "armed, without joint_2: no valid and fresh state of joint_2"
    for _ in range(20):
        rig.observe(0.1, valid=SAYS_NO)
        assert rig.send(0.12, torque_limit_nm=[3.0] * JOINT_COUNT) is None
        decision = rig.pass_tick()
        points = decision.setpoints
        assert points.mode == [JointMode.POSITION, JointMode.PASSIVE, JointMode.POSITION]
        assert points.target == [0.12, 0.0, 0.12]
        assert points.torque_limit_nm == [3.0, 0.0, 3.0]
        assert points.isolated == {1}
        assert decision.limit_by_joint == {1: "isolated"}
    assert rig.authority.state == "armed"
    assert len(rig.authority.faults) == 1
    assert rig.authority.limited_counts["isolated"] == 21


def test_nothing_is_limited_where_nothing_is_asked() -> None:
    rig = armed_without_joint_2()
    assert (
        rig.run_tick_with_command(
            [0.1, 0.0, 0.1], [JointMode.POSITION, JointMode.PASSIVE, JointMode.POSITION]
        ).limit_by_joint
        == {}
    )


@pytest.mark.parametrize("known", [True, False])
def test_one_joint_too_many_stops_the_robot(known: bool) -> None:
    rig = armed_without_joint_2()
    if known:
        rig.authority.latch_fault(fault_in("joint_3"))
    else:
        rig.observe(0.1, valid=[True, False, False])
        rig.pass_tick()
    assert rig.authority.state == "fault"
    assert [(fault.joint, fault.scope) for fault in rig.authority.faults] == [
        ("joint_2", "joint"),
        ("joint_3", "robot"),
    ]


def test_two_that_fail_at_once_are_two() -> None:
    rig = make_armed_rig(safety__max_isolated_joints=1)
    rig.observe(0.1, valid=[True, False, False])
    rig.pass_tick()
    assert rig.authority.state == "fault"
    assert rig.authority.isolated_joints == []
    rig = make_armed_rig(safety__max_isolated_joints=2)
    rig.observe(0.1, valid=[True, False, False])
    rig.pass_tick()
    assert rig.authority.state == "armed"
    assert rig.authority.isolated_joints == ["joint_2", "joint_3"]


@pytest.mark.parametrize(
    "fault",
    [fault_in(scope="robot"), fault_in(joint=None), fault_in(joint="joint_9")],
    ids=["robot", "nobody", "unknown"],
)
def test_what_concerns_more_than_a_joint_stops_the_robot(fault: Fault) -> None:
    rig = make_armed_rig(safety__max_isolated_joints=3)
    rig.authority.latch_fault(fault)
    assert rig.authority.state == "fault"
    assert rig.authority.isolated_joints == []


def test_a_state_of_no_joints_at_all_stops_the_robot() -> None:
    rig = make_armed_rig(safety__max_isolated_joints=3)
    rig.observe(0.1, valid=[])
    rig.pass_tick()
    assert rig.authority.state == "fault"


def test_what_a_lost_joint_complains_of_is_no_news() -> None:
    rig = armed_without_joint_2()
    rig.authority.latch_fault(fault_in())
    rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    rig.authority.latch_fault(fault_in())
    assert rig.authority.state == "disarmed"
    assert len(rig.authority.faults) == 1


def test_while_disarmed_no_joint_is_set_aside() -> None:
    rig = AuthorityRig(safety__max_isolated_joints=1)
    rig.observe(0.1, valid=SAYS_NO)
    rig.acquire()
    rig.send(0.1)
    answer = rig.arm()
    assert answer.refusal == "not_ready"
    assert "joint_2" in answer.reason
    rig.authority.latch_fault(fault_in())
    assert rig.authority.state == "fault"
    assert rig.authority.isolated_joints == []


def test_it_may_be_armed_again_without_the_joint() -> None:
    rig = armed_without_joint_2()
    rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    rig.pass_tick()
    rig.observe(0.1, valid=SAYS_NO)
    rig.send([0.1, 1.4, 0.1])  # where nobody knows the joint to be
    assert rig.arm().ok
    assert rig.run_tick_with_command(0.1).setpoints.isolated == {1}


def test_isolation_ends_after_reset_and_a_new_state() -> None:
    rig = armed_without_joint_2()
    answer = rig.authority.handle_lifecycle_request(RESET, rig.now_ns)  # not while it moves
    assert answer.refusal == "wrong_state"
    assert (
        answer.reason
        == "nothing to reset in state armed; disarm first, then a reset ends the isolation of joint_2"
    )
    rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    rig.pass_tick()
    assert rig.authority.handle_lifecycle_request(RESET, rig.now_ns).ok
    assert rig.authority.isolated_joints == []
    assert rig.authority.faults == []
    rig.send(0.1)
    assert "no joint state since the reset" in rig.arm().reason
    rig.observe(0.1)
    rig.send(0.1)
    assert rig.arm().ok
    assert rig.run_tick_with_command(0.1).setpoints.mode == [JointMode.POSITION] * JOINT_COUNT


@pytest.mark.parametrize("action", ["passive", "damp", "hold"])
def test_no_safe_action_moves_a_lost_joint(action: str) -> None:
    rig = armed_without_joint_2(safety__action=action)
    rig.pass_tick(6)
    assert rig.authority.state == "fault"
    points = rig.pass_tick().setpoints
    assert points.isolated == {1}
    assert points.mode[1] is JointMode.PASSIVE
    assert points.torque_limit_nm[1] == 0.0
    assert rig.authority.handle_lifecycle_request(RESET, rig.now_ns).ok
    assert rig.authority.isolated_joints == []


def test_an_emergency_stop_keeps_the_joint_aside_until_the_clear() -> None:
    rig = armed_without_joint_2()
    rig.authority.handle_estop_request(ESTOP, rig.tick)
    assert rig.authority.isolated_joints == ["joint_2"]
    assert rig.authority.handle_lifecycle_request(RESET, rig.now_ns).ok
    assert rig.authority.isolated_joints == []


def test_isolation_applies_to_overheated_joint_but_not_to_leak() -> None:
    rig = make_armed_rig(safety__max_isolated_joints=1)
    report_power(rig, [20.0, 110.0, 20.0])
    assert rig.run_tick_with_command(0.1).setpoints.isolated == {1}
    assert rig.authority.state == "armed"
    rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    rig.pass_tick()
    rig.send(0.1)
    assert rig.arm().ok  # it stays hot, and is not asked
    report_power(rig, [20.0, 110.0, 20.0], volts=12.0)
    for _ in range(7):
        rig.run_tick_with_command(0.1)
    assert rig.authority.state == "fault"
    assert rig.authority.faults[-1].what == "undervoltage"


def test_isolation_silent_health_of_lost_joint_is_not_recorded() -> None:
    rig = armed_without_joint_2()
    report_power(rig, [20.0] * JOINT_COUNT)
    rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    rig.pass_tick(250)
    report_power(rig, [20.0] * JOINT_COUNT, valid=[True, False, True])
    rig.pass_tick(100)
    assert [fault.what for fault in rig.authority.faults] == ["state_invalid"]
    rig.pass_tick(250)
    assert [fault.what for fault in rig.authority.faults] == ["state_invalid", "power_unknown"]


@pytest.mark.parametrize("kept", ["faults_since_reset", "faults_since_start"])
@pytest.mark.parametrize("before", [0, 3, 20, 50])
def test_why_the_robot_stopped_is_never_left_out(kept: str, before: int) -> None:
    rig = make_armed_rig(safety__max_isolated_joints=1)
    for tick in range(before):
        rig.authority.log_fault(Fault(tick=tick, what="noted", cause=""))
    rig.authority.latch_fault(Fault(tick=1000, what="leak", cause="water"))
    log = getattr(rig.authority, kept)
    for tick in range(2000, 2100):
        rig.authority.latch_fault(Fault(tick=tick, what="follows", cause=""))
        assert 1000 in [fault.tick for fault in log.faults]
        assert log.faults[-1].tick == tick
        assert len(log.faults) <= MAX_FAULTS
        assert len(log.faults) + log.dropped_count == before + 1 + tick - 1999
    assert [fault.tick for fault in log.faults] == sorted(fault.tick for fault in log.faults)


def test_isolation_fault_in_a_full_log_is_dropped_like_others() -> None:
    """Only the fault that stopped the robot is always kept."""
    rig = make_armed_rig(safety__max_isolated_joints=1)
    for tick in range(16):
        rig.authority.log_fault(Fault(tick=tick, what="noted", cause=""))
    rig.authority.latch_fault(
        Fault(tick=16, what="module_frozen", cause="", joint="joint_2", scope="joint")
    )
    assert rig.authority.isolated_joints == ["joint_2"]
    for tick in range(17, 100):
        rig.authority.log_fault(Fault(tick=tick, what="noted", cause=""))
    assert 16 not in [fault.tick for fault in rig.authority.faults]
