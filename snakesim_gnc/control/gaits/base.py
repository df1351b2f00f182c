"""What all gaits share: a phase that grows while motion is requested, and a reference of all joints at that phase."""

import math
from abc import abstractmethod
from typing import Annotated, ClassVar, TypeVar

import numpy as np

from snakesim_gnc.control.bumpless import BumplessReference
from snakesim_gnc.control.gaits.body_curve import DIRECTIONS
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry, is_motion_requested
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Axis, Description
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

    _reason_to_stay: ClassVar[str] = ""
    """Why the gait does not travel; empty for a gait that travels."""

    _blends_after_hold: ClassVar[bool] = True
    """Whether the command changes smoothly to the reference after the robot has held its pose.

    False: at once, so that only the command limiter smooths it.
    """

    def __init__(self, robot: Description, parameters: GaitParametersT) -> None:
        super().__init__(robot, parameters)
        self._bumpless = BumplessReference(robot, parameters.blend_s)
        self._phase_rad = 0.0
        self._holding = False  # in the tick before
        self._reason_to_hold = explain_missing_joints(robot, self._required_axes)

    def update(self, observation: Observation) -> ControllerCommand:
        """Advance the gait while motion is requested; a robot without the necessary joints holds its pose."""
        if self._reason_to_hold or not is_motion_requested(observation):
            return self.hold(observation, self._reason_to_hold)
        passed_rad = math.tau * observation.period_s / self.parameters.period_s
        self._phase_rad += find_travel_sign(observation) * passed_rad
        reference_rad = self.find_reference_rad(observation, self._phase_rad)
        restarted = self._holding and self._blends_after_hold
        self._holding = False
        setpoints = self._bumpless.follow(observation, reference_rad, restarted=restarted)
        telemetry = Telemetry(
            reason=self._reason_to_stay, reference_rad=reference_rad.tolist(), custom=self.list_custom_numbers()
        )
        return ControllerCommand(setpoints, telemetry)

    def hold(self, observation: Observation, reason: str) -> ControllerCommand:
        """Keep every joint at its last reference, or at its pose if there was none. The reason is reported."""
        self._holding = True
        return self._bumpless.hold_pose(observation, reason)

    @abstractmethod
    def find_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        """Return the angles of all joints, (n_joints,) tail to head, at a phase. It is called once a tick."""

    def list_custom_numbers(self) -> dict[str, float]:
        """Return numbers of this tick for the telemetry, by names that end in their unit."""
        return {}

    def find_joints(self, axis: Axis) -> list[int]:
        """Return the indices of all joints with an axis, tail to head."""
        return [i for i, joint in enumerate(self.robot.joints) if joint.axis == axis]

    def make_straight(self) -> Floats:
        """Return the angles of a straight body, (n_joints,)."""
        return np.zeros(len(self.robot.joints))


def find_travel_sign(observation: Observation) -> float:
    """Return 1.0 for a trajectory that leads forward, and -1.0 for one that leads backward."""
    if observation.trajectory is None:
        return 1.0
    return math.copysign(1.0, observation.trajectory.speed_m_s)


def explain_missing_joints(robot: Description, required_axes: tuple[Axis, ...]) -> str:
    """Return why a robot cannot move by a gait that needs joints with these axes; empty if it can."""
    present = {joint.axis for joint in robot.joints}
    directions = [DIRECTIONS[axis] for axis in required_axes if axis not in present]
    if not directions:
        return ""
    return f"this robot has no joints that turn {' and '.join(directions)}"
