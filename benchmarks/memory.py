"""`python -m benchmarks.memory --minutes 10`: memory of each process of a run with recorder and console, over time."""

import argparse
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

PAGE_MB = resource.getpagesize() / 2**20
FIRST_S, EVERY_S = 60.0, 10.0
MODULES = {"snakesim_hal.host_process": "host", "recording.process": "recorder", "operator.console": "console"}


def name_of(line: list[str]) -> str:
    """What a command line starts."""
    words = " ".join(line)
    service = line[line.index("snakesim_hal.serve") + 1] if "snakesim_hal.serve" in line else "run"
    return next((name for module, name in MODULES.items() if module in words), service)


def resident_mb(run: int) -> dict[str, float]:
    """MB of each process of a run, by name. run: process id of the supervisor."""
    found: dict[str, float] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            if run in (parent, int(entry.name)):
                line = (entry / "cmdline").read_bytes().decode(errors="replace").split("\0")
                found[name_of(line)] = int((entry / "statm").read_text().split()[1]) * PAGE_MB
        except OSError:
            continue
    return found


def main() -> int:
    """Print a row for each process."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    seconds = 60 * parser.parse_args().minutes
    with tempfile.TemporaryDirectory() as folder:
        typed = ["triplet", "--pace", "lockstep", "--duration", "36000", "--stay", "--console", "--out", "run"]
        run = subprocess.Popen([sys.executable, "-m", "snakesim_operator", "run", *typed], cwd=folder)
        try:
            time.sleep(FIRST_S)
            first = most = last = resident_mb(run.pid)
            until = time.monotonic() + seconds - FIRST_S
            while time.monotonic() < until and run.poll() is None:
                time.sleep(EVERY_S)
                last = resident_mb(run.pid)
                most = {name: max(mb, most.get(name, 0.0)) for name, mb in last.items()}
        finally:
            run.send_signal(signal.SIGINT)
            run.wait(60)
        size_mb = sum(path.stat().st_size for path in Path(folder, "run").glob("recording*.mcap")) / 1e6
    print(f"\n| process | after {FIRST_S:.0f} s | after {seconds:.0f} s | most |\n|---|---|---|---|")
    for name in sorted(last):
        print(f"| {name} | {first.get(name, 0.0):.0f} MB | {last[name]:.0f} MB | {most[name]:.0f} MB |")
    print(f"\nRecording: {size_mb:.0f} MB.")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
