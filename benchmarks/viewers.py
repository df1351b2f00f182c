"""`python -m benchmarks.viewers`: what a console at 30 Hz with three viewers costs a run.

With and without are measured in turn, and their ratios paired. The viewers are one process at the lowest priority, that
reads and answers as viser's page does and draws nothing: three browsers without a graphics card would be what is
measured, and on a lab's bench they run elsewhere.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import msgspec

from benchmarks.table import HEADER, Line, compare
from snakesim_operator.results.record import SUMMARY
from snakesim_operator.results.summary import RunSummary

PAIRS = 5
VIEWERS = 3
AIM = 1.1
RUN = [sys.executable, "-m", "snakesim_operator", "run"]
ADDRESS = "console: "


@dataclass(frozen=True)
class Run:
    """One run, and CPU seconds of its processes without the viewers."""

    summary: RunSummary
    cpu_s: float

    @property
    def tick_us(self) -> float:
        """Wall time of a tick."""
        return self.summary.wall_s / self.summary.ticks * 1e6

    @property
    def cpu_of_tick_us(self) -> float:
        """CPU of all processes, a tick; start and end included."""
        return self.cpu_s / self.summary.ticks * 1e6


def run(*arguments: str, viewers: int) -> Run:
    """One `snakesim run`; viewers: 0 has no console."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        console = ["--console"] if viewers else []
        typed = [*RUN, "triplet", *arguments, *console, "--out", str(out)]
        process = subprocess.Popen(typed, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        watching = None
        for line in process.stdout:
            if line.startswith(ADDRESS):
                looks_on = [sys.executable, "-m", "tests.viewer", line.split()[1], str(viewers)]
                watching = subprocess.Popen(["nice", "-n", "19", *looks_on])
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        if watching is not None:
            assert watching.wait(20) == 0, "the viewers failed"
        summary = msgspec.json.decode((out / SUMMARY).read_bytes(), type=RunSummary)
        return Run(summary, used.ru_utime + used.ru_stime)


def line_of(what: str, pairs: list[tuple[float, float]]) -> Line:
    """With against without."""
    with_console, without = zip(*pairs, strict=True)
    return compare(what, "no console", with_console, without, AIM)


def pairs_of(*arguments: str) -> list[tuple[Run, Run]]:
    """With and without, in turn."""
    return [(run(*arguments, viewers=VIEWERS), run(*arguments, viewers=0)) for _ in range(PAIRS)]


def main() -> int:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {VIEWERS} viewers\n{HEADER}", flush=True)
    pairs = pairs_of("--pace", "realtime", "--duration", "10")
    for name in ("p50", "p99"):
        found = [tuple(one.summary.state_to_command_us[name] or 0.0 for one in pair) for pair in pairs]
        print(line_of(f"triplet in real time: state to command, {name}", [(a, b) for a, b in found]).row(), flush=True)
    costs = [(a.cpu_of_tick_us, b.cpu_of_tick_us) for a, b in pairs]
    print(line_of("triplet in real time: CPU of the whole run, a tick", costs).row(), flush=True)
    pairs = pairs_of("--pace", "lockstep", "--duration", "30")
    times = [(a.tick_us, b.tick_us) for a, b in pairs]
    print(line_of("triplet in lockstep: wall time of a tick", times).row(), flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
