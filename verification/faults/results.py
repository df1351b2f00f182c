"""Stores the raw results in a JSON file, which is written again after each row.

Single rows can therefore be measured on different days.
"""

import os
import platform
from pathlib import Path

import msgspec

from verification.faults.row import RowResult

ROOT = Path(__file__).resolve().parents[2]
RESULTS_PATH = ROOT / "docs" / "benchmarks" / "faults.json"


class FaultResults:
    """The stored result of each row on each backend."""

    def __init__(self, path: Path = RESULTS_PATH) -> None:
        self.path = path

    def read(self) -> dict[tuple[str, str], RowResult]:
        """Return every stored result by the name of its row and its backend."""
        if not self.path.is_file():
            return {}
        results = msgspec.json.decode(self.path.read_bytes(), type=list[RowResult])
        return {(result.row, result.backend): result for result in results}

    def save(self, result: RowResult) -> None:
        """Store a result. It replaces the older result of the same row and backend."""
        results = self.read()
        results[result.row, result.backend] = result
        ordered = [results[key] for key in sorted(results)]
        lines = ",\n".join(msgspec.json.encode(entry).decode() for entry in ordered)
        # Renaming replaces the file at once: an interrupted measurement leaves the older results intact.
        partial = self.path.with_suffix(".partial")
        partial.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
        partial.rename(self.path)


def describe_machine() -> str:
    """Return the number of cores, the kernel and the interpreter of this machine as text."""
    is_guest = os.environ.get("SNAKESIM_VCAN") == "guest"
    suffix = f", in a guest ({_describe_processor()})" if is_guest else ""
    return (
        f"{os.cpu_count()} cores, {platform.machine()}, Linux {platform.release()}, "
        f"Python {platform.python_version()}{suffix}"
    )


def _describe_processor() -> str:
    """Return the processor's name, which shows whether a guest is emulated or user-mode Linux."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [
        line.partition(":")[2].strip()
        for line in lines
        if line.startswith(("model name", "vendor_id"))
    ]
    return " ".join(names[:2]) or "unknown processor"
