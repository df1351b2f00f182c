"""Joint check: moves one joint after another a little to one side, back, to the other side and back, from tail to head.

The other joints hold. The load of each gear reverses on the way, so that its backlash shows. `snakesim robot check`
evaluates afterwards what the motors, the encoders and the IMUs measured.
"""

from enum import Enum, auto
from typing import Annotated

from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import about, bounded

MARGIN_RAD = 0.02  # between a target and the joint's limit


class _Phase(Enum):
    """What the joint that is under test does."""

    REST = auto()
    OUT = auto()
    BACK = auto()


class JointCheck:
    """Moves each joint away from its nearer limit until its encoder shows the motion, and back; then the other way."""

    NEEDS = "joints"

    class Settings(FileStruct, frozen=True):
        """How far, how fast, and when to give up."""

        move_rad: Annotated[float, bounded(0.01, 0.2, "rad"), about("how far each joint moves to either side")] = 0.06
        speed_rad_s: Annotated[float, bounded(0.02, 1.0, "rad/s"), about("speed of a target")] = 0.3
        give_up_rad: Annotated[
            float,
            bounded(0.02, 0.5, "rad"),
            about("a joint that has not moved when its target is so far away is left, and the next one follows"),
        ] = 0.15
        rest_s: Annotated[
            float, bounded(0.02, 5.0, "s"), about("rest before each of its two motions, and after them")
        ] = 0.15

    def __init__(self, robot: Description, settings: Settings) -> None:
        self._robot = robot
        self._settings = settings
        self._start_rad: list[float] = []  # empty: there has been no view yet

        # The joint under test.
        self._joint = 0
        self._sides: list[int] = []  # the sides to which it still has to move: +1, -1
        self._before_rad = 0.0  # measured before the motion; a drive without current may have let it sink

        # Its present motion.
        self._phase = _Phase.REST
        self._rested_s = 0.0
        self._offset_rad = 0.0  # between its target and its start angle

    def update(self, view: View) -> Action:
        """Return the next target of the joint under test; all others hold."""
        if not self._start_rad:
            self._start_rad = list(view.joints.angle_rad)
            self._sides = self._plan_sides(self._joint)
        if self._joint == len(self._robot.joints):
            return self._hold("every joint was moved")
        name = self._robot.joints[self._joint].name
        match self._phase:
            case _Phase.REST:
                self._rest(view)
                return self._hold(f"resting beside the motion of {name}")
            case _Phase.OUT:
                self._move_out(view)
            case _Phase.BACK:
                self._move_back(view)
        targets = list(self._start_rad)
        if self._joint < len(targets) and self._sides:
            targets[self._joint] += self._sides[0] * self._offset_rad
        return Action(positions(self._robot, targets), Report(why=f"moving {name}", reference_rad=targets))

    def _hold(self, why: str) -> Action:
        return Action(positions(self._robot, self._start_rad), Report(why=why))

    def _rest(self, view: View) -> None:
        """Wait before a motion, and after the last one of a joint."""
        self._rested_s += view.period_s
        if self._rested_s < self._settings.rest_s:
            return
        self._rested_s = 0.0
        if not self._sides:
            self._begin_joint(self._joint + 1)
            if self._joint == len(self._robot.joints):
                return
        self._before_rad = view.joints.angle_rad[self._joint]
        self._phase = _Phase.OUT

    def _begin_joint(self, joint: int) -> None:
        """Test another joint; the number of joints means that all have been tested."""
        self._joint = joint
        if joint < len(self._robot.joints):
            self._sides = self._plan_sides(joint)

    def _move_out(self, view: View) -> None:
        """Move the target further until the joint has moved as far as it should, or does not follow."""
        settings = self._settings
        self._offset_rad += settings.speed_rad_s * view.period_s
        moved_rad = abs(view.joints.angle_rad[self._joint] - self._before_rad)
        furthest_rad = min(settings.give_up_rad, self._room_rad(self._joint, self._sides[0]))
        if moved_rad >= settings.move_rad:
            self._phase = _Phase.BACK
        elif self._offset_rad >= furthest_rad:
            # A joint that does not follow is not moved to the other side.
            del self._sides[1:]
            self._phase = _Phase.BACK

    def _move_back(self, view: View) -> None:
        """Move the target back to the start angle."""
        self._offset_rad -= self._settings.speed_rad_s * view.period_s
        if self._offset_rad <= 0:
            self._offset_rad = 0.0
            del self._sides[0]
            self._phase = _Phase.REST

    def _plan_sides(self, joint: int) -> list[int]:
        """Return the sides to which a joint moves: first away from the nearer limit, then back if there is room."""
        limits = self._robot.joints[joint]
        is_nearer_to_minimum = 2 * self._start_rad[joint] <= limits.angle_min_rad + limits.angle_max_rad
        away = 1 if is_nearer_to_minimum else -1
        has_room = self._room_rad(joint, -away) > self._settings.move_rad + MARGIN_RAD
        if has_room:
            return [away, -away]
        return [away]

    def _room_rad(self, joint: int, side: int) -> float:
        """Return how far a joint's target may move from its start angle to a side."""
        limits = self._robot.joints[joint]
        start_rad = self._start_rad[joint]
        if side > 0:
            return limits.angle_max_rad - start_rad - MARGIN_RAD
        return start_rad - limits.angle_min_rad - MARGIN_RAD
