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

    link: int
    position_l: Vector  # m; mean of the contacts, weighted by force
    force_l: Vector  # N, on the body


class PhysicsModel(Protocol):
    """Joints that turn under motor torques, with or without a world around them. Time advances only in `advance`.

    Its class has `Settings`, a Struct, and is made from a `RunConfig` and those: at the run's start pose, at rest.
    """

    step_s: float  # the longest time for which torques may be held constant

    def advance(self, torque_nm: Floats) -> None:
        """Advance by `step_s` under these motor torques, (n_joints,). Raises BackendError if the state diverges."""
        ...

    @property
    def angle_rad(self) -> Floats:
        """Joint angles now, (n_joints,), tail to head. May be a view of the physics_model's state."""
        ...

    @property
    def velocity_rad_s(self) -> Floats:
        """Joint velocities now, (n_joints,)."""
        ...

    def shaft_torque_nm(self) -> Floats:
        """Torque through each joint's shaft, as its strain gauge measures it, (n_joints,)."""
        ...

    def loads(self) -> list[LinkLoad]:
        """Loads of the links in contact; empty in a physics model without a world."""
        ...

    def imu(self) -> Imu | None:
        """Angular velocity and specific force of the links; None in a physics model without a world. Its tick is 0."""
        ...

    def pose(self) -> Pose | None:
        """Pose of the base, as from motion capture; None in a physics model without a world. Its tick is 0."""
        ...
