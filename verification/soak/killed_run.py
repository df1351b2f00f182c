"""One run whose processes are killed and frozen at a drawn moment: what is done to it, and what is left of it."""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, get_args

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

Moment = Literal[
    "starting", "arm_session", "armed", "stopping", "resetting", "interrupted", "ending"
]
MOMENTS: tuple[Moment, ...] = get_args(Moment)
SUPERVISOR = "supervisor"
ROBOT = "planar13"
# The longest lease there is: this is about processes that end, not about a busy machine.
RATE_HZ = 50
MOMENT_LIMIT_S = 60.0
PATIENCE_S = 15.0  # for a run to end by itself; then it is interrupted
STAYS_S = 1.5  # how long a run that stays is left alone
END_LIMIT_S = 20.0
GONE_LIMIT_S = 10.0
# Until a process that is to be hit at the start is there: then it is hit at once.
BORN_LIMIT_S = 3.0
LOOK_S = 0.003
MARK = "SNAKESIM_KILLS"  # in the environment of everything that descends from a trial


@dataclass(frozen=True)
class ProcessKill:
    """A signal to one process, so long after the moment."""

    victim: str
    number: signal.Signals
    after_s: float
    # Of a SIGSTOP: so long until SIGCONT; None: until the run is to end.
    thaw_s: float | None = None

    def __str__(self) -> str:
        thaw = "" if self.thaw_s is None else f" for {self.thaw_s:.2f} s"
        return f"{self.number.name} to {self.victim} at +{self.after_s:.3f} s{thaw}"


@dataclass(frozen=True)
class KillTrial:
    """What is drawn."""

    number: int
    backend: str
    clock_mode: str
    stay: bool
    router: bool
    asked_s: float
    moment: Moment
    by_datagram: bool  # how the emergency stop is asked for
    hits: tuple[ProcessKill, ...]

    def __str__(self) -> str:
        kind = " ".join([self.backend, self.clock_mode, *self._flags])
        return f"#{self.number} {kind}, {self.moment}: {', '.join(map(str, self.hits))}"

    @property
    def _flags(self) -> list[str]:
        return ["--stay"] * self.stay + ["--with-router"] * self.router

    def arguments(self) -> list[str]:
        """Of `snakesim run`."""
        fixed = ["triplet", "--controller", "hold", "--set", f"rate_hz={RATE_HZ}"]
        return [
            *fixed,
            "--backend",
            self.backend,
            "--clock-mode",
            self.clock_mode,
            "--duration",
            str(self.asked_s),
            *self._flags,
        ]


@dataclass
class KillOutcome:
    """What became of it."""

    trial: KillTrial
    reached: bool = False  # the moment
    hits: int = 0
    code: int | None = None
    interrupted: bool = False  # by a signal to the supervisor, whoever sent it
    printed: str = ""
    logs: dict[str, str] = field(default_factory=dict[str, str])
    armed_ticks: int = 0  # as somebody on the network has counted them
    record: HostRecord | None = None
    summary: RunSummary | None = None
    stop_answered: bool = False
    reset_asked: bool = False
    reset_answered: bool = False
    stop_kept: bool = False
    left_behind: list[str] = field(default_factory=list[str])


class KilledRun:
    """A run, and who watches it from its network."""

    def __init__(self, trial: KillTrial, folder: Path) -> None:
        self._trial, self._folder, self._out = trial, folder, folder / "run"
        self._outcome = KillOutcome(trial)
        self._mark = f"{os.getpid()}-{trial.number}-{time.monotonic_ns()}"
        self._status: RobotStatus | None = None
        self._armed: set[tuple[int, int]] = set()  # epoch of the lease, tick
        self._frozen: set[str] = set()
        self._asking = ThreadPoolExecutor(2)
        self._asked: list[Future[None]] = []

    def go(self) -> KillOutcome:
        """Carry it out, wait for the end, and gather what is left."""
        with running_snakesim(
            self._out, *self._trial.arguments(), extra_env={MARK: self._mark}
        ) as run:
            self._process, self._endpoint = run.process, run.endpoint
            try:
                with contextlib.ExitStack() as stack:
                    self._session: Session | None = None
                    self._outcome.reached = self._await_moment(stack)
                    self._hit()
                    self._await_end()
                    for asked in self._asked:
                        asked.result()
            finally:
                self._outcome.code = self._process.poll()
                self._asking.shutdown()
                self._sweep()
            self._outcome.printed = run.printed()
        self._gather()
        return self._outcome

    # --- until the moment -------------------------------------------------------------------------------------

    def _await_moment(self, stack: contextlib.ExitStack) -> bool:
        if self._trial.moment == "starting":
            return True
        if not self._until(lambda: self._join(stack), MOMENT_LIMIT_S):
            return False
        if self._trial.moment == "arm_session":
            return self._until(lambda: self._status is not None, MOMENT_LIMIT_S)
        if not self._until(lambda: bool(self._armed), MOMENT_LIMIT_S):
            return False
        if self._trial.moment == "resetting":
            self._stop()
            return self._until(lambda: self._outcome.stop_answered, 5.0)
        if self._trial.moment == "ending":
            wanted = 0.9 * self._trial.asked_s * RATE_HZ
            return self._until(lambda: len(self._armed) >= wanted, MOMENT_LIMIT_S)
        return True

    def _join(self, stack: contextlib.ExitStack) -> bool:
        with contextlib.suppress(NotConnectedError):
            session = stack.enter_context(
                open_session(ConnectionSettings(self._endpoint, ROBOT), connect_timeout_s=0.2)
            )
            self._statuses = session.declare_latched_reader(keys.STATUS, RobotStatus)
            self._clocks = session.declare_reader(keys.CLOCK, Clock)
            self._session = session
        return self._session is not None

    def _look(self) -> None:
        if self._session is None:
            return
        self._status = (self._statuses.drain() or [self._status])[-1]
        for clock in self._clocks.drain():
            if clock.lifecycle == "armed":
                self._armed.add((clock.lease_epoch, clock.tick))

    def _until(self, condition: Callable[[], bool], limit_s: float) -> bool:
        """Whether it came true before the run ended, and in time."""
        deadline = time.monotonic() + limit_s
        while self._process.poll() is None and time.monotonic() < deadline:
            self._look()
            if condition():
                return True
            time.sleep(LOOK_S)
        return False

    # --- at the moment ----------------------------------------------------------------------------------------

    def _hit(self) -> None:
        began = time.monotonic()
        acts: dict[Moment, Callable[[], None]] = {
            "stopping": self._stop,
            "resetting": self._reset,
            "interrupted": self._interrupt,
        }
        if self._outcome.reached and self._trial.moment in acts:
            acts[self._trial.moment]()
        events: list[tuple[float, Callable[[], None]]] = []
        for hit in self._trial.hits:
            events.append((hit.after_s, lambda hit=hit: self._signal(hit.victim, hit.number)))
            if hit.thaw_s is not None:
                events.append(
                    (
                        hit.after_s + hit.thaw_s,
                        lambda hit=hit: self._signal(hit.victim, signal.SIGCONT),
                    )
                )
        for after_s, event in sorted(events, key=lambda pair: pair[0]):
            while time.monotonic() < began + after_s and self._process.poll() is None:
                self._look()
                time.sleep(LOOK_S)
            event()

    def _signal(self, name: str, number: signal.Signals) -> None:
        born_by = time.monotonic() + (BORN_LIMIT_S if self._trial.moment == "starting" else 0.0)
        while (
            (pid := self._pid(name)) is None
            and time.monotonic() < born_by
            and self._process.poll() is None
        ):
            time.sleep(LOOK_S)
        if pid is None or self._process.poll() is not None:
            return
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)
            self._outcome.hits += number is not signal.SIGCONT
            self._outcome.interrupted |= name == SUPERVISOR and number in (
                signal.SIGINT,
                signal.SIGTERM,
            )

    def _pid(self, name: str) -> int | None:
        return self._process.pid if name == SUPERVISOR else find_run_processes(self._out).get(name)

    def _interrupt(self) -> None:
        self._signal(SUPERVISOR, signal.SIGCONT)
        self._signal(SUPERVISOR, signal.SIGINT)

    def _stop(self) -> None:
        self._asked.append(self._asking.submit(self._ask_to_stop))

    def _reset(self) -> None:
        self._outcome.reset_asked = True
        self._asked.append(self._asking.submit(self._ask_to_reset))

    def _ask_to_stop(self) -> None:
        with contextlib.suppress(NotConnectedError):
            if self._trial.by_datagram:
                host, _, port = self._endpoint.removeprefix("tcp/").rpartition(":")
                self._outcome.stop_answered = (
                    request_stop(host, int(port), "kills", 3.0) is not None
                )
            elif self._session is not None:
                answer = self._session.send_request(
                    keys.ESTOP, EstopRequest(requester="kills"), 3.0
                )
                self._outcome.stop_answered = answer.ok

    def _ask_to_reset(self) -> None:
        if self._session is not None:
            with contextlib.suppress(NotConnectedError):
                request = LifecycleRequest(action="reset", requester="kills")
                self._outcome.reset_answered = self._session.send_request(
                    keys.LIFECYCLE, request, 3.0
                ).ok

    # --- after it ---------------------------------------------------------------------------------------------

    def _await_end(self) -> None:
        self._until(lambda: False, STAYS_S if self._trial.stay else PATIENCE_S)
        if self._process.poll() is None:
            self._interrupt()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(END_LIMIT_S)

    def _sweep(self) -> None:
        """Everything that descends from this trial must be gone by itself; what is not is told, and killed."""
        if self._process.poll() is None:
            self._outcome.left_behind.append(
                f"the run itself, {END_LIMIT_S:g} s after an interrupt"
            )
            self._process.kill()
            self._process.wait()
        deadline = time.monotonic() + GONE_LIMIT_S
        while (
            left := find_processes_with("environ", f"{MARK}={self._mark}\0")
        ) and time.monotonic() < deadline:
            time.sleep(0.02)
        for pid, line in left:
            self._outcome.left_behind.append(f"{pid} {line[:200]}".replace("\0", " "))
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)

    def _gather(self) -> None:
        outcome = self._outcome
        outcome.armed_ticks = len(self._armed)
        for log in sorted(self._out.glob("*.log")):
            outcome.logs[log.stem] = log.read_text(encoding="utf-8", errors="replace")
        with contextlib.suppress(FileNotFoundError):
            outcome.record = msgspec.json.decode(
                (self._out / HOST_RECORD).read_bytes(), type=HostRecord
            )
        with contextlib.suppress(FileNotFoundError):
            outcome.summary = msgspec.json.decode(
                (self._out / SUMMARY_FILENAME).read_bytes(), type=RunSummary
            )
        outcome.stop_kept = any(self._folder.glob("snakesim/robots/*/estop.json"))
