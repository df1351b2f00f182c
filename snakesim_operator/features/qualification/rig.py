"""The drive under test with its normal host, a commanding client, and a second program that reads the drive.

Whatever happens, `close` resumes the host, ends the commands, and ends the host, which switches the drive off.
"""

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from snakesim_drivers.kit.drive_probe import DriveProbe
from snakesim_hal.base.errors import NotConnectedError, RefusedError
from snakesim_hal.base.process import get_user_name
from snakesim_hal.model.scenario import write_config
from snakesim_hal.network.free_ports import find_free_port
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.streams import SampleReader
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    LifecycleRequest,
    RobotDescription,
    RobotStatus,
    make_arm_request,
)
from snakesim_operator.features.qualification.command_thread import CommandThread, MotionPlan
from snakesim_operator.features.qualification.emulated_drive import EmulatedDrive
from snakesim_operator.features.qualification.protocol.torque_timeline import (
    TorqueReading,
    TorqueTimeline,
    make_timeline,
)
from snakesim_operator.features.qualification.setup import Setup
from snakesim_operator.run.processes import children
from snakesim_operator.run.processes.children import ChildProcess

START_TIMEOUT_S = 30.0
REQUEST_TIMEOUT_S = 15.0
RETRY_PERIOD_S = 0.1
STATUS_TIMEOUT_S = 0.15  # for one answer of the drive
POLL_PAUSE_S = 0.004  # between two polls of the drive
HOST_MODULE = "snakesim_hal.programs.host_program"


def make_requester() -> str:
    """Return the name under which requests of a qualification are in the host's records."""
    return f"{get_user_name()[:40]}, drive qualify"


class Rig:
    """One drive, and everything that a qualification does with it."""

    def __init__(
        self,
        setup: Setup,
        folder: Path,
        emulated_drive: EmulatedDrive | None,
        typed_firmware: str = "",
    ) -> None:
        """Prepare; nothing is started.

        Args:
            setup: Checked configuration.
            folder: Folder for configuration and output of the host.
            emulated_drive: The drive, if it is emulated.
            typed_firmware: Firmware version that the operator has typed, for a drive that reports none.
        """
        self.setup = setup
        self.emulated_drive = emulated_drive
        self.typed_firmware = typed_firmware
        self._folder = folder
        self._endpoint = f"tcp/127.0.0.1:{find_free_port()}"
        self._connection = ConnectionSettings(self._endpoint, setup.config.robot.name)
        self._host: ChildProcess | None = None
        self._is_frozen = False
        self._center_rad: float | None = None  # angle of the joint at the very start
        self._probe: DriveProbe | None = None
        self._session: Session | None = None
        self._exit_stack = contextlib.ExitStack()  # of what lives as long as one host
        self._commands: CommandThread | None = None
        self._status_reader: SampleReader[RobotStatus] | None = None
        self._status: RobotStatus | None = None
        self._robot: RobotDescription | None = None
        write_config(setup.config, folder / "host.json")

    # --- host -------------------------------------------------------------------------------------------------

    @property
    def endpoint(self) -> str:
        """Where the host listens."""
        return self._endpoint

    @property
    def robot(self) -> RobotDescription:
        """Description that the host publishes."""
        assert self._robot is not None, "the host was not started"
        return self._robot

    def start_host(self) -> None:
        """Open the probe, start the host, and begin to command; the robot stays disarmed.

        Raises:
            SnakesimError: The drive or the host does not start.
        """
        setup = self.setup
        self._probe = setup.backend.open_probe(setup.config, setup.settings)
        assert self._probe is not None
        self._exit_stack.callback(self._probe.close)
        log = self._exit_stack.enter_context((self._folder / "host.txt").open("ab", buffering=0))
        arguments = [HOST_MODULE, str(self._folder / "host.json"), "--endpoint", self._endpoint]
        self._host = children.start_child("host", arguments, log.write)
        session = self._connect()
        self._session = session
        self._robot = session.wait_for_latched(keys.DESCRIPTION, RobotDescription, START_TIMEOUT_S)
        if self._robot is None:
            raise NotConnectedError(
                "the host does not publish its description; see host.txt", code="network/no-answer"
            )
        self._status_reader = session.declare_latched_reader(keys.STATUS, RobotStatus)
        joint = self._robot.joints[0]
        plan = MotionPlan(joint.torque_limit_nm)
        self._commands = CommandThread(self._connection, self._robot, plan, self._center_rad)
        self._commands.start()

    def _connect(self) -> Session:
        """Open a session as soon as the host listens. Raises RefusedError if the host ends."""
        deadline_s = time.monotonic() + START_TIMEOUT_S
        while True:
            assert self._host is not None
            ending = self._host.describe_exit()
            if ending is not None:
                raise RefusedError(
                    ending, *self._host.output.last_lines()[-5:], code="robot/not-running"
                )
            try:
                return self._exit_stack.enter_context(open_session(self._connection, 0.5))
            except NotConnectedError:
                if time.monotonic() > deadline_s:
                    raise

    def freeze_host(self) -> int:
        """Stop the host's process with SIGSTOP, and return when, by the monotonic clock in ns."""
        return self._signal_host(signal.SIGSTOP, is_frozen=True)

    def resume_host(self) -> int:
        """Continue the host's process, and return when, by the monotonic clock in ns."""
        return self._signal_host(signal.SIGCONT, is_frozen=False)

    def kill_host(self) -> int:
        """End the host's process at once with SIGKILL, and return when, by the monotonic clock in ns."""
        killed_ns = self._signal_host(signal.SIGKILL, is_frozen=False)
        assert self._host is not None
        self._host.process.wait()
        return killed_ns

    def _signal_host(self, number: signal.Signals, *, is_frozen: bool) -> int:
        assert self._host is not None
        now_ns = time.monotonic_ns()
        os.kill(self._host.process.pid, number)
        self._is_frozen = is_frozen
        return now_ns

    def stop_host(self) -> None:
        """End commands and host, which switches the drive off, and close the probe."""
        if self._commands is not None:
            self._center_rad = self._commands.center_rad
            self._commands.stop()
            self._commands = None
        if self._host is not None:
            children.stop_children([self._host])  # it resumes a frozen process
            self._host = None
        self._is_frozen = False
        self._exit_stack.close()
        self._session = None
        self._status = None

    def close(self) -> None:
        """End everything. The drive is without torque afterwards."""
        try:
            self.stop_host()
        finally:
            if self.emulated_drive is not None:
                self.emulated_drive.close()

    # --- requests ---------------------------------------------------------------------------------------------

    @property
    def session(self) -> Session:
        """The main thread's session on the robot's network."""
        assert self._session is not None, "the host was not started"
        return self._session

    @property
    def commands(self) -> CommandThread:
        """The thread that commands the joint."""
        assert self._commands is not None, "the host was not started"
        return self._commands

    def read_lifecycle(self) -> str:
        """Return the newest state that the host has published; empty before the first one."""
        self._update_status()
        return self._status.lifecycle if self._status is not None else ""

    def list_faults(self) -> list[str]:
        """Return the names of the faults since the last reset, as the host publishes them."""
        self._update_status()
        return [fault.what for fault in self._status.faults] if self._status is not None else []

    def _update_status(self) -> None:
        if self._status_reader is not None:
            for status in self._status_reader.drain():
                self._status = status

    def wait_for_lifecycle(self, *states: str, timeout_s: float) -> str:
        """Wait until the host publishes one of some states, and return its newest one."""
        deadline_s = time.monotonic() + timeout_s
        while self.read_lifecycle() not in states and time.monotonic() < deadline_s:
            time.sleep(0.01)
        return self.read_lifecycle()

    def arm(self, plan: MotionPlan) -> None:
        """Arm the robot through its host, and begin a motion.

        Raises:
            RefusedError: The host refuses, or no commands are sent.
        """
        self.commands.set_plan(plan)
        request = make_arm_request(self.robot, make_requester(), unchecked=True)
        self._request(request, "armed")
        self.commands.set_plan(plan)  # its oscillation begins now
        if self.wait_for_lifecycle("armed", timeout_s=2.0) != "armed":
            reason = self._status.reason if self._status is not None else ""
            raise RefusedError(
                f"the robot is {self.read_lifecycle()} after it was armed: {reason}",
                code="robot/not-armed",
            )
        time.sleep(0.3)

    def disarm(self) -> None:
        """Disarm the robot, or reset its fault or emergency stop, so that it is disarmed. Restart a host that refuses.

        Raises:
            SnakesimError: Not even a new host is disarmed.
        """
        requester = make_requester()
        action = "disarm" if self.read_lifecycle() == "armed" else "reset"
        if self.read_lifecycle() == "disarmed":
            return
        try:
            self._request(LifecycleRequest(action=action, requester=requester), "disarmed")
            if self.wait_for_lifecycle("disarmed", timeout_s=2.0) == "disarmed":
                return
        except (RefusedError, NotConnectedError):
            pass
        self.stop_host()
        self.start_host()
        if self.wait_for_lifecycle("disarmed", "estop", timeout_s=5.0) == "estop":
            self._request(LifecycleRequest(action="reset", requester=requester), "disarmed")

    def _request(self, request: LifecycleRequest, outcome: str) -> None:
        """Send a request until the host grants it. Raises RefusedError and NotConnectedError after a timeout."""
        deadline_s = time.monotonic() + REQUEST_TIMEOUT_S
        while True:
            failure = self.commands.failure
            if failure is not None:
                raise RefusedError(f"not {outcome}: {failure}", code="robot/not-armed")
            answer = self.session.send_request(keys.LIFECYCLE, request, 2.0)
            if answer.ok:
                return
            if time.monotonic() > deadline_s:
                raise RefusedError(f"not {outcome}: {answer.reason}", code="robot/not-armed")
            time.sleep(RETRY_PERIOD_S)

    # --- what the drive does ----------------------------------------------------------------------------------

    @property
    def probe(self) -> DriveProbe:
        """The second program."""
        assert self._probe is not None, "the host was not started"
        return self._probe

    @contextlib.contextmanager
    def quiet_bus(self) -> Iterator[None]:
        """Freeze the host meanwhile if the bus is half duplex, so that the probe may read. Only while disarmed."""
        should_freeze = (
            not self.probe.has_own_line and not self._is_frozen and self._is_host_running()
        )
        if should_freeze:
            self.freeze_host()
            time.sleep(0.02)  # what the host has requested is answered
        try:
            yield
        finally:
            if should_freeze:
                self.resume_host()

    def _is_host_running(self) -> bool:
        return self._host is not None and self._host.process.poll() is None

    def watch_torque(
        self,
        duration_s: float,
        *,
        until: Callable[[bool], bool] = lambda _enabled: False,
        should_poll: bool = True,
    ) -> list[TorqueReading]:
        """Poll the drive with the second program for some time.

        On a half-duplex bus whose host runs, the drive is read once, at the end.

        Args:
            duration_s: Maximum time.
            until: Function of whether the drive is enabled; True ends the polling early.
            should_poll: False: read once, at the end, because polling keeps some drives on.

        Returns:
            What the drive has answered.
        """
        deadline_s = time.monotonic() + duration_s
        may_poll = should_poll and (
            self.probe.has_own_line or self._is_frozen or not self._is_host_running()
        )
        if not may_poll:
            time.sleep(duration_s)
            with self.quiet_bus():
                status = self.probe.read_status(STATUS_TIMEOUT_S)
            return [] if status is None else [TorqueReading(time.monotonic_ns(), status.is_enabled)]
        readings: list[TorqueReading] = []
        while time.monotonic() < deadline_s:
            status = self.probe.read_status(
                min(STATUS_TIMEOUT_S, max(deadline_s - time.monotonic(), 0.01))
            )
            if status is not None:
                readings.append(TorqueReading(time.monotonic_ns(), status.is_enabled))
                if until(status.is_enabled):
                    break
            time.sleep(POLL_PAUSE_S)
        return readings

    def make_timeline(self, readings: list[TorqueReading]) -> TorqueTimeline:
        """Return when the drive had torque: by its own log if it has one, otherwise by its status."""
        if self.emulated_drive is not None:
            logged = [
                TorqueReading(state.monotonic_ns, state.is_enabled)
                for state in self.emulated_drive.read_log()
            ]
            return make_timeline(logged, "drive log", lists_changes=True)
        return make_timeline(readings, "drive status", lists_changes=False)
