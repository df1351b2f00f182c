"""Isolated joints: a failed joint is passive from then on, and the others continue, if the robot file allows it. Pure.

Only a joint that fails while the robot is armed is isolated, and only as long as `max_isolated_joints` is not exceeded;
one more is a fault of the whole robot. A reset ends all isolations.
"""

from dataclasses import replace

import numpy as np

from snakesim_hal.safety.joint_limits import AppliedSetpoints, JointMask
from snakesim_hal.wire.messages import JointCommand, JointMode, RobotDescription


class JointIsolation:
    """The isolated joints of a robot."""

    def __init__(self, description: RobotDescription) -> None:
        self._names = [joint.name for joint in description.joints]
        self._max_isolated = description.max_isolated_joints
        self.joints: JointMask = np.zeros(len(self._names), dtype=np.bool_)
        self.indices = frozenset[int]()  # indices of the same joints in every vector

    @property
    def joint_names(self) -> list[str]:
        """Names of the isolated joints, tail to head."""
        return [self._names[i] for i in sorted(self.indices)]

    def make_joint_mask(self, name: str | None) -> JointMask:
        """Return a mask that is True for the joint of this name; for an unknown name or None it is False everywhere."""
        return np.array([name == joint for joint in self._names])

    def is_isolated(self, name: str | None) -> bool:
        """Return whether the joint of this name is isolated."""
        return name in self.joint_names

    def are_isolated(self, joints: JointMask) -> bool:
        """Return whether all joints of a mask are isolated already; False for an empty mask."""
        return bool(joints.any() and (self.joints | ~joints).all())

    def try_isolate(self, joints: JointMask) -> bool:
        """Isolate the joints of a mask, unless more joints would be isolated than the robot file allows.

        Returns:
            Whether the joints are isolated. False for an empty mask, and if there would be too many.
        """
        isolated_joints = self.joints | joints
        if not joints.any() or np.count_nonzero(isolated_joints) > self._max_isolated:
            return False
        self._set_joints(isolated_joints)
        return True

    def reset(self) -> None:
        """End all isolations."""
        self._set_joints(np.zeros_like(self.joints))

    def make_passive(self, applied: AppliedSetpoints) -> AppliedSetpoints:
        """Return the setpoints with isolated joints passive and without torque."""
        if not self.indices:
            return applied
        return replace(
            applied,
            mode=np.where(self.joints, int(JointMode.PASSIVE), applied.mode),
            target=np.where(self.joints, 0.0, applied.target),
            torque_limit_nm=np.where(self.joints, 0.0, applied.torque_limit_nm),
        )

    def find_overruled_joints(self, command: JointCommand) -> dict[int, str]:
        """Return the limit name "isolated" by the index of each isolated joint that a command would move."""
        return {
            i: "isolated" for i in sorted(self.indices) if command.mode[i] is not JointMode.PASSIVE
        }

    def _set_joints(self, joints: JointMask) -> None:
        self.joints = joints
        self.indices = frozenset(np.flatnonzero(joints).tolist())
