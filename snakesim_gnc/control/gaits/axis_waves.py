"""Gaits as waves of the joints, for robots whose joints are yaw and pitch joints in alternation. They use no map.

All are sums of two waves, one of the yaw joints and one of the pitch joints (Tesch et al. 2009). Sidewinding lifts
parts of the body over while others rest on the ground. Rolling turns a bent body about its own axis. A raised head
bends its last pitch joints up, and looks around.
"""

import math
from typing import Annotated

import numpy as np

from snakesim_gnc.control.gaits.base import Gait, GaitParameters, GaitParametersT, Seconds
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import RobotDescription
from snakesim_hal.wire.quantities import bounded, from_zero

Swing = Annotated[float, bounded(-2, 2, "rad")]
Lag = Annotated[float, bounded(-3.2, 3.2, "rad")]


class _WaveGait(Gait[GaitParametersT]):
    """A gait whose waves have a lag from joint to joint."""

    _blends_after_hold = False  # the digests of recorded runs depend on it

    def __init__(self, robot: RobotDescription, parameters: GaitParametersT) -> None:
        super().__init__(robot, parameters)
        self._yaw_joints = self.find_joints("yaw")
        self._pitch_joints = self.find_joints("pitch")
        self._joints_from_head = np.arange(len(robot.joints))[::-1]  # (n_joints,), 0 at the head

    def _compute_wave(self, joints: list[int], phase_rad: float, lag_rad: float) -> Floats:
        """Compute sin(phase - lag n) for joints that are n joints behind the head; this wave travels to the tail.

        Args:
            joints: Indices of the joints, from the tail.
            phase_rad: Phase of the wave at the head.
            lag_rad: Phase of a joint behind the joint ahead of it.

        Returns:
            (len(joints),) values from -1 to 1.
        """
        return np.sin(phase_rad - lag_rad * self._joints_from_head[joints])


class SidewindingParameters(GaitParameters, frozen=True, kw_only=True):
    """Two waves, a quarter of a period apart. A negative `pitch_rad` travels to the other side."""

    yaw_rad: Swing = 0.6
    """Amplitude of the joints that turn left and right."""

    pitch_rad: Swing = 0.2
    """Amplitude of the joints that turn up and down. Negative: the robot travels to the other side."""

    lag_rad: Lag = 0.45
    """Phase of a joint behind the one ahead of it."""

    period_s: Seconds = 2.0
    """Period of the wave."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


class Sidewinding(_WaveGait[SidewindingParameters]):
    """Travels sideways, by a yaw wave and a pitch wave that leads by a quarter of a period.

    A joint n joints behind the head has, at phase phi and with the lag beta, the angle

        yaw joints     yaw_rad   sin(phi - beta n)
        pitch joints   pitch_rad sin(phi + pi/2 - beta n)
    """

    Parameters = SidewindingParameters

    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        reference_rad = self.make_straight_angles_rad()
        lag_rad = self.parameters.lag_rad
        reference_rad[self._yaw_joints] = self.parameters.yaw_rad * self._compute_wave(
            self._yaw_joints, phase_rad, lag_rad
        )
        reference_rad[self._pitch_joints] = self.parameters.pitch_rad * self._compute_wave(
            self._pitch_joints, phase_rad + 0.5 * math.pi, lag_rad
        )
        return reference_rad


class RollingParameters(GaitParameters, frozen=True, kw_only=True):
    """The arc. A negative `bend_rad` of the pitch joints rolls to the other side."""

    bend_rad: Swing = 0.25
    """Bend of every joint. Negative: the robot rolls to the other side."""

    period_s: Seconds = 2.0
    """Time of one revolution."""

    blend_s: Seconds = 1.0
    """Time over which the command changes smoothly to a new reference."""


class Rolling(_WaveGait[RollingParameters]):
    """Rolls sideways: the body lies in an arc that turns about its own axis.

    All yaw joints have the angle |bend_rad| sin(phi), and all pitch joints bend_rad cos(phi), at phase phi.
    """

    Parameters = RollingParameters

    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        reference_rad = self.make_straight_angles_rad()
        reference_rad[self._yaw_joints] = abs(self.parameters.bend_rad) * math.sin(phase_rad)
        reference_rad[self._pitch_joints] = self.parameters.bend_rad * math.cos(phase_rad)
        return reference_rad


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


class RaisedHead(_WaveGait[RaisedHeadParameters]):
    """Lifts its head by one pitch joint, keeps it level by the next, and looks left and right.

    The body behind lies in a wave of its yaw joints, because a straight round body would roll over.
    """

    _no_travel_reason = "it lifts its head, looks around, and travels nowhere"

    Parameters = RaisedHeadParameters

    def compute_reference_rad(self, observation: Observation, phase_rad: float) -> Floats:
        reference_rad = self.make_straight_angles_rad()
        # Positive pitch bends the head down. With one pitch joint only, nothing keeps the head level.
        lift_joint = (
            self._pitch_joints[0] if len(self._pitch_joints) == 1 else self._pitch_joints[-2]
        )
        if len(self._pitch_joints) > 1:
            reference_rad[self._pitch_joints[-1]] = self.parameters.lift_rad
        reference_rad[lift_joint] = -self.parameters.lift_rad
        reference_rad[self._yaw_joints] = self.parameters.stance_rad * self._compute_wave(
            self._yaw_joints, 0.0, self.parameters.lag_rad
        )
        foremost_yaw_joint = self._yaw_joints[-1]
        reference_rad[foremost_yaw_joint] = self.parameters.look_rad * math.sin(phase_rad)
        return reference_rad
