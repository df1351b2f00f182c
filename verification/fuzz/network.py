"""Fuzzing of a robot that runs: real processes, a real network, a stranger who sends, and a stopwatch.

First the run is left alone, then the stranger sends; both for about the same time. What is compared: processes, logs,
memory, overruns, commands that were taken, who commands, and every setpoint that went to the motors.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from snakesim_hal.network.session import ConnectionSettings, Session, open_session
from snakesim_hal.run_log.black_box import read_black_box
from snakesim_hal.run_log.host_record import BLACK_BOX, HOST_RECORD, HostRecord
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointMode, RobotStatus
from snakesim_testing.harness.processes import find_processes_of_run, find_run_processes
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import TIMEOUT_S, RunningCommand, running_snakesim
from verification.fuzz.vitals import ProcessVitals, complaints, vitals
from verification.fuzz.writer import SentSample

ROBOT = "planar13"
SCENARIO = ("triplet", "--controller", "hold", "--clock-mode", "realtime", "--duration", "86400")
LOOK_S = 0.5
# After arming: until then it is the host that holds the angles, then the controller.
SETTLED_TICKS = 20
WARM_UP = 0.1  # of the stretch: until then, memory may grow
GROWTH_MB = 64.0  # more than in the quiet stretch: what allocators keep of 4 MiB payloads, 25 to 45 MB, 120000 no more
OVERRUN_SHARE = 0.01  # of the ticks, more than in the quiet stretch
TAKEN_SHARE = 0.01  # of the ticks, fewer commands taken than in the quiet stretch


@dataclass
class ObservedPeriod:
    """Some time of a run, as it was watched from outside."""

    first: RobotStatus
    last: RobotStatus
    seen: dict[str, list[ProcessVitals]] = field(default_factory=dict[str, list[ProcessVitals]])
    failure: list[str] = field(default_factory=list[str])

    def counted(self, what: Literal["tick", "overruns", "commands_accepted"]) -> int:
        """By how much a number of the status has grown."""
        return getattr(self.last, what) - getattr(self.first, what)

    def share(self, what: Literal["overruns", "commands_accepted"]) -> float:
        """The same, of its ticks."""
        return self.counted(what) / max(self.counted("tick"), 1)

    def growth_mb(self, part: str) -> float:
        """Memory gained since the warm-up, in the mean of the last tenth."""
        rows = [row.resident_mb for row in self.seen[part]]
        tenth = max(round(len(rows) * WARM_UP), 1)
        return float(np.mean(rows[-tenth:]) - np.mean(rows[tenth : 2 * tenth] or rows))


@dataclass
class NetworkVerdict:
    """Everything that was measured, and what of it must not be."""

    quiet: ObservedPeriod
    fuzzed: ObservedPeriod
    sent: SentSample
    record: HostRecord
    violations: list[str]


class RunWatcher:
    """Looks at a run again and again."""

    def __init__(self, session: Session, out: Path) -> None:
        self._statuses = session.declare_latched_reader(keys.STATUS, RobotStatus)
        self._out = out
        self._parts = find_run_processes(out)
        self._status: RobotStatus | None = None
        wait_until(lambda: self.status() is not None, "a status")

    def status(self) -> RobotStatus | None:
        """The newest one."""
        self._status = (self._statuses.drain() or [self._status])[-1]
        return self._status

    def ready(self) -> bool:
        """Whether the run is armed and commanded."""
        status = self.status()
        return status is not None and status.lifecycle == "armed" and status.commands_accepted > 0

    def stretch(self, going_on: Callable[[], bool]) -> ObservedPeriod:
        """Watch for as long as something goes on."""
        first = self._fresh()
        stretch = ObservedPeriod(first, first)
        while going_on():
            time.sleep(LOOK_S)
            for name, pid in self._parts.items():
                now = vitals(pid)
                if now is None:
                    stretch.failure.append(f"{name} (process {pid}) has ended")
                    continue
                stretch.seen.setdefault(name, []).append(now)
            status = self.status()
            if status is not None and status.lifecycle != "armed":
                stretch.failure.append(f"the robot is in {status.lifecycle}: {status.reason}")
            if stretch.failure:
                break
        stretch.last = self._fresh()
        return stretch

    def _fresh(self) -> RobotStatus:
        """A status that comes after now, or the last one when no more comes."""
        before = self.status()
        give_up = time.monotonic() + 5.0
        while (status := self.status()) is before and time.monotonic() < give_up:
            time.sleep(0.01)
        assert status is not None
        return status


@dataclass(frozen=True)
class FuzzRequest:
    """What is asked for."""

    payloads: int
    rate: float  # a second
    seed: int = 1
    backend: str = "sim"
    # How long the robot is left alone first; None: as long as the sending should take.
    quiet_s: float | None = None
    robot_hz: float = 100.0


def fuzz(out: Path, request: FuzzRequest) -> NetworkVerdict:
    """Run it."""
    given = ("--backend", request.backend, "--set", f"rate_hz={request.robot_hz}")
    sent = SentSample()
    with running_and_joined(out, ROBOT, *SCENARIO, *given) as (run, session):
        watcher = RunWatcher(session, out)
        wait_until(watcher.ready, "armed and commanded")
        until = time.monotonic() + (
            request.payloads / request.rate if request.quiet_s is None else request.quiet_s
        )
        quiet = fuzzed = watcher.stretch(lambda: time.monotonic() < until)
        if not quiet.failure:
            with _stranger(run.endpoint, request) as stranger:
                fuzzed = watcher.stretch(lambda: stranger.poll() is None)
                if fuzzed.failure:
                    stranger.kill()
                said, _ = stranger.communicate(timeout=TIMEOUT_S)
            if stranger.returncode == 0:
                sent = msgspec.json.decode(said, type=SentSample)
        run.interrupt()
    wait_until(lambda: not find_processes_of_run(out), "all processes of the run gone")
    record = msgspec.json.decode((out / HOST_RECORD).read_bytes(), type=HostRecord)
    failure = [*(f"in a log: {line}" for line in complaints(out)), *_foreign(out, record)]
    if quiet.failure:
        failure += [
            f"before anything was sent, {what}: is this machine too busy?" for what in quiet.failure
        ]
    else:
        failure += [*fuzzed.failure, *_differences(quiet, fuzzed, sent, request.payloads)]
    return NetworkVerdict(quiet, fuzzed, sent, record, failure)


@contextmanager
def running_and_joined(
    out: Path, robot: str, *arguments: str
) -> Iterator[tuple[RunningCommand, Session]]:
    """A run, and a session on its network; what the run said when it does not come up."""
    with running_snakesim(out, *arguments) as run:
        run.wait_for("network:")
        with open_session(ConnectionSettings(run.endpoint, robot)) as session:
            yield run, session


@contextmanager
def _stranger(endpoint: str, request: FuzzRequest) -> Iterator[subprocess.Popen[bytes]]:
    given = [endpoint, ROBOT, *map(str, (request.payloads, request.rate, request.seed))]
    process = subprocess.Popen(
        [sys.executable, "-m", "verification.fuzz.writer", *given], stdout=subprocess.PIPE
    )
    try:
        yield process
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


def _foreign(out: Path, record: HostRecord) -> list[str]:
    """RequestedSetpoints that the holding controller did not ask for."""
    found = [f"fault {fault.what}: {fault.cause}" for fault in record.faults]
    _, box = read_black_box(out / BLACK_BOX)
    modes, targets = box["mode"], box["target"]
    if (modes != JointMode.POSITION).any():
        found.append(
            f"{int((modes != JointMode.POSITION).any(axis=1).sum())} ticks in another mode than position"
        )
    elif len(targets) and (targets != targets[-1]).any():
        moved = np.flatnonzero((targets != targets[-1]).any(axis=1))
        off = float(np.abs(targets - targets[-1]).max())
        if moved[-1] > SETTLED_TICKS:
            found.append(
                f"setpoints that nobody asked for in {len(moved)} ticks, up to {off:.3g} rad away"
            )
    return found


def _differences(
    quiet: ObservedPeriod, fuzzed: ObservedPeriod, sent: SentSample, payload_count: int
) -> list[str]:
    found: list[str] = []
    first, last = quiet.first, fuzzed.last
    if last.lifecycle != "armed":
        found.append(f"lifecycle is {last.lifecycle}: {last.reason}")
    if (last.lease_holder, last.lease_epoch) != (first.lease_holder, first.lease_epoch):
        found.append(
            f"the lease went from {first.lease_holder} {first.lease_epoch} to {last.lease_holder}"
        )
    arrived = sum(sent.samples.values()) + sum(sent.queries.values())
    if arrived != payload_count:
        found.append(f"only {arrived} of {payload_count} payloads were sent")
    if sent.unanswered:
        found.append(f"{sent.unanswered} queries to the HAL got no answer")
    found += [f"an answer {word}" for word in sent.answers if word not in ("yes", "no", "an error")]
    for part in fuzzed.seen:
        more = fuzzed.growth_mb(part) - max(quiet.growth_mb(part), 0.0)
        if more > GROWTH_MB:
            found.append(
                f"{part} grew by {more:.1f} MB more than in the quiet stretch, at most {GROWTH_MB:g} MB"
            )
    for word, share, most in (
        ("overruns", fuzzed.share("overruns") - quiet.share("overruns"), OVERRUN_SHARE),
        (
            "commands taken",
            quiet.share("commands_accepted") - fuzzed.share("commands_accepted"),
            TAKEN_SHARE,
        ),
    ):
        if share > most:
            found.append(
                f"{word}: {100 * share:.2f} % of the ticks worse than quiet, at most {100 * most:g} %"
            )
    return found


def table(verdict: NetworkVerdict) -> str:
    """The result, for people."""
    quiet, fuzzed, sent = verdict.quiet, verdict.fuzzed, verdict.sent
    asked, put = sum(sent.queries.values()), sum(sent.samples.values())

    def counts(numbers: dict[str, int]) -> str:
        return (
            ", ".join(
                f"{count} {word}" for word, count in sorted(numbers.items(), key=lambda n: -n[1])
            )
            or "none"
        )

    lines = [
        f"machine   load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores",
        f"sent      {put} samples and {asked} queries, {sent.megabytes:.0f} MB, in {sent.seconds:.0f} s: "
        f"{(put + asked) / max(sent.seconds, 1e-9):.0f} a second",
        f"  samples   {counts(sent.samples)}",
        f"  queries   {counts(sent.queries)}",
        f"  mutations {counts(sent.by_mutation)}",
        f"  withheld  {counts(sent.withheld)}: valid and effective, so never sent",
        f"  answers   {counts(sent.answers)}; {sent.unanswered} queries to the HAL without one",
        f"refused   {counts(verdict.record.rejected_commands)}",
        f"lifecycle {fuzzed.last.lifecycle}: {fuzzed.last.reason}; lease of {fuzzed.last.lease_holder}, epoch "
        f"{fuzzed.last.lease_epoch} (before: {quiet.first.lease_holder}, {quiet.first.lease_epoch})",
        f"{'':10}{'quiet':>12}{'fuzzed':>12}",
        f"{'ticks':10}{quiet.counted('tick'):>12}{fuzzed.counted('tick'):>12}",
        f"{'taken':10}{quiet.counted('commands_accepted'):>12}{fuzzed.counted('commands_accepted'):>12}",
        f"{'overruns':10}{quiet.counted('overruns'):>12}{fuzzed.counted('overruns'):>12}",
    ]
    for part in sorted(fuzzed.seen):
        first, last = fuzzed.seen[part][0], fuzzed.seen[part][-1]
        lines.append(
            f"{part:10}{quiet.growth_mb(part):>+9.1f} MB{fuzzed.growth_mb(part):>+9.1f} MB  now "
            f"{last.resident_mb:.0f} MB, {first.threads} -> {last.threads} threads, {first.files} -> {last.files} files"
        )
    lines += [f"VIOLATION {what}" for what in verdict.violations] or [
        "nothing died, nothing complained, nothing grew"
    ]
    return "\n".join(lines)
