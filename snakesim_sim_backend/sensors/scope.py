"""The interface of a sensor's reader, and what it may use."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.thermal import ThermalModel
from snakesim_hal.wire.messages import Message
from snakesim_sim_backend.actuators import ModelMotors
from snakesim_sim_backend.model.build import SimModel
from snakesim_sim_backend.physics import PhysicsStepper

Normal = Callable[[int], Floats]  # n -> (n,) standard normal numbers


@dataclass(frozen=True)
class SensorScope:
    """The model and the state that a sensor that looks around may use."""

    config: RunConfig  # the run
    sim: SimModel  # the MuJoCo model, with the indices of the robot's bodies in it
    data: mujoco.MjData  # a copy of the state, in which only the places of bodies are computed
    noise: np.random.Generator  # of this sensor alone


@dataclass(frozen=True)
class BodyScope(SensorScope):
    """The state itself, for a sensor of the body, and the noise generator that these sensors share."""

    motors: ModelMotors
    physics: PhysicsStepper
    windings: ThermalModel


class SensorReader(Protocol):
    """Makes the samples of one sensor."""

    def read(self, tick: int, timestamp_ns: int) -> Message:
        """Return the sample of this tick; rate and delay are applied by the caller."""
        ...
