"""Hold: every joint stays at its angle at arming. The control experiment, and the safest controller."""

from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description


class Hold:
    """Keeps the pose."""

    NEEDS = "joints"

    class Settings(FileStruct, frozen=True):
        """No settings."""

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._robot = robot
        self._angles_rad: list[float] | None = None

    def update(self, view: View) -> Action:
        """The angles of the first view, for ever."""
        if self._angles_rad is None:
            self._angles_rad = list(view.joints.angle_rad)
        return Action(positions(self._robot, self._angles_rad), Report(why="holding", reference_rad=self._angles_rad))
