"""Gaits in three dimensions, for robots whose joints are yaw and pitch joints in alternation. They use no map.

All are sums of two waves, one of the yaw joints and one of the pitch joints (Tesch et al. 2009). Sidewinding lifts
parts of the body over while others rest on the ground. Rolling turns a bent body about its own axis. A raised head
bends its last pitch joints up, and looks around.
"""

import math
from typing import Annotated, TypeVar

import numpy as np

from snakesim_gnc.control.bumpless import BumplessReference
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Controller, ControllerCommand, Observation, Telemetry, is_motion_requested
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import above, bounded, from_zero

Swing = Annotated[float, bounded(-2, 2, "rad")]
Lag = Annotated[float, bounded(-3.2, 3.2, "rad")]
Seconds = Annotated[float, above(100, "s")]


class GaitParameters(FileStruct, frozen=True, kw_only=True):
    """Parameters that all gaits have; each declares them again, with its own default."""

    period_s: Seconds
    blend_s: Seconds


GaitParametersT = TypeVar("GaitParametersT", bound=GaitParameters)


class _Gait(Controller[GaitParametersT]):
    """A reference over time for yaw and pitch joints, which the joints follow without a jump.

    A subclass computes the reference from the phase of the gait.
    """

    _reason_to_stay = ""  # why the gait does not travel; empty for a gait that travels

    def __init__(self, robot: Description, parameters: GaitParametersT) -> None:
        super().__init__(robot, parameters)
        self._bumpless = BumplessReference(robot, parameters.blend_s)
        self._phase_rad = 0.0

        # Indices of the joints.
        axes = [joint.axis for joint in robot.joints]
        self._yaw = [i for i, axis in enumerate(axes) if axis == "yaw"]
        self._pitch = [i for i, axis in enumerate(axes) if axis == "pitch"]
        self._from_head = np.arange(len(axes))[::-1]  # (n_joints,), 0 at the head

        self._missing = _explain_missing_joints(self._yaw, self._pitch)

    def update(self, observation: Observation) -> ControllerCommand:
        """Advance the gait while motion is requested; a robot without the necessary joints holds its pose."""
        if self._missing or not is_motion_requested(observation):
            return self._bumpless.hold_pose(observation, self._missing)
        self._phase_rad += math.tau * observation.period_s / self.parameters.period_s
        reference_rad = np.zeros(len(self._from_head))
        self._shape(reference_rad, self._phase_rad)
        setpoints = self._bumpless.follow(observation, reference_rad)
        return ControllerCommand(
            setpoints, Telemetry(reason=self._reason_to_stay, reference_rad=reference_rad.tolist())
        )

    def _shape(self, reference_rad: Floats, phase_rad: float) -> None:
        """Write the angles of all joints, (n_joints,), into an array of zeros."""
        raise NotImplementedError

    def _wave(self, joints: list[int], phase_rad: float, lag_rad: float) -> Floats:
        """Return sin(phase - lag n) for joints that are n joints behind the head, (len(joints),).

        The wave travels from the head to the tail.
        """
        return np.sin(phase_rad - lag_rad * self._from_head[joints])


def _explain_missing_joints(yaw: list[int], pitch: list[int]) -> str:
    """Return why a robot cannot move in three dimensions; empty if it can."""
    directions: list[str] = []
    if not pitch:
        directions.append("up and down")
    if not yaw:
        directions.append("left and right")
    if not directions:
        return ""
    return f"this robot has no joints that turn {' and '.join(directions)}"


class SidewindingParameters(GaitParameters, frozen=True, kw_only=True):
    """Two waves, a quarter of a period apart; a negative `pitch_rad` travels to the other side."""

    yaw_rad: Swing = 0.6
    """Amplitude of the joints that turn left and right."""

    pitch_rad: Swing = 0.2
    """Amplitude of the joints that turn up and down; negative: the robot travels to the other side."""

    lag_rad: Lag = 0.45
    """Phase of a joint behind the one ahead of it."""

    period_s: Seconds = 2.0
    """Period of the wave."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


class Sidewinding(_Gait[SidewindingParameters]):
    """Travels sideways, by a yaw wave and a pitch wave that leads by a quarter of a period.

    A joint n joints behind the head has, at phase phi and with the lag beta, the angle

        yaw joints     yaw_rad   sin(phi - beta n)
        pitch joints   pitch_rad sin(phi + pi/2 - beta n)
    """

    Parameters = SidewindingParameters

    def _shape(self, reference_rad: Floats, phase_rad: float) -> None:
        lag_rad = self.parameters.lag_rad
        reference_rad[self._yaw] = self.parameters.yaw_rad * self._wave(self._yaw, phase_rad, lag_rad)
        reference_rad[self._pitch] = self.parameters.pitch_rad * self._wave(
            self._pitch, phase_rad + 0.5 * math.pi, lag_rad
        )


class RollingParameters(GaitParameters, frozen=True, kw_only=True):
    """The arc; a negative `bend_rad` of the pitch joints rolls to the other side."""

    bend_rad: Swing = 0.25
    """Bend of every joint; negative: the robot rolls to the other side."""

    period_s: Seconds = 2.0
    """Time of one revolution."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


class Rolling(_Gait[RollingParameters]):
    """Rolls sideways: the body lies in an arc that turns about its own axis.

    All yaw joints have the angle |bend_rad| sin(phi), and all pitch joints bend_rad cos(phi), at phase phi.
    """

    Parameters = RollingParameters

    def _shape(self, reference_rad: Floats, phase_rad: float) -> None:
        reference_rad[self._yaw] = abs(self.parameters.bend_rad) * math.sin(phase_rad)
        reference_rad[self._pitch] = self.parameters.bend_rad * math.cos(phase_rad)


class RaisedHeadParameters(GaitParameters, frozen=True, kw_only=True):
    """How high, and how far to each side."""

    lift_rad: Annotated[float, from_zero(1.5, "rad")] = 0.6
    """Angle of the joint that lifts the head."""

    look_rad: Swing = 0.4
    """Angle by which the foremost yaw joint looks to each side."""

    stance_rad: Swing = 0.5
    """Amplitude of the wave in which the body behind lies."""

    lag_rad: Lag = 0.6
    """Phase of that wave from joint to joint."""

    period_s: Seconds = 6.0
    """Time for looking to both sides."""

    blend_s: Seconds = 2.0
    """Time over which the command changes smoothly to a new reference."""


class RaisedHead(_Gait[RaisedHeadParameters]):
    """Lifts its head by one pitch joint, keeps it level by the next, and looks left and right.

    The body behind lies in a wave of its yaw joints, because a straight round body would roll over.
    """

    _reason_to_stay = "it lifts its head, looks around, and travels nowhere"

    Parameters = RaisedHeadParameters

    def _shape(self, reference_rad: Floats, phase_rad: float) -> None:
        # Positive pitch bends the head down. With one pitch joint only, nothing keeps the head level.
        lift_joint = self._pitch[0] if len(self._pitch) == 1 else self._pitch[-2]
        if len(self._pitch) > 1:
            reference_rad[self._pitch[-1]] = self.parameters.lift_rad
        reference_rad[lift_joint] = -self.parameters.lift_rad
        reference_rad[self._yaw] = self.parameters.stance_rad * self._wave(self._yaw, 0.0, self.parameters.lag_rad)
        foremost_yaw_joint = self._yaw[-1]
        reference_rad[foremost_yaw_joint] = self.parameters.look_rad * math.sin(phase_rad)
