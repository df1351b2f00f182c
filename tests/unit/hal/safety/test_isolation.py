"""If a joint fails, the robot isolates it or stops, as its robot file demands."""

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

VALID_WITHOUT_JOINT_2 = [True, False, True]  # only joint_2 has no valid state


def make_armed_rig_without_joint_2(**robot: Any) -> AuthorityRig:
    """Return an armed robot that has isolated joint_2."""
    rig = make_armed_rig(safety__max_isolated_joints=1, **robot)
    rig.observe(0.1, valid=VALID_WITHOUT_JOINT_2)
    rig.run_tick_with_command(0.1)
    assert rig.authority.state == "armed"
    assert rig.authority.isolated_joints == ["joint_2"]
    return rig


def make_fault(joint: str | None = "joint_2", scope: Any = "joint") -> Fault:
    """Return a fault of a joint."""
    return Fault(
        tick=3, what="module_frozen", cause=f"{joint} repeats itself", joint=joint, scope=scope
    )


def test_isolation_by_default_is_off_and_a_fault_stops() -> None:
    rig = make_armed_rig()
    rig.observe(0.1, valid=VALID_WITHOUT_JOINT_2)
    rig.pass_tick()
    assert rig.authority.state == "fault"
    assert rig.authority.isolated_joints == []
    (fault,) = rig.authority.faults
    assert fault.joint == "joint_2"
    assert fault.scope == "robot"


def test_isolation_failed_joint_is_passive_while_others_continue() -> None:
    rig = make_armed_rig_without_joint_2()
    (fault,) = rig.authority.faults
    assert fault.what == "state_invalid"
    assert fault.joint == "joint_2"
    assert fault.scope == "joint"
    assert rig.authority.reason == "armed, without joint_2: no valid and fresh state of joint_2"
    for _ in range(20):
        rig.observe(0.1, valid=VALID_WITHOUT_JOINT_2)
        assert rig.send(0.12, torque_limit_nm=[3.0] * JOINT_COUNT) is None
        decision = rig.pass_tick()
        setpoints = decision.setpoints
        assert setpoints.mode == [JointMode.POSITION, JointMode.PASSIVE, JointMode.POSITION]
        assert setpoints.target == [0.12, 0.0, 0.12]
        assert setpoints.torque_limit_nm == [3.0, 0.0, 3.0]
        assert setpoints.isolated == {1}
        assert decision.limit_by_joint == {1: "isolated"}
    assert rig.authority.state == "armed"
    assert len(rig.authority.faults) == 1
    assert rig.authority.limited_counts["isolated"] == 21


def test_isolation_passive_command_of_isolated_joint_is_not_limited() -> None:
    rig = make_armed_rig_without_joint_2()
    assert (
        rig.run_tick_with_command(
            [0.1, 0.0, 0.1], [JointMode.POSITION, JointMode.PASSIVE, JointMode.POSITION]
        ).limit_by_joint
        == {}
    )


@pytest.mark.parametrize("is_reported", [True, False])
def test_isolation_of_more_joints_than_allowed_stops_the_robot(is_reported: bool) -> None:
    rig = make_armed_rig_without_joint_2()
    if is_reported:
        rig.authority.latch_fault(make_fault("joint_3"))
    else:
        rig.observe(0.1, valid=[True, False, False])
        rig.pass_tick()
    assert rig.authority.state == "fault"
    assert [(fault.joint, fault.scope) for fault in rig.authority.faults] == [
        ("joint_2", "joint"),
        ("joint_3", "robot"),
    ]


def test_isolation_counts_joints_that_fail_together() -> None:
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
    [make_fault(scope="robot"), make_fault(joint=None), make_fault(joint="joint_9")],
    ids=["robot", "no joint", "unknown"],
)
def test_isolation_fault_of_more_than_one_joint_stops_robot(fault: Fault) -> None:
    rig = make_armed_rig(safety__max_isolated_joints=3)
    rig.authority.latch_fault(fault)
    assert rig.authority.state == "fault"
    assert rig.authority.isolated_joints == []


def test_isolation_joint_state_without_joints_stops_the_robot() -> None:
    rig = make_armed_rig(safety__max_isolated_joints=3)
    rig.observe(0.1, valid=[])
    rig.pass_tick()
    assert rig.authority.state == "fault"


def test_isolation_further_faults_of_isolated_joint_are_ignored() -> None:
    rig = make_armed_rig_without_joint_2()
    rig.authority.latch_fault(make_fault())
    rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    rig.authority.latch_fault(make_fault())
    assert rig.authority.state == "disarmed"
    assert len(rig.authority.faults) == 1


def test_isolation_while_disarmed_is_not_possible() -> None:
    rig = AuthorityRig(safety__max_isolated_joints=1)
    rig.observe(0.1, valid=VALID_WITHOUT_JOINT_2)
    rig.acquire()
    rig.send(0.1)
    answer = rig.arm()
    assert answer.refusal == "not_ready"
    assert "joint_2" in answer.reason
    rig.authority.latch_fault(make_fault())
    assert rig.authority.state == "fault"
    assert rig.authority.isolated_joints == []


def test_isolation_robot_can_be_armed_again_without_the_joint() -> None:
    rig = make_armed_rig_without_joint_2()
    rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    rig.pass_tick()
    rig.observe(0.1, valid=VALID_WITHOUT_JOINT_2)
    rig.send([0.1, 1.4, 0.1])  # the angle of joint_2 is unknown
    assert rig.arm().ok
    assert rig.run_tick_with_command(0.1).setpoints.isolated == {1}


def test_isolation_ends_after_reset_and_a_new_state() -> None:
    rig = make_armed_rig_without_joint_2()
    answer = rig.authority.handle_lifecycle_request(
        RESET, rig.now_ns
    )  # a reset has no effect while armed
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


@pytest.mark.parametrize("stop_mode", ["passive", "damp", "hold"])
def test_isolation_no_stop_mode_moves_an_isolated_joint(stop_mode: str) -> None:
    rig = make_armed_rig_without_joint_2(safety__action=stop_mode)
    rig.pass_tick(6)
    assert rig.authority.state == "fault"
    setpoints = rig.pass_tick().setpoints
    assert setpoints.isolated == {1}
    assert setpoints.mode[1] is JointMode.PASSIVE
    assert setpoints.torque_limit_nm[1] == 0.0
    assert rig.authority.handle_lifecycle_request(RESET, rig.now_ns).ok
    assert rig.authority.isolated_joints == []


def test_isolation_remains_in_emergency_stop_until_reset() -> None:
    rig = make_armed_rig_without_joint_2()
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
    assert rig.arm().ok  # the hot joint remains isolated
    report_power(rig, [20.0, 110.0, 20.0], volts=12.0)
    for _ in range(7):
        rig.run_tick_with_command(0.1)
    assert rig.authority.state == "fault"
    assert rig.authority.faults[-1].what == "undervoltage"


def test_isolation_silent_health_of_lost_joint_is_not_recorded() -> None:
    rig = make_armed_rig_without_joint_2()
    report_power(rig, [20.0] * JOINT_COUNT)
    rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    rig.pass_tick(250)
    report_power(rig, [20.0] * JOINT_COUNT, valid=[True, False, True])
    rig.pass_tick(100)
    assert [fault.what for fault in rig.authority.faults] == ["state_invalid"]
    rig.pass_tick(250)
    assert [fault.what for fault in rig.authority.faults] == ["state_invalid", "power_unknown"]


@pytest.mark.parametrize("log_name", ["faults_since_reset", "faults_since_start"])
@pytest.mark.parametrize("earlier_count", [0, 3, 20, 50])
def test_fault_log_always_contains_the_reason_of_a_stop(log_name: str, earlier_count: int) -> None:
    rig = make_armed_rig(safety__max_isolated_joints=1)
    for tick in range(earlier_count):
        rig.authority.log_fault(Fault(tick=tick, what="noted", cause=""))
    rig.authority.latch_fault(Fault(tick=1000, what="leak", cause="water"))
    log = getattr(rig.authority, log_name)
    for tick in range(2000, 2100):
        rig.authority.latch_fault(Fault(tick=tick, what="follows", cause=""))
        assert 1000 in [fault.tick for fault in log.faults]
        assert log.faults[-1].tick == tick
        assert len(log.faults) <= MAX_FAULTS
        assert len(log.faults) + log.dropped_count == earlier_count + 1 + tick - 1999
    assert [fault.tick for fault in log.faults] == sorted(fault.tick for fault in log.faults)


def test_isolation_fault_in_a_full_log_is_dropped_like_others() -> None:
    """Drop it, because only the fault that stopped the robot is always kept."""
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
