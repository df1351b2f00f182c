"""Holds every joint at its angle at arming. This is the control condition of experiments, and the safest controller."""

from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description


class Hold:
    """Keeps the pose of the first view."""

    NEEDS = "joints"

    class Settings(FileStruct, frozen=True):
        """No settings."""

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._robot = robot
        self._angles_rad: list[float] | None = None  # None: there has been no view yet

    def update(self, view: View) -> Action:
        """Return the angles of the first view."""
        if self._angles_rad is None:
            self._angles_rad = list(view.joints.angle_rad)
        return Action(positions(self._robot, self._angles_rad), Report(why="holding", reference_rad=self._angles_rad))
