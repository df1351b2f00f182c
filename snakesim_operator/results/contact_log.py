"""The contact forces of a run, as compact arrays: one row for each contact in each sample of the contact sensor."""

import re
from array import array
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Contacts

UNIDENTIFIED = "unidentified"  # an obstacle that the sensor does not identify
OTHER = "other"  # obstacles beyond MAX_OBSTACLES
MAX_OBSTACLES = 200  # each needs three columns of a table


@dataclass(frozen=True, eq=False)
class ContactLog:
    """Contact forces of obstacles on the links, by samples in time order."""

    ticks: NDArray[np.int64]  # (s,) of the samples; ascending
    obstacles: list[str] = field(default_factory=list[str])  # names of those that were touched, sorted

    # One row for each contact.
    sample: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # (c,) index into `ticks`
    link: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # (c,) from 0 at the tail
    obstacle: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))  # (c,) index into `obstacles`
    force_l_n: Floats = field(default_factory=lambda: np.zeros((0, 3)))  # (c, 3) on the body, in the link's frame


class ContactCollector:
    """Collects the contacts of a run while its messages are read."""

    def __init__(self) -> None:
        """Start without any sample."""
        self._ticks = array("q")
        self._sample = array("q")
        self._link = array("q")
        self._obstacle = array("q")
        self._force_l_n = array("d")
        self._obstacle_numbers: dict[str, int] = {}

    def add(self, contacts: Contacts) -> None:
        """Add one sample of the contact sensor."""
        sample = len(self._ticks)
        self._ticks.append(contacts.tick)
        for contact in contacts.contacts:
            self._sample.append(sample)
            self._link.append(contact.link)
            self._obstacle.append(self._number_obstacle(contact.obstacle))
            self._force_l_n.extend(contact.force_l)

    def make_log(self) -> ContactLog:
        """Return what was collected, in the order of the ticks. The last sample of a tick counts."""
        ticks = np.array(self._ticks, dtype=np.int64)
        unique_ticks, index_from_end = np.unique(ticks[::-1], return_index=True)
        kept = len(ticks) - 1 - index_from_end
        place = np.full(len(ticks), -1, dtype=np.int64)  # of each sample in the log
        place[kept] = np.arange(len(kept))
        sample = place[np.array(self._sample, dtype=np.int64)]
        rows = np.flatnonzero(sample >= 0)
        rows = rows[np.argsort(sample[rows], kind="stable")]
        obstacles = sorted(self._obstacle_numbers, key=_make_sort_key)
        place_of_number = np.zeros(len(obstacles), dtype=np.int64)
        for i, name in enumerate(obstacles):
            place_of_number[self._obstacle_numbers[name]] = i
        return ContactLog(
            ticks=unique_ticks,
            obstacles=obstacles,
            sample=sample[rows],
            link=np.array(self._link, dtype=np.int64)[rows],
            obstacle=place_of_number[np.array(self._obstacle, dtype=np.int64)[rows]],
            force_l_n=np.array(self._force_l_n, dtype=float).reshape(-1, 3)[rows],
        )

    def _number_obstacle(self, name: str | None) -> int:
        """Return the number of an obstacle, and count it if it is new."""
        name = name or UNIDENTIFIED
        numbers = self._obstacle_numbers
        if name not in numbers and len(numbers) >= MAX_OBSTACLES:
            name = OTHER
        return numbers.setdefault(name, len(numbers))


def _make_sort_key(name: str) -> list[tuple[bool, int, str]]:
    """Return a key that sorts peg_2 before peg_10."""
    parts = re.split(r"([0-9]{1,9})", name)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts]
