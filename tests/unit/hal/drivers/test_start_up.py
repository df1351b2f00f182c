"""Start-up steps of drives: order, time limits, failures, aborts, and what the operator reads meanwhile."""

import pytest

from snakesim_drivers.kit.readings import DriveReadings
from snakesim_drivers.kit.start_up import StartUp, StartUpStep, StepFailedError
from snakesim_testing.hal.small_robots import make_run_config

LABELS = ["joint_1 (node 1 on can0)", "joint_2 (node 2 on can0)"]


class Bench:
    """Two drives that acknowledge a step when the test allows it."""

    def __init__(self, *, may_move: bool = True) -> None:
        self.now_ns = 0
        self.sent: list[tuple[str, int]] = []
        self.done: set[tuple[str, int]] = set()
        self.failed: set[int] = set()
        joints = make_run_config(robot__chain__modules=2).robot.joint_table
        self.readings = DriveReadings(joints, lambda: self.now_ns)
        steps = [
            StartUpStep(
                "configuring",
                1.0,
                start=lambda i: self.sent.append(("configure", i)),
                is_done=self.configured,
            ),
            StartUpStep(
                "homing",
                10.0,
                start=lambda i: self.sent.append(("home", i)),
                is_done=self.homed,
                abort=lambda i: self.sent.append(("stop", i)),
                moves_joint=True,
            ),
        ]
        self.start_up = StartUp(
            LABELS, self.readings, lambda: self.now_ns, steps=steps, may_move=may_move
        )

    def configured(self, i: int) -> bool:
        return ("configured", i) in self.done

    def homed(self, i: int) -> bool:
        if i in self.failed:
            raise StepFailedError("no index found")
        return ("homed", i) in self.done

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 10)):
            self.now_ns += 100_000_000
            self.start_up.update()


def bring_both_to_homing(bench: Bench) -> None:
    bench.start_up.update()
    bench.done |= {("configured", 0), ("configured", 1)}
    bench.start_up.update()


def test_steps_run_in_order_and_report_step_and_time() -> None:
    bench = Bench()
    assert not bench.start_up.is_ready(0)
    bring_both_to_homing(bench)
    assert bench.sent == [("configure", 0), ("configure", 1), ("home", 0), ("home", 1)]
    bench.run(2.1)
    assert bench.readings.not_ready_reasons[1] == "joint_2 (node 2 on can0): homing, 2.1 of 10 s"
    bench.done.add(("homed", 0))
    bench.run(0.1)
    assert [bench.start_up.is_ready(i) for i in (0, 1)] == [True, False]
    assert bench.readings.not_ready_reasons[0] == ""
    assert bench.start_up.list_findings() == []


def test_step_that_takes_too_long_is_aborted_and_begins_again_after_reset() -> None:
    bench = Bench()
    bring_both_to_homing(bench)
    bench.run(10.2)
    assert bench.sent[-2:] == [("stop", 0), ("stop", 1)]
    assert "homing did not end within 10 s" in bench.readings.not_ready_reasons[0]
    assert {(finding.what, finding.joint) for finding in bench.start_up.list_findings()} == {
        ("drive_not_ready", 0),
        ("drive_not_ready", 1),
    }
    assert not bench.start_up.can_continue()
    bench.start_up.reset(frozenset({1}))
    assert [finding.joint for finding in bench.start_up.list_findings()] == [0]
    bench.run(0.2)
    assert bench.sent[-2:] == [("configure", 1), ("home", 1)]


def test_failure_that_the_drive_reports_is_the_reason() -> None:
    bench = Bench()
    bring_both_to_homing(bench)
    bench.failed.add(0)
    bench.run(0.1)
    assert bench.sent[-1] == ("stop", 0)
    assert "homing failed: no index found" in bench.readings.not_ready_reasons[0]


def test_emergency_stop_aborts_the_steps_under_way_without_a_fault_of_the_drive() -> None:
    bench = Bench()
    bring_both_to_homing(bench)
    bench.done.add(("homed", 0))
    bench.run(0.1)
    bench.start_up.abort("emergency stop")
    assert bench.sent[-1] == ("stop", 1)
    assert bench.start_up.is_ready(0)
    assert "homing was aborted: emergency stop" in bench.readings.not_ready_reasons[1]
    assert bench.start_up.list_findings() == []


def test_lost_position_is_a_fault_and_needs_the_whole_start_up_again() -> None:
    bench = Bench()
    bring_both_to_homing(bench)
    bench.done |= {("homed", 0), ("homed", 1)}
    bench.run(0.1)
    bench.start_up.invalidate(1, "position unknown after a restart")
    [finding] = bench.start_up.list_findings()
    assert (finding.what, finding.joint, finding.affects_only_joint) == ("drive_not_ready", 1, True)
    assert "position unknown" in finding.cause
    bench.run(5.0)
    assert not bench.start_up.is_ready(1)
    bench.start_up.reset(frozenset({0, 1}))
    bench.run(0.3)
    assert bench.start_up.is_ready(1)
    assert bench.sent.count(("home", 0)) == 1, "a drive that is ready keeps its start-up"


@pytest.mark.parametrize("may_move", [False, True])
def test_step_that_moves_a_joint_waits_until_it_is_allowed(may_move: bool) -> None:
    bench = Bench(may_move=may_move)
    bring_both_to_homing(bench)
    assert (("home", 0) in bench.sent) == may_move
    assert bench.start_up.can_continue() == may_move
    assert ("do not allow" in bench.readings.not_ready_reasons[0]) != may_move
