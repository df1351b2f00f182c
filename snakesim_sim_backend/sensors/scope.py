"""What a sensor's reader gets, and what it must do."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.physics.thermal import Thermal
from snakesim_hal.wire.messages import Message
from snakesim_sim_backend.actuators import Motors
from snakesim_sim_backend.model import SimModel
from snakesim_sim_backend.physics import Physics

Normal = Callable[[int], Floats]  # n -> (n,) standard normal numbers


@dataclass(frozen=True)
class Scope:
    """What a sensor that looks around gets."""

    config: RunConfig
    sim: SimModel
    data: mujoco.MjData  # a copy of the state, with the places of all bodies and no more
    noise: np.random.Generator  # of its own


@dataclass(frozen=True)
class BodyScope(Scope):
    """What a sensor of the body gets: the state itself, and the noise that they all share."""

    motors: Motors
    physics: Physics
    windings: Thermal


class Reader(Protocol):
    """Makes the samples of one sensor."""

    def read(self, tick: int, timestamp_ns: int) -> Message:
        """The sample of this tick, without rate and delay."""
        ...


class NoSettings(FileStruct, frozen=True):
    """For a model of a sensor that has none."""
