"""Behind the real host, commanded by a real client over Zenoh: lease, staleness, faults."""

import math
import time
from collections import Counter
from typing import Any

import numpy as np

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault, JointMode, SimulatorRequest
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.loopback import HostedBackend, hold_all_joints, wait_until
from snakesim_testing.contract.rig import JointTargets


def arm_and_move_by_controller(falls_silent: bool, hosted: HostedBackend) -> int:
    """Arm the robot, and let the controller move joint 0.

    Args:
        falls_silent: Whether the controller sends nothing after the motion.
        hosted: The backend behind a real host.

    Returns:
        Number of ticks from the arming to the end of the motion.
    """
    wait_until(lambda: hosted.backend.joint_states, "a first sample")
    start_angle_rad = hosted.backend.joint_states[-1].angle_rad[0]
    # Away from the nearer stop.
    speed_rad_s = -math.copysign(tolerances.MOTION_SPEED_RAD_S, start_angle_rad)
    has_velocity_mode = hosted.robot.joints[0].supports_mode(JointMode.VELOCITY)
    period_s = hosted.config.period_ns * 1e-9
    motion_ticks = tolerances.ARMING_PERIODS + math.ceil(
        tolerances.MOTION_DURATION_S * 1e9 / hosted.config.period_ns
    )

    def plan(ticks_since_arming: int) -> JointTargets | None:
        if ticks_since_arming < tolerances.ARMING_PERIODS:
            return {}
        if falls_silent and ticks_since_arming >= motion_ticks:
            return None
        if has_velocity_mode:
            return {0: (JointMode.VELOCITY, speed_rad_s)}
        position_rad = start_angle_rad + speed_rad_s * period_s * (
            ticks_since_arming - tolerances.ARMING_PERIODS
        )
        return {0: (JointMode.POSITION, position_rad)}

    hosted.arm(plan)
    return motion_ticks


def assert_moved_before(fault: Fault, hosted: HostedBackend) -> None:
    """Fail if joint 0 was still until the fault: then its stopping would prove nothing."""
    since = fault.tick - 2 * tolerances.ARMING_PERIODS
    speeds = [
        abs(state.velocity_rad_s[0])
        for state in hosted.backend.joint_states
        if since < state.tick <= fault.tick
    ]
    assert max(speeds) > tolerances.STANDSTILL_RAD_S, (
        "the joint did not move, so stopping cannot be tested"
    )


def assert_rest_after(fault: Fault, hosted: HostedBackend) -> None:
    """Fail if a joint still moves SETTLING_TIME_S after the fault, in ticks of the robot."""
    settled_tick = (
        fault.tick + math.ceil(tolerances.SETTLING_TIME_S * 1e9 / hosted.config.period_ns) + 1
    )
    while hosted.tick < settled_tick:
        hosted.wait_for_ticks(1)
    states = [
        state for state in hosted.backend.joint_states if fault.tick < state.tick <= settled_tick
    ]
    assert np.abs(states[-1].velocity_rad_s).max() < tolerances.STANDSTILL_RAD_S, (
        f"the joints still move: {states[-1].velocity_rad_s} rad/s"
    )
    last_angles_rad = np.array([state.angle_rad for state in states[-len(states) // 3 :]])
    assert np.ptp(last_angles_rad, axis=0).max() < tolerances.STANDSTILL_RAD, (
        f"the joints still move: {np.ptp(last_angles_rad, axis=0)} rad"
    )


def test_bad_commands_are_refused_and_counted_and_move_nothing(hosted: HostedBackend) -> None:
    """Invalid commands are refused, counted by the kind of their error, and move no joint.

    The commands are of another lease, for another robot, too long, NaN, too old or from the future.
    """
    hosted.arm(hold_all_joints)
    hosted.wait_for_ticks(tolerances.ARMING_PERIODS)
    count = len(hosted.robot.joints)
    lease_periods = math.ceil(hosted.robot.lease_ns / hosted.robot.period_ns)
    wait_until(lambda: hosted.tick > 2 * lease_periods, "ticks enough to be late by")
    rejected_before = Counter(hosted.host.authority.rejected_counts)
    start_angles_rad = hosted.backend.joint_states[-1].angle_rad
    invalid_fields_by_rejection: dict[str, dict[str, Any]] = {
        "wrong_epoch": {"lease_epoch": hosted.controller.last_lease_epoch + 7},
        "wrong_layout": {"layout": "f" * 16},
        "wrong_length": {"mode": [JointMode.POSITION] * (count + 1), "target": [0.5] * (count + 1)},
        "malformed": {"target": [math.nan] * count},
        "stale": {"tick": 0},
        "from_the_future": {"tick": hosted.tick + 1_000_000},
    }
    rejected = hosted.host.authority.rejected_counts

    def all_refused() -> bool:
        missing = [
            values
            for word, values in invalid_fields_by_rejection.items()
            if rejected[word] <= rejected_before[word]
        ]
        for values in missing:  # again, because a burst of samples may lose some
            hosted.send_forged_command(**values)
        return not missing

    wait_until(all_refused, f"all refused, so far: {rejected}")
    states_after = hosted.wait_for_ticks(tolerances.ARMING_PERIODS)
    assert hosted.host.authority.state == "armed", hosted.host.authority.reason
    moved_rad = np.array([state.angle_rad for state in states_after]) - start_angles_rad
    assert np.abs(moved_rad).max() < tolerances.STANDSTILL_RAD, (
        f"a joint moved by {np.abs(moved_rad).max():.3f} rad"
    )


def test_a_fault_of_the_backend_latches_and_stops_the_joints(hosted: HostedBackend) -> None:
    """A fault of the backend stops the joints with any command of the controller, and only a reset ends the fault."""
    motion_ticks = arm_and_move_by_controller(falls_silent=False, hosted=hosted)
    fault_tick = hosted.armed_tick + motion_ticks
    hosted.backend.planted_fault = lambda tick: (
        Fault(tick=tick, what="planted", cause="by the test") if tick >= fault_tick else None
    )
    hosted.wait_for_lifecycle("fault")
    hosted.backend.planted_fault = None
    assert {fault.what for fault in hosted.host.authority.faults} == {"planted"}
    assert_moved_before(hosted.host.authority.faults[0], hosted)
    assert_rest_after(hosted.host.authority.faults[0], hosted)
    assert not hosted.request_lifecycle("arm").ok, "a fault has to be reset first"
    answer = hosted.request_lifecycle("reset")
    assert answer.ok and answer.lifecycle == "disarmed", answer


def test_a_controller_that_falls_silent_stops_joints_within_lease(
    bench: Bench, hosted: HostedBackend
) -> None:
    """If the controller sends nothing, its command lease expires. This is a fault, and the joints come to rest."""
    try:
        let_lease_expire_and_check_time(hosted)
        assert_rest_after(hosted.host.authority.faults[0], hosted)
    finally:
        bench.reopen_for_next_test()  # a lockstep host does not wait again for a service that has stalled


def let_lease_expire_and_check_time(hosted: HostedBackend) -> None:
    """Let the controller fall silent in motion, and check that its command lease expires in time."""
    arm_and_move_by_controller(falls_silent=True, hosted=hosted)
    hosted.wait_for_lifecycle("fault")
    expired = next(fault for fault in hosted.host.authority.faults if fault.what == "lease_expired")
    lease_periods = math.ceil(hosted.robot.lease_ns / hosted.robot.period_ns)
    assert_moved_before(expired, hosted)
    late_periods = expired.tick - hosted.controller.last_sent_tick - lease_periods
    assert late_periods <= tolerances.TRANSPORT_PERIODS, (
        f"the robot stopped {late_periods} periods after the end of the lease"
    )


def test_a_simulator_stands_still_on_request_and_a_robot_refuses(hosted: HostedBackend) -> None:
    """While a simulator is paused, no tick passes and no lease expires. A robot that cannot pause refuses."""
    hosted.arm(hold_all_joints)
    hosted.wait_for_ticks(tolerances.ARMING_PERIODS)
    answer = hosted.session.send_request(
        keys.SIMULATOR, SimulatorRequest(action="pause", requester="contract"), timeout_s=10.0
    )
    if not hosted.robot.simulated_time:
        assert answer.refusal == "not_simulated", answer
        hosted.wait_for_ticks(tolerances.ARMING_PERIODS)
        return
    assert answer.ok, answer
    wait_until(lambda: hosted.host.build_status().paused_by == "contract", "the pause")
    tick = hosted.tick
    time.sleep(2 * hosted.robot.lease_ns * 1e-9)
    assert hosted.tick == tick, "time goes on in a pause"
    assert hosted.session.send_request(
        keys.SIMULATOR, SimulatorRequest(action="resume"), timeout_s=10.0
    ).ok
    hosted.wait_for_ticks(tolerances.ARMING_PERIODS)
    assert hosted.host.authority.state == "armed", hosted.host.authority.reason
