"""Measures the processes of a run from outside, and finds errors in their logs."""

import re
from dataclasses import dataclass
from pathlib import Path

import psutil

ERROR_PATTERN = re.compile(
    r"Traceback|Exception|panicked|RuntimeWarning|[A-Z]\w+Error\b", re.MULTILINE
)
MAX_LINE_CHARACTERS = 200


@dataclass(frozen=True)
class ProcessVitals:
    """Memory, threads and open files of one process at one moment."""

    resident_mb: float
    threads: int
    files: int


def measure_process(pid: int) -> ProcessVitals | None:
    """Measure a process. Returns None if it has ended."""
    try:
        process = psutil.Process(pid)
        return ProcessVitals(
            resident_mb=process.memory_info().rss / 2**20,
            threads=process.num_threads(),
            files=process.num_fds(),
        )
    except psutil.Error:
        return None


def find_error_lines(out: Path) -> list[str]:
    """Find the lines in the logs of a run that report an error, each with the name of the log."""
    errors: list[str] = []
    for log in sorted(out.glob("*.log")):
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
            if ERROR_PATTERN.search(line):
                errors.append(f"{log.stem}: {line.strip()[:MAX_LINE_CHARACTERS]}")
    return errors
