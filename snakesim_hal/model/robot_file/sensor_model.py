"""The interface of a sensor model: the simulation of a sensor that is mounted on a link, such as a camera.

The base class is here, and not in the simulator, so that a file with a model and its message can be loaded by a driver
on a computer without a simulator.
"""

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import msgspec

from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Message


class NoSettings(FileStruct, frozen=True):
    """The settings of a sensor model that has none."""


class SensorModel(ABC):
    """Makes the samples of one sensor. Derive from it, set `message`, and implement the constructor and `read`.

    A thread of the simulator that is not that of the control cycle makes all calls, first of the constructor. An
    exception of any call ends the run, and its message names the sensor.
    """

    # What `read` returns: that of the sensor's key, or of its own.
    message: ClassVar[type[Message]] = Message
    # The sensor's `settings` in the robot file.
    Settings: ClassVar[type[msgspec.Struct]] = NoSettings

    def __init__(self, sensor: Any, scope: Any, settings: Any) -> None:
        """Prepare for reading.

        Args:
            sensor: The entry of the robot file, a `MountedSensor` of `snakesim_hal.model.robot_file.sensors` with the
                fields of its section.
            scope: A `snakesim_sim_backend.sensors.scope.SensorScope`: the run, the model, a copy of its state, and the
                noise generator of this sensor.
            settings: An instance of `Settings`.

        Raises:
            ConfigError: The sensor cannot be simulated like this.
        """
        del sensor, scope, settings

    @abstractmethod
    def read(self, tick: int, timestamp_ns: int) -> Message:
        """Return the sample of the current state.

        Called at the rate of the robot file. The caller applies the delay, and in real time drops a sample that takes
        longer than the delay, or than one control period if that is longer.

        Args:
            tick: Number of the control cycle, which goes into the sample.
            timestamp_ns: The robot's time, which goes into the sample.
        """
