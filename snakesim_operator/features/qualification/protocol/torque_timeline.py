"""When a drive had torque: from the drive's own log, or from its status as a second program reads it. Pure."""

from collections.abc import Iterable
from dataclasses import dataclass

from snakesim_operator.features.qualification.protocol.checks import Source


@dataclass(frozen=True)
class TorqueReading:
    """Whether a drive was enabled at one instant."""

    monotonic_ns: int
    is_enabled: bool


@dataclass(frozen=True)
class TorqueTimeline:
    """Readings of one drive, oldest first."""

    readings: tuple[TorqueReading, ...]
    source: Source
    lists_changes: bool  # True: each reading holds until the next one; False: nothing is known between two readings

    def was_enabled_at(self, time_ns: int) -> bool | None:
        """Return whether the drive was enabled at an instant; None if it is not known."""
        before = [reading for reading in self.readings if reading.monotonic_ns <= time_ns]
        return before[-1].is_enabled if before else None

    def find_torque_off_s(self, start_ns: int) -> float | None:
        """Return how long after an instant the drive was found without torque; None if it was not.

        A drive that was without torque already gives 0.
        """
        if self.lists_changes and self.was_enabled_at(start_ns) is False:
            return 0.0
        for reading in self.readings:
            if reading.monotonic_ns > start_ns and not reading.is_enabled:
                return (reading.monotonic_ns - start_ns) * 1e-9
        return None

    def count_enabled_again(self, start_ns: int, end_ns: int) -> int | None:
        """Return how many readings between two instants show torque; None if there is no reading at all.

        A drive that has no torque at the start and at no later reading gives 0.
        """
        inside = [reading for reading in self.readings if start_ns < reading.monotonic_ns <= end_ns]
        enabled = sum(reading.is_enabled for reading in inside)
        if self.lists_changes:
            at_start = self.was_enabled_at(start_ns)
            return None if at_start is None else enabled + int(at_start)
        return enabled if inside else None


def make_timeline(
    readings: Iterable[TorqueReading], source: Source, *, lists_changes: bool
) -> TorqueTimeline:
    """Return a timeline of readings in any order."""
    ordered = sorted(readings, key=lambda reading: reading.monotonic_ns)
    return TorqueTimeline(tuple(ordered), source, lists_changes)
