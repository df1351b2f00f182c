"""Faults: none in normal operation; a silent joint is detected, and stops the robot."""

import math

import numpy as np
import pytest

from snakesim_hal.wire.messages import Mode
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.rig import Record, Rig
from snakesim_testing.contract.test_lifecycle import assert_at_rest

MUTED = 1
LOST = 1


def test_a_healthy_robot_reports_no_fault(rig: Rig, healthy: Record) -> None:
    """`faults()` is empty after opening, and in operation."""
    assert not rig.faults_at_opening, rig.faults_at_opening
    assert healthy.samples and not healthy.faults, healthy.faults


def test_an_isolated_joint_is_passive_while_others_continue(rig: Rig) -> None:
    """While it is in `isolated`, a joint has no torque, whatever is commanded; a reset ends that."""
    with rig.with_isolation_allowed():
        began = rig.tick
        rig.cruise()
        rig.isolate_joint(LOST)
        asked = {0: (Mode.VELOCITY, t.CRUISE_RAD_S), LOST: (Mode.POSITION, rig.home_rad[LOST] + t.STEP_RAD)}
        record = rig.drive(asked, rig.count_periods(t.CRUISE_S))
        rig.assert_armed()
        assert abs(record.torque_nm[-1, LOST]) < t.TORQUE_NM, f"{record.torque_nm[-1, LOST]:.3f} N·m"
        moved = np.ptp(record.angle_rad[t.TRANSPORT_PERIODS :, LOST])
        assert moved < t.REACHED_RAD, f"it was moved by {moved:.3f} rad"
        assert record.velocity_rad_s[-1, 0] > (1 - t.SPEED_SHARE) * t.CRUISE_RAD_S, "the others stop, too"
        rig.disarm()
        rig.idle(t.TRANSPORT_PERIODS)
        rig.reset()
        rig.idle(t.ARMING_PERIODS)
        rig.arm()
        record = rig.drive({LOST: asked[LOST]}, rig.count_periods(t.SETTLE_S))
        away = record.angle_rad[-1, LOST] - asked[LOST][1]
        assert abs(away) < t.REACHED_RAD, f"after the reset it stops {away:.3f} rad from its target"
        assert not rig.record_since(began).faults, rig.record_since(began).faults


def test_a_silent_joint_grows_old_and_the_robot_stops(bench: Bench, rig: Rig) -> None:
    """The silent joint is invalid, or its age grows with time, until the robot is at fault.

    The others stay fresh. Faults that the backend reports besides have a word and a cause, and each is reported once.
    """
    if bench.mute is None:
        pytest.skip("this bench cannot silence a joint; give --snakesim-mute")
    rig.cruise()
    rig.spoiled = True
    began = rig.tick
    bench.mute(rig.backend, MUTED)
    lease = math.ceil(rig.robot.lease_ns / rig.period_ns)
    record = rig.drive({0: (Mode.VELOCITY, t.CRUISE_RAD_S)}, lease + t.TRANSPORT_PERIODS + 2)
    for joints in record.joints[t.TRANSPORT_PERIODS :]:
        silent_ns = (joints.tick - began - t.TRANSPORT_PERIODS) * rig.period_ns
        known = joints.valid[MUTED] and joints.age_ns[MUTED] < silent_ns
        assert not known, f"silent for {silent_ns * 1e-6} ms, reported as {joints.age_ns[MUTED] * 1e-6} ms old"
        others = [i for i in range(rig.count) if i != MUTED]
        assert all(joints.valid[i] and joints.age_ns[i] <= rig.period_ns for i in others), "the others are fresh"
    assert rig.authority.state == "fault", "the robot goes on with a joint of unknown state"
    assert_others_at_rest(rig)
    before = len(rig.faults)
    assert all(fault.what and fault.cause for fault in rig.faults)
    rig.idle(t.TRANSPORT_PERIODS)
    assert len(rig.faults) == before, f"reported again: {rig.faults[before:]}"
    rig.close()


def assert_others_at_rest(rig: Rig) -> None:
    """The position of the silent joint is unknown; the others rest."""
    record = rig.idle(rig.count_periods(t.SETTLE_S))
    for sample in record.samples:
        sample.joints.velocity_rad_s[MUTED] = 0.0
        sample.joints.angle_rad[MUTED] = 0.0
    assert_at_rest(record, rig)
    assert np.isfinite(record.angle_rad).all()
