"""What `snakesim run --stay` does when processes end: it starts them again, and arms nothing. And faults on request."""

import os
import re
import signal
from pathlib import Path
from typing import Literal

import pytest

from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Answer,
    FaultRequest,
    LifecycleRequest,
    RobotDescription,
    RobotStatus,
)
from snakesim_operator.results.summary import RunSummary
from snakesim_testing.harness.processes import assert_no_process_left, find_processes_of_run
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import (
    RunningCommand,
    read_summary,
    running_armed_snakesim,
    running_snakesim,
)
from snakesim_testing.runs.in_process_command import snakesim

pytestmark = pytest.mark.e2e

SERVICES = ("guidance", "navigation", "control")
# 50 Hz has the longest lease, 100 ms: a busy test machine may well forget a process for 50 ms.
LONG = ["triplet", "--controller", "hold", "--duration", "600", "--set", "rate_hz=50"]
BACK_S = 20.0  # 5 s on a machine that has nothing else to do


class Robot:
    """A run as somebody on its network sees it."""

    def __init__(self, session: Session) -> None:
        self._session, self._statuses = (
            session,
            session.declare_latched_reader(keys.STATUS, RobotStatus),
        )
        self._status: RobotStatus | None = None

    def status(self) -> RobotStatus:
        def heard() -> RobotStatus | None:
            self._status = (self._statuses.drain() or [self._status])[-1]
            return self._status

        wait_until(heard, "a status")
        assert self._status is not None
        return self._status

    def reaches(self, lifecycle: str) -> RobotStatus:
        wait_until(lambda: self.status().lifecycle == lifecycle, f"lifecycle {lifecycle}", BACK_S)
        return self.status()

    def is_ready(self) -> None:
        wait_until(lambda: self.status().ready_to_arm, "ready to arm", BACK_S)

    def tell(self, action: Literal["arm", "reset"]) -> Answer:
        robot = self._session.wait_for_latched(keys.DESCRIPTION, RobotDescription, BACK_S)
        assert robot is not None
        request = LifecycleRequest(
            action=action, robot=robot.robot, backend=robot.backend, config_hash=robot.config_hash
        )
        return self._session.send_request(keys.LIFECYCLE, request)

    def arm(self) -> None:
        wait_until(lambda: self.tell("arm").ok, "armed", BACK_S)

    def is_commanded(self, times: int) -> bool:
        """Arm a robot that is disarmed; whether it has then accepted so many commands."""
        if self.status().lifecycle == "disarmed":
            self.tell("arm")
        return self.status().lifecycle == "armed" and self.status().commands_accepted > times

    def fault(self, kind: str, target: str, **more: object) -> Answer:
        request = FaultRequest(kind=kind, target=target, **more)  # pyright: ignore[reportArgumentType]
        return self._session.send_request(keys.fault_key("run"), request, 5.0)


def pids(run: RunningCommand, *names: str) -> dict[str, int]:
    return {name: run.part(name) for name in names}


def interrupt(run: RunningCommand) -> RunSummary:
    assert run.interrupt() == 130 and "report:" in run.printed(), run.printed()
    return read_summary(run.out)


@pytest.mark.parametrize(
    "clock_mode", ["lockstep", pytest.param("realtime", marks=pytest.mark.quiet)]
)
def test_a_killed_host_is_started_again_and_not_armed(tmp_path: Path, clock_mode: str) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG, "--clock-mode", clock_mode, "--stay"
    ) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            robot = Robot(session)
            first, services = robot.reaches("armed"), pids(run, *SERVICES)
            os.kill(run.part("host"), signal.SIGKILL)
            wait_until(
                lambda: robot.status().lease_epoch > first.lease_epoch + 1,
                "another host's lease",
                BACK_S,
            )
            robot.is_ready()
            assert robot.status().lifecycle == "disarmed"
            assert robot.status().commands_accepted == 0
            assert robot.status().tick == 0 or clock_mode == "realtime"
            assert pids(run, *SERVICES) == services  # they found the new host by themselves
            wait_until(lambda: robot.is_commanded(20), "commands to the new host")
        summary = interrupt(run)
    assert summary.hosts == 2
    assert [restart.name for restart in summary.restarts] == ["host"]
    assert (tmp_path / "run" / "recording-1.mcap").is_file()
    assert summary.ticks > 0
    assert "host was ended by SIGKILL; restart in 0.5 s" in run.printed()


def test_killed_controller_latches_fault_until_a_person_resets(tmp_path: Path) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG, "--clock-mode", "realtime", "--stay"
    ) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            robot, before = Robot(session), run.part("control")
            os.kill(before, signal.SIGKILL)
            robot.reaches("fault")
            wait_until(
                lambda: run.parts().get("control", before) != before, "another process of control"
            )
            wait_until(
                lambda: (
                    "control" in robot.status().alive and robot.status().lease_holder == "control"
                ),
                "control",
            )
            assert robot.status().lifecycle == "fault"
            assert not robot.tell("arm").ok
            assert robot.tell("reset").ok
            robot.is_ready()
            robot.arm()
            robot.reaches("armed")
        summary = interrupt(run)
    assert {fault.what for fault in summary.faults} == {"service_lost", "lease_expired"}
    assert summary.ended == "interrupted"
    assert "continue with `snakesim robot reset`" in run.printed()


@pytest.mark.slow  # a row of the fault table
def test_dead_router_stops_robot_and_nothing_rearms_it(tmp_path: Path) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG, "--clock-mode", "realtime", "--stay", "--with-router"
    ) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            robot = Robot(session)
            robot.reaches("armed")
            before = pids(run, "host", *SERVICES)
            os.kill(run.part("router"), signal.SIGKILL)
            robot.reaches("fault")  # told by the host as soon as there is a router again
            wait_until(lambda: not robot.status().waiting_for, "everybody back", BACK_S)
            assert robot.status().lifecycle == "fault"
            assert pids(run, "host", *SERVICES) == before
            assert "lease_expired" in [fault.what for fault in robot.status().faults]
            for command in (["robot", "reset"], ["robot", "arm", "planar13", "sim"]):
                result = snakesim(*command, "--router", run.endpoint, cwd=tmp_path)
                if command == ["robot", "reset"]:
                    assert result.code == 0, result.err
                    robot.is_ready()
            robot.reaches("armed")
        interrupt(run)


@pytest.mark.slow
def test_a_service_that_may_not_be_restarted_ends_the_run(tmp_path: Path) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG, "--stay", "--set", "services.guidance.restart=false"
    ) as run:
        os.kill(run.part("guidance"), signal.SIGKILL)
        assert run.end() == 1
        assert "guidance was ended by SIGKILL" in run.printed()


@pytest.mark.slow  # rows of the fault table
def test_processes_go_wrong_on_request(tmp_path: Path) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG, "--clock-mode", "realtime", "--stay"
    ) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            robot = Robot(session)
            robot.reaches("armed")
            assert robot.fault("freeze", "control", for_s=0.5).ok
            robot.reaches("fault")
            wait_until(lambda: "injected fault ends: freeze:control" in run.printed(), "the thaw")
            before = run.part("navigation")
            assert robot.fault("stop", "navigation").ok
            wait_until(lambda: run.printed().count("; restart in") == 1, "navigation's end")
            wait_until(lambda: not robot.status().waiting_for, "navigation again", BACK_S)
            assert run.part("navigation") != before
            for kind, target, word in (
                ("kill", "nobody", "host, guidance, navigation, control"),
                ("hang", "control", "fault/control"),
                ("kill", "router", "no process 'router'"),
                ("freeze", "sensor/imu", "knows no 'freeze'"),
                ("freeze", "host", "give --for SECONDS"),
            ):
                answer = robot.fault(kind, target)
                assert (
                    not answer.ok and answer.refusal == "unknown_fault" and word in answer.reason
                ), answer
            assert robot.fault("freeze", "host", for_s=60.0).ok
            run.wait_for("injected fault: freeze:host")
        interrupt(run)  # a frozen host is thawed to end in order


def test_a_killed_supervisor_leaves_no_frozen_child(tmp_path: Path) -> None:
    frozen_soon = ("--set", 'faults=["freeze:control@0.2","freeze:host@0.2"]')
    with running_snakesim(
        tmp_path / "run", *LONG, "--clock-mode", "realtime", "--with-router", *frozen_soon
    ) as run:
        run.wait_for("injected fault: freeze:host")
        frozen = [Path(f"/proc/{run.part(name)}/stat").read_text() for name in ("control", "host")]
        assert [re.sub(r".*\) ", "", line)[0] for line in frozen] == ["T", "T"]
        # Router, host, three services, recorder.
        assert len(find_processes_of_run(tmp_path / "run")) == 6
        os.kill(run.process.pid, signal.SIGKILL)
        run.end()
        assert_no_process_left(tmp_path / "run")
