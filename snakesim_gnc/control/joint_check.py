"""Joint check: moves one joint after another a little to one side, back, to the other side and back, from tail to head.

The other joints hold. The load of each gear reverses on the way, so that its backlash shows in the IMUs. Then the joint
makes a smaller and slower motion to both sides, twice. Within backlash, it needs no torque. `snakesim robot check`
evaluates afterwards what the motors, the encoders and the IMUs measured.
"""

from dataclasses import dataclass
from enum import Enum, auto
from typing import Annotated

from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    Observation,
    Telemetry,
    make_position_setpoints,
)
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import bounded

JOINT_LIMIT_MARGIN_RAD = 0.02  # between a target and the joint's limit


class _MotionPhase(Enum):
    """Phases of the motion of the joint under test."""

    REST = auto()
    MOVE_OUT = auto()
    MOVE_BACK = auto()


class JointCheckParameters(FileStruct, frozen=True):
    """How far, how fast, and when to give up."""

    move_rad: Annotated[float, bounded(0.01, 0.2, "rad")] = 0.06
    """Angle by which each joint moves to either side."""

    speed_rad_s: Annotated[float, bounded(0.02, 1.0, "rad/s")] = 0.3
    """Speed of a joint's target."""

    give_up_rad: Annotated[float, bounded(0.02, 0.5, "rad")] = 0.15
    """Distance of the target at which a joint that has not moved counts as stuck, and the next one follows."""

    rest_s: Annotated[float, bounded(0.02, 5.0, "s")] = 0.15
    """Rest before each of a joint's large motions, before its small motions, and after them."""

    small_move_rad: Annotated[float, bounded(0.001, 0.05, "rad")] = 0.005
    """Angle by which each joint then moves to either side, twice. Backlash of less than twice this angle is not found.
    """

    small_speed_rad_s: Annotated[float, bounded(0.01, 0.5, "rad/s")] = 0.06
    """Speed of a joint's target in the small motion, which is slow, so that inertia needs no torque."""


SMALL_MOTION_CYCLES = 2  # the first one moves the link to the middle of the backlash


@dataclass(frozen=True)
class _Motion:
    """A motion of the joint under test away from its start angle and back."""

    direction: int  # +1 or -1
    move_rad: float  # by its encoder
    speed_rad_s: float  # of its target
    rest_s: float  # before it


class JointCheck(Controller[JointCheckParameters]):
    """Moves each joint away from its nearer limit until its encoder shows the motion, and back; then the other way."""

    Parameters = JointCheckParameters
    needs_world = False

    def __init__(self, robot: RobotDescription, parameters: JointCheckParameters) -> None:
        """Create a controller that tests one joint after the other, beginning at the tail.

        Args:
            robot: Description of the robot, with the limits of the joints.
            parameters: How far and how fast each joint is moved.
        """
        super().__init__(robot, parameters)
        self._start_angles_rad: list[float] = []  # empty if there has been no observation yet

        # The joint under test.
        self._joint_index = 0
        # Motions that it still has to make, the current one first.
        self._remaining_motions: list[_Motion] = []
        # Measured before the motion; a drive without current may have let it sink.
        self._angle_before_motion_rad = 0.0

        # Its current motion.
        self._phase = _MotionPhase.REST
        self._rest_elapsed_s = 0.0
        self._target_offset_rad = 0.0  # between its target and its start angle

    def update(self, observation: Observation) -> ControllerCommand:
        """Return position targets that move the joint under test, while all others hold their start angles.

        Each joint in turn rests, moves out until its encoder shows the motion, and moves back; then in the other
        direction; then the same with a small motion. After the last joint, all joints hold.

        Args:
            observation: The inputs of this tick; the first one sets the start angles.

        Returns:
            Position setpoints of all joints, with telemetry that names the joint under test.
        """
        if not self._start_angles_rad:
            self._start_angles_rad = list(observation.joints.angle_rad)
            self._remaining_motions = self._plan_motions(self._joint_index)
        if self._joint_index == len(self.robot.joints):
            return self._hold_pose("every joint was moved")
        name = self.robot.joints[self._joint_index].name
        match self._phase:
            case _MotionPhase.REST:
                self._update_rest(observation)
                return self._hold_pose(f"resting beside the motion of {name}")
            case _MotionPhase.MOVE_OUT:
                self._move_out(observation)
            case _MotionPhase.MOVE_BACK:
                self._move_back(observation)
        # The call above may have ended the motion in the last direction of this joint; then the joint holds.
        targets_rad = list(self._start_angles_rad)
        if self._joint_index < len(targets_rad) and self._remaining_motions:
            targets_rad[self._joint_index] += (
                self._remaining_motions[0].direction * self._target_offset_rad
            )
        return ControllerCommand(
            make_position_setpoints(self.robot, targets_rad),
            Telemetry(reason=f"moving {name}", reference_rad=targets_rad),
        )

    def _hold_pose(self, reason: str) -> ControllerCommand:
        """Return setpoints that hold every joint at its start angle. The reason is reported as telemetry."""
        return ControllerCommand(
            make_position_setpoints(self.robot, self._start_angles_rad), Telemetry(reason=reason)
        )

    def _update_rest(self, observation: Observation) -> None:
        """Advance the rest before a motion; when the rest is over, start the next motion or select the next joint."""
        self._rest_elapsed_s += observation.period_s
        rest_s = self.parameters.rest_s
        if self._remaining_motions:
            rest_s = self._remaining_motions[0].rest_s
        if self._rest_elapsed_s < rest_s:
            return
        self._rest_elapsed_s = 0.0
        if not self._remaining_motions:
            self._start_joint(self._joint_index + 1)
            if self._joint_index == len(self.robot.joints):
                return
        self._angle_before_motion_rad = observation.joints.angle_rad[self._joint_index]
        self._phase = _MotionPhase.MOVE_OUT

    def _start_joint(self, joint_index: int) -> None:
        """Select the joint to test next. An index equal to the number of joints means that all have been tested."""
        self._joint_index = joint_index
        if joint_index < len(self.robot.joints):
            self._remaining_motions = self._plan_motions(joint_index)

    def _move_out(self, observation: Observation) -> None:
        """Move the target away from the start angle, and decide whether the joint has moved far enough or is stuck.

        A joint that has moved far enough moves back next. A joint whose target has reached the maximum offset without
        that counts as stuck: its target moves back, and that was its last motion.
        """
        motion = self._remaining_motions[0]
        self._target_offset_rad += motion.speed_rad_s * observation.period_s
        moved_rad = abs(
            observation.joints.angle_rad[self._joint_index] - self._angle_before_motion_rad
        )
        max_offset_rad = min(
            self.parameters.give_up_rad,
            self._compute_free_range_rad(self._joint_index, motion.direction),
        )
        if moved_rad >= motion.move_rad:
            self._phase = _MotionPhase.MOVE_BACK
        elif self._target_offset_rad >= max_offset_rad:
            # A joint that does not follow is not moved again.
            del self._remaining_motions[1:]
            self._phase = _MotionPhase.MOVE_BACK

    def _move_back(self, observation: Observation) -> None:
        """Move the target back towards the start angle; there, the motion in this direction is complete."""
        self._target_offset_rad -= self._remaining_motions[0].speed_rad_s * observation.period_s
        if self._target_offset_rad <= 0:
            self._target_offset_rad = 0.0
            del self._remaining_motions[0]
            self._phase = _MotionPhase.REST

    def _plan_motions(self, joint_index: int) -> list[_Motion]:
        """Return the motions of a joint in order: large ones, then small ones, first away from its nearer limit.

        The other direction is left out if the joint has too little range in it.
        """
        parameters = self.parameters
        directions = self._plan_directions(joint_index)
        motions = [
            _Motion(direction, parameters.move_rad, parameters.speed_rad_s, parameters.rest_s)
            for direction in directions
        ]
        rest_s = parameters.rest_s
        for _ in range(SMALL_MOTION_CYCLES):
            for direction in directions:
                motions.append(
                    _Motion(
                        direction, parameters.small_move_rad, parameters.small_speed_rad_s, rest_s
                    )
                )
                rest_s = 0.0
        return motions

    def _plan_directions(self, joint_index: int) -> list[int]:
        """Return the directions in which a joint is moved, +1 or -1, in order."""
        limits = self.robot.joints[joint_index]
        is_nearer_to_minimum = (
            2 * self._start_angles_rad[joint_index] <= limits.angle_min_rad + limits.angle_max_rad
        )
        away_direction = 1 if is_nearer_to_minimum else -1
        has_room = (
            self._compute_free_range_rad(joint_index, -away_direction)
            > self.parameters.move_rad + JOINT_LIMIT_MARGIN_RAD
        )
        if has_room:
            return [away_direction, -away_direction]
        return [away_direction]

    def _compute_free_range_rad(self, joint_index: int, direction: int) -> float:
        """Return the angle in rad by which a joint's target may move from its start angle in a direction, +1 or -1."""
        limits = self.robot.joints[joint_index]
        start_rad = self._start_angles_rad[joint_index]
        if direction > 0:
            return limits.angle_max_rad - start_rad - JOINT_LIMIT_MARGIN_RAD
        return start_rad - limits.angle_min_rad - JOINT_LIMIT_MARGIN_RAD
