"""Behind the real host, commanded by a real client over Zenoh: lease, staleness, faults."""

import math
import time
from collections import Counter
from typing import Any

import numpy as np

from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Fault, Mode, SimulatorRequest
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.loopback import Hosted, stay, wait_until
from snakesim_testing.contract.rig import JointTargets


def arm_and_move(silent: bool, hosted: Hosted) -> int:
    """Arm, and move joint 0.

    Args:
        silent: whether the controller sends nothing after the motion.
        hosted: the robot.

    Returns:
        The duration of the motion in ticks, from the arming on.
    """
    wait_until(lambda: hosted.backend.joint_states, "a first sample")
    angle = hosted.backend.joint_states[-1].angle_rad[0]
    speed = -math.copysign(t.CRUISE_RAD_S, angle)  # away from the nearer stop
    has_velocity_mode = hosted.robot.joints[0].supports_mode(Mode.VELOCITY)
    period_s = hosted.config.period_ns * 1e-9
    ticks = t.ARMING_PERIODS + math.ceil(t.CRUISE_S * 1e9 / hosted.config.period_ns)

    def plan(since_arming: int) -> JointTargets | None:
        if since_arming < t.ARMING_PERIODS:
            return {}
        if silent and since_arming >= ticks:
            return None
        if has_velocity_mode:
            return {0: (Mode.VELOCITY, speed)}
        position = angle + speed * period_s * (since_arming - t.ARMING_PERIODS)
        return {0: (Mode.POSITION, position)}

    hosted.arm(plan)
    return ticks


def assert_moved_before(fault: Fault, hosted: Hosted) -> None:
    """Fail if joint 0 was still until the fault: then its stopping would prove nothing."""
    since = fault.tick - 2 * t.ARMING_PERIODS
    speeds = [abs(state.velocity_rad_s[0]) for state in hosted.backend.joint_states if since < state.tick <= fault.tick]
    assert max(speeds) > t.STILL_RAD_S, "the joint did not move, so stopping cannot be tested"


def assert_rest_after(fault: Fault, hosted: Hosted) -> None:
    """Fail if a joint still moves SETTLE_S after the fault, in ticks of the robot."""
    settled = fault.tick + math.ceil(t.SETTLE_S * 1e9 / hosted.config.period_ns) + 1
    while hosted.tick < settled:
        hosted.wait_for_ticks(1)
    states = [state for state in hosted.backend.joint_states if fault.tick < state.tick <= settled]
    assert np.abs(states[-1].velocity_rad_s).max() < t.STILL_RAD_S, f"still moving: {states[-1].velocity_rad_s} rad/s"
    tail = np.array([state.angle_rad for state in states[-len(states) // 3 :]])
    assert np.ptp(tail, axis=0).max() < t.STILL_RAD, f"still moving: {np.ptp(tail, axis=0)} rad"


def test_bad_commands_are_refused_and_counted_and_move_nothing(hosted: Hosted) -> None:
    """Of another lease, for another robot, too long, NaN, too old, from the future: each by its own word."""
    hosted.arm(stay)
    hosted.wait_for_ticks(t.ARMING_PERIODS)
    count = len(hosted.robot.joints)
    lease = math.ceil(hosted.robot.lease_ns / hosted.robot.period_ns)
    wait_until(lambda: hosted.tick > 2 * lease, "ticks enough to be late by")
    refused = Counter(hosted.host.authority.rejected_counts)
    home = hosted.backend.joint_states[-1].angle_rad
    wrong: dict[str, dict[str, Any]] = {
        "wrong_epoch": {"lease_epoch": hosted.controller.epoch + 7},
        "wrong_layout": {"layout": "f" * 16},
        "wrong_length": {"mode": [Mode.POSITION] * (count + 1), "target": [0.5] * (count + 1)},
        "malformed": {"target": [math.nan] * count},
        "stale": {"tick": 0},
        "from_the_future": {"tick": hosted.tick + 1_000_000},
    }
    rejected = hosted.host.authority.rejected_counts

    def all_refused() -> bool:
        missing = [values for word, values in wrong.items() if rejected[word] <= refused[word]]
        for values in missing:  # again, because a burst of samples may lose some
            hosted.send_forged_command(**values)
        return not missing

    wait_until(all_refused, f"all refused, so far: {rejected}")
    after = hosted.wait_for_ticks(t.ARMING_PERIODS)
    assert hosted.host.authority.state == "armed", hosted.host.authority.reason
    away = np.array([state.angle_rad for state in after]) - home
    assert np.abs(away).max() < t.STILL_RAD, f"it moved by {np.abs(away).max():.3f} rad"


def test_a_fault_of_the_backend_latches_and_stops_the_joints(hosted: Hosted) -> None:
    """Whatever the controller still sends; and only a reset ends it."""
    ticks = arm_and_move(silent=False, hosted=hosted)
    at = hosted.armed_at + ticks
    hosted.backend.planted_fault = lambda tick: (
        Fault(tick=tick, what="planted", cause="by the test") if tick >= at else None
    )
    hosted.wait_for_lifecycle("fault")
    hosted.backend.planted_fault = None
    assert {fault.what for fault in hosted.host.authority.faults} == {"planted"}
    assert_moved_before(hosted.host.authority.faults[0], hosted)
    assert_rest_after(hosted.host.authority.faults[0], hosted)
    assert not hosted.lifecycle("arm").ok, "a fault has to be reset first"
    answer = hosted.lifecycle("reset")
    assert answer.ok and answer.lifecycle == "disarmed", answer


def test_a_controller_that_falls_silent_stops_joints_within_lease(bench: Bench, hosted: Hosted) -> None:
    """The lease is the dead-man switch: it runs out, that is a fault, and the joints come to rest."""
    try:
        let_lease_expire(hosted)
        assert_rest_after(hosted.host.authority.faults[0], hosted)
    finally:
        bench.reopen_for_next_test()  # a lockstep host does not wait again for a service that has stalled


def let_lease_expire(hosted: Hosted) -> None:
    """Let the controller fall silent, and check that the lease expires in time."""
    arm_and_move(silent=True, hosted=hosted)
    hosted.wait_for_lifecycle("fault")
    expired = next(fault for fault in hosted.host.authority.faults if fault.what == "lease_expired")
    lease = math.ceil(hosted.robot.lease_ns / hosted.robot.period_ns)
    assert_moved_before(expired, hosted)
    late = expired.tick - hosted.controller.last_sent_tick - lease
    assert late <= t.TRANSPORT_PERIODS, f"{late} periods after the end of the lease"


def test_a_simulator_stands_still_on_request_and_a_robot_refuses(hosted: Hosted) -> None:
    """In a pause no tick passes and no lease expires; a robot that cannot pause refuses."""
    hosted.arm(stay)
    hosted.wait_for_ticks(t.ARMING_PERIODS)
    answer = hosted.session.request(
        keys.SIMULATOR, SimulatorRequest(action="pause", requester="contract"), timeout_s=10.0
    )
    if not hosted.robot.simulated_time:
        assert answer.refusal == "not_simulated", answer
        hosted.wait_for_ticks(t.ARMING_PERIODS)
        return
    assert answer.ok, answer
    wait_until(lambda: hosted.host.status().paused_by == "contract", "the pause")
    tick = hosted.tick
    time.sleep(2 * hosted.robot.lease_ns * 1e-9)
    assert hosted.tick == tick, "time goes on in a pause"
    assert hosted.session.request(keys.SIMULATOR, SimulatorRequest(action="resume"), timeout_s=10.0).ok
    hosted.wait_for_ticks(t.ARMING_PERIODS)
    assert hosted.host.authority.state == "armed", hosted.host.authority.reason
