"""`python -m verification.soak.kills --trials 300 --seed 1`: runs whose processes are killed and frozen at random.

Of starting, arming, moving, stopping, resetting, being interrupted and ending, on both backends. Afterwards nothing may
be left behind, exit code 0 must mean that the time asked for was armed, nothing may have thrown, and an emergency stop
that was answered must be on the disk. Exit code 1 when anything was wrong.
"""

import argparse
import itertools
import random
import re
import signal
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from verification.soak.killed_run import (
    MOMENTS,
    RATE_HZ,
    SUPERVISOR,
    KilledRun,
    KillOutcome,
    KillTrial,
    ProcessKill,
)

SIGNALS = (
    signal.SIGKILL,
    signal.SIGKILL,
    signal.SIGSTOP,
    signal.SIGSTOP,
    signal.SIGTERM,
    signal.SIGINT,
)
VICTIMS = (SUPERVISOR, "host", "host", "guidance", "navigation", "control")
WITHIN_S = {  # of the moment, the hits come
    "starting": 2.0,
    "arm_session": 1.0,
    "armed": 0.8,
    "stopping": 0.06,
    "resetting": 0.06,
    "interrupted": 0.8,
    "ending": 1.0,
}
THREW = re.compile(r"Traceback|panicked|Exception ignored|RuntimeWarning|Fatal Python error")


def draw(seed: int, *, backend: str | None = None) -> Iterator[KillTrial]:
    """Trials without end; the same ones for the same seed. Backends and moments take turns."""
    dice = random.Random(seed)
    for number in itertools.count():
        moment, router = MOMENTS[number % len(MOMENTS)], dice.random() < 0.25
        clock_mode = dice.choice(("realtime", "realtime", "lockstep"))
        victims = (*VICTIMS, "router") if router else VICTIMS
        hits: list[ProcessKill] = []
        for _ in range(dice.choice((1, 1, 1, 2, 3))):
            what = dice.choice(SIGNALS)
            thaw_s = dice.choice((0.02, 0.2, 1.0, 3.0, None)) if what is signal.SIGSTOP else None
            hits.append(
                ProcessKill(
                    dice.choice(victims),
                    what,
                    round(dice.uniform(0.0, WITHIN_S[moment]), 3),
                    thaw_s,
                )
            )
        yield KillTrial(
            number=number,
            backend=backend or ("sim", "can")[number // len(MOMENTS) % 2],
            clock_mode=clock_mode,
            stay=dice.random() < 0.4,
            router=router,
            asked_s=1.0
            if moment == "ending"
            else 8.0
            if clock_mode == "realtime"
            else 60.0,  # which a lockstep run hurries
            moment=moment,
            by_datagram=dice.random() < 0.5,
            hits=tuple(hits),
        )


def judge(outcome: KillOutcome) -> list[str]:
    """What was wrong; empty when nothing was."""
    trial, wrong = outcome.trial, [f"left behind: {what}" for what in outcome.left_behind]
    wrong += [
        f"{name}: {_around(text, thrown.start())}"
        for name, text in {"the run": outcome.printed, **outcome.logs}.items()
        if (thrown := THREW.search(text)) is not None and not _before_our_code(trial, name, text)
    ]
    wrong += _lies(outcome)
    if outcome.stop_answered and not outcome.reset_asked and not outcome.stop_kept:
        wrong.append("an emergency stop was answered, and is not on the disk")
    if outcome.reset_answered and outcome.stop_kept:
        wrong.append("a reset was answered, and the emergency stop is still on the disk")
    if not outcome.printed.strip() and outcome.code not in (None, 0) and trial.moment != "starting":
        wrong.append(f"exit code {outcome.code}, and not a word why")
    return wrong


def _before_our_code(trial: KillTrial, name: str, text: str) -> bool:
    """Whether Ctrl-C came while Python itself was starting: no line of ours had been read."""
    interrupted = any(
        hit.victim == SUPERVISOR and hit.number is signal.SIGINT for hit in trial.hits
    )
    return (
        interrupted
        and name == "the run"
        and "KeyboardInterrupt" in text
        and "snakesim_" not in text
    )


def _lies(outcome: KillOutcome) -> list[str]:
    """Exit codes that are not so: 0 armed for as long as asked, 1 a fault, 130 interrupted, else by that signal."""
    code, trial = outcome.code, outcome.trial
    asked = round(trial.asked_s * RATE_HZ)
    if code == 0:
        record, ended = (
            outcome.record,
            outcome.summary.ended if outcome.summary is not None else None,
        )
        counted = None if record is None else record.armed_ticks
        if counted is None or counted < asked or ended != "complete":
            return [
                f"exit code 0 with {counted} of {asked} ticks armed by the host's record, ended {ended!r}"
            ]
        if outcome.reached and trial.moment == "ending" and outcome.armed_ticks < 0.8 * asked:
            return [f"exit code 0, and {outcome.armed_ticks} of {asked} ticks were seen armed"]
        return ["exit code 0 with the emergency stop latched"] if outcome.stop_kept else []
    if code == 130:
        return [] if outcome.interrupted else ["exit code 130, and nobody has interrupted it"]
    if code == 1:
        words = ("fault:", "snakesim:", "left no record")
        return (
            []
            if any(word in outcome.printed for word in words)
            else ["exit code 1, and no word of a fault"]
        )
    by = {hit.number for hit in trial.hits if hit.victim == SUPERVISOR}
    by |= {signal.SIGINT} if outcome.interrupted else set()
    return [] if code is not None and -code in by else [f"exit code {code}"]


def _around(text: str, at: int) -> str:
    return " | ".join(line.strip() for line in text[at:].splitlines()[:40] if line.strip())[-600:]


def carry_out(trial: KillTrial, folder: Path) -> tuple[KillOutcome, list[str]]:
    """One trial in a folder of its own."""
    folder.mkdir(parents=True)
    outcome = KilledRun(trial, folder).go()
    return outcome, judge(outcome)


def main() -> int:
    """0 when nothing was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trials", type=int, default=300)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--backend", choices=["sim", "can"], help="one of them alone (default: in turns)"
    )
    parser.add_argument("--only", type=int, help="the trial of this number alone")
    parser.add_argument("--workers", type=int, default=2, help="how many at the same time")
    parser.add_argument(
        "--out", type=Path, help="where the folders of the runs stay (default: nowhere)"
    )
    asked = parser.parse_args()
    drawn = itertools.islice(draw(asked.seed, backend=asked.backend), asked.trials)
    trials = [trial for trial in drawn if asked.only in (None, trial.number)]
    began, wrong, codes, hits = time.monotonic(), Counter[str](), Counter[str](), 0
    with (
        tempfile.TemporaryDirectory(prefix="snakesim-kills-") as temporary,
        ThreadPoolExecutor(asked.workers) as side_by_side,
    ):
        folder = (asked.out or Path(temporary)).resolve()
        made = side_by_side.map(
            lambda trial: carry_out(trial, folder / f"{trial.number:04}"), trials
        )
        for outcome, found in made:
            hits += outcome.hits
            codes[f"{outcome.trial.moment}: exit code {outcome.code}"] += 1
            print(f"{'WRONG' if found else 'ok   '} {outcome.trial} -> {outcome.code}", flush=True)
            for what in found:
                wrong[re.sub(r"\d+", "N", what)[:100]] += 1
                print(f"      {what}", flush=True)
    for what, count in sorted(codes.items()):
        print(f"{count:>5} {what}")
    for what, count in wrong.most_common():
        print(f"{count:>5} WRONG {what}")
    print(
        f"{len(trials)} trials of seed {asked.seed}, {hits} signals, {(time.monotonic() - began) / 60:.1f} minutes"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
