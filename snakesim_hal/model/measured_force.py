"""The contact force as a robot would measure it: the impulse over 50 ms, divided by that time.

The force at one moment depends more on how hard the surfaces are than on the push: a body that slides along a peg
bounces off it within milliseconds. The impulse is what the contact does to the body.
"""

from collections import deque
from collections.abc import Mapping
from typing import Any

FORCE_WINDOW_S = 0.05  # duration of the mean


class MeasuredForce:
    """Moving averages of contact forces over FORCE_WINDOW_S; before the first sample all forces were 0."""

    def __init__(self, sample_period_s: float) -> None:
        """Create averages of no samples.

        Args:
            sample_period_s: Time between two samples.
        """
        self._count = max(round(FORCE_WINDOW_S / sample_period_s), 1)
        self._samples: deque[Mapping[Any, float]] = deque()

    def add_sample(self, forces_n: Mapping[Any, float]) -> None:
        """Add a sample.

        Args:
            forces_n: Mean force of each contact since the last sample. The keys identify contacts, such as pairs
                of link and obstacle.
        """
        self._samples.append(forces_n)
        if len(self._samples) > self._count:
            self._samples.popleft()

    @property
    def max_n(self) -> float:
        """Return the mean force of the contact that pushes hardest; 0 without contacts."""
        sums: dict[Any, float] = {}
        for forces_n in self._samples:
            for contact, force_n in forces_n.items():
                sums[contact] = sums.get(contact, 0.0) + force_n
        return max(sums.values(), default=0.0) / self._count
