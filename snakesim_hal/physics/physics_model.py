"""The body that emulated motors move: the mechanics that an emulated joint module needs, independent of CAN and MuJoCo.

A physics model is found by name among the entry points of the group `snakesim.physics_models`, so that the emulated
joint modules of one backend can use the physics of another without importing it.
"""

from dataclasses import dataclass
from typing import Protocol

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Imu, Pose
from snakesim_hal.wire.quantities import Vector


@dataclass(frozen=True)
class LinkLoad:
    """The resultant of all contacts of one link with obstacles, in the link's frame: what its force sensor measures."""

    link: int  # index from the tail
    position_l: Vector  # m; mean position of the contacts, weighted by force
    force_l: Vector  # N, on the body


class PhysicsModel(Protocol):
    """Joints that move under motor torques, with or without a world around them. Time advances only in `advance`.

    A class of this kind has `Settings`, which is a Struct. It is constructed from a `RunConfig` and these settings, and
    then the robot is at rest, at the start pose of the run.
    """

    step_s: float  # the longest time for which torques may be held constant

    def advance(self, torque_nm: Floats) -> None:
        """Advance by `step_s` under constant motor torques.

        Args:
            torque_nm: (n_joints,), tail to head.

        Raises:
            BackendError: The state has diverged.
        """
        ...

    @property
    def angle_rad(self) -> Floats:
        """Return the joint angles now, (n_joints,), tail to head. It may be a view of the state of the model."""
        ...

    @property
    def velocity_rad_s(self) -> Floats:
        """Return the joint velocities now, (n_joints,), tail to head."""
        ...

    def shaft_torque_nm(self) -> Floats:
        """Return the torque through each joint's shaft, as its strain gauge measures it, (n_joints,)."""
        ...

    def loads(self) -> list[LinkLoad]:
        """Return the loads of the links in contact; empty in a physics model without a world."""
        ...

    def imu(self) -> Imu | None:
        """Return angular velocity and specific force of the links; None without a world. The tick of it is 0."""
        ...

    def pose(self) -> Pose | None:
        """Return the pose of the base, as from motion capture; None without a world. The tick of it is 0."""
        ...
