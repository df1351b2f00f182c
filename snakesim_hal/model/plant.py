"""The body that emulated motors move: what a module twin needs to know of mechanics, and nothing of CAN or MuJoCo.

A plant is found by name among the entry points of the group `snakesim.plants`, so that the module twins of one backend
can stand on the physics of another without importing it.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.wire.messages import Imu, Pose
from snakesim_hal.wire.quantities import Vector

if TYPE_CHECKING:
    from snakesim_hal.model.scenario import RunConfig

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LinkLoad:
    """The resultant of all touches of one link by obstacles, in the link's frame: what its force sensor feels."""

    link: int
    position_l: Vector  # m; mean of the touches, weighted by force
    force_l: Vector  # N, on the body


class Plant(Protocol):
    """Joints that turn under motor torques, with or without a world around them. Time passes only in `advance`."""

    step_s: float  # the longest time for which torques may be held

    def advance(self, torque_nm: Floats) -> None:
        """Let `step_s` pass under these motor torques, (n_joints,). Raises BackendError when the numbers blow up."""
        ...

    @property
    def angle_rad(self) -> Floats:
        """Joint angles now, (n_joints,), tail to head. May be a view of the plant's state."""
        ...

    @property
    def velocity_rad_s(self) -> Floats:
        """Joint velocities now, (n_joints,)."""
        ...

    def shaft_torque_nm(self) -> Floats:
        """Torque through each joint's shaft, as its strain gauge feels it, (n_joints,)."""
        ...

    def loads(self) -> list[LinkLoad]:
        """Links that are touched; empty in a plant without a world."""
        ...

    def imu(self) -> Imu | None:
        """Angular velocity and specific force of the links; None in a plant without a world. Its tick is 0."""
        ...

    def pose(self) -> Pose | None:
        """The base, as motion capture would see it; None in a plant without a world. Its tick is 0."""
        ...


class PlantFactory(Protocol):
    """What stands behind an entry point in the group `snakesim.plants`: usually the plant's class."""

    Settings: type[msgspec.Struct]

    def __call__(self, config: "RunConfig", settings: Any) -> Plant:
        """Make the plant at the run's start pose, at rest."""
        ...
