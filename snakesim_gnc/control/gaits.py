"""Gaits in three dimensions, for robots whose joints are yaw and pitch joints in alternation. They use no map.

All are sums of two waves, one of the yaw joints and one of the pitch joints (Tesch et al. 2009). Sidewinding lifts
parts of the body over while others rest on the ground. Rolling turns a bent body about its own axis. A raised head
bends its last pitch joints up, and looks around.
"""

import math
from typing import Annotated, Any

import numpy as np

from snakesim_gnc.control.bumpless import BumplessReference
from snakesim_gnc.control.controller import Action, Report, View, motion_wanted
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Description
from snakesim_hal.wire.quantities import about, above, bounded, from_zero

Swing = Annotated[float, bounded(-2, 2, "rad")]
Lag = Annotated[float, bounded(-3.2, 3.2, "rad")]
Seconds = Annotated[float, above(100, "s")]


class _Gait:
    """A reference over time for yaw and pitch joints, which the joints follow without a jump.

    A subclass computes the reference from the phase of the gait, and declares its `Settings` with `period_s` and
    `blend_s`.
    """

    stays = ""  # why the gait does not travel; empty for a gait that travels

    def __init__(self, robot: Description, settings: Any) -> None:
        self._set = settings
        self._bumpless = BumplessReference(robot, settings.blend_s)
        self._phase_rad = 0.0

        # Indices of the joints.
        axes = [joint.axis for joint in robot.joints]
        self._yaw = [i for i, axis in enumerate(axes) if axis == "yaw"]
        self._pitch = [i for i, axis in enumerate(axes) if axis == "pitch"]
        self._from_head = np.arange(len(axes))[::-1]  # (n_joints,), 0 at the head

        self._missing = _explain_missing_joints(self._yaw, self._pitch)

    def update(self, view: View) -> Action:
        """Advance the gait while motion is wanted; a robot without the necessary joints holds its pose."""
        if self._missing or not motion_wanted(view):
            return self._bumpless.hold(view, self._missing)
        self._phase_rad += math.tau * view.period_s / self._set.period_s
        reference_rad = np.zeros(len(self._from_head))
        self._shape(reference_rad, self._phase_rad)
        setpoints = self._bumpless.follow(view, reference_rad)
        return Action(setpoints, Report(why=self.stays, reference_rad=reference_rad.tolist()))

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


class Sidewinding(_Gait):
    """Travels sideways, by a yaw wave and a pitch wave that leads by a quarter of a period.

    A joint n joints behind the head has, at phase phi and with the lag beta, the angle

        yaw joints     yaw_rad   sin(phi - beta n)
        pitch joints   pitch_rad sin(phi + pi/2 - beta n)
    """

    class Settings(FileStruct, frozen=True, kw_only=True):
        """Two waves, a quarter of a period apart; a negative `pitch_rad` travels to the other side."""

        yaw_rad: Annotated[Swing, about("amplitude of the joints that turn left and right")] = 0.6
        pitch_rad: Annotated[
            Swing, about("amplitude of the joints that turn up and down; negative: to the other side")
        ] = 0.2
        lag_rad: Annotated[Lag, about("phase of a joint behind the one ahead of it")] = 0.45
        period_s: Annotated[Seconds, about("period of the wave")] = 2.0
        blend_s: Annotated[Seconds, about("time over which the command changes smoothly to a new reference")] = 1.0

    def _shape(self, reference_rad: Floats, phase_rad: float) -> None:
        lag_rad = self._set.lag_rad
        reference_rad[self._yaw] = self._set.yaw_rad * self._wave(self._yaw, phase_rad, lag_rad)
        reference_rad[self._pitch] = self._set.pitch_rad * self._wave(self._pitch, phase_rad + 0.5 * math.pi, lag_rad)


class Rolling(_Gait):
    """Rolls sideways: the body lies in an arc that turns about its own axis.

    All yaw joints have the angle |bend_rad| sin(phi), and all pitch joints bend_rad cos(phi), at phase phi.
    """

    class Settings(FileStruct, frozen=True, kw_only=True):
        """The arc; a negative `bend_rad` of the pitch joints rolls to the other side."""

        bend_rad: Annotated[Swing, about("bend of every joint; negative: to the other side")] = 0.25
        period_s: Annotated[Seconds, about("period of a turn")] = 2.0
        blend_s: Annotated[Seconds, about("time over which the command changes smoothly to a new reference")] = 1.0

    def _shape(self, reference_rad: Floats, phase_rad: float) -> None:
        reference_rad[self._yaw] = abs(self._set.bend_rad) * math.sin(phase_rad)
        reference_rad[self._pitch] = self._set.bend_rad * math.cos(phase_rad)


class RaisedHead(_Gait):
    """Lifts its head by one pitch joint, keeps it level by the next, and looks left and right.

    The body behind lies in a wave of its yaw joints, because a straight round body would roll over.
    """

    stays = "it lifts its head, looks around, and travels nowhere"

    class Settings(FileStruct, frozen=True, kw_only=True):
        """How high, and how far to each side."""

        lift_rad: Annotated[float, from_zero(1.5, "rad"), about("angle of the joint that lifts the head")] = 0.6
        look_rad: Annotated[Swing, about("how far the foremost yaw joint looks to each side")] = 0.4
        stance_rad: Annotated[Swing, about("amplitude of the wave in which the body behind lies")] = 0.5
        lag_rad: Annotated[Lag, about("phase of that wave from joint to joint")] = 0.6
        period_s: Annotated[Seconds, about("period of looking to both sides")] = 6.0
        blend_s: Annotated[Seconds, about("time over which the command changes smoothly to a new reference")] = 2.0

    def _shape(self, reference_rad: Floats, phase_rad: float) -> None:
        # Positive pitch bends the head down. With one pitch joint only, nothing keeps the head level.
        lift_joint = self._pitch[0] if len(self._pitch) == 1 else self._pitch[-2]
        if len(self._pitch) > 1:
            reference_rad[self._pitch[-1]] = self._set.lift_rad
        reference_rad[lift_joint] = -self._set.lift_rad
        reference_rad[self._yaw] = self._set.stance_rad * self._wave(self._yaw, 0.0, self._set.lag_rad)
        foremost_yaw_joint = self._yaw[-1]
        reference_rad[foremost_yaw_joint] = self._set.look_rad * math.sin(phase_rad)
