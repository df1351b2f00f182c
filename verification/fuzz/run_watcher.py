"""Watches a run from outside: its processes, and the status that the HAL host publishes."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from snakesim_hal.network.session import Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import RobotStatus
from snakesim_testing.harness.processes import find_run_processes
from snakesim_testing.harness.wait import wait_until
from verification.fuzz.vitals import ProcessVitals, measure_process

WATCH_PERIOD_S = 0.5
WARM_UP_FRACTION = 0.1  # of a period: until then, memory may grow
STATUS_TIMEOUT_S = 5.0
STATUS_POLL_PERIOD_S = 0.01


@dataclass
class ObservedPeriod:
    """What was observed of a run between two statuses."""

    first_status: RobotStatus
    last_status: RobotStatus
    vitals_by_part: dict[str, list[ProcessVitals]] = field(
        default_factory=dict[str, list[ProcessVitals]]
    )
    failures: list[str] = field(default_factory=list[str])

    def count(self, counter: Literal["tick", "overruns", "commands_accepted"]) -> int:
        """Return by how much a counter of the status has grown."""
        return getattr(self.last_status, counter) - getattr(self.first_status, counter)

    def fraction_of_ticks(self, counter: Literal["overruns", "commands_accepted"]) -> float:
        """Return by how much a counter of the status has grown per tick."""
        return self.count(counter) / max(self.count("tick"), 1)

    def compute_growth_mb(self, part: str) -> float:
        """Compute by how much the memory of a part has grown from the end of the warm-up to the last tenth, in MB."""
        resident_mb = [vitals.resident_mb for vitals in self.vitals_by_part[part]]
        count = max(round(len(resident_mb) * WARM_UP_FRACTION), 1)
        after_warm_up_mb = resident_mb[count : 2 * count] or resident_mb
        return float(np.mean(resident_mb[-count:]) - np.mean(after_warm_up_mb))


class RunWatcher:
    """Observes a run for one period after the other."""

    def __init__(self, session: Session, out: Path) -> None:
        """Wait for the first status of the run.

        Args:
            session: A session on the network of the run.
            out: The folder of the run, by which its processes are found.
        """
        self._statuses = session.declare_latched_reader(keys.STATUS, RobotStatus)
        self._pids_by_part = find_run_processes(out)
        self._newest_status: RobotStatus | None = None
        wait_until(lambda: self.read_status() is not None, "a status")

    def read_status(self) -> RobotStatus | None:
        """Return the newest status, or None before the first."""
        statuses = self._statuses.drain()
        if statuses:
            self._newest_status = statuses[-1]
        return self._newest_status

    def is_commanded(self) -> bool:
        """Return whether the robot is armed and has accepted a command."""
        status = self.read_status()
        return status is not None and status.lifecycle == "armed" and status.commands_accepted > 0

    def watch(self, continues: Callable[[], bool]) -> ObservedPeriod:
        """Observe the run while `continues()` is true, or until something fails."""
        first_status = self._read_fresh_status()
        period = ObservedPeriod(first_status, first_status)
        while continues() and not period.failures:
            time.sleep(WATCH_PERIOD_S)
            self._observe(period)
        period.last_status = self._read_fresh_status()
        return period

    def _observe(self, period: ObservedPeriod) -> None:
        for part, pid in self._pids_by_part.items():
            vitals = measure_process(pid)
            if vitals is None:
                period.failures.append(f"{part} (process {pid}) has ended")
            else:
                period.vitals_by_part.setdefault(part, []).append(vitals)
        status = self.read_status()
        if status is not None and status.lifecycle != "armed":
            period.failures.append(f"the robot is in {status.lifecycle}: {status.reason}")

    def _read_fresh_status(self) -> RobotStatus:
        """Wait for the next status. Returns the newest one if no other arrives in time."""
        before = self.read_status()
        deadline_s = time.monotonic() + STATUS_TIMEOUT_S
        status = before
        while status is before and time.monotonic() < deadline_s:
            time.sleep(STATUS_POLL_PERIOD_S)
            status = self.read_status()
        assert status is not None
        return status
