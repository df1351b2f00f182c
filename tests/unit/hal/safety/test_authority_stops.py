"""Who may move the robot: what stops it, and what a stop leaves."""

import msgspec
import pytest

from snakesim_hal.safety.authority import COMMANDS_KEPT, Authority
from snakesim_hal.safety.derating import MIN_VOLTAGE_FIELD
from snakesim_hal.safety.fault_log import MAX_FAULTS
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault, Mode, SensorDescription
from snakesim_testing.hal.authority_rig import CLEAR, DISARM, ESTOP, JOINTS, Rig, armed, modes, receive
from snakesim_testing.hal.small_robots import PERIOD_NS, state

# --- stops -----------------------------------------------------------------------------------------------------


def test_an_estop_is_latched_and_only_clear_and_arm_lead_back() -> None:
    rig = armed()
    rig.tick_with(0.2)
    assert rig.authority.on_estop(ESTOP, rig.tick).ok
    for _ in range(3):
        decision = rig.tick_with(0.2)
        assert modes(decision) == {Mode.PASSIVE} and decision.sequence is None
    assert not rig.arm().ok and not rig.authority.on_lifecycle(DISARM, rig.now_ns).ok
    assert rig.authority.on_lifecycle(CLEAR, rig.now_ns).ok
    assert modes(rig.tick_with(0.2)) == {Mode.PASSIVE}
    assert rig.arm().ok
    assert rig.pass_tick().setpoints.target == [0.1] * JOINTS  # resumes from the measured pose


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
        assert modes(decision) == {mode} and decision.setpoints.target == [target] * JOINTS
    assert rig.authority.lease.holder is None
    assert rig.acquire("control").lifecycle != "armed" and not rig.arm().ok


def test_a_joint_without_a_velocity_mode_is_damped_by_its_position_and_then_let_go() -> None:
    rig = armed(joints={"joint_2": {"modes": ["position"]}}, limits__acceleration_rad_s2=50.0)
    rig.observe(0.1, 1.0)
    rig.authority.fault(Fault(tick=1, what="hot", cause="joint_1 is hot"))
    seen: list[tuple[Mode, float]] = []
    while not seen or seen[-1][0] is not Mode.PASSIVE:
        points = rig.pass_tick().setpoints
        assert points.mode[0] is points.mode[2] is Mode.VELOCITY and points.target[0] == points.target[2] == 0.0
        seen.append((points.mode[1], points.target[1]))
        assert len(seen) < 10
    on_the_way = [target for mode, target in seen if mode is Mode.POSITION]
    assert len(on_the_way) == 1, "from 1 rad/s at 50 rad/s² it stands after two periods of 10 ms"
    assert 0.1 < on_the_way[0] < 0.2 and seen[-1] == (Mode.PASSIVE, 0.0)


def test_a_fault_that_reaches_nothing_is_listed_and_stops_nothing() -> None:
    rig = armed()
    rig.authority.fault(Fault(tick=1, what="sample_late", cause="sensor/depth/head", reach="none"))
    assert rig.authority.state == "armed" and rig.authority.lease.holder is not None
    assert [(fault.what, fault.reach) for fault in rig.authority.faults] == [("sample_late", "none")]


def test_a_joint_that_moves_when_a_fault_comes_is_slowed_down_over_some_periods() -> None:
    """At 3 rad/s and 100 rad/s2: in three periods."""
    rig = armed(safety__action="hold")
    rig.observe(0.4, 3.0)
    rig.authority.fault(Fault(tick=1, what="hot", cause="joint_2 is hot"))
    held = [rig.pass_tick().setpoints.target[0] for _ in range(5)]
    assert held == pytest.approx([0.425, 0.44, 0.445, 0.445, 0.445])


def test_all_joints_that_are_hot_are_named() -> None:
    rig = armed()
    receive(rig, [90.0] * JOINTS)
    rig.pass_tick()
    assert rig.tick_with(0.1, torque_limit_nm=[4.0] * JOINTS).limited == dict.fromkeys(range(JOINTS), "thermal")


def test_faults_are_kept_up_to_a_limit_the_first_and_the_newest() -> None:
    rig = Rig()
    for i in range(100):
        rig.authority.fault(Fault(tick=i, what="hot", cause="hot"))
    assert [fault.tick for fault in rig.authority.faults] == [*range(16), *range(84, 100)]
    assert rig.authority.faults_since_reset.left_out == rig.authority.faults_since_start.left_out == 68
    assert (MAX_FAULTS, COMMANDS_KEPT) == (32, 1024)  # a status holds 64 faults
    rig.authority.on_lifecycle(CLEAR, 0)
    assert rig.authority.faults == [] and rig.authority.faults_since_reset.left_out == 0
    assert (
        len(rig.authority.faults_since_start.stored) == MAX_FAULTS and rig.authority.faults_since_start.left_out == 68
    )


@pytest.mark.parametrize("by", ["fault", "estop"])
def test_what_stopped_the_robot_is_kept_however_much_comes_after_it(by: str) -> None:
    rig = armed()
    for i in range(16):
        rig.authority.record_fault(Fault(tick=i, what="late", cause="late"))
    if by == "fault":
        rig.authority.fault(Fault(tick=16, what="hot", cause="hot"))
    else:
        rig.authority.on_estop(ESTOP, 16)
        rig.authority.on_estop(ESTOP, 17)  # it is stopped already
    for i in range(18, 100):
        rig.authority.record_fault(Fault(tick=i, what="late", cause="late"))
    assert [fault.tick for fault in rig.authority.faults] == [*range(17), *range(85, 100)]
    for i in range(100):  # of one that was never stopped
        (rig := rig if i else Rig()).authority.record_fault(Fault(tick=i, what="late", cause="late"))
    assert len(rig.authority.faults) == MAX_FAULTS


def test_a_fault_is_explained_in_as_many_words_as_a_message_holds() -> None:
    rig = armed()
    rig.authority.fault(Fault(tick=1, what="hot", cause="x" * 501))
    assert rig.authority.reason == rig.authority.faults[0].cause == "x" * 500
    rig = armed()
    rig.authority.fault(Fault(tick=1, what="hot", cause=""))
    assert rig.authority.reason == "hot"


def test_the_first_fault_is_why_and_what_it_brings_about_is_listed() -> None:
    rig = armed()
    for what in ("bus_off", *["watchdog"] * 40):
        rig.authority.fault(Fault(tick=1, what=what, cause=f"because of {what}"))
    assert rig.authority.reason == rig.authority.faults[0].cause == "because of bus_off"
    assert rig.authority.faults[1].cause == "because of watchdog"


def test_a_note_stops_nothing() -> None:
    rig = armed()
    rig.authority.record_fault(Fault(tick=1, what="service_lost", cause="guidance is gone"))
    assert rig.authority.state == "armed"
    assert [fault.reach for fault in rig.authority.faults] == ["none"], "so nobody takes it for the reason of a stop"


# --- what is not believed --------------------------------------------------------------------------------------


def test_a_glitch_stands_against_arming() -> None:
    rig = Rig()
    rig.observe(0.1)
    rig.acquire()
    rig.send(0.1)
    rig.timestamp_ns += PERIOD_NS - 10**9
    rig.observe([0.1, 0.9, 0.1])
    assert "joint_2 by +0.80 rad" in rig.arm().reason
    rig.observe(0.1)
    assert rig.arm().ok


def test_time_that_the_host_knows_of_counts() -> None:
    rig = armed()
    rig.authority.observe(state(rig.robot, 0.9, timestamp_ns=rig.timestamp_ns), rig.timestamp_ns + 10**9)
    rig.pass_tick()
    assert rig.authority.state == "armed"


# --- heat, supply and leaks ------------------------------------------------------------------------------------


def test_heat_derates_then_stops_and_must_be_gone_before_the_next_arming() -> None:
    rig = armed()
    receive(rig, [20.0, 92.5, 20.0])
    decision = rig.tick_with(0.1)
    assert decision.setpoints.torque_limit_nm == pytest.approx([4.0, 2.4, 4.0])
    assert decision.limited == {1: "thermal"} and rig.authority.limited_counts == {"thermal": 1}
    assert rig.authority.derated_joints == {"joint_2": pytest.approx(0.6)}
    receive(rig, [20.0, 110.0, 20.0])
    decision = rig.pass_tick()
    assert [(fault.what, fault.joint) for fault in rig.authority.faults] == [("overheated", "joint_2")]
    assert decision.setpoints.torque_limit_nm == pytest.approx([4.0, 0.8, 4.0])  # also of the stop mode
    rig.authority.on_lifecycle(CLEAR, rig.now_ns)
    rig.acquire()
    rig.tick_with(0.1)
    answer = rig.arm()
    assert rig.authority.state == "disarmed" and answer.refusal == "not_ready" and "joint_2 is at 110" in answer.reason
    receive(rig, [20.0, 70.0, 20.0])
    rig.pass_tick()
    rig.send(0.1)
    assert rig.arm().ok and rig.authority.derated_joints == {}


def test_who_tells_nothing_of_its_health_is_noted() -> None:
    rig = Rig()
    receive(rig, [20.0] * JOINTS)
    rig.pass_tick(301)
    assert [fault.what for fault in rig.authority.faults] == ["power_unknown"] and rig.authority.state == "disarmed"


def test_a_weak_supply_stops_an_armed_robot_within_50_ms() -> None:
    rig = armed()
    receive(rig, [20.0] * JOINTS, volts=12.0)
    for _ in range(5):
        assert rig.authority.state == "armed"
        rig.tick_with(0.1)
    assert {fault.what for fault in rig.authority.faults} == {"undervoltage"}


def test_a_weak_supply_stands_against_arming_once_with_the_field_to_change() -> None:
    rig = Rig()
    rig.acquire()
    for _ in range(7):
        receive(rig, [20.0] * JOINTS, volts=12.0)
        rig.tick_with(0.1)
    rig.authority.on_lifecycle(CLEAR, rig.now_ns)
    rig.acquire()
    rig.tick_with(0.1)
    answer = rig.arm()
    assert answer.refusal == "not_ready" and answer.reason.count("12.0 V") == 1 and MIN_VOLTAGE_FIELD in answer.reason


def test_time_may_stand_still_until_a_robot_is_armed_so_no_report_is_awaited() -> None:
    power = SensorDescription(key=keys.POWER, rate_hz=2.0, delay_s=0.0)
    rig = Rig()
    rig.authority = Authority(msgspec.structs.replace(rig.robot, sensors=[*rig.robot.sensors, power]))
    rig.observe(0.1)
    rig.acquire()
    rig.tick_with(0.1)
    rig.send(0.1)
    assert rig.arm().ok


# --- what is told ----------------------------------------------------------------------------------------------


def test_what_never_became_a_command_is_counted_by_reason() -> None:
    rig = armed()
    rig.authority.count_rejection("malformed")
    assert rig.authority.rejected_counts == {"malformed": 1} and rig.authority.state == "armed"


def test_what_is_published_of_a_joint_without_a_number_is_its_last_good_state() -> None:
    rig = armed()
    reported = rig.authority.replace_unreadable(state(rig.robot, [0.2, float("nan"), 0.2]))
    assert reported.angle_rad == [0.2, 0.1, 0.2] and reported.valid == [True, False, True]
