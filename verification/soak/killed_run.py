"""Carries out one trial: starts a run, sends the signals at the moment, waits for the end, and gathers what is left."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.network.stop_port import request_stop
from snakesim_hal.run_log.host_record import HOST_RECORD, HostRecord
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Clock, EstopRequest, LifecycleRequest, RobotStatus
from snakesim_operator.results.run_reader import SUMMARY_FILENAME
from snakesim_operator.results.summary import RunSummary
from snakesim_testing.harness.command import running_snakesim
from snakesim_testing.harness.processes import find_processes_with, find_run_processes
from verification.soak.kill_trial import SUPERVISOR, KillTrial

ROBOT = "planar13"
REQUESTER = "kills"
MAX_MOMENT_WAIT_S = 60.0
CONNECT_TIMEOUT_S = 0.2
STOP_ANSWER_WAIT_S = 5.0
REQUEST_TIMEOUT_S = 3.0
ENDING_FRACTION = 0.9  # of the requested ticks, after which a run counts as ending
MAX_RUN_S = 15.0  # for a run to end by itself; then it is interrupted
STAY_DURATION_S = 1.5  # until a run that stays is interrupted
MAX_END_S = 20.0  # after the interrupt
MAX_PROCESS_END_S = 10.0  # for all other processes, after the run
# Until a process that gets a signal at the start exists; it then gets the signal at once.
MAX_PROCESS_START_S = 3.0
POLL_PERIOD_S = 0.003
SWEEP_PERIOD_S = 0.02
MARK = "SNAKESIM_KILLS"  # in the environment of all processes that descend from a trial


@dataclass
class KillOutcome:
    """What was done to a run, and what is left of it."""

    trial: KillTrial
    reached_moment: bool = False
    kill_count: int = 0  # of signals that were sent, without SIGCONT
    exit_code: int | None = None
    interrupted: bool = False  # by a signal to the supervisor, of the trial or at its end
    printed: str = ""
    logs: dict[str, str] = field(default_factory=dict[str, str])
    armed_ticks: int = 0  # as counted on the network
    host_record: HostRecord | None = None
    summary: RunSummary | None = None
    stop_answered: bool = False
    reset_requested: bool = False
    reset_answered: bool = False
    stop_kept: bool = False  # on the disk
    left_behind: list[str] = field(default_factory=list[str])


class KilledRun:
    """A run whose processes get signals, and a session on its network that watches it."""

    def __init__(self, trial: KillTrial, folder: Path) -> None:
        """Prepare a trial.

        Args:
            trial: The trial.
            folder: An empty folder for the run and for what outlives it.
        """
        self._trial = trial
        self._folder = folder
        self._out = folder / "run"
        self._outcome = KillOutcome(trial)
        self._mark = f"{os.getpid()}-{trial.number}-{time.monotonic_ns()}"
        # What is known from the network. The session is None until the run has been joined.
        self._session: Session | None = None
        self._status: RobotStatus | None = None
        self._armed_ticks: set[tuple[int, int]] = set()  # epoch of the lease, tick
        # Requests that are sent while signals are sent.
        self._request_threads = ThreadPoolExecutor(2)
        self._requests: list[Future[None]] = []

    def carry_out(self) -> KillOutcome:
        """Start the run, send the signals, wait for the end, and gather what is left."""
        arguments = self._trial.list_arguments()
        with running_snakesim(self._out, *arguments, extra_env={MARK: self._mark}) as run:
            self._process = run.process
            self._endpoint = run.endpoint
            try:
                with contextlib.ExitStack() as stack:
                    self._outcome.reached_moment = self._await_moment(stack)
                    self._act_at_moment()
                    self._send_signals()
                    self._await_end()
                    for request in self._requests:
                        request.result()
            finally:
                self._outcome.exit_code = self._process.poll()
                self._request_threads.shutdown()
                self._end_remaining_processes()
            self._outcome.printed = run.printed()
        self._gather_files()
        return self._outcome

    # --- until the moment -------------------------------------------------------------------------------------

    def _await_moment(self, stack: contextlib.ExitStack) -> bool:
        """Wait for the moment of the trial. Returns whether the run has reached it."""
        moment = self._trial.moment
        if moment == "starting":
            return True
        if not self._wait_until(lambda: self._join_network(stack), MAX_MOMENT_WAIT_S):
            return False
        if moment == "arm_session":
            return self._wait_until(lambda: self._status is not None, MAX_MOMENT_WAIT_S)
        if not self._wait_until(lambda: bool(self._armed_ticks), MAX_MOMENT_WAIT_S):
            return False
        if moment == "resetting":
            self._submit_request(self._request_stop)
            return self._wait_until(lambda: self._outcome.stop_answered, STOP_ANSWER_WAIT_S)
        if moment == "ending":
            min_ticks = ENDING_FRACTION * self._trial.requested_ticks
            return self._wait_until(lambda: len(self._armed_ticks) >= min_ticks, MAX_MOMENT_WAIT_S)
        return True

    def _join_network(self, stack: contextlib.ExitStack) -> bool:
        """Try to open a session, which the stack closes. Returns whether there is one."""
        settings = ConnectionSettings(self._endpoint, ROBOT)
        with contextlib.suppress(NotConnectedError):
            session = stack.enter_context(
                open_session(settings, connect_timeout_s=CONNECT_TIMEOUT_S)
            )
            self._statuses = session.declare_latched_reader(keys.STATUS, RobotStatus)
            self._clocks = session.declare_reader(keys.CLOCK, Clock)
            self._session = session
        return self._session is not None

    def _read_messages(self) -> None:
        """Remember the newest status, and the ticks at which the robot was armed."""
        if self._session is None:
            return
        statuses = self._statuses.drain()
        if statuses:
            self._status = statuses[-1]
        for clock in self._clocks.drain():
            if clock.lifecycle == "armed":
                self._armed_ticks.add((clock.lease_epoch, clock.tick))

    def _wait_until(self, condition: Callable[[], bool], timeout_s: float) -> bool:
        """Read messages until a condition holds. Returns False if the run ends before, or after the timeout."""
        deadline_s = time.monotonic() + timeout_s
        while self._process.poll() is None and time.monotonic() < deadline_s:
            self._read_messages()
            if condition():
                return True
            time.sleep(POLL_PERIOD_S)
        return False

    # --- at the moment ----------------------------------------------------------------------------------------

    def _act_at_moment(self) -> None:
        """Send the request or the interrupt that the moment is named after."""
        self._moment_s = time.monotonic()
        if not self._outcome.reached_moment:
            return
        match self._trial.moment:
            case "stopping":
                self._submit_request(self._request_stop)
            case "resetting":
                self._outcome.reset_requested = True
                self._submit_request(self._request_reset)
            case "interrupted":
                self._interrupt()
            case _:
                pass

    def _send_signals(self) -> None:
        """Send all signals of the trial, each when it is due, while the run has not ended."""
        signals: list[tuple[float, str, signal.Signals]] = []  # delay in s, victim, signal
        for kill in self._trial.kills:
            signals.append((kill.delay_s, kill.victim, kill.signal_number))
            if kill.freeze_duration_s is not None:
                thaw_delay_s = kill.delay_s + kill.freeze_duration_s
                signals.append((thaw_delay_s, kill.victim, signal.SIGCONT))
        for delay_s, victim, number in sorted(signals, key=lambda entry: entry[0]):
            while time.monotonic() < self._moment_s + delay_s and self._process.poll() is None:
                self._read_messages()
                time.sleep(POLL_PERIOD_S)
            self._send_signal(victim, number)

    def _send_signal(self, victim: str, number: signal.Signals) -> None:
        """Send a signal to a process of the run, if it exists."""
        pid = self._await_process(victim)
        if pid is None or self._process.poll() is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
            if number is not signal.SIGCONT:
                self._outcome.kill_count += 1
            if victim == SUPERVISOR and number in (signal.SIGINT, signal.SIGTERM):
                self._outcome.interrupted = True

    def _await_process(self, name: str) -> int | None:
        """Return the id of a process. In a run that is just starting, wait until the process exists."""
        deadline_s = time.monotonic()
        if self._trial.moment == "starting":
            deadline_s += MAX_PROCESS_START_S
        while True:
            pid = self._find_process(name)
            if pid is not None or time.monotonic() >= deadline_s:
                return pid
            if self._process.poll() is not None:
                return None
            time.sleep(POLL_PERIOD_S)

    def _find_process(self, name: str) -> int | None:
        if name == SUPERVISOR:
            return self._process.pid
        return find_run_processes(self._out).get(name)

    def _interrupt(self) -> None:
        """Interrupt the supervisor, even if it is frozen."""
        self._send_signal(SUPERVISOR, signal.SIGCONT)
        self._send_signal(SUPERVISOR, signal.SIGINT)

    def _submit_request(self, request: Callable[[], None]) -> None:
        self._requests.append(self._request_threads.submit(request))

    def _request_stop(self) -> None:
        """Request an emergency stop, by a datagram or by a query."""
        with contextlib.suppress(NotConnectedError):
            if self._trial.by_datagram:
                host, _, port = self._endpoint.removeprefix("tcp/").rpartition(":")
                answer = request_stop(host, int(port), REQUESTER, REQUEST_TIMEOUT_S)
                self._outcome.stop_answered = answer is not None
            elif self._session is not None:
                request = EstopRequest(requester=REQUESTER)
                answer = self._session.send_request(keys.ESTOP, request, REQUEST_TIMEOUT_S)
                self._outcome.stop_answered = answer.ok

    def _request_reset(self) -> None:
        if self._session is None:
            return
        with contextlib.suppress(NotConnectedError):
            request = LifecycleRequest(action="reset", requester=REQUESTER)
            answer = self._session.send_request(keys.LIFECYCLE, request, REQUEST_TIMEOUT_S)
            self._outcome.reset_answered = answer.ok

    # --- after the moment -------------------------------------------------------------------------------------

    def _await_end(self) -> None:
        """Wait until the run ends, and interrupt it if it does not end by itself."""
        self._wait_until(lambda: False, STAY_DURATION_S if self._trial.stay else MAX_RUN_S)
        if self._process.poll() is None:
            self._interrupt()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(MAX_END_S)

    def _end_remaining_processes(self) -> None:
        """Wait until all processes of the trial have ended. Note and kill those that do not end by themselves."""
        if self._process.poll() is None:
            self._outcome.left_behind.append(f"the run itself, {MAX_END_S:g} s after an interrupt")
            self._process.kill()
            self._process.wait()
        deadline_s = time.monotonic() + MAX_PROCESS_END_S
        remaining = self._find_marked_processes()
        while remaining and time.monotonic() < deadline_s:
            time.sleep(SWEEP_PERIOD_S)
            remaining = self._find_marked_processes()
        for pid, line in remaining:
            self._outcome.left_behind.append(f"{pid} {line[:200]}".replace("\0", " "))
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _find_marked_processes(self) -> list[tuple[int, str]]:
        return find_processes_with("environ", f"{MARK}={self._mark}\0")

    def _gather_files(self) -> None:
        """Read the logs and records of the run, as far as they exist."""
        outcome = self._outcome
        outcome.armed_ticks = len(self._armed_ticks)
        for log in sorted(self._out.glob("*.log")):
            outcome.logs[log.stem] = log.read_text(encoding="utf-8", errors="replace")
        with contextlib.suppress(FileNotFoundError):
            host_record = (self._out / HOST_RECORD).read_bytes()
            outcome.host_record = msgspec.json.decode(host_record, type=HostRecord)
        with contextlib.suppress(FileNotFoundError):
            summary = (self._out / SUMMARY_FILENAME).read_bytes()
            outcome.summary = msgspec.json.decode(summary, type=RunSummary)
        outcome.stop_kept = any(self._folder.glob("snakesim/robots/*/estop.json"))
