"""`snakesim run --stay` restarts processes that end, and never arms the robot; it also injects requested faults."""

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
# 50 Hz has the longest lease, 100 ms: a busy test machine may pause a process for 50 ms.
LONG_RUN = ["triplet", "--controller", "hold", "--duration", "600", "--set", "rate_hz=50"]
RESTART_TIMEOUT_S = 20.0  # a restart takes 5 s on an idle machine


class RobotClient:
    """A client on the network of a run."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._statuses = session.declare_latched_reader(keys.STATUS, RobotStatus)
        self._status: RobotStatus | None = None

    def status(self) -> RobotStatus:
        """Return the newest status of the robot; wait for the first one."""

        def read_newest() -> RobotStatus | None:
            self._status = (self._statuses.drain() or [self._status])[-1]
            return self._status

        wait_until(read_newest, "a status")
        assert self._status is not None
        return self._status

    def wait_for_lifecycle(self, lifecycle: str) -> RobotStatus:
        """Wait until the robot is in this lifecycle state, and return its status."""
        wait_until(
            lambda: self.status().lifecycle == lifecycle,
            f"lifecycle {lifecycle}",
            RESTART_TIMEOUT_S,
        )
        return self.status()

    def wait_until_ready(self) -> None:
        """Wait until the robot may be armed."""
        wait_until(lambda: self.status().ready_to_arm, "ready to arm", RESTART_TIMEOUT_S)

    def request_lifecycle(self, action: Literal["arm", "reset"]) -> Answer:
        """Send a lifecycle request to the host."""
        robot = self._session.wait_for_latched(
            keys.DESCRIPTION, RobotDescription, RESTART_TIMEOUT_S
        )
        assert robot is not None
        request = LifecycleRequest(
            action=action, robot=robot.robot, backend=robot.backend, config_hash=robot.config_hash
        )
        return self._session.send_request(keys.LIFECYCLE, request)

    def arm(self) -> None:
        """Request arming until the host arms the robot."""
        wait_until(lambda: self.request_lifecycle("arm").ok, "armed", RESTART_TIMEOUT_S)

    def arm_and_check_commands(self, min_commands: int) -> bool:
        """Arm a disarmed robot; return whether it is armed and has accepted more than this number of commands."""
        if self.status().lifecycle == "disarmed":
            self.request_lifecycle("arm")
        status = self.status()
        return status.lifecycle == "armed" and status.commands_accepted > min_commands

    def inject_fault(self, kind: str, target: str, **options: object) -> Answer:
        """Request a fault from the supervisor of the run."""
        request = FaultRequest(kind=kind, target=target, **options)  # pyright: ignore[reportArgumentType]
        return self._session.send_request(keys.fault_key("run"), request, 5.0)


def get_process_ids(run: RunningCommand, *names: str) -> dict[str, int]:
    """Return the process id of each named part of a run."""
    return {name: run.part(name) for name in names}


def interrupt_and_read_summary(run: RunningCommand) -> RunSummary:
    """End a run with Ctrl-C."""
    assert run.interrupt() == 130, run.printed()
    assert "report:" in run.printed(), run.printed()
    return read_summary(run.out)


@pytest.mark.heavy
@pytest.mark.parametrize(
    "clock_mode", ["lockstep", pytest.param("realtime", marks=pytest.mark.quiet)]
)
def test_supervisor_restarts_killed_host_without_arming_it(tmp_path: Path, clock_mode: str) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG_RUN, "--clock-mode", clock_mode, "--stay"
    ) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            robot = RobotClient(session)
            first_status = robot.wait_for_lifecycle("armed")
            service_ids = get_process_ids(run, *SERVICES)
            os.kill(run.part("host"), signal.SIGKILL)
            wait_until(
                lambda: robot.status().lease_epoch > first_status.lease_epoch + 1,
                "the lease of another host",
                RESTART_TIMEOUT_S,
            )
            robot.wait_until_ready()
            assert robot.status().lifecycle == "disarmed"
            assert robot.status().commands_accepted == 0
            assert robot.status().tick == 0 or clock_mode == "realtime"
            assert (
                get_process_ids(run, *SERVICES) == service_ids
            )  # the services connected to the new host
            wait_until(lambda: robot.arm_and_check_commands(20), "commands to the new host")
        summary = interrupt_and_read_summary(run)
    assert summary.hosts == 2
    assert [restart.name for restart in summary.restarts] == ["host"]
    assert (tmp_path / "run" / "recording-1.mcap").is_file()
    assert summary.ticks > 0
    assert "host was ended by SIGKILL; restart in 0.5 s" in run.printed()


@pytest.mark.heavy
def test_supervisor_after_killed_controller_waits_for_reset_by_operator(tmp_path: Path) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG_RUN, "--clock-mode", "realtime", "--stay"
    ) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            robot = RobotClient(session)
            first_control_id = run.part("control")
            os.kill(first_control_id, signal.SIGKILL)
            robot.wait_for_lifecycle("fault")
            wait_until(
                lambda: run.parts().get("control", first_control_id) != first_control_id,
                "another process of control",
            )
            wait_until(
                lambda: (
                    "control" in robot.status().alive and robot.status().lease_holder == "control"
                ),
                "control holds the lease",
            )
            assert robot.status().lifecycle == "fault"
            assert not robot.request_lifecycle("arm").ok
            assert robot.request_lifecycle("reset").ok
            robot.wait_until_ready()
            robot.arm()
            robot.wait_for_lifecycle("armed")
        summary = interrupt_and_read_summary(run)
    assert {fault.what for fault in summary.faults} == {"service_lost", "lease_expired"}
    assert summary.ended == "interrupted"
    assert "continue with `snakesim robot reset`" in run.printed()


@pytest.mark.quiet  # the fault table measures this fault, too
def test_supervisor_after_killed_router_does_not_arm_robot(tmp_path: Path) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG_RUN, "--clock-mode", "realtime", "--stay", "--with-router"
    ) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            robot = RobotClient(session)
            robot.wait_for_lifecycle("armed")
            process_ids = get_process_ids(run, "host", *SERVICES)
            os.kill(run.part("router"), signal.SIGKILL)
            robot.wait_for_lifecycle(
                "fault"
            )  # the host publishes it as soon as the router runs again
            wait_until(
                lambda: not robot.status().waiting_for, "all services connected", RESTART_TIMEOUT_S
            )
            assert robot.status().lifecycle == "fault"
            assert get_process_ids(run, "host", *SERVICES) == process_ids
            assert "lease_expired" in [fault.what for fault in robot.status().faults]
            router = ("--router", run.endpoint)
            reset = snakesim("robot", "reset", *router, cwd=tmp_path)
            assert reset.code == 0, reset.err
            robot.wait_until_ready()
            snakesim("robot", "arm", "planar13", "sim", *router, cwd=tmp_path)
            robot.wait_for_lifecycle("armed")
        interrupt_and_read_summary(run)


@pytest.mark.slow
def test_supervisor_ends_run_if_service_may_not_restart(tmp_path: Path) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG_RUN, "--stay", "--set", "services.guidance.restart=false"
    ) as run:
        os.kill(run.part("guidance"), signal.SIGKILL)
        assert run.end() == 1
        assert "guidance was ended by SIGKILL" in run.printed()


@pytest.mark.quiet  # the fault table measures these faults, too
def test_requested_process_faults_are_injected_or_refused(tmp_path: Path) -> None:
    with running_armed_snakesim(
        tmp_path / "run", *LONG_RUN, "--clock-mode", "realtime", "--stay"
    ) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            robot = RobotClient(session)
            robot.wait_for_lifecycle("armed")
            assert robot.inject_fault("freeze", "control", for_s=0.5).ok
            robot.wait_for_lifecycle("fault")
            wait_until(
                lambda: "injected fault ends: freeze:control" in run.printed(),
                "the end of the fault",
            )
            first_navigation_id = run.part("navigation")
            assert robot.inject_fault("stop", "navigation").ok
            wait_until(lambda: run.printed().count("; restart in") == 1, "navigation has ended")
            wait_until(
                lambda: not robot.status().waiting_for, "navigation runs again", RESTART_TIMEOUT_S
            )
            assert run.part("navigation") != first_navigation_id
            for kind, target, reason in (
                ("kill", "nobody", "host, guidance, navigation, control"),
                ("hang", "control", "fault/control"),
                ("kill", "router", "no process 'router'"),
                ("freeze", "sensor/imu", "knows no 'freeze'"),
                ("freeze", "host", "give --for SECONDS"),
            ):
                answer = robot.inject_fault(kind, target)
                assert not answer.ok, answer
                assert answer.refusal == "unknown_fault", answer
                assert reason in answer.reason, answer
            assert robot.inject_fault("freeze", "host", for_s=60.0).ok
            run.wait_for("injected fault: freeze:host")
        interrupt_and_read_summary(
            run
        )  # the supervisor continues a frozen host, so that it can end in order


@pytest.mark.heavy
def test_killed_supervisor_leaves_no_frozen_process(tmp_path: Path) -> None:
    freeze_option = ("--set", 'faults=["freeze:control@0.2","freeze:host@0.2"]')
    with running_snakesim(
        tmp_path / "run", *LONG_RUN, "--clock-mode", "realtime", "--with-router", *freeze_option
    ) as run:
        run.wait_for("injected fault: freeze:host")
        for name in ("control", "host"):
            stat_line = Path(f"/proc/{run.part(name)}/stat").read_text()
            process_state = re.sub(r".*\) ", "", stat_line)[0]
            assert process_state == "T"  # stopped by a signal
        # The router, the host, three services, and the recorder.
        assert len(find_processes_of_run(tmp_path / "run")) == 6
        os.kill(run.process.pid, signal.SIGKILL)
        run.end()
        assert_no_process_left(tmp_path / "run")
