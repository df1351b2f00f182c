"""Raw results: one JSON file, written again after each row, so that rows can be run on different days."""

import os
import platform
from pathlib import Path

import msgspec

from verification.faults.row import RowResult

ROOT = Path(__file__).resolve().parents[2]
RAW = ROOT / "docs" / "benchmarks" / "faults.json"


class FaultResults:
    """Results by row and backend."""

    def __init__(self, path: Path = RAW) -> None:
        self.path = path

    def read(self) -> dict[tuple[str, str], RowResult]:
        """Return every stored result by row and backend."""
        if not self.path.is_file():
            return {}
        results = msgspec.json.decode(self.path.read_bytes(), type=list[RowResult])
        return {(result.row, result.backend): result for result in results}

    def save(self, result: RowResult) -> None:
        """Store a result, in place of an older one of the same row and backend."""
        results = self.read() | {(result.row, result.backend): result}
        ordered = [results[key] for key in sorted(results)]
        partial = self.path.with_suffix(".partial")
        lines = ",\n".join(msgspec.json.encode(result).decode() for result in ordered)
        partial.write_text(f"[\n{lines}\n]\n", encoding="utf-8")
        partial.rename(self.path)


def machine() -> str:
    """Return the cores, the kernel and the interpreter of this machine, in words."""
    emulated = ", emulated in a guest" if os.environ.get("SNAKESIM_VCAN") == "guest" else ""
    return (
        f"{os.cpu_count()} cores, {platform.machine()}, Linux {platform.release()}, "
        f"Python {platform.python_version()}{emulated}"
    )
