"""How the processes of a run are: memory, threads and open files of each, and what they complained of."""

import re
import resource
from dataclasses import dataclass
from pathlib import Path

COMPLAINTS = re.compile(r"Traceback|Exception|panicked|RuntimeWarning|[A-Z]\w+Error\b", re.MULTILINE)
_PAGE_MB = resource.getpagesize() / 2**20


@dataclass(frozen=True)
class Vitals:
    """One process at one moment."""

    pid: int
    resident_mb: float
    threads: int
    files: int


def vitals(pid: int) -> Vitals | None:
    """None when the process is gone."""
    try:
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        threads = len(list(Path(f"/proc/{pid}/task").iterdir()))
        files = len(list(Path(f"/proc/{pid}/fd").iterdir()))
    except OSError:
        return None
    return Vitals(pid, pages * _PAGE_MB, threads, files)


def complaints(out: Path) -> list[str]:
    """Lines in the logs of a run's parts that tell of an exception, with the name of the part."""
    found: list[str] = []
    for log in sorted(out.glob("*.log")):
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines():
            if COMPLAINTS.search(line):
                found.append(f"{log.stem}: {line.strip()[:200]}")
    return found
