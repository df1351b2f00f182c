"""A controller that holds the pose and writes down when it had each command ready."""

import time

from snakesim_gnc.control.controller import Action, View
from snakesim_gnc.control.hold import Hold
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description


class Stamped:
    """`--controller benchmarks/stamped.py:Stamped --set control.path=FILE`."""

    class Settings(FileStruct, frozen=True, kw_only=True):
        """Where to write to."""

        path: str

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._hold = Hold(robot, Hold.Settings())
        self._file = open(settings.path, "w", buffering=1, encoding="ascii")  # noqa: PTH123, SIM115 - open until the end

    def update(self, view: View) -> Action:
        """The pose of the start, for ever."""
        action = self._hold.update(view)
        self._file.write(f"{time.time():.6f}\n")
        return action
