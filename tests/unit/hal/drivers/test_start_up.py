"""Start-up steps of drives: order, time limits, failures, aborts, and the reasons that an operator reads."""

import pytest

from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.kit.start_up import StartUp, StartUpStep, StepFailedError
from snakesim_testing.hal.small_robots import make_run_config

LABELS = ["joint_1 (node 1 on can0)", "joint_2 (node 2 on can0)"]


class StartUpRig:
    """Two drives that acknowledge a step when the test allows it."""

    def __init__(self, *, may_move: bool = True) -> None:
        self.now_ns = 0
        self.sent: list[tuple[str, int]] = []
        self.acknowledged: set[tuple[str, int]] = set()
        self.failing_drives: set[int] = set()
        joints = make_run_config(robot__chain__modules=2).robot.joint_table
        self.readings = DriveReadings(joints, lambda: self.now_ns)
        steps = [
            StartUpStep(
                "configuring",
                1.0,
                start=lambda i: self.sent.append(("configure", i)),
                is_done=self.is_configured,
            ),
            StartUpStep(
                "homing",
                10.0,
                start=lambda i: self.sent.append(("home", i)),
                is_done=self.is_homed,
                abort=lambda i: self.sent.append(("stop", i)),
                moves_joint=True,
            ),
        ]
        self.start_up = StartUp(
            LABELS, self.readings, lambda: self.now_ns, steps=steps, may_move=may_move
        )

    def is_configured(self, i: int) -> bool:
        return ("configured", i) in self.acknowledged

    def is_homed(self, i: int) -> bool:
        if i in self.failing_drives:
            raise StepFailedError("no index found")
        return ("homed", i) in self.acknowledged

    def run(self, seconds: float) -> None:
        """Let time pass in steps of 0.1 s."""
        for _ in range(round(seconds * 10)):
            self.now_ns += 100_000_000
            self.start_up.update()


def bring_both_to_homing(rig: StartUpRig) -> None:
    rig.start_up.update()
    rig.acknowledged |= {("configured", 0), ("configured", 1)}
    rig.start_up.update()


def test_steps_run_in_order_and_report_step_and_time() -> None:
    rig = StartUpRig()
    assert not rig.start_up.is_ready(0)
    bring_both_to_homing(rig)
    assert rig.sent == [("configure", 0), ("configure", 1), ("home", 0), ("home", 1)]
    rig.run(2.1)
    assert rig.readings.not_ready_reasons[1] == "joint_2 (node 2 on can0): homing, 2.1 of 10 s"
    rig.acknowledged.add(("homed", 0))
    rig.run(0.1)
    assert [rig.start_up.is_ready(i) for i in (0, 1)] == [True, False]
    assert rig.readings.not_ready_reasons[0] == ""
    assert rig.start_up.list_findings() == []


def test_step_beyond_its_time_is_aborted_and_repeated_after_reset() -> None:
    rig = StartUpRig()
    bring_both_to_homing(rig)
    rig.run(10.2)
    assert rig.sent[-2:] == [("stop", 0), ("stop", 1)]
    assert "homing did not end within 10 s" in rig.readings.not_ready_reasons[0]
    assert {(finding.what, finding.joint) for finding in rig.start_up.list_findings()} == {
        ("drive_not_ready", 0),
        ("drive_not_ready", 1),
    }
    assert not rig.start_up.can_continue()
    rig.start_up.reset(frozenset({1}))
    assert [finding.joint for finding in rig.start_up.list_findings()] == [0]
    rig.run(0.2)
    assert rig.sent[-2:] == [("configure", 1), ("home", 1)]


def test_failed_step_reports_the_reason_of_the_drive() -> None:
    rig = StartUpRig()
    bring_both_to_homing(rig)
    rig.failing_drives.add(0)
    rig.run(0.1)
    assert rig.sent[-1] == ("stop", 0)
    assert "homing failed: no index found" in rig.readings.not_ready_reasons[0]


def test_emergency_stop_aborts_steps_without_a_drive_fault() -> None:
    rig = StartUpRig()
    bring_both_to_homing(rig)
    rig.acknowledged.add(("homed", 0))
    rig.run(0.1)
    rig.start_up.abort("emergency stop")
    assert rig.sent[-1] == ("stop", 1)
    assert rig.start_up.is_ready(0)
    assert "homing was aborted: emergency stop" in rig.readings.not_ready_reasons[1]
    assert rig.start_up.list_findings() == []


def test_lost_position_is_a_fault_and_repeats_the_start_up() -> None:
    rig = StartUpRig()
    bring_both_to_homing(rig)
    rig.acknowledged |= {("homed", 0), ("homed", 1)}
    rig.run(0.1)
    rig.start_up.invalidate(1, "position unknown after a restart")
    [finding] = rig.start_up.list_findings()
    assert (finding.what, finding.joint, finding.affects_only_joint) == ("drive_not_ready", 1, True)
    assert "position unknown" in finding.cause
    rig.run(5.0)
    assert not rig.start_up.is_ready(1)
    rig.start_up.reset(frozenset({0, 1}))
    rig.run(0.3)
    assert rig.start_up.is_ready(1)
    assert rig.sent.count(("home", 0)) == 1, "a drive that is ready keeps its start-up"


@pytest.mark.parametrize("may_move", [False, True])
def test_step_that_moves_a_joint_waits_for_permission(may_move: bool) -> None:
    rig = StartUpRig(may_move=may_move)
    bring_both_to_homing(rig)
    assert (("home", 0) in rig.sent) == may_move
    assert rig.start_up.can_continue() == may_move
    assert ("do not allow" in rig.readings.not_ready_reasons[0]) != may_move
