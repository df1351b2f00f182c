"""Stores the contact forces of a run in compact arrays: a row for each contact in each sample of the sensor."""

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
    """Contact forces of obstacles on the links, in the order of the samples."""

    ticks: NDArray[np.int64]  # (s,) of the samples; ascending
    # Names of those that were touched, sorted.
    obstacles: list[str] = field(default_factory=list[str])

    # One row for each contact.
    # (c,) index into `ticks`.
    sample_index: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    # (c,) from 0 at the tail.
    link_index: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    # (c,) index into `obstacles`.
    obstacle_index: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    # (c, 3) on the body, in the link's frame.
    force_l_n: Floats = field(default_factory=lambda: np.zeros((0, 3)))


class ContactCollector:
    """Collects the contacts of a run while its messages are read."""

    def __init__(self) -> None:
        """Prepare a collector without samples."""
        self._ticks = array("q")
        self._sample_indices = array("q")
        self._link_indices = array("q")
        self._obstacle_indices = array("q")
        self._force_l_n = array("d")
        self._obstacle_index_by_name: dict[str, int] = {}

    def add_sample(self, contacts: Contacts) -> None:
        """Add one sample of the contact sensor."""
        sample = len(self._ticks)
        self._ticks.append(contacts.tick)
        for contact in contacts.contacts:
            self._sample_indices.append(sample)
            self._link_indices.append(contact.link)
            self._obstacle_indices.append(self._get_obstacle_index(contact.obstacle))
            self._force_l_n.extend(contact.force_l)

    def make_log(self) -> ContactLog:
        """Return the collected contacts in the order of their ticks. Only the last sample of each tick is used."""
        ticks = np.array(self._ticks, dtype=np.int64)
        # np.unique keeps the first occurrence: in reversed order, the last sample of each tick.
        unique_ticks, index_from_end = np.unique(ticks[::-1], return_index=True)
        retained_samples = len(ticks) - 1 - index_from_end
        # New index of each collected sample; -1 if it is dropped.
        new_index_by_old_sample = np.full(len(ticks), -1, dtype=np.int64)
        new_index_by_old_sample[retained_samples] = np.arange(len(retained_samples))
        sample_indices = new_index_by_old_sample[np.array(self._sample_indices, dtype=np.int64)]
        contact_rows = np.flatnonzero(sample_indices >= 0)
        contact_rows = contact_rows[np.argsort(sample_indices[contact_rows], kind="stable")]
        obstacles = sorted(self._obstacle_index_by_name, key=_make_sort_key)
        new_index_by_old_obstacle = np.zeros(len(obstacles), dtype=np.int64)
        for index, name in enumerate(obstacles):
            new_index_by_old_obstacle[self._obstacle_index_by_name[name]] = index
        return ContactLog(
            ticks=unique_ticks,
            obstacles=obstacles,
            sample_index=sample_indices[contact_rows],
            link_index=np.array(self._link_indices, dtype=np.int64)[contact_rows],
            obstacle_index=new_index_by_old_obstacle[
                np.array(self._obstacle_indices, dtype=np.int64)[contact_rows]
            ],
            force_l_n=np.array(self._force_l_n, dtype=float).reshape(-1, 3)[contact_rows],
        )

    def _get_obstacle_index(self, name: str | None) -> int:
        """Return the index of an obstacle, and add the obstacle if it is new. None stands for UNIDENTIFIED."""
        name = name or UNIDENTIFIED
        index_by_name = self._obstacle_index_by_name
        if name not in index_by_name and len(index_by_name) >= MAX_OBSTACLES:
            name = OTHER
        return index_by_name.setdefault(name, len(index_by_name))


def _make_sort_key(name: str) -> list[tuple[bool, int, str]]:
    """Return a key that sorts peg_2 before peg_10."""
    parts = re.split(r"([0-9]{1,9})", name)
    return [(part.isdecimal(), int(part) if part.isdecimal() else 0, part) for part in parts]
