"""How the processes of a run are: memory, threads and open files of each, and what they complained of."""

import re
import resource
from dataclasses import dataclass
from pathlib import Path

from tests.harness.processes import processes_of

COMPLAINTS = re.compile(r"Traceback|Exception|panicked|RuntimeWarning|[A-Z]\w+Error\b", re.MULTILINE)
_PAGE_MB = resource.getpagesize() / 2**20
_SERVICE = re.compile(r"snakesim_hal\.serve\0(\w+)\0")


@dataclass(frozen=True)
class Vitals:
    """One process at one moment."""

    pid: int
    resident_mb: float
    threads: int
    files: int


def name_of(command_line: str) -> str:
    """The part of a run that a NUL-separated command line starts."""
    service = _SERVICE.search(command_line)
    if service is not None:
        return service[1]
    if "snakesim_hal.host_process" in command_line:
        return "host"
    if "snakesim_hal.router_process" in command_line:
        return "router"
    return "twins" if "snakesim_can_backend.twin" in command_line else "run"


def parts(out: Path) -> dict[str, int]:
    """Process ids of a run's parts, by name; a second process of the same name is `NAME again`."""
    found: dict[str, int] = {}
    for pid, line in sorted(processes_of(out)):
        name = name_of(line)
        found[f"{name} again" if name in found else name] = pid
    return found


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
