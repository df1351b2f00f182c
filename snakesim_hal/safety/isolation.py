"""Isolated joints: a failed joint is passive from then on, and the others go on, if the robot file allows it. Pure.

Only a joint that fails while the robot is armed is isolated, and only as long as `max_isolated_joints` is not exceeded;
one more is a fault of the whole robot. A clear ends all isolations.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.safety.limiter import Applied
from snakesim_hal.wire.messages import Description, JointCommand, Mode

Mask = NDArray[np.bool_]


class Isolation:
    """Which joints are isolated."""

    def __init__(self, description: Description) -> None:
        self._names = [joint.name for joint in description.joints]
        self._most = description.max_isolated_joints
        self.joints: Mask = np.zeros(len(self._names), dtype=np.bool_)
        self.indices = frozenset[int]()  # the same, by their index in every vector

    @property
    def names(self) -> list[str]:
        """Tail to head."""
        return [self._names[i] for i in sorted(self.indices)]

    def mask(self, name: str | None) -> Mask:
        """The joint of that name; none for an unknown name."""
        return np.array([name == own for own in self._names])

    def has(self, name: str | None) -> bool:
        """Whether the joint of that name is isolated."""
        return name in self.names

    def covers(self, joints: Mask) -> bool:
        """Whether all these joints are isolated already."""
        return bool(joints.any() and (self.joints | ~joints).all())

    def add(self, joints: Mask) -> bool:
        """Isolate joints; False, without any change, when the robot may not lose so many."""
        together = self.joints | joints
        if not joints.any() or np.count_nonzero(together) > self._most:
            return False
        self._now(together)
        return True

    def clear(self) -> None:
        """End all isolations."""
        self._now(np.zeros_like(self.joints))

    def without(self, applied: Applied) -> Applied:
        """The setpoints, with isolated joints passive and without torque."""
        if not self.indices:
            return applied
        return replace(
            applied,
            mode=np.where(self.joints, int(Mode.PASSIVE), applied.mode),
            target=np.where(self.joints, 0.0, applied.target),
            torque_limit_nm=np.where(self.joints, 0.0, applied.torque_limit_nm),
        )

    def overruled(self, command: JointCommand) -> dict[int, str]:
        """Isolated joints that a command would move, and the word to count by."""
        return {i: "isolated" for i in sorted(self.indices) if command.mode[i] is not Mode.PASSIVE}

    def _now(self, joints: Mask) -> None:
        self.joints, self.indices = joints, frozenset(np.flatnonzero(joints).tolist())
