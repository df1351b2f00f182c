"""The force of a contact as a robot would feel it: its impulse over 50 ms, over that time.

The force at one instant says more about how hard the surfaces are than about the push: a body that slides along a peg
bounces off it within milliseconds. What the body gets of that is the impulse.
"""

from collections import deque
from collections.abc import Mapping

FELT_OVER_S = 0.05


class FeltForce:
    """Means of the forces of contacts over the last FELT_OVER_S; before the first of them there was none."""

    def __init__(self, every_s: float) -> None:
        """every_s: how long each of the forces that are added lasts."""
        self._count = max(round(FELT_OVER_S / every_s), 1)
        self._last: deque[Mapping[object, float]] = deque()

    def add(self, forces_n: Mapping[object, float]) -> None:
        """Forces by contact, such as a link and an obstacle, that act from the last ones on."""
        self._last.append(forces_n)
        if len(self._last) > self._count:
            self._last.popleft()

    @property
    def max_n(self) -> float:
        """Mean force of the contact that pushes hardest; 0 without any."""
        sums: dict[object, float] = {}
        for forces_n in self._last:
            for contact, force_n in forces_n.items():
                sums[contact] = sums.get(contact, 0.0) + force_n
        return max(sums.values(), default=0.0) / self._count
