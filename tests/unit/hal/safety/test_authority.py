"""Regressions of the command authority. test_authority_machine.py compares it with a model, in any order of inputs."""

from typing import Any

import msgspec
import pytest

from snakesim_hal.safety.authority import RECENT_COMMAND_COUNT, CommandAuthority, TickOutput
from snakesim_hal.safety.cables import CableTracker
from snakesim_hal.safety.derating import WHERE_TO_SET_MIN_VOLTAGE
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault, JointMode, LeaseRequest, SensorDescription
from snakesim_testing.hal.authority_rig import (
    ARM,
    DISARM,
    ESTOP,
    JOINT_COUNT,
    RESET,
    AuthorityRig,
    list_modes,
    make_armed_rig,
    make_commanded_rig,
    report_power,
)
from snakesim_testing.hal.small_robots import LEASE_NS, PERIOD_NS, make_joint_state

MAX_REASON_LENGTH = 500  # characters that the reason of an answer may have on the wire
MAX_CONDITION_LENGTH = 400  # characters of one unmet condition, of which a reason may list several
ARM_UNCHECKED = msgspec.structs.replace(ARM, unchecked=True)
HOT = Fault(tick=1, what="hot", cause="joint_2 is hot")

# --- arming ----------------------------------------------------------------------------------------------------


def test_arming_unmet_conditions_are_named_until_met() -> None:
    """Each step meets one condition more, and the next answer names the ones that are left."""
    measured_rad = 0.1
    rig = AuthorityRig()
    assert rig.arm().reason == "no joint state yet; nothing commands the robot: the lease is free"

    rig.observe(measured_rad)
    assert rig.arm().reason == "nothing commands the robot: the lease is free"

    rig.acquire()
    assert rig.arm().reason == "no commands from control yet"

    rig.send(measured_rad + 0.6)
    assert "joint_1 has a target +0.60 rad" in rig.arm().reason

    rig.send(measured_rad, JointMode.TORQUE)
    assert (
        "joint_1 is commanded in mode torque; it must hold its position at arming"
        in rig.arm().reason
    )

    rig.send(measured_rad)
    answer = rig.arm()
    assert answer.ok
    assert answer.lifecycle == "armed"


@pytest.mark.parametrize(
    ("target_rad", "mode"), [(0.0, JointMode.PASSIVE), (0.1, JointMode.POSITION)]
)
def test_arming_commands_that_move_no_joint_meet_all_conditions(
    target_rad: float, mode: JointMode
) -> None:
    """A passive joint may have any target, and a joint at 0.1 rad holds its position."""
    rig = AuthorityRig()
    rig.observe(0.1)
    rig.acquire()

    rig.send(target_rad, mode)

    assert rig.authority.list_unmet_conditions(rig.now_ns) == []


def test_arming_stopped_robot_is_refused_until_reset() -> None:
    rig = make_armed_rig()

    rig.authority.latch_fault(HOT)
    assert "state is fault, must be disarmed; first `snakesim robot reset`" in rig.arm().reason

    rig.authority.handle_estop_request(ESTOP, rig.tick)
    assert "state is estop, must be disarmed; first `snakesim robot reset`" in rig.arm().reason


@pytest.mark.parametrize(
    ("request_fields", "refusal", "explanation"),
    [
        pytest.param({"robot": None, "backend": None}, "wrong_robot", "names None", id="no-robot"),
        pytest.param({"robot": "other"}, "wrong_robot", "this robot is 'worm'", id="other-robot"),
        pytest.param({"backend": None}, "wrong_backend", "the request names None", id="no-backend"),
        pytest.param(
            {"backend": "can"}, "wrong_backend", "this backend is 'lag'", id="other-backend"
        ),
        pytest.param(
            {"config_hash": None}, "wrong_config", "arm with its config_hash", id="no-configuration"
        ),
        pytest.param({"config_hash": "1" * 16}, "wrong_config", "1" * 16, id="other-configuration"),
    ],
)
def test_arming_request_for_another_robot_is_explained(
    request_fields: dict[str, Any], refusal: str, explanation: str
) -> None:
    rig = make_commanded_rig()
    request = msgspec.structs.replace(ARM, **request_fields)

    answer = rig.authority.handle_lifecycle_request(request, rig.now_ns)

    assert answer.refusal == refusal
    assert explanation in answer.reason


# A condition that all joints of a very long robot do not meet would name each of them, in too long a text.
LONG_ROBOT_JOINTS = 100


def test_arming_condition_of_hundred_unknown_joints_is_shortened() -> None:
    rig = AuthorityRig(chain__modules=LONG_ROBOT_JOINTS)
    rig.observe(0.1, valid=[False] * LONG_ROBOT_JOINTS)

    first_condition = rig.authority.list_unmet_conditions(rig.now_ns)[0]

    assert len(first_condition) == MAX_CONDITION_LENGTH


def test_arming_hundred_joints_far_from_targets_has_short_reason() -> None:
    """A longer reason could not be sent, so that the client would get no answer."""
    far_target_rad = 9.0  # from the measured 0.1 rad
    rig = AuthorityRig(chain__modules=LONG_ROBOT_JOINTS)
    rig.observe(0.1)
    rig.acquire()
    rig.send(far_target_rad)

    answer = rig.arm()

    assert not answer.ok
    assert len(answer.reason) == MAX_REASON_LENGTH


@pytest.mark.parametrize("stop", ["estop", "fault", "disarm"])
def test_arming_before_motors_received_the_stop_is_refused(stop: str) -> None:
    """Reset and armed again within one period, the backend would never receive the stop."""
    rig = make_armed_rig()
    rig.run_tick_with_command(0.1)
    match stop:
        case "estop":
            rig.authority.handle_estop_request(ESTOP, rig.tick)
        case "fault":
            rig.authority.latch_fault(HOT)
        case _:
            rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    if stop != "disarm":
        rig.pass_tick()  # the motors receive the stop, but not yet its reset
        rig.authority.handle_lifecycle_request(RESET, rig.now_ns)
    rig.acquire()
    rig.send(0.1)

    answer = rig.arm()
    assert answer.refusal == "not_ready"
    assert "have not received the stop" in answer.reason

    rig.authority.compute_setpoints()  # the motors receive the stop
    assert rig.arm().ok


def test_arming_for_the_first_time_waits_for_no_stop() -> None:
    """A robot that was never armed has motors that are off, so they need not receive the stop of a fault."""
    rig = AuthorityRig()
    rig.authority.latch_fault(HOT)
    rig.authority.handle_lifecycle_request(RESET, rig.now_ns)
    rig.observe(0.1)
    rig.acquire()
    rig.send(0.1)

    assert rig.arm().ok


def test_arming_after_a_disarm_needs_a_new_command() -> None:
    rig = make_armed_rig()
    rig.run_tick_with_command(0.1)

    rig.authority.handle_lifecycle_request(DISARM, rig.now_ns)
    rig.pass_tick()

    assert rig.arm().reason == "no commands from control yet"


def test_arming_after_commands_ended_is_refused_despite_renewals() -> None:
    rig = make_commanded_rig()
    renewal = LeaseRequest(action="renew", holder="control", priority=100, epoch=1)
    rig.now_ns = LEASE_NS
    assert rig.authority.handle_lease_request(renewal, rig.now_ns).ok
    assert rig.authority.list_unmet_conditions(rig.now_ns) == []
    rig.now_ns += 1
    assert rig.arm().reason == "no commands from control any more"


def test_arming_unchecked_robot_needs_explicit_request() -> None:
    rig = make_commanded_rig(unchecked="the joints are not checked")
    answer = rig.arm()
    assert answer.refusal == "not_checked"
    assert "the joints are not checked; to arm it" in answer.reason
    assert rig.authority.handle_lifecycle_request(ARM_UNCHECKED, rig.now_ns).ok
    assert ", unchecked" in rig.authority.reason


def test_arming_waits_until_backend_reports_no_obstacle() -> None:
    rig = make_commanded_rig()

    rig.authority.set_backend_obstacles(["joint_2 is at step `home`"])
    answer = rig.arm()
    assert not answer.ok
    assert answer.refusal == "not_ready"
    assert "joint_2 is at step `home`" in answer.reason

    rig.authority.set_backend_obstacles([])
    assert rig.arm().ok


def test_arming_with_unknown_cable_is_refused_even_unchecked() -> None:
    rig = make_commanded_rig(
        unchecked="the joints are not checked", cables=CableTracker((), {}, {"joint_2": "unknown"})
    )
    answer = rig.authority.handle_lifecycle_request(ARM_UNCHECKED, rig.now_ns)
    assert answer.refusal == "cable"
    assert answer.reason == "joint_2: unknown"


def test_arming_in_lockstep_does_not_wait_for_power_reports() -> None:
    """Arm without a report, because time may be paused until the robot is armed."""
    power_sensor = SensorDescription(key=keys.POWER, rate_hz=2.0, delay_s=0.0)
    rig = AuthorityRig()
    rig.authority = CommandAuthority(
        msgspec.structs.replace(rig.robot, sensors=[*rig.robot.sensors, power_sensor])
    )
    rig.observe(0.1)
    rig.acquire()
    rig.run_tick_with_command(0.1)
    rig.send(0.1)
    assert rig.arm().ok


@pytest.mark.parametrize("was_used", [True, False])
def test_arming_in_lockstep_drops_commands_of_the_last_session(was_used: bool) -> None:
    rig = make_armed_rig()
    rig.send(0.3)
    if was_used:
        rig.authority.compute_setpoints(rig.tick)
    assert rig.authority.handle_lifecycle_request(DISARM, rig.now_ns).ok
    rig.authority.compute_setpoints(rig.tick)  # the motors receive the stop

    rig.send(0.1)
    assert rig.arm().ok
    decision = rig.authority.compute_setpoints(rig.tick)
    assert decision.command_sequence is None, "a command of the last arm session was applied"
    assert decision.setpoints.target == pytest.approx([0.1] * JOINT_COUNT)


# --- commands and the lease ------------------------------------------------------------------------------------


def test_command_of_another_arm_session_neither_moves_nor_renews() -> None:
    """The lease of five periods expires although commands of other sessions arrive in each of them."""
    last_session = 0
    this_session = 1
    later_session = 2
    rig = make_armed_rig()
    rig.run_tick_with_command(0.1, arm_session=this_session)

    for other_session in (last_session, later_session, last_session, later_session):
        assert rig.send(0.2, arm_session=other_session) == "before_arming"
        assert rig.pass_tick().setpoints.target == pytest.approx([0.1] * JOINT_COUNT)
    rig.run_tick_with_command(0.2, arm_session=last_session)

    assert rig.authority.state == "fault"
    assert rig.authority.faults[0].what == "lease_expired"
    assert rig.authority.rejected_counts == {"before_arming": 5}


@pytest.mark.parametrize("other_session", [0, 2, 7])
def test_command_of_any_arm_session_is_kept_while_disarmed(other_session: int) -> None:
    """A client cannot know the next session, and its commands must flow before the robot is armed."""
    rig = make_armed_rig()
    assert rig.authority.handle_lifecycle_request(DISARM, rig.now_ns).ok
    assert rig.authority.arm_session == 1

    assert rig.send(0.1, arm_session=other_session) is None
    assert rig.authority.rejected_counts == {}


def test_command_under_way_at_arming_is_not_counted_as_rejected() -> None:
    rig = AuthorityRig()
    rig.tick = 5
    rig.observe(0.1, tick=5)
    rig.acquire()
    rig.send(0.1)
    rig.arm()
    rig.tick = 6

    answers_tick_before_arming = rig.send(0.1, tick=5, arm_session=0)
    assert answers_tick_before_arming == "before_arming"
    assert rig.authority.rejected_counts == {}, "the client could not know that it is armed"

    answers_tick_after_arming = rig.send(0.1, tick=6, arm_session=0)
    assert answers_tick_after_arming == "before_arming"
    assert rig.authority.rejected_counts == {"before_arming": 1}


def test_lease_without_commands_expires_with_a_fault() -> None:
    rig = make_armed_rig()
    for _ in range(20):
        rig.run_tick_with_command(0.1)

    periods_in_term = LEASE_NS // PERIOD_NS - 1
    for _ in range(periods_in_term):
        assert rig.pass_tick().command_sequence == rig.sequence, "the last command is in force"
    decision = rig.pass_tick()

    assert rig.authority.state == "fault"
    assert decision.command_sequence is None
    assert list_modes(decision) == {JointMode.VELOCITY}
    assert decision.setpoints.target == [0.0] * JOINT_COUNT
    (fault,) = rig.authority.faults
    assert fault.what == "lease_expired"
    assert fault.tick == rig.tick
    assert fault.cause == "lease of control expired: no accepted command for 50 ms"
    assert rig.authority.lease.holder is None


def test_lease_taken_by_higher_priority_disarms_and_rejects_old_holder() -> None:
    rig = make_armed_rig()
    rig.run_tick_with_command(0.1)
    assert not rig.acquire("teleop").ok, "its priority is not higher"
    assert rig.authority.state == "armed"

    answer = rig.acquire("teleop", priority=200)

    assert answer.epoch == 2
    assert answer.lifecycle == "disarmed"
    assert list_modes(rig.pass_tick()) == {JointMode.PASSIVE}
    assert rig.send(0.1, lease_epoch=1) == "wrong_epoch", "a command of the old holder"
    assert rig.arm().reason == "no commands from teleop yet"
    rig.send(0.1, sequence=1)  # a new holder starts with new sequence numbers
    assert rig.arm().ok


def test_lease_taken_while_disarmed_drops_the_old_commands() -> None:
    rig = make_commanded_rig()
    rig.acquire("teleop", priority=200)
    assert rig.arm().reason == "no commands from teleop yet"
    assert rig.send(0.1, sequence=0) is None
    assert rig.arm().ok


def test_holder_gone_while_armed_keeps_the_lease() -> None:
    rig = make_armed_rig()
    rig.authority.handle_lease_holder_exit("control is gone")
    assert rig.authority.state == "armed"
    assert rig.authority.lease.holder == "control"


def test_holder_gone_after_estop_frees_lease_and_keeps_reason() -> None:
    rig = make_armed_rig()
    rig.authority.handle_estop_request(ESTOP, rig.tick)

    rig.authority.handle_lease_holder_exit("control is gone")
    assert rig.authority.lease.holder is None
    assert "emergency stop by a person" in rig.authority.reason, "why the robot is stopped"

    rig.authority.handle_lifecycle_request(RESET, rig.now_ns)
    rig.authority.handle_lease_holder_exit("control is gone")
    assert rig.authority.reason == "control is gone"


def test_decision_before_any_input_is_passive() -> None:
    rig = AuthorityRig()
    assert rig.send(0.1) == "no_lease"
    assert list_modes(rig.authority.compute_setpoints()) == {JointMode.PASSIVE}


def test_decision_in_lockstep_uses_the_command_of_its_tick() -> None:
    rig = make_armed_rig()
    rig.send(0.11, tick=0)
    rig.tick = 1
    rig.send(0.12, tick=1)
    assert rig.authority.compute_setpoints(0).setpoints.target == pytest.approx(
        [0.11] * JOINT_COUNT
    )
    assert rig.authority.compute_setpoints(1).setpoints.target == pytest.approx(
        [0.12] * JOINT_COUNT
    )


def test_decision_in_lockstep_after_a_flood_keeps_the_last_command() -> None:
    """Keep the last command, because the pose at arming would be a jump without a limit."""
    rig = make_armed_rig()
    decisions: list[TickOutput] = []
    for tick in range(5):
        rig.tick = tick
        rig.send(0.3)
        decisions.append(rig.authority.compute_setpoints(tick))
    before = decisions[-1]

    # More commands for the next tick than are kept, so that none for tick 4 is left.
    rig.tick = 5
    for _ in range(RECENT_COMMAND_COUNT + 1):
        rig.send(0.1)
    after = rig.authority.compute_setpoints(4)

    assert after.command_sequence == before.command_sequence
    assert after.setpoints.target == pytest.approx([0.3] * JOINT_COUNT)


# --- stops -----------------------------------------------------------------------------------------------------


def test_estop_stays_until_reset_and_arming() -> None:
    rig = make_armed_rig()
    rig.run_tick_with_command(0.2)

    assert rig.authority.handle_estop_request(ESTOP, rig.tick).ok
    for _ in range(3):
        assert list_modes(rig.run_tick_with_command(0.2)) == {JointMode.PASSIVE}
    assert not rig.arm().ok
    assert not rig.authority.handle_lifecycle_request(DISARM, rig.now_ns).ok

    assert rig.authority.handle_lifecycle_request(RESET, rig.now_ns).ok
    assert list_modes(rig.run_tick_with_command(0.2)) == {JointMode.PASSIVE}

    assert rig.arm().ok
    assert rig.pass_tick().setpoints.target == [0.1] * JOINT_COUNT  # resumes from the measured pose


@pytest.mark.parametrize(
    ("stop_mode", "mode", "target"),
    [
        ("passive", JointMode.PASSIVE, 0.0),
        ("damp", JointMode.VELOCITY, 0.0),
        ("hold", JointMode.POSITION, 0.4),
    ],
)
def test_fault_starts_the_stop_mode_of_the_robot(
    stop_mode: str, mode: JointMode, target: float
) -> None:
    rig = make_armed_rig(safety__action=stop_mode)
    rig.observe(0.4)

    rig.authority.latch_fault(HOT)

    # Later motion of the joint does not change the pose that is held.
    for angle_rad in (0.4, 0.6, 0.9):
        rig.observe(angle_rad)
        decision = rig.pass_tick()
        assert list_modes(decision) == {mode}
        assert decision.setpoints.target == [target] * JOINT_COUNT


def test_fault_brakes_a_position_only_joint_until_it_rests() -> None:
    """Brake from 1 rad/s at 50 rad/s², which takes two periods of 10 ms."""
    rig = make_armed_rig(
        joints={"joint_2": {"modes": ["position"]}}, limits__acceleration_rad_s2=50.0
    )
    rig.observe(0.1, 1.0)
    rig.authority.latch_fault(HOT)
    braking = rig.pass_tick().setpoints
    assert braking.mode == [JointMode.VELOCITY, JointMode.POSITION, JointMode.VELOCITY]
    assert 0.1 < braking.target[1] < 0.2
    at_rest = rig.pass_tick().setpoints
    assert at_rest.mode == [JointMode.VELOCITY, JointMode.PASSIVE, JointMode.VELOCITY]
    assert at_rest.target == [0.0] * JOINT_COUNT


def test_fault_holds_a_moving_joint_where_it_comes_to_rest() -> None:
    """Brake from 1 rad/s at 50 rad/s², which takes 0.01 rad and two periods of 10 ms."""
    rig = make_armed_rig(safety__action="hold", limits__acceleration_rad_s2=50.0)
    rig.observe(0.1, 1.0)
    rig.authority.latch_fault(HOT)
    targets = [rig.pass_tick().setpoints.target[0] for _ in range(4)]
    assert targets == pytest.approx([0.1075, 0.11, 0.11, 0.11])


def test_fault_after_the_first_does_not_replace_the_reason() -> None:
    rig = make_armed_rig()
    for what in ("bus_off", *["watchdog"] * 40):
        rig.authority.latch_fault(Fault(tick=1, what=what, cause=f"because of {what}"))
    assert rig.authority.reason == "because of bus_off"
    assert rig.authority.faults[0].cause == "because of bus_off"
    assert rig.authority.faults[1].cause == "because of watchdog"


@pytest.mark.parametrize("stop", ["fault", "estop"])
def test_faults_of_a_full_log_include_the_first_stop(stop: str) -> None:
    """Of a full log, the first 16 faults stay, and after them the fault that has stopped the robot.

    The tick of a fault shows which one it is.
    """
    first_count = 16
    stop_tick = first_count
    rig = make_armed_rig()

    for tick in range(first_count):
        rig.authority.log_fault(Fault(tick=tick, what="late", cause="late"))
    match stop:
        case "fault":
            rig.authority.latch_fault(Fault(tick=stop_tick, what="hot", cause="hot"))
        case _:
            rig.authority.handle_estop_request(ESTOP, stop_tick)
            rig.authority.handle_estop_request(ESTOP, stop_tick + 1)  # repeats the stop
    # None of the following faults stops the robot, which is stopped already.
    rig.authority.latch_fault(Fault(tick=18, what="hot", cause="hot"))
    for tick in range(19, 60):
        rig.authority.latch_fault(Fault(tick=tick, what="late", cause="late", scope="none"))
    for tick in range(60, 100):
        rig.authority.log_fault(Fault(tick=tick, what="late", cause="late"))

    kept_ticks = [fault.tick for fault in rig.authority.faults]
    assert kept_ticks[: first_count + 1] == [*range(first_count), stop_tick]


def test_faults_since_start_survive_a_reset() -> None:
    rig = make_armed_rig()
    rig.authority.latch_fault(HOT)
    rig.authority.handle_lifecycle_request(RESET, rig.now_ns)
    assert rig.authority.faults == []
    assert [fault.what for fault in rig.authority.faults_since_start.faults] == ["hot"]


# --- names of active limits ------------------------------------------------------------------------------------


def test_limited_target_is_named_and_counted() -> None:
    rig = make_armed_rig()
    rig.observe(0.0)
    rig.send(3.0)  # beyond the limits of all joints
    decision = rig.pass_tick()
    assert decision.limit_by_joint == dict.fromkeys(range(JOINT_COUNT), "angle")
    assert rig.authority.limited_counts == {"angle": JOINT_COUNT}


def test_unlimited_command_has_no_active_limit() -> None:
    rig = make_armed_rig()
    measured_rad = 0.1
    decision = rig.run_tick_with_command(measured_rad)
    assert decision.limit_by_joint == {}
    assert not rig.authority.limited_counts


# --- heat, supply and measured states --------------------------------------------------------------------------


def test_heat_derates_then_stops_then_blocks_arming() -> None:
    """The motor of joint_2 gets hot, too hot, and cools down."""
    rig = make_armed_rig()

    report_power(rig, [20.0, 92.5, 20.0])
    derated = rig.run_tick_with_command(0.1)
    assert derated.setpoints.torque_limit_nm == pytest.approx([4.0, 2.4, 4.0])
    assert derated.limit_by_joint == {1: "thermal"}
    assert rig.authority.derated_joints == {"joint_2": pytest.approx(0.6)}

    report_power(rig, [20.0, 110.0, 20.0])
    stopped = rig.pass_tick()
    assert [(fault.what, fault.joint) for fault in rig.authority.faults] == [
        ("overheated", "joint_2")
    ]
    # Torque is also derated while the robot stops.
    assert stopped.setpoints.torque_limit_nm == pytest.approx([4.0, 0.8, 4.0])

    rig.authority.handle_lifecycle_request(RESET, rig.now_ns)
    rig.acquire()
    rig.run_tick_with_command(0.1)
    assert "joint_2 is at 110" in rig.arm().reason

    report_power(rig, [20.0, 70.0, 20.0])
    rig.pass_tick()
    rig.send(0.1)
    assert rig.arm().ok


def test_weak_supply_blocks_arming_with_one_explanation() -> None:
    rig = AuthorityRig()
    for _ in range(7):  # long enough for a fault of the supply, which is reset then
        report_power(rig, [20.0] * JOINT_COUNT, volts=12.0)
        rig.pass_tick()
    rig.authority.handle_lifecycle_request(RESET, rig.now_ns)

    answer = rig.arm()

    assert answer.refusal == "not_ready"
    assert answer.reason.count("12.0 V") == 1, "all joints have the same supply"
    assert WHERE_TO_SET_MIN_VOLTAGE in answer.reason


def test_joint_angle_after_a_host_pause_may_be_far() -> None:
    """The timestamp has not advanced, but a second has passed for the host, in which a joint may turn far."""
    rig = make_armed_rig()
    far_state = make_joint_state(rig.robot, 0.9, timestamp_ns=rig.timestamp_ns)
    one_second_ns = 10**9

    rig.authority.observe_joints(far_state, rig.timestamp_ns + one_second_ns)
    rig.pass_tick()

    assert rig.authority.state == "armed"


def test_joint_state_with_nan_is_published_as_last_good() -> None:
    rig = make_armed_rig()
    published = rig.authority.replace_non_finite_values(
        make_joint_state(rig.robot, [0.2, float("nan"), 0.2])
    )
    assert published.angle_rad == [0.2, 0.1, 0.2]
    assert published.valid == [True, False, True]


# --- details that the model does not contain ---------------------------------------------------------------------


def test_reset_without_a_fault_is_refused_with_its_reason() -> None:
    rig = make_armed_rig()
    answer = rig.authority.handle_lifecycle_request(RESET, rig.now_ns)
    assert not answer.ok
    assert answer.reason == "nothing to reset in state armed"


def test_fault_without_scope_is_recorded_and_stops_nothing() -> None:
    rig = make_armed_rig()
    rig.authority.latch_fault(Fault(tick=1, what="noted", cause="a test", scope="none"))
    assert rig.authority.state == "armed"
    assert [fault.what for fault in rig.authority.faults] == ["noted"]


def test_command_with_a_repeated_sequence_number_is_a_replay() -> None:
    rig = make_armed_rig()
    assert rig.send(0.1, sequence=50) is None
    assert rig.send(0.1, sequence=50) == "replayed"


@pytest.mark.parametrize("is_armed", [False, True], ids=["disarmed", "armed"])
def test_constant_angles_are_implausible_only_while_commanded_to_move(
    is_armed: bool,
) -> None:
    """Accept constant angles of a robot without commands for any time."""
    rig = make_armed_rig() if is_armed else make_commanded_rig()

    for tick in range(1, 400):  # 4 s, many times as long as a joint may be frozen
        rig.run_tick_with_command(0.1 + 0.001 * tick)
        measured_ns = rig.timestamp_ns + tick * PERIOD_NS
        rig.authority.observe_joints(
            make_joint_state(rig.robot, 0.1, tick=tick, timestamp_ns=measured_ns), measured_ns
        )
        rig.authority.latch_faults_and_expire_lease(rig.now_ns, rig.tick)

    assert (rig.authority.state == "fault") == is_armed, rig.authority.reason
