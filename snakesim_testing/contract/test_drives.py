"""Drives without their driver: what has stopped by itself stays off, and nothing brakes without end."""

from collections.abc import Callable

import numpy as np
import pytest

from snakesim_hal.wire.messages import Mode
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.bench import EmulatedDrives
from snakesim_testing.contract.rig import Rig


def do_nothing(_rig: Rig) -> None:
    """Do nothing: the host finds by itself that it was away."""


@pytest.mark.parametrize("then", [do_nothing, Rig.disarm, Rig.estop], ids=["goes_on", "disarm", "estop"])
def test_drives_that_stop_during_host_freeze_stay_off_until_reset(
    rig: Rig, drives: EmulatedDrives, then: Callable[[Rig], None]
) -> None:
    """A host that does nothing for 1 s while a joint moves: every drive stops by its own watchdog.

    Once the host resumes, the backend reports each of those stops as a fault of its joint, whatever the operator asks
    for first. No drive is enabled again before the fault is reset and the robot armed.
    """
    unguarded = rig.joints_without_watchdog
    if unguarded:
        pytest.skip(f"described without a watchdog, so they hold while the host is frozen: {unguarded}")
    rig.cruise()
    rig.spoiled = True
    assert all(drives.enabled()), f"armed, and enabled are {drives.enabled()}"
    began = rig.tick
    rig.freeze_host(t.FROZEN_S, drives.freeze_driver)
    assert not any(drives.enabled()), f"{t.FROZEN_S} s without the driver, and still enabled are {drives.enabled()}"
    then(rig)
    assert_drives_stay_off(rig, drives, rig.count_periods(t.SETTLE_S))
    record = rig.record_since(began)
    named = {fault.joint for fault in record.faults if fault.cause}
    silent = [joint.name for joint in rig.robot.joints if joint.name not in named]
    assert not silent, f"their stop was never reported: {silent}; reported were {record.faults}"
    assert rig.authority.state in ("fault", "estop"), rig.authority.state
    rig.reset()
    assert_drives_stay_off(rig, drives, t.ARMING_PERIODS)
    reset_tick = rig.tick
    rig.cruise()
    assert all(drives.enabled()), f"reset and armed, and enabled are {drives.enabled()}"
    assert not rig.record_since(reset_tick).faults, rig.record_since(reset_tick).faults


def test_drives_without_watchdog_are_off_once_frozen_host_resumes(rig: Rig, drives: EmulatedDrives) -> None:
    """Drives that are described without a watchdog hold while the host does nothing.

    Once it resumes, the backend switches each of them off at once, reports it as a fault of its joint, and enables none
    before the fault is reset and the robot armed.
    """
    unguarded = rig.joints_without_watchdog
    if not unguarded:
        pytest.skip("every joint is described with a watchdog")
    rig.cruise()
    rig.spoiled = True
    began = rig.tick
    rig.freeze_host(t.FROZEN_S, drives.freeze_driver)
    rig.idle(t.TRANSPORT_PERIODS)
    assert_drives_stay_off(rig, drives, rig.count_periods(t.SETTLE_S))
    record = rig.record_since(began)
    named = {fault.joint for fault in record.faults if fault.cause}
    assert named >= {*unguarded}, f"reported were {record.faults}"
    assert rig.authority.state in ("fault", "estop"), rig.authority.state
    rig.reset()
    assert_drives_stay_off(rig, drives, t.ARMING_PERIODS)
    rig.cruise()
    assert all(drives.enabled()), f"reset and armed, and enabled are {drives.enabled()}"


def assert_drives_stay_off(rig: Rig, drives: EmulatedDrives, periods: int) -> None:
    """Fail if a drive is enabled at any time."""
    for _ in range(periods):
        rig.idle()
        assert not any(drives.enabled()), f"enabled again, in state {rig.authority.state}: {drives.enabled()}"


def test_drives_brake_after_fault_and_are_off_after_watchdog(rig: Rig, drives: EmulatedDrives) -> None:
    """A fault that the driver gets: the drive of a moving joint brakes, for its watchdog's time at most."""
    rig.cruise()
    rig.fault()
    rig.idle()
    if rig.supports_mode(
        0, Mode.VELOCITY
    ):  # otherwise the joint is led to rest by its position, which takes less than a period
        assert drives.enabled()[0], "the joint moves, and its drive does not brake"
    rig.idle(rig.count_periods(t.BRAKES_S) + t.TRANSPORT_PERIODS)
    assert_drives_stay_off(rig, drives, rig.count_periods(t.SETTLE_S))
    assert np.abs(rig.newest_joints.velocity_rad_s).max() < t.STILL_RAD_S, (
        f"still moving: {rig.newest_joints.velocity_rad_s} rad/s"
    )
