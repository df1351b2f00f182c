"""Gaits in three dimensions, for robots whose joints turn left-right and up-down in alternation. They use no map.

All are sums of two waves, one of the yaw joints and one of the pitch joints (Tesch et al. 2009). Sidewinding lifts
parts of the body over while others rest on the ground; rolling turns a bent body about its own axis; a raised head
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
    """A reference in time for yaw and pitch joints, followed without a jump."""

    stays = ""  # why it does not travel, if it does not

    def __init__(self, robot: Description, settings: Any) -> None:
        self._set = settings
        self._bumpless = BumplessReference(robot, settings.blend_s)
        axes = [joint.axis for joint in robot.joints]
        self._yaw, self._pitch = ([i for i, axis in enumerate(axes) if axis == one] for one in ("yaw", "pitch"))
        self._from_head = np.arange(len(axes))[::-1]  # 0 at the head
        lacking = [name for name, joints in (("up and down", self._pitch), ("left and right", self._yaw)) if not joints]
        self._lacks = f"this robot has no joints that turn {' and '.join(lacking)}" if lacking else ""
        self._phase_rad = 0.0

    def update(self, view: View) -> Action:
        """The gait goes on while motion is wanted; a robot that cannot do it stays as it is."""
        if self._lacks or not motion_wanted(view):
            return self._bumpless.hold(view, self._lacks)
        self._phase_rad += math.tau * view.period_s / self._set.period_s
        reference = np.zeros(len(self._from_head))
        self._shape(reference, self._phase_rad)
        setpoints = self._bumpless.follow(view, reference)
        return Action(setpoints, Report(why=self.stays, reference_rad=reference.tolist()))

    def _shape(self, reference: Floats, phase_rad: float) -> None:
        """Fill in the angles of all joints."""
        raise NotImplementedError

    def _wave(self, joints: list[int], phase_rad: float, lag_rad: float) -> Floats:
        """A wave that travels from the head to the tail, (len(joints),)."""
        return np.sin(phase_rad - lag_rad * self._from_head[joints])


class Sidewinding(_Gait):
    """Travels sideways."""

    class Settings(FileStruct, frozen=True, kw_only=True):
        """Two waves, a quarter of a period apart; a negative `pitch_rad` travels to the other side."""

        yaw_rad: Annotated[Swing, about("amplitude of the joints that turn left and right")] = 0.6
        pitch_rad: Annotated[
            Swing, about("amplitude of the joints that turn up and down; negative: to the other side")
        ] = 0.2
        lag_rad: Annotated[Lag, about("phase of a joint behind the one ahead of it")] = 0.45
        period_s: Annotated[Seconds, about("of the wave")] = 2.0
        blend_s: Annotated[Seconds, about("over which the command changes smoothly to a new reference")] = 1.0

    def _shape(self, reference: Floats, phase_rad: float) -> None:
        lag_rad = self._set.lag_rad
        reference[self._yaw] = self._set.yaw_rad * self._wave(self._yaw, phase_rad, lag_rad)
        reference[self._pitch] = self._set.pitch_rad * self._wave(self._pitch, phase_rad + 0.5 * math.pi, lag_rad)


class Rolling(_Gait):
    """An arc that turns about its own axis, and so rolls over the ground like a wheel."""

    class Settings(FileStruct, frozen=True, kw_only=True):
        """The arc; a negative `bend_rad` of the pitch joints rolls to the other side."""

        bend_rad: Annotated[Swing, about("bend of every joint; negative: to the other side")] = 0.25
        period_s: Annotated[Seconds, about("of a turn")] = 2.0
        blend_s: Annotated[Seconds, about("over which the command changes smoothly to a new reference")] = 1.0

    def _shape(self, reference: Floats, phase_rad: float) -> None:
        reference[self._yaw] = abs(self._set.bend_rad) * math.sin(phase_rad)
        reference[self._pitch] = self._set.bend_rad * math.cos(phase_rad)


class RaisedHead(_Gait):
    """Lifts its head by one pitch joint, keeps it level by the next, and looks left and right.

    The body behind lies in a wave: a straight round body would roll over.
    """

    stays = "it lifts its head, looks around, and travels nowhere"

    class Settings(FileStruct, frozen=True, kw_only=True):
        """How high, and how far to each side."""

        lift_rad: Annotated[float, from_zero(1.5, "rad"), about("angle of the joint that lifts the head")] = 0.6
        look_rad: Annotated[Swing, about("how far the foremost yaw joint looks to each side")] = 0.4
        stance_rad: Annotated[Swing, about("amplitude of the wave in which the body behind lies")] = 0.5
        lag_rad: Annotated[Lag, about("phase of that wave from joint to joint")] = 0.6
        period_s: Annotated[Seconds, about("of looking to both sides")] = 6.0
        blend_s: Annotated[Seconds, about("over which the command changes smoothly to a new reference")] = 2.0

    def _shape(self, reference: Floats, phase_rad: float) -> None:
        if len(self._pitch) > 1:
            reference[self._pitch[-1]] = self._set.lift_rad  # down is positive
        reference[self._pitch[-2:][0]] = -self._set.lift_rad
        reference[self._yaw] = self._set.stance_rad * self._wave(self._yaw, 0.0, self._set.lag_rad)
        reference[self._yaw[-1:]] = self._set.look_rad * math.sin(phase_rad)
