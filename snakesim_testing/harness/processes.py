"""Finds the processes of a run in /proc."""

import contextlib
import re
from pathlib import Path

from snakesim_testing.harness.wait import wait_until

SERVICE = re.compile(r"snakesim_hal\.programs\.service_program\0(\w+)\0")
PROGRAMS = {
    "snakesim_hal.programs.host_program": "host",
    "snakesim_hal.programs.router_program": "router",
    "snakesim_operator.recording.recorder_process": "recorder",
    "snakesim_can_backend.emulator": "emulators",
}


def find_processes_with(file: str, content: str) -> list[tuple[int, str]]:
    """Return process id and NUL-separated command line of every live process with a text in a file below /proc/PID.

    Args:
        file: Name of the file, such as `cmdline` or `environ`.
        content: The text.
    """
    found: list[tuple[int, str]] = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, IndexError):  # gone in the meantime, or of another user
            state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
            if state != "Z" and content.encode() in (entry / file).read_bytes():
                found.append(
                    (int(entry.name), (entry / "cmdline").read_bytes().decode(errors="replace"))
                )
    return found


def find_processes_of_run(out: Path) -> list[tuple[int, str]]:
    """Return process id and command line of every live process that was started for the folder of a run."""
    return find_processes_with("cmdline", f"{out}/config.json")


def find_run_processes(out: Path) -> dict[str, int]:
    """Return the process ids of a run by name of the part. A second process of a part is named `NAME again`."""
    pid_by_name: dict[str, int] = {}
    for pid, line in sorted(find_processes_of_run(out)):
        service = SERVICE.search(line)
        if service is not None:
            name = service[1]
        else:
            name = next((name for module, name in PROGRAMS.items() if module in line), "run")
        is_second = name in pid_by_name
        pid_by_name[f"{name} again" if is_second else name] = pid
    return pid_by_name


def assert_no_process_left(out: Path, limit_s: float = 10.0) -> None:
    """Fail unless every process of a run has ended within a time."""
    wait_until(lambda: not find_processes_of_run(out), f"no process of {out} left", limit_s)
