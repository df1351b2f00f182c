"""Memory, threads, files and processes of a run over time: flat, or not."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snakesim_testing.harness.processes import find_run_processes
from verification.fuzz.vitals import ProcessVitals, vitals

EVERY_S = 2.0
WARM_UP_S = 20.0  # of a process: until then, anything may grow
LONG_ENOUGH_S = 300.0  # of a process that a slope is told of
GROWTH_MB_MIN = 4.0  # a minute
GROWTH_MB = 24.0  # in all
MORE_THREADS, MORE_FILES = 8, 16
ORPHANED_S = 10.0


@dataclass(frozen=True)
class HealthRow:
    """One look at one process."""

    at_s: float
    vitals: ProcessVitals


class ProcessHealth:
    """Looks at a run's processes every now and then."""

    def __init__(self, out: Path) -> None:
        self.rows: dict[tuple[str, int], list[HealthRow]] = {}  # by part and process id
        self.violations: list[str] = []
        self._out = out
        self._due_s = 0.0
        self._extra_since: dict[int, float] = {}

    def look(self) -> None:
        """When it is time to."""
        now = time.monotonic()
        if now < self._due_s:
            return
        self._due_s = now + EVERY_S
        found = find_run_processes(self._out)
        for name, pid in found.items():
            seen = vitals(pid)
            if seen is not None:
                self.rows.setdefault((name, pid), []).append(HealthRow(now, seen))
        extra = {pid: name for name, pid in found.items() if name.endswith("again")}
        self._extra_since = {pid: self._extra_since.get(pid, now) for pid in extra}
        for pid, since in self._extra_since.items():
            if now - since > ORPHANED_S:
                self.violations.append(
                    f"process {pid} is there as {extra[pid]} for {now - since:.0f} s"
                )
                self._extra_since[pid] = now

    def judge(self) -> list[str]:
        """What grew, with the process that it grew in, and what was left over."""
        found = list(self.violations)
        for (name, pid), rows in self.rows.items():
            rows = [row for row in rows if row.at_s - rows[0].at_s > WARM_UP_S]
            if len(rows) < 3:
                continue
            lasted_s = rows[-1].at_s - rows[0].at_s
            grown_mb = rows[-1].vitals.resident_mb - rows[0].vitals.resident_mb
            if grown_mb > GROWTH_MB:
                found.append(
                    f"{name} (process {pid}) grew by {grown_mb:.1f} MB in {lasted_s:.0f} s"
                )
            if lasted_s > LONG_ENOUGH_S and grown_mb > GROWTH_MB / 4:
                at_min = [(row.at_s - rows[0].at_s) / 60 for row in rows]
                slope = np.polyfit(at_min, [row.vitals.resident_mb for row in rows], 1)[0]
                if slope > GROWTH_MB_MIN:
                    found.append(f"{name} (process {pid}) grows by {slope:.1f} MB a minute")
            for what, first, last, more in (
                ("threads", rows[0].vitals.threads, rows[-1].vitals.threads, MORE_THREADS),
                ("files", rows[0].vitals.files, rows[-1].vitals.files, MORE_FILES),
            ):
                if last > first + more:
                    found.append(f"{name} (process {pid}) has {last} {what}, at first {first}")
        return found

    def in_words(self) -> list[str]:
        """First and last of each part, over all its processes."""
        lines: list[str] = []
        for name in sorted({name for name, _ in self.rows}):
            mine = [rows for (part, _), rows in self.rows.items() if part == name]
            first, last = mine[0][0].vitals, mine[-1][-1].vitals
            peak = max(row.vitals.resident_mb for rows in mine for row in rows)
            lines.append(
                f"{name:<11}{len(mine)} processes, memory {first.resident_mb:.0f} -> {last.resident_mb:.0f} MB (most "
                f"{peak:.0f}), threads {first.threads} -> {last.threads}, files {first.files} -> {last.files}"
            )
        return lines
