"""The lifecycle: nothing moves unless armed, and a stop is permanent."""

from collections.abc import Callable

import numpy as np
import pytest

from snakesim_hal.wire.messages import LifecycleState, Mode
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.rig import JointTargets, Record, Rig, unlimited

GO: JointTargets = {0: (Mode.VELOCITY, t.CRUISE_RAD_S)}


def assert_at_rest(record: Record, rig: Rig) -> None:
    """Fail if a joint moves, or is driven, at the end of a record."""
    last = record.velocity_rad_s[-1]
    assert np.abs(last).max() < t.STILL_RAD_S, f"still moving: {last} rad/s"
    tail = record.angle_rad[-rig.count_periods(t.SETTLE_S / 3) :]
    assert np.ptp(tail, axis=0).max() < t.STILL_RAD, f"still moving: {np.ptp(tail, axis=0)} rad"


def test_nothing_moves_while_disarmed_whatever_is_commanded(rig: Rig) -> None:
    """Commands are sent and received; the joints stay, without torque."""
    asked = {i: (Mode.POSITION, rig.home_rad[i] + t.STEP_RAD) for i in range(rig.count)}
    before = np.array(rig.newest_joints.angle_rad)
    record = rig.drive(asked, rig.count_periods(t.CRUISE_S))
    moved = np.abs(record.angle_rad - before).max()
    assert moved < t.STILL_RAD, f"it moved by {moved:.3f} rad"
    assert np.abs(record.torque_nm).max() < t.TORQUE_NM


@pytest.mark.parametrize("state", ["disarmed", "estop"])
def test_a_robot_with_modules_stops_them_itself_when_not_armed(bench: Bench, rig: Rig, state: LifecycleState) -> None:
    """The second line of defence: given moving setpoints by mistake, a robot that is not armed does not follow.

    A simulator need not do this (see `Backend.enact`); the host hands it none.
    """
    asked = {i: (Mode.POSITION, rig.home_rad[i] + 0.5 * t.STEP_RAD) for i in range(rig.count)}
    before = np.array(rig.newest_joints.angle_rad)
    first_tick = rig.tick
    for _ in range(rig.count_periods(t.CRUISE_S)):
        rig.enact_without_limiter(unlimited(rig.make_setpoints(asked)), state)
    rig.idle(t.TRANSPORT_PERIODS)  # disarmed: the only state after a stop
    moved = float(np.abs(rig.record_since(first_tick).angle_rad - before).max())
    if moved >= t.STILL_RAD and bench.clock_mode == "lockstep":
        pytest.skip("a simulator may follow setpoints in every state; the host hands it safe ones only")
    assert moved < t.STILL_RAD, f"{state}, and it moved by {moved:.3f} rad"


@pytest.mark.parametrize("stop", [Rig.disarm, Rig.estop, Rig.fault], ids=["disarm", "estop", "fault"])
def test_leaving_armed_brings_a_moving_joint_to_rest(rig: Rig, stop: Callable[[Rig], None]) -> None:
    """Disarmed, stopped or at fault: the joint comes to rest, and later commands do not move it."""
    rig.cruise()
    stop(rig)
    assert_at_rest(rig.drive(GO, rig.count_periods(t.SETTLE_S)), rig)


def test_disarmed_joints_have_no_torque(rig: Rig) -> None:
    """Passive means no torque, also away from the start pose."""
    rig.arm()
    rig.drive({0: (Mode.POSITION, rig.home_rad[0] + t.STEP_RAD)}, rig.count_periods(t.SETTLE_S))
    rig.disarm()
    record = rig.drive(GO, rig.count_periods(t.SETTLE_S))
    assert np.abs(record.torque_nm[-1]).max() < t.TORQUE_NM, f"{record.torque_nm[-1]} N·m"
    assert_at_rest(record, rig)


def test_arming_again_goes_on_from_where_the_robot_is(rig: Rig) -> None:
    """Stopped on its way, reset and armed again: no joint resumes an earlier setpoint."""
    rig.cruise()
    rig.estop()
    rig.idle(rig.count_periods(t.SETTLE_S))
    rig.disarm()
    rig.idle(t.TRANSPORT_PERIODS)
    before = np.array(rig.newest_joints.angle_rad)
    first_tick = rig.tick
    rig.arm()
    record = rig.record_since(first_tick)
    assert np.abs(record.angle_rad - before).max() < t.STILL_RAD, f"{record.angle_rad[-1] - before} rad"
    assert np.abs(np.diff(record.torque_nm, axis=0)).max() < t.BUMP_SHARE * rig.full_torque_nm[0]


def test_after_reset_and_arm_it_moves_again(rig: Rig) -> None:
    """After a stop, reset and armed, the robot works as before."""
    rig.cruise()
    rig.fault()
    rig.idle(rig.count_periods(t.SETTLE_S))
    rig.cruise(joint=rig.count - 1)
