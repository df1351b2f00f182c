"""The random numbers of many robots: each robot has the stream of numbers that it has when it is simulated alone."""

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

Mask = NDArray[np.bool_]  # (robots,)
BLOCK = 4096  # numbers that are drawn at once for each robot; a tick needs about 130


class NoiseStreams:
    """A stream of standard normal numbers for each robot. Numbers are drawn in blocks, which changes none of them."""

    def __init__(self, all_robots: Mask) -> None:
        """Make streams; `restart` gives them seeds.

        Args:
            all_robots: The mask of all robots.
        """
        robots = len(all_robots)
        self._all_robots = all_robots
        self._random = [np.random.default_rng() for _ in range(robots)]
        self._numbers: Floats = np.zeros((robots, BLOCK))
        # Position of each robot's next number in its block, and how many numbers all robots have left out after it.
        self._next: NDArray[np.intp] = np.zeros(robots, dtype=np.intp)
        self._skipped = 0
        self._first = BLOCK * np.arange(robots)  # position of each robot's block in the flat array
        self._left = 0  # numbers that every robot has left at least

    def restart(self, robot_index: int, seed: int) -> None:
        """Start the stream of a robot with a seed."""
        self._random[robot_index] = np.random.default_rng(seed)
        self._numbers[robot_index] = self._random[robot_index].standard_normal(BLOCK)
        self._next[robot_index] = -self._skipped

    def peek(self, count: int) -> Floats:
        """Return the next numbers of every robot, (robots, count), and leave them in the streams."""
        if count > self._left:
            self._draw(count)
        if len(self._first) == 1:  # faster
            start = int(self._next[0]) + self._skipped
            return self._numbers[:, start : start + count]
        return self._numbers.take(
            (self._first + self._next + self._skipped)[:, None] + np.arange(count)
        )

    def skip(self, count: int, robots: Mask) -> None:
        """Leave out the next numbers of some robots."""
        if count > self._left:
            self._draw(count)
        if robots is self._all_robots:
            self._skipped += count
        else:
            self._next += count * robots
        self._left -= count

    def skip_each(self, counts: NDArray[np.intp]) -> None:
        """Leave out the next numbers of every robot, (robots,)."""
        most = int(counts.max())
        if most > self._left:
            self._draw(most)
        self._next += counts
        self._left -= most

    def _draw(self, count: int) -> None:
        """Draw more numbers if a robot has fewer than `count` left."""
        self._next += self._skipped
        self._skipped = 0
        self._left = BLOCK - int(self._next.max())
        if count <= self._left:
            return
        if count > BLOCK:
            raise ValueError(f"{count} numbers at once; at most {BLOCK}")
        for robot, used in enumerate(self._next.tolist()):
            row = self._numbers[robot]
            unused_count = BLOCK - used
            row[:unused_count] = row[used:].copy()
            row[unused_count:] = self._random[robot].standard_normal(used)
        self._next[:] = 0
        self._left = BLOCK
