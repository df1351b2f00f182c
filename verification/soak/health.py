"""Measures whether memory, threads, files and processes of a run grow over time."""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snakesim_testing.harness.processes import find_run_processes
from verification.fuzz.vitals import ProcessVitals, measure_process

MEASUREMENT_PERIOD_S = 2.0
WARM_UP_S = 20.0  # of a process: until then, anything may grow
MIN_SLOPE_DURATION_S = 300.0  # after the warm-up: a shorter slope says nothing
MAX_SLOPE_MB_MIN = 4.0
MAX_GROWTH_MB = 24.0  # after the warm-up
MIN_SLOPE_GROWTH_MB = MAX_GROWTH_MB / 4  # less growth is not judged by its slope
MAX_MORE_THREADS = 8
MAX_MORE_FILES = 16
MAX_DUPLICATE_S = 10.0  # for which a part may have two processes
MIN_MEASUREMENTS = 3
DUPLICATE_SUFFIX = "again"  # of the name of a part's second process


@dataclass(frozen=True)
class HealthMeasurement:
    """The vitals of one process at one moment."""

    time_s: float  # of the monotonic clock
    vitals: ProcessVitals


class ProcessHealth:
    """Measures the processes of a run now and then, and finds what has grown."""

    def __init__(self, out: Path) -> None:
        """Start without measurements.

        Args:
            out: The folder of the run, by which its processes are found.
        """
        # By part and process id.
        self.measurements: dict[tuple[str, int], list[HealthMeasurement]] = {}
        self.violations: list[str] = []
        self._out = out
        self._next_time_s = 0.0
        self._duplicate_since_s: dict[int, float] = {}  # by process id

    def measure_when_due(self) -> None:
        """Measure all processes if the last measurement is old enough."""
        now_s = time.monotonic()
        if now_s < self._next_time_s:
            return
        self._next_time_s = now_s + MEASUREMENT_PERIOD_S
        pids_by_name = find_run_processes(self._out)
        for name, pid in pids_by_name.items():
            vitals = measure_process(pid)
            if vitals is not None:
                measurements = self.measurements.setdefault((name, pid), [])
                measurements.append(HealthMeasurement(now_s, vitals))
        self._find_duplicates(pids_by_name, now_s)

    def _find_duplicates(self, pids_by_name: dict[str, int], now_s: float) -> None:
        """Report second processes of a part that have existed for too long."""
        duplicates = {
            pid: name for name, pid in pids_by_name.items() if name.endswith(DUPLICATE_SUFFIX)
        }
        self._duplicate_since_s = {
            pid: self._duplicate_since_s.get(pid, now_s) for pid in duplicates
        }
        for pid, since_s in self._duplicate_since_s.items():
            age_s = now_s - since_s
            if age_s > MAX_DUPLICATE_S:
                self.violations.append(
                    f"process {pid} has run as {duplicates[pid]} for {age_s:.0f} s"
                )
                self._duplicate_since_s[pid] = now_s

    def find_violations(self) -> list[str]:
        """Return what has grown, each with its process, and processes that should have ended."""
        violations = list(self.violations)
        for (name, pid), measurements in self.measurements.items():
            start_s = measurements[0].time_s
            judged = [
                measurement
                for measurement in measurements
                if measurement.time_s - start_s > WARM_UP_S
            ]
            if len(judged) >= MIN_MEASUREMENTS:
                process = f"{name} (process {pid})"
                violations += _find_memory_growth(process, judged)
                violations += _find_other_growth(process, judged[0].vitals, judged[-1].vitals)
        return violations

    def format_summary(self) -> list[str]:
        """Format the first and the last vitals of each part, over all its processes."""
        lines: list[str] = []
        for name in sorted({part for part, _ in self.measurements}):
            processes = [
                measurements
                for (part, _), measurements in self.measurements.items()
                if part == name
            ]
            first = processes[0][0].vitals
            last = processes[-1][-1].vitals
            peak_mb = max(
                measurement.vitals.resident_mb
                for measurements in processes
                for measurement in measurements
            )
            lines.append(
                f"{name:<11}{len(processes)} processes, "
                f"memory {first.resident_mb:.0f} -> {last.resident_mb:.0f} MB (maximum {peak_mb:.0f}), "
                f"threads {first.threads} -> {last.threads}, files {first.files} -> {last.files}"
            )
        return lines


def _find_memory_growth(process: str, measurements: list[HealthMeasurement]) -> list[str]:
    """Return the violation if the memory of a process has grown too much, or grows too fast."""
    violations: list[str] = []
    start_s = measurements[0].time_s
    duration_s = measurements[-1].time_s - start_s
    resident_mb = [measurement.vitals.resident_mb for measurement in measurements]
    growth_mb = resident_mb[-1] - resident_mb[0]
    if growth_mb > MAX_GROWTH_MB:
        violations.append(f"{process} grew by {growth_mb:.1f} MB in {duration_s:.0f} s")
    if duration_s > MIN_SLOPE_DURATION_S and growth_mb > MIN_SLOPE_GROWTH_MB:
        times_min = [(measurement.time_s - start_s) / 60 for measurement in measurements]
        slope_mb_min, _ = np.polyfit(times_min, resident_mb, 1)
        if slope_mb_min > MAX_SLOPE_MB_MIN:
            violations.append(f"{process} grows by {slope_mb_min:.1f} MB a minute")
    return violations


def _find_other_growth(process: str, first: ProcessVitals, last: ProcessVitals) -> list[str]:
    """Return the violations if a process has many more threads or open files than at first."""
    violations: list[str] = []
    if last.threads > first.threads + MAX_MORE_THREADS:
        violations.append(f"{process} has {last.threads} threads, at first {first.threads}")
    if last.files > first.files + MAX_MORE_FILES:
        violations.append(f"{process} has {last.files} files, at first {first.files}")
    return violations
