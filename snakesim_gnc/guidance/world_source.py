"""What the guidance service makes world models with: a source, of which each kind has a module of its own."""

from typing import Protocol

import numpy as np

from snakesim_gnc.guidance.pose.body_history import BasePose
from snakesim_hal.model.scenario import RunConfig, compute_start_pose
from snakesim_hal.wire.messages import Clock, RobotDescription, WorldModel


class WorldSource(Protocol):
    """Makes world models, either from a surveyed map or from the sensors alone."""

    def configure(self, robot: RobotDescription) -> None:
        """Create the model for this robot."""
        ...

    def make_world(self, clock: Clock) -> WorldModel | None:
        """Return the world model at this tick, from the newest samples; None while it is unknown."""
        ...


def make_start_pose(config: RunConfig) -> BasePose:
    """Return the pose of the base at the start of the run."""
    start = compute_start_pose(config)
    return BasePose(
        np.array([*start.position_w, start.yaw_rad]), config.robot.module.radius_m, np.eye(3)
    )
