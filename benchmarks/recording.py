"""`python -m benchmarks.recording`: what the recorder costs a run, what a recording takes on disk, and in memory.

With and without are measured in turn, and their ratios paired: on a shared machine only these mean something.
"""

import argparse
import os
import resource
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import msgspec

from benchmarks.table import HEADER, compare
from snakesim_operator.recording.message import RECORDING
from snakesim_operator.results.record import SUMMARY
from snakesim_operator.results.summary import RunSummary

PAIRS = 4
SCENARIOS = ("triplet", "clutter")
AIM = 1.05


def run(*arguments: str) -> tuple[RunSummary, float, int]:
    """One `snakesim run`: its summary, CPU seconds of all its processes, and size of the recording (0: none)."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        before = _cpu_s()
        typed = [sys.executable, "-m", "snakesim_operator", "run", *arguments, "--out", str(out)]
        subprocess.run(typed, stdout=subprocess.DEVNULL, timeout=300, check=False)
        recording = out / RECORDING
        summary = msgspec.json.decode((out / SUMMARY).read_bytes(), type=RunSummary)
        return summary, _cpu_s() - before, recording.stat().st_size if recording.exists() else 0


def _cpu_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def tell(what: str, ours: list[float], theirs: list[float]) -> None:
    """Print one line of the table."""
    print(compare(what, "--no-record", ours, theirs, AIM).row(), flush=True)


def main() -> int:
    """Print the table."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n{HEADER}", flush=True)
    sizes: list[str] = []
    for scenario in SCENARIOS:
        for what, flags in (("lockstep, in one process", ["--in-process"]), ("lockstep", [])):
            typed = [scenario, "--pace", "lockstep", "--duration", "5", *flags]
            pairs = [(run(*typed), run(*typed, "--no-record")) for _ in range(PAIRS)]
            ours, theirs = ([one[i][0].wall_s / one[i][0].ticks * 1e6 for one in pairs] for i in (0, 1))
            tell(f"{scenario}, {what}: wall time of a tick", ours, theirs)
            ours, theirs = ([one[i][1] / one[i][0].ticks * 1e6 for one in pairs] for i in (0, 1))
            tell(f"{scenario}, {what}: CPU of the whole run", ours, theirs)
        sizes.append(f"{scenario} {statistics.median(one[0][2] for one in pairs) * 720 / 1e6:.0f} MB")
    typed = ["triplet", "--pace", "realtime", "--duration", "5"]
    pairs = [(run(*typed), run(*typed, "--no-record")) for _ in range(PAIRS)]
    for name in ("p50", "p99"):
        ours, theirs = ([one[i][0].state_to_command_us[name] or 0.0 for one in pairs] for i in (0, 1))
        tell(f"triplet in real time: state to command, {name}", ours, theirs)
    print(f"\nAn hour of robot time on disk: {', '.join(sizes)}.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
