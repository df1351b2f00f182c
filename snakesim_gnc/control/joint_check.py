"""Joint check: moves one joint after another a little to one side, back, to the other side and back, from tail to head.

The other joints hold. The load of each gear reverses on the way, so that its backlash shows. `snakesim robot check`
evaluates afterwards what the motors, the encoders and the IMUs measured.
"""

from enum import Enum, auto
from typing import Annotated

from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry, positions
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import bounded

MARGIN_RAD = 0.02  # between a target and the joint's limit


class _Phase(Enum):
    """What the joint that is under test does."""

    REST = auto()
    OUT = auto()
    BACK = auto()


class JointCheckParameters(FileStruct, frozen=True):
    """How far, how fast, and when to give up."""

    move_rad: Annotated[float, bounded(0.01, 0.2, "rad")] = 0.06
    """Angle by which each joint moves to either side."""

    speed_rad_s: Annotated[float, bounded(0.02, 1.0, "rad/s")] = 0.3
    """Speed of a joint's target."""

    give_up_rad: Annotated[float, bounded(0.02, 0.5, "rad")] = 0.15
    """Distance of the target at which a joint that has not moved counts as stuck, and the next one follows."""

    rest_s: Annotated[float, bounded(0.02, 5.0, "s")] = 0.15
    """Rest before each of a joint's two motions, and after them."""


class JointCheck(Controller[JointCheckParameters]):
    """Moves each joint away from its nearer limit until its encoder shows the motion, and back; then the other way."""

    Parameters = JointCheckParameters
    needs_world = False

    def __init__(self, robot: Description, parameters: JointCheckParameters) -> None:
        super().__init__(robot, parameters)
        self._start_rad: list[float] = []  # empty: there has been no observation yet

        # The joint under test.
        self._joint = 0
        self._sides: list[int] = []  # the sides to which it still has to move: +1, -1
        self._before_rad = 0.0  # measured before the motion; a drive without current may have let it sink

        # Its present motion.
        self._phase = _Phase.REST
        self._rested_s = 0.0
        self._offset_rad = 0.0  # between its target and its start angle

    def update(self, observation: Observation) -> ControllerCommand:
        """Return position targets that move the joint under test, while all others hold their start angles.

        Each joint in turn rests, moves out until its encoder shows the motion, and moves back; then the same to the
        other side. After the last joint, all joints hold.

        Args:
            observation: the inputs of this tick; the first one sets the start angles.

        Returns:
            Position setpoints of all joints, with a telemetry that names the joint under test.
        """
        if not self._start_rad:
            self._start_rad = list(observation.joints.angle_rad)
            self._sides = self._plan_sides(self._joint)
        if self._joint == len(self.robot.joints):
            return self._hold_pose("every joint was moved")
        name = self.robot.joints[self._joint].name
        match self._phase:
            case _Phase.REST:
                self._update_rest(observation)
                return self._hold_pose(f"resting beside the motion of {name}")
            case _Phase.OUT:
                self._move_out(observation)
            case _Phase.BACK:
                self._move_back(observation)
        targets = list(self._start_rad)
        if self._joint < len(targets) and self._sides:
            targets[self._joint] += self._sides[0] * self._offset_rad
        return ControllerCommand(
            positions(self.robot, targets), Telemetry(reason=f"moving {name}", reference_rad=targets)
        )

    def _hold_pose(self, why: str) -> ControllerCommand:
        return ControllerCommand(positions(self.robot, self._start_rad), Telemetry(reason=why))

    def _update_rest(self, observation: Observation) -> None:
        """Wait before a motion, and after the last one of a joint."""
        self._rested_s += observation.period_s
        if self._rested_s < self.parameters.rest_s:
            return
        self._rested_s = 0.0
        if not self._sides:
            self._begin_joint(self._joint + 1)
            if self._joint == len(self.robot.joints):
                return
        self._before_rad = observation.joints.angle_rad[self._joint]
        self._phase = _Phase.OUT

    def _begin_joint(self, joint: int) -> None:
        """Test another joint; the number of joints means that all have been tested."""
        self._joint = joint
        if joint < len(self.robot.joints):
            self._sides = self._plan_sides(joint)

    def _move_out(self, observation: Observation) -> None:
        """Move the target further until the joint has moved as far as it should, or does not follow."""
        parameters = self.parameters
        self._offset_rad += parameters.speed_rad_s * observation.period_s
        moved_rad = abs(observation.joints.angle_rad[self._joint] - self._before_rad)
        furthest_rad = min(parameters.give_up_rad, self._room_rad(self._joint, self._sides[0]))
        if moved_rad >= parameters.move_rad:
            self._phase = _Phase.BACK
        elif self._offset_rad >= furthest_rad:
            # A joint that does not follow is not moved to the other side.
            del self._sides[1:]
            self._phase = _Phase.BACK

    def _move_back(self, observation: Observation) -> None:
        """Move the target back to the start angle."""
        self._offset_rad -= self.parameters.speed_rad_s * observation.period_s
        if self._offset_rad <= 0:
            self._offset_rad = 0.0
            del self._sides[0]
            self._phase = _Phase.REST

    def _plan_sides(self, joint: int) -> list[int]:
        """Return the sides to which a joint moves: first away from the nearer limit, then back if there is room."""
        limits = self.robot.joints[joint]
        is_nearer_to_minimum = 2 * self._start_rad[joint] <= limits.angle_min_rad + limits.angle_max_rad
        away = 1 if is_nearer_to_minimum else -1
        has_room = self._room_rad(joint, -away) > self.parameters.move_rad + MARGIN_RAD
        if has_room:
            return [away, -away]
        return [away]

    def _room_rad(self, joint: int, side: int) -> float:
        """Return how far a joint's target may move from its start angle to a side."""
        limits = self.robot.joints[joint]
        start_rad = self._start_rad[joint]
        if side > 0:
            return limits.angle_max_rad - start_rad - MARGIN_RAD
        return start_rad - limits.angle_min_rad - MARGIN_RAD
