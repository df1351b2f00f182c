"""A controller that holds the pose and writes the time of each finished command to a file."""

import time

from snakesim_gnc.control.controller import Action, View
from snakesim_gnc.control.hold import Hold
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description


class Stamped:
    """Holds the pose; selected with `--controller benchmarks/stamped.py:Stamped --set control.path=FILE`."""

    class Settings(FileStruct, frozen=True, kw_only=True):
        """The file that gets the times, one a line, in s since the epoch."""

        path: str

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._hold = Hold(robot, Hold.Settings())
        self._file = open(settings.path, "w", buffering=1, encoding="ascii")  # noqa: PTH123, SIM115 - open until the end

    def update(self, view: View) -> Action:
        """Return the pose of the start, and write down the time."""
        action = self._hold.update(view)
        self._file.write(f"{time.time():.6f}\n")
        return action
