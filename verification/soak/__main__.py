"""`python -m verification.soak`: a run, one fault after the other, and the operator who gets the robot going again."""

import argparse
import statistics
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from snakesim_hal.base.errors import NotConnectedError
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Answer, LifecycleRequest, Message
from snakesim_testing.harness.processes import find_processes_of_run
from snakesim_testing.harness.wait import wait_until
from verification.faults.observer import TrialError
from verification.fuzz.network import running_and_joined
from verification.fuzz.vitals import complaints
from verification.soak.faults import EventDrawer, SoakEvent
from verification.soak.health import ProcessHealth
from verification.soak.watch import JudgingObserver

ROBOT = "planar13"
RUN = ("triplet", "--clock-mode", "realtime", "--duration", "86400", "--stay")
START_S = 120.0
SETTLE_S = 1.0  # after a fault has ended, until what follows must have followed
RECOVERY_S = 60.0  # back-off of a supervisor included
MOVING = 50  # ticks with a controller's command
MOVING_S = 5.0
MAX_VIOLATIONS = 20
LOOK_S = 0.01
ONLY_BEHIND_THE_ROBOT = ("Traceback", "panicked", "Exception")


class EventLogLine(msgspec.Struct, kw_only=True):
    """One event in the log."""

    at_s: float
    event: str
    follows: str
    answer: str
    became: str = ""  # the lifecycle in the end, and why
    causes: list[str] = []
    detected: bool = False
    recovered_s: float | None = None
    violations: list[str] = []


@dataclass
class SoakResult:
    """What a soak has found."""

    seed: int
    lines: list[EventLogLine] = field(default_factory=list[EventLogLine])
    violations: list[str] = field(default_factory=list[str])
    impossible: Counter[str] = field(default_factory=Counter[str])
    health: list[str] = field(default_factory=list[str])
    heard: Counter[str] = field(default_factory=Counter[str])
    took_s: float = 0.0


class SoakOperator:
    """Lets one thing go wrong after the other, and gets the robot going again."""

    def __init__(
        self, watch: JudgingObserver, health: ProcessHealth, soak: SoakResult, log: Any
    ) -> None:
        self._watch, self._health, self._soak, self._log = watch, health, soak, log
        self._started = time.monotonic()

    def go(self, dice: EventDrawer, seconds: float) -> None:
        """Until the time is over, or too much is wrong."""
        for event in dice.events():
            if (
                time.monotonic() - self._started > seconds
                or len(self._soak.violations) >= MAX_VIOLATIONS
            ):
                return
            self._spend(event.pause_s)
            answer = self._ask(keys.fault_key(event.part), event.request)
            if not answer.ok:
                if answer.refusal in ("cannot", "unknown_fault", "not_permitted"):
                    dice.rule_out(event)
                    self._soak.impossible[
                        f"{event.request.kind}:{event.request.target}: {answer.reason}"
                    ] += 1
                else:
                    self._violated(event, [f"the injector says no: {answer.reason}"])
                continue
            line = EventLogLine(
                at_s=round(time.monotonic() - self._started, 3),
                event=str(event),
                follows=event.follows,
                answer=answer.reason,
            )
            try:
                self._suffer(event, line)
            except TrialError as error:
                line.violations.append(str(error))
            line.violations += self._watch.violations
            self._watch.violations.clear()
            self._violated(event, line.violations)
            self._soak.lines.append(line)
            self._log.write(msgspec.json.encode(line) + b"\n")
            self._log.flush()
            if line.recovered_s is None:
                return

    def _suffer(self, event: SoakEvent, line: EventLogLine) -> None:
        """Watch what follows, look at how it is explained, and recover."""
        watch, began_ns = self._watch, time.monotonic_ns()
        watch.blind = {event.request.target}
        tick = watch.status.tick if watch.status is not None else 0
        self._spend(event.lasts_s)
        if event.end_request is not None:
            answer = self._ask(keys.fault_key(event.part), event.end_request)
            if not answer.ok and answer.refusal not in ("wrong_state", "not_on", "unknown_fault"):
                line.violations.append(f"its end was refused: {answer.reason}")
        self._spend(SETTLE_S)
        restarted = watch.status is not None and watch.status.tick < tick
        if restarted:
            watch.start_over()
        seen = [heard.message for heard in watch.statuses if heard.at_ns >= began_ns]
        latched = next((status for status in seen if status.lifecycle == "fault"), None)
        line.detected = (
            latched is not None
            or restarted
            or any(status.lifecycle == "disarmed" for status in seen)
        )
        if latched is not None:
            line.causes = [fault.cause for fault in latched.faults]
            words = " ".join(
                (latched.reason, *line.causes, *(f"{fault.joint}" for fault in latched.faults))
            )
            if not any(name in words for name in event.names):
                line.violations.append(f"no cause names one of {', '.join(event.names)}: {words}")
        if event.follows == "stop" and not line.detected:
            line.violations.append(f"it had to stop, and went on: {watch.describe_status()}")
        self._recover()
        watch.blind = set()
        line.became = watch.describe_status()
        line.recovered_s = round(
            (time.monotonic_ns() - began_ns) * 1e-9 - event.lasts_s - SETTLE_S, 3
        )

    def _recover(self) -> None:
        """As a person would: reset, wait until it is ready, arm, and see it move."""
        watch = self._watch
        give_up = time.monotonic() + RECOVERY_S
        last = ""
        while True:
            if time.monotonic() > give_up:
                raise TrialError(
                    f"not back within {RECOVERY_S:g} s: {watch.describe_status()}; {last}"
                )
            self._spend(0.1)
            status = watch.status
            if status is None or status.waiting_for or not self._fresh():
                continue
            if status.lifecycle == "armed":
                if self._moves():
                    return
            elif status.lifecycle in ("fault", "estop"):
                last = self._ask(keys.LIFECYCLE, LifecycleRequest(action="reset")).reason
            elif status.ready_to_arm:
                hash_ = watch.get_description().config_hash
                arm = LifecycleRequest(
                    action="arm", robot=status.robot, backend=status.backend, config_hash=hash_
                )
                last = self._ask(keys.LIFECYCLE, arm).reason

    def _fresh(self) -> bool:
        """Whether the newest status is of now, and not what a host said that is gone."""
        heard = self._watch.statuses
        return bool(heard) and time.monotonic_ns() - heard[-1].at_ns < 1_000_000_000

    def _moves(self) -> bool:
        """Whether a controller's commands are applied tick after tick."""
        watch, before = self._watch, self._watch.sequences
        deadline = time.monotonic() + MOVING_S
        while time.monotonic() < deadline:
            self._spend(0.05)
            if watch.get_lifecycle() != "armed":
                return False
            if watch.sequences - before >= MOVING:
                return True
        return False

    def _ask(self, key: str, request: Message) -> Answer:
        """Until it is answered: who was started a moment ago answers a little later."""
        give_up = time.monotonic() + RECOVERY_S
        while True:
            try:
                return self._watch.session.send_request(key, request, timeout_s=5.0)
            except NotConnectedError as error:
                if time.monotonic() > give_up:
                    return Answer(ok=False, reason=str(error), refusal="no_answer")
                self._spend(0.2)

    def _spend(self, seconds: float) -> None:
        deadline = time.monotonic() + seconds
        while True:
            self._watch.listen()
            self._health.look()
            left = deadline - time.monotonic()
            if left <= 0:
                return
            time.sleep(min(left, LOOK_S))

    def _violated(self, event: SoakEvent, what: list[str]) -> None:
        for text in what:
            found = f"seed {self._soak.seed}, {event}: {text}"
            print(f"VIOLATION {found}", flush=True)
            self._soak.violations.append(found)


def soak(out: Path, minutes: float, seed: int, backend: str) -> SoakResult:
    """Run it."""
    found = SoakResult(seed)
    log_path, began = out.with_suffix(".jsonl"), time.monotonic()
    with (
        running_and_joined(out, ROBOT, *RUN, "--backend", backend, "--seed", str(seed)) as (
            run,
            session,
        ),
        log_path.open("wb") as log,
    ):
        watch, health = JudgingObserver(session), ProcessHealth(out)
        watch.wait_until(lambda: watch.get_lifecycle() == "armed", "armed", START_S)
        joints = len(watch.get_description().joints)
        SoakOperator(watch, health, found, log).go(EventDrawer(seed, joints), 60 * minutes)
        if run.process.poll() is not None:
            found.violations.append(f"the run has ended by itself: {run.printed()[-500:]}")
        code = run.interrupt()
        if code != 130:
            found.violations.append(f"an interrupted run ends with exit code {code}, not 130")
        found.violations += health.judge()
        found.health, found.heard = health.in_words(), watch.counts
    try:
        wait_until(lambda: not find_processes_of_run(out), "all processes gone", 10.0)
    except AssertionError:
        found.violations += [
            f"left behind: {pid} {line[:200]!r}" for pid, line in find_processes_of_run(out)
        ]
    found.violations += [
        f"in a log: {line}"
        for line in complaints(out)
        if any(word in line for word in ONLY_BEHIND_THE_ROBOT)
    ]
    found.took_s = time.monotonic() - began
    return found


def summary(found: SoakResult) -> str:
    """For people."""
    by_kind: dict[str, list[EventLogLine]] = {}
    for line in found.lines:
        what = line.event.split(" ")[1].partition("=")[0]
        by_kind.setdefault(what, []).append(line)
    back = [line.recovered_s for line in found.lines if line.recovered_s is not None]
    lines = [f"{'fault':<34}{'times':>6}{'stopped':>9}{'back':>6}{'slowest':>10}"]
    for what, mine in sorted(by_kind.items()):
        times = [line.recovered_s for line in mine if line.recovered_s is not None]
        lines.append(
            f"{what:<34}{len(mine):>6}{sum(line.detected for line in mine):>9}{len(times):>6}"
            f"{max(times, default=float('nan')):>8.1f} s"
        )
    lines.append(
        f"{len(found.lines)} faults in {found.took_s / 60:.1f} minutes of seed {found.seed}; back {len(back)} times, "
        f"p50 {statistics.median(back) if back else 0:.1f} s, slowest {max(back, default=0):.1f} s"
    )
    lines += [f"cannot be had here: {what}" for what in sorted(found.impossible)]
    lines += [
        f"could not be read: {what}, {count} times" for what, count in sorted(found.heard.items())
    ]
    lines += found.health
    lines += [f"VIOLATION {what}" for what in found.violations] or [
        "nothing unexplained, nothing grew, nothing left"
    ]
    return "\n".join(lines)


def main() -> int:
    """0 when the robot came through it; 1 when anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--backend", default="sim", help="sim or can")
    parser.add_argument(
        "--out",
        type=Path,
        help="folder of the run, the events beside it (default: a temporary one)",
    )
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="snakesim-soak-") as temporary:
        out = (asked.out or Path(temporary) / "run").resolve()
        out.parent.mkdir(parents=True, exist_ok=True)
        found = soak(out, asked.minutes, asked.seed, asked.backend)
    print(summary(found))
    return 1 if found.violations else 0


if __name__ == "__main__":
    raise SystemExit(main())
