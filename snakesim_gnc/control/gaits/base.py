"""What all gaits share: a phase that grows while motion is requested, and a reference of all joints at that phase."""

import math
from abc import abstractmethod
from typing import Annotated, ClassVar, TypeVar

import numpy as np

from snakesim_gnc.control.bumpless import BumplessFollower
from snakesim_gnc.control.gaits.body_curve import DIRECTIONS
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import (
    Controller,
    ControllerCommand,
    Observation,
    Telemetry,
    is_motion_requested,
)
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Axis, RobotDescription
from snakesim_hal.wire.quantities import above

Seconds = Annotated[float, above(100, "s")]


class GaitParameters(FileStruct, frozen=True, kw_only=True):
    """Parameters that all gaits have; each declares them again, with its own default."""

    period_s: Seconds
    blend_s: Seconds


GaitParametersT = TypeVar("GaitParametersT", bound=GaitParameters)


class Gait(Controller[GaitParametersT]):
    """A reference over time, which the joints follow without a jump.

    The phase grows by 2 pi in each period while motion is requested, and shrinks at a negative speed. A subclass
    computes the reference from the phase.
    """

    _required_axes: ClassVar[tuple[Axis, ...]] = ("pitch", "yaw")
    """Axes of which the robot needs a joint. A robot without one holds its pose and reports the reason."""

    _no_travel_reason: ClassVar[str] = ""
    """Why the gait does not travel; empty for a gait that travels."""

    _blends_after_hold: ClassVar[bool] = True
    """Whether the command changes smoothly to the reference after the robot has held its pose.

    False: at once, so that only the command limiter smooths it.
    """

    def __init__(self, robot: RobotDescription, parameters: GaitParametersT) -> None:
        super().__init__(robot, parameters)
        self._bumpless_follower = BumplessFollower(robot, parameters.blend_s)
        self._phase_rad = 0.0
        self._is_holding = False  # in the tick before
        self._hold_reason = explain_missing_joints(robot, self._required_axes)

    def update(self, observation: Observation) -> ControllerCommand:
        """Advance the gait while motion is requested; a robot without the necessary joints holds its pose."""
        if self._hold_reason or not is_motion_requested(observation):
            return self.hold_and_report(observation, self._hold_reason)
        phase_step_rad = math.tau * observation.period_s / self.parameters.period_s
        self._phase_rad += get_travel_sign(observation) * phase_step_rad
        reference_rad = self.compute_reference_rad(observation, self._phase_rad)
        may_have_jumped = self._is_holding and self._blends_after_hold
        self._is_holding = False
        setpoints = self._bumpless_follower.make_setpoints(
            observation, reference_rad, may_have_jumped=may_have_jumped
        )
        telemetry = Telemetry(
            reason=self._no_travel_reason,
            reference_rad=reference_rad.tolist(),
            custom=self.list_custom_telemetry(),
        )
        return ControllerCommand(setpoints, telemetry)

    def hold_and_report(self, observation: Observation, reason: str) -> ControllerCommand:
        """Keep every joint at its last reference, or at its measured angle if it had none, and report the reason."""
        self._is_holding = True
        return self._bumpless_follower.hold_pose(observation, reason)

    @abstractmethod
    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        """Compute the reference angles of all joints at a phase. It is called once a tick.

        Args:
            observation: The inputs of this tick.
            phase_rad: Phase of the gait, which grows by 2 pi in each period.

        Returns:
            (n_joints,) angles in rad, tail to head.
        """

    def list_custom_telemetry(self) -> dict[str, float]:
        """Return additional values of this tick for the telemetry, by names that end in the unit."""
        return {}

    def find_joints(self, axis: Axis) -> list[int]:
        """Return the indices of all joints with an axis, tail to head."""
        return [i for i, joint in enumerate(self.robot.joints) if joint.axis == axis]

    def make_straight_angles_rad(self) -> Floats:
        """Return the angles of a straight body, (n_joints,)."""
        return np.zeros(len(self.robot.joints))


def get_travel_sign(observation: Observation) -> float:
    """Return 1.0 for a trajectory that leads forward, and -1.0 for one that leads backward."""
    if observation.trajectory is None:
        return 1.0
    return math.copysign(1.0, observation.trajectory.speed_m_s)


def explain_missing_joints(robot: RobotDescription, required_axes: tuple[Axis, ...]) -> str:
    """Return why a robot cannot move by a gait that needs joints with these axes; empty if it can."""
    available_axes = {joint.axis for joint in robot.joints}
    directions = [DIRECTIONS[axis] for axis in required_axes if axis not in available_axes]
    if not directions:
        return ""
    return f"this robot has no joints that turn {' and '.join(directions)}"
