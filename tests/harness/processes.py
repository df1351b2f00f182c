"""The processes of a run, as the system knows them."""

from pathlib import Path

from tests.harness.wait import wait_until


def processes_of(out: Path) -> list[tuple[int, str]]:
    """(pid, NUL-separated command line) of every live process that was started for a run's folder."""
    found: list[tuple[int, str]] = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            line = (entry / "cmdline").read_bytes().decode(errors="replace")
            state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
        except (OSError, IndexError):
            continue
        if f"{out}/config.json" in line and state != "Z":
            found.append((int(entry.name), line))
    return found


def nothing_left(out: Path, limit_s: float = 10.0) -> None:
    """Fail unless every process of a run is gone soon."""
    wait_until(lambda: not processes_of(out), f"no process of {out} left", limit_s)
