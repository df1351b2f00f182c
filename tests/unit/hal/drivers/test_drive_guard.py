"""The drive guard selects drives that may be enabled after stops and pauses, and joints that brake."""

import numpy as np
import pytest

from snakesim_drivers.kit.braking import BrakingJoints
from snakesim_drivers.kit.drive_guard import DriveGuard
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_hal.wire.messages import JointMode

NS_PER_MS = 1_000_000
WATCHDOG_NS = 50 * NS_PER_MS
GRACE_NS = 50 * NS_PER_MS
BOTH_DRIVES = frozenset({0, 1})
NO_DRIVES = frozenset[int]()


class GuardRig:
    """A guard of two drives, and its clock."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.guard = DriveGuard(
            lambda: self.now_ns, watchdog_timeout_ns=WATCHDOG_NS, reset_grace_period_ns=GRACE_NS
        )

    def select_when_armed(self) -> frozenset[int]:
        """Return the drives that may be enabled while armed."""
        return self.guard.select_drives_to_enable(BOTH_DRIVES, may_enable=True)

    def select_in_fault(self) -> frozenset[int]:
        """Return the drives that may stay enabled in a fault."""
        return self.guard.select_drives_to_enable(BOTH_DRIVES, may_enable=False)

    def note_fault(self, joint: int | None) -> None:
        """Note a fault of a joint, or of the bus."""
        self.guard.note_findings([FaultFinding("drive_fault", "it is too hot", joint)])


@pytest.fixture
def rig() -> GuardRig:
    return GuardRig()


def test_guard_driver_pause_counts_until_states_are_read(rig: GuardRig) -> None:
    rig.now_ns = 10_000 * NS_PER_MS  # bring-up may take long
    rig.guard.mark_active()
    rig.now_ns += WATCHDOG_NS
    rig.guard.mark_active()
    assert not rig.guard.was_paused
    rig.now_ns += WATCHDOG_NS + 1
    rig.guard.mark_active()
    rig.guard.mark_active()
    assert rig.guard.was_paused
    rig.guard.mark_states_read()
    assert not rig.guard.was_paused


def test_guard_enables_only_armed_drives_and_keeps_damped_ones(rig: GuardRig) -> None:
    assert rig.select_in_fault() == NO_DRIVES
    assert rig.select_when_armed() == BOTH_DRIVES
    assert rig.select_in_fault() == BOTH_DRIVES
    assert rig.guard.select_drives_to_enable(frozenset({0}), may_enable=False) == {0}
    assert rig.select_in_fault() == {0}, "the other drive was released"


def test_guard_faulty_drive_is_disabled_until_reset(rig: GuardRig) -> None:
    rig.select_when_armed()
    rig.note_fault(None)
    assert rig.select_when_armed() == BOTH_DRIVES, "a finding of the bus concerns no drive"
    rig.note_fault(1)
    assert rig.select_when_armed() == {0}
    assert rig.select_in_fault() == {0}
    rig.guard.reset(frozenset({0}))
    assert rig.select_when_armed() == {0}, "only another joint was reset"
    rig.guard.reset(BOTH_DRIVES)
    assert rig.select_when_armed() == BOTH_DRIVES


def test_guard_stale_drive_report_right_after_reset_is_ignored(rig: GuardRig) -> None:
    rig.select_when_armed()
    rig.guard.reset(BOTH_DRIVES)
    rig.now_ns += GRACE_NS
    rig.note_fault(1)
    assert rig.select_when_armed() == BOTH_DRIVES
    rig.now_ns += 1
    rig.note_fault(1)
    assert rig.select_when_armed() == {0}


def test_guard_drives_disabled_by_bus_stay_off_until_reset(rig: GuardRig) -> None:
    assert not rig.guard.note_drives_released(), "no drive was enabled"
    assert rig.select_when_armed() == BOTH_DRIVES
    assert rig.guard.note_drives_released()
    assert rig.select_when_armed() == NO_DRIVES
    assert rig.select_in_fault() == NO_DRIVES
    rig.guard.reset(BOTH_DRIVES)
    assert rig.select_when_armed() == BOTH_DRIVES


VELOCITIES_RAD_S = np.array([0.3, -0.3, 0.04])
ALL_JOINTS = frozenset({0, 1, 2})


def test_guard_joint_brakes_until_rest_or_watchdog_time() -> None:
    braking = BrakingJoints([100 * NS_PER_MS, 200 * NS_PER_MS, 100 * NS_PER_MS], is_hold_mode=False)
    modes = [JointMode.VELOCITY] * 3
    for _ in range(2):  # two faults
        assert braking.select_braking_joints(ALL_JOINTS, modes, VELOCITIES_RAD_S, 0) == {0, 1}
        assert braking.select_braking_joints(
            ALL_JOINTS, modes, VELOCITIES_RAD_S, 99 * NS_PER_MS
        ) == {0, 1}
        assert braking.select_braking_joints(
            ALL_JOINTS, modes, VELOCITIES_RAD_S, 100 * NS_PER_MS
        ) == {1}
        assert braking.select_braking_joints(
            ALL_JOINTS, modes, 10 * VELOCITIES_RAD_S, 100 * NS_PER_MS
        ) == {1}, "a joint that has stopped braking does not start again"
        assert (
            braking.select_braking_joints(ALL_JOINTS, modes, VELOCITIES_RAD_S, 200 * NS_PER_MS)
            == NO_DRIVES
        )
        braking.reset()


def test_guard_hold_mode_brakes_without_end_unless_passive() -> None:
    braking = BrakingJoints([100 * NS_PER_MS] * 3, is_hold_mode=True)
    assert (
        braking.select_braking_joints(ALL_JOINTS, [JointMode.POSITION] * 3, 0 * VELOCITIES_RAD_S, 0)
        == ALL_JOINTS
    )
    assert (
        braking.select_braking_joints(
            ALL_JOINTS, [JointMode.POSITION] * 3, VELOCITIES_RAD_S, 10_000 * NS_PER_MS
        )
        == ALL_JOINTS
    )
    modes = [JointMode.PASSIVE, JointMode.POSITION, JointMode.POSITION]
    assert braking.select_braking_joints(
        ALL_JOINTS, modes, VELOCITIES_RAD_S, 10_000 * NS_PER_MS
    ) == {1, 2}
