"""Which drives may be driven after a stop of their own or a pause of the driver, and for how long they brake."""

import numpy as np
import pytest

from snakesim_drivers.kit.braking import BrakingJoints
from snakesim_drivers.kit.drive_guard import DriveGuard
from snakesim_drivers.kit.findings import FaultFinding
from snakesim_hal.wire.messages import JointMode

MS = 1_000_000
GAP_NS, GRACE_NS = 50 * MS, 50 * MS
BOTH = frozenset({0, 1})
NONE = frozenset[int]()


class Bench:
    """A guard of two drives, and its clock."""

    def __init__(self) -> None:
        self.now_ns = 0
        self.guard = DriveGuard(
            lambda: self.now_ns, watchdog_timeout_ns=GAP_NS, reset_grace_period_ns=GRACE_NS
        )

    def armed(self) -> frozenset[int]:
        return self.guard.select_drives_to_enable(BOTH, may_enable=True)

    def in_fault(self) -> frozenset[int]:
        return self.guard.select_drives_to_enable(BOTH, may_enable=False)

    def finds(self, joint: int | None) -> None:
        self.guard.note_findings([FaultFinding("drive_fault", "it is too hot", joint)])


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_guard_driver_pause_counts_until_states_are_read(bench: Bench) -> None:
    bench.now_ns = 10_000 * MS  # bring-up may take long
    bench.guard.mark_active()
    bench.now_ns += GAP_NS
    bench.guard.mark_active()
    assert not bench.guard.was_paused
    bench.now_ns += GAP_NS + 1
    bench.guard.mark_active()
    bench.guard.mark_active()
    assert bench.guard.was_paused
    bench.guard.mark_states_read()
    assert not bench.guard.was_paused


def test_guard_enables_only_armed_drives_and_keeps_damped_ones(bench: Bench) -> None:
    assert bench.in_fault() == NONE
    assert bench.armed() == BOTH
    assert bench.in_fault() == BOTH
    assert bench.guard.select_drives_to_enable(frozenset({0}), may_enable=False) == {0}
    assert bench.in_fault() == {0}, "the other one was let go"


def test_guard_faulty_drive_is_disabled_until_reset(bench: Bench) -> None:
    bench.armed()
    bench.finds(None)
    assert bench.armed() == BOTH, "a finding of the bus"
    bench.finds(1)
    assert bench.armed() == {0}
    assert bench.in_fault() == {0}
    bench.guard.reset(frozenset({0}))
    assert bench.armed() == {0}, "another joint was reset"
    bench.guard.reset(BOTH)
    assert bench.armed() == BOTH


def test_guard_stale_drive_report_right_after_reset_is_ignored(bench: Bench) -> None:
    bench.armed()
    bench.guard.reset(BOTH)
    bench.now_ns += GRACE_NS
    bench.finds(1)
    assert bench.armed() == BOTH
    bench.now_ns += 1
    bench.finds(1)
    assert bench.armed() == {0}


def test_guard_drives_disabled_by_bus_stay_off_until_reset(bench: Bench) -> None:
    assert not bench.guard.note_drives_released(), "none was driven"
    assert bench.armed() == BOTH
    assert bench.guard.note_drives_released()
    assert bench.armed() == NONE
    assert bench.in_fault() == NONE
    bench.guard.reset(BOTH)
    assert bench.armed() == BOTH


VELOCITIES = np.array([0.3, -0.3, 0.04])
EVERYBODY = frozenset({0, 1, 2})


def test_guard_joint_brakes_until_rest_or_watchdog_time() -> None:
    braking, modes = (
        BrakingJoints([100 * MS, 200 * MS, 100 * MS], is_hold_mode=False),
        [JointMode.VELOCITY] * 3,
    )
    for _ in range(2):  # a fault, and the next one
        assert braking.select_braking_joints(EVERYBODY, modes, VELOCITIES, 0) == {0, 1}
        assert braking.select_braking_joints(EVERYBODY, modes, VELOCITIES, 99 * MS) == {0, 1}
        assert braking.select_braking_joints(EVERYBODY, modes, VELOCITIES, 100 * MS) == {1}
        assert braking.select_braking_joints(EVERYBODY, modes, 10 * VELOCITIES, 100 * MS) == {1}, (
            "none begins again"
        )
        assert braking.select_braking_joints(EVERYBODY, modes, VELOCITIES, 200 * MS) == NONE
        braking.reset()


def test_guard_hold_has_no_end_and_passive_disables_at_once() -> None:
    braking = BrakingJoints([100 * MS] * 3, is_hold_mode=True)
    assert (
        braking.select_braking_joints(EVERYBODY, [JointMode.POSITION] * 3, 0 * VELOCITIES, 0)
        == EVERYBODY
    )
    assert (
        braking.select_braking_joints(EVERYBODY, [JointMode.POSITION] * 3, VELOCITIES, 10_000 * MS)
        == EVERYBODY
    )
    modes = [JointMode.PASSIVE, JointMode.POSITION, JointMode.POSITION]
    assert braking.select_braking_joints(EVERYBODY, modes, VELOCITIES, 10_000 * MS) == {1, 2}
