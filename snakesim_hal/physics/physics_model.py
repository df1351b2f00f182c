"""The body that emulated motors move: the mechanics that an emulated joint module needs, independent of CAN and MuJoCo.

A physics model is found by name among the entry points of the group `snakesim.physics_models`, so that the emulated
joint modules of one backend can use the physics of another without importing it.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

import msgspec

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.messages import Imu, Pose
from snakesim_hal.wire.quantities import Vector


@dataclass(frozen=True)
class LinkLoad:
    """The resultant of all contacts of one link with obstacles, in the link's frame: what its force sensor measures."""

    link: int  # index from the tail
    position_l: Vector  # m; mean position of the contacts, weighted by force
    force_l: Vector  # N, on the body


class PhysicsModel(ABC):
    """Joints that move under motor torques, with or without a world around them. Time advances only in `advance`.

    Derive from it, set `step_s` in the constructor, and implement the abstract methods. The thread that operates the
    emulated drives makes all calls, and no two overlap.
    """

    # The `physics_model_settings` of a backend; may be an empty Struct.
    Settings: ClassVar[type[msgspec.Struct]]
    step_s: float  # the longest time for which torques may be held constant

    def __init__(self, config: RunConfig, settings: Any) -> None:
        """Place the robot at the start pose of the run, at rest.

        Args:
            config: The run, with motors as they are in truth.
            settings: An instance of `Settings`.

        Raises:
            ConfigError: The model cannot simulate this robot or scene.
        """
        del config, settings

    @abstractmethod
    def advance(self, torque_nm: Floats) -> None:
        """Advance by `step_s` under constant motor torques.

        Args:
            torque_nm: (n_joints,), tail to head.

        Raises:
            BackendError: The state has diverged.
        """

    @property
    @abstractmethod
    def angle_rad(self) -> Floats:
        """Return the joint angles now, (n_joints,), tail to head. It may be a view of the state of the model."""

    @property
    @abstractmethod
    def velocity_rad_s(self) -> Floats:
        """Return the joint velocities now, (n_joints,), tail to head. It may be a view of the state of the model."""

    @abstractmethod
    def shaft_torque_nm(self) -> Floats:
        """Return the torque through each joint's shaft, as its strain gauge measures it, (n_joints,)."""

    def loads(self) -> list[LinkLoad]:
        """Return the loads of the links in contact; empty in a physics model without a world, which is the default."""
        return []

    def imu(self) -> Imu | None:
        """Return angular velocity and specific force of the links, at tick 0; None without a world, the default."""
        return None

    def pose(self) -> Pose | None:
        """Return the pose of the base, as from motion capture, at tick 0; None without a world, the default."""
        return None
