"""A controller that holds the pose and writes the time of each finished command to a file."""

import time

from snakesim_gnc.control.hold import HoldPose
from snakesim_hal.controller import Controller, ControllerCommand, NoParameters, Observation
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import RobotDescription


class StampedParameters(FileStruct, frozen=True, kw_only=True):
    """The file that gets the times."""

    path: str
    """The file; it gets one time a line, in s since the epoch."""


class Stamped(Controller[StampedParameters]):
    """Holds the pose; selected with `--controller benchmarks/stamped.py:Stamped --set control.path=FILE`."""

    Parameters = StampedParameters

    def __init__(self, robot: RobotDescription, parameters: StampedParameters) -> None:
        super().__init__(robot, parameters)
        self._hold = HoldPose(robot, NoParameters())
        self._file = open(parameters.path, "w", buffering=1, encoding="ascii")  # noqa: PTH123, SIM115 - open until the end

    def update(self, observation: Observation) -> ControllerCommand:
        """Return setpoints that hold the pose of the start, and write down the time."""
        command = self._hold.update(observation)
        self._file.write(f"{time.time():.6f}\n")
        return command
