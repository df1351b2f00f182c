"""Isolated joints: a failed joint is passive from then on, and the others continue, if the robot file allows it. Pure.

Only a joint that fails while the robot is armed is isolated, and only as long as `max_isolated_joints` is not exceeded;
one more is a fault of the whole robot. A reset ends all isolations.
"""

from dataclasses import replace

import numpy as np

from snakesim_hal.safety.joint_limits import Applied, Mask
from snakesim_hal.wire.messages import Description, JointCommand, Mode


class Isolation:
    """The isolated joints of a robot."""

    def __init__(self, description: Description) -> None:
        self._names = [joint.name for joint in description.joints]
        self._max_isolated = description.max_isolated_joints
        self.joints: Mask = np.zeros(len(self._names), dtype=np.bool_)
        self.indices = frozenset[int]()  # of the same joints, in every vector

    @property
    def names(self) -> list[str]:
        """The names of isolated joints, tail to head."""
        return [self._names[i] for i in sorted(self.indices)]

    def find_joint(self, name: str | None) -> Mask:
        """Return a mask with the joint of that name; it is empty for an unknown name."""
        return np.array([name == joint for joint in self._names])

    def is_isolated(self, name: str | None) -> bool:
        """Return whether the joint of that name is isolated."""
        return name in self.names

    def covers(self, joints: Mask) -> bool:
        """Return whether all these joints are isolated already; False for an empty mask."""
        return bool(joints.any() and (self.joints | ~joints).all())

    def isolate(self, joints: Mask) -> bool:
        """Isolate joints. Returns False, and changes nothing, if the robot may not lose so many."""
        together = self.joints | joints
        if not joints.any() or np.count_nonzero(together) > self._max_isolated:
            return False
        self._set_joints(together)
        return True

    def reset(self) -> None:
        """End all isolations."""
        self._set_joints(np.zeros_like(self.joints))

    def make_passive(self, applied: Applied) -> Applied:
        """Return the setpoints with isolated joints passive and without torque."""
        if not self.indices:
            return applied
        return replace(
            applied,
            mode=np.where(self.joints, int(Mode.PASSIVE), applied.mode),
            target=np.where(self.joints, 0.0, applied.target),
            torque_limit_nm=np.where(self.joints, 0.0, applied.torque_limit_nm),
        )

    def name_overruled(self, command: JointCommand) -> dict[int, str]:
        """Return the index of each isolated joint that a command would move, with the word "isolated" to count by."""
        return {i: "isolated" for i in sorted(self.indices) if command.mode[i] is not Mode.PASSIVE}

    def _set_joints(self, joints: Mask) -> None:
        self.joints = joints
        self.indices = frozenset(np.flatnonzero(joints).tolist())
