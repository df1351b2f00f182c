"""Joint check: moves one joint after another a little and back, from tail to head, while the others hold.

What the motors, the encoders and the IMUs say of it is judged afterwards, from the record: `snakesim joints check`.
"""

from typing import Annotated

from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import about, bounded

MARGIN_RAD = 0.02  # left before a limit


class JointCheck:
    """Each joint towards the middle of its range, until its encoder says that it moved, and back."""

    NEEDS = "joints"

    class Settings(FileStruct, frozen=True):
        """How far, how fast, and when to give up."""

        move_rad: Annotated[float, bounded(0.01, 0.2, "rad"), about("how far each joint moves")] = 0.035
        speed_rad_s: Annotated[float, bounded(0.02, 1.0, "rad/s"), about("of a target")] = 0.15
        give_up_rad: Annotated[
            float,
            bounded(0.02, 0.5, "rad"),
            about("a joint that has not moved when its target is so far away is left, and the next one follows"),
        ] = 0.15
        rest_s: Annotated[float, bounded(0.02, 5.0, "s"), about("between two joints")] = 0.15

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._robot, self._settings = robot, settings
        self._start_rad: list[float] = []
        self._before_rad = 0.0  # of the joint whose turn it is: without current, it may not be where it was
        self._joint = 0
        self._offset_rad, self._out, self._rest_s = 0.0, True, settings.rest_s

    def update(self, view: View) -> Action:
        """The next target of the joint whose turn it is."""
        if not self._start_rad:
            self._start_rad = list(view.joints.angle_rad)
        joints, target = self._robot.joints, list(self._start_rad)
        if self._joint == len(joints):
            return Action(positions(self._robot, target), Report(why="every joint was moved"))
        name = joints[self._joint].name
        if self._rest_s > 0:
            self._rest_s -= view.period_s
            self._before_rad = view.joints.angle_rad[self._joint]
            return Action(positions(self._robot, target), Report(why=f"resting before {name}"))
        target[self._joint] += self._away() * self._advance(view)
        return Action(positions(self._robot, target), Report(why=f"moving {name}", reference_rad=target))

    def _away(self) -> int:
        """The direction that leads further from the nearer limit."""
        joint = self._robot.joints[self._joint]
        return 1 if 2 * self._start_rad[self._joint] <= joint.angle_min_rad + joint.angle_max_rad else -1

    def _advance(self, view: View) -> float:
        """The offset of the next tick; passes on to the next joint when it is back."""
        settings, joint, start_rad = self._settings, self._robot.joints[self._joint], self._start_rad[self._joint]
        room_rad = (
            joint.angle_max_rad - start_rad if self._away() > 0 else start_rad - joint.angle_min_rad
        ) - MARGIN_RAD
        step_rad = settings.speed_rad_s * view.period_s
        if self._out:
            self._offset_rad += step_rad
            moved = abs(view.joints.angle_rad[self._joint] - self._before_rad) >= settings.move_rad
            self._out = not moved and self._offset_rad < min(settings.give_up_rad, room_rad - MARGIN_RAD)
        else:
            self._offset_rad -= step_rad
            if self._offset_rad <= 0:
                self._joint, self._offset_rad, self._out = self._joint + 1, 0.0, True
                self._rest_s = settings.rest_s
        return self._offset_rad
