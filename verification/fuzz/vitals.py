"""How the processes of a run are: memory, threads and open files of each, and what they complained of."""

import re
from dataclasses import dataclass
from pathlib import Path

import psutil

COMPLAINTS = re.compile(
    r"Traceback|Exception|panicked|RuntimeWarning|[A-Z]\w+Error\b", re.MULTILINE
)


@dataclass(frozen=True)
class ProcessVitals:
    """One process at one moment."""

    resident_mb: float
    threads: int
    files: int


def vitals(pid: int) -> ProcessVitals | None:
    """None when the process is gone."""
    try:
        process = psutil.Process(pid)
        return ProcessVitals(
            process.memory_info().rss / 2**20, process.num_threads(), process.num_fds()
        )
    except psutil.Error:
        return None


def complaints(out: Path) -> list[str]:
    """Lines in the logs of a run's parts that tell of an exception, with the name of the part."""
    found: list[str] = []
    for log in sorted(out.glob("*.log")):
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
            if COMPLAINTS.search(line):
                found.append(f"{log.stem}: {line.strip()[:200]}")
    return found
