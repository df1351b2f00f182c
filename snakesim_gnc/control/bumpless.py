"""Switching joints between position and torque mode without a jump. Pure except for its own state.

A released joint starts from the position target with which its servo gives the present torque
(`q + (torque + kd speed) / kp`), and the difference to its reference fades out. A joint that takes over starts from its
present torque, and the propulsion torque fades in. Both fades move by `fade` a tick.
"""

from typing import Annotated

import numpy as np

from snakesim_gnc.control.controller import Action, Report, View, positions
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Description, JointState
from snakesim_hal.wire.quantities import about, above
from snakesim_hal.wire.setpoints import RequestedSetpoints

Blend = Annotated[float, above(10, "s"), about("over which the command changes smoothly to a new reference")]


class HandOver:
    """The fading differences of all joints. Indices here are those of the robot's joints."""

    def __init__(self, robot: Description) -> None:
        self._stiffness = np.maximum(np.array([j.stiffness_nm_per_rad for j in robot.joints]), 1e-9)
        self._damping = np.array([j.damping_nm_s_per_rad for j in robot.joints])
        self._offset = np.zeros(len(robot.joints))
        self._turn: int | None = None
        self._torque_before_nm = 0.0
        self._share = 1.0  # of the propulsion torque that has faded in

    def start(self, joints: JointState, reference_rad: Floats) -> None:
        """Start from the present joint states, all in position mode."""
        torque, speed = np.array(joints.torque_nm), np.array(joints.velocity_rad_s)
        held = np.array(joints.angle_rad) + (torque + self._damping * speed) / self._stiffness
        self._offset = held - reference_rad
        self._turn = None

    def shift(self, change_rad: Floats) -> None:
        """The reference has jumped by this much: keep the targets where they are."""
        self._offset -= change_rad

    def fade(self, fade: float) -> None:
        """Reduce differences by a share."""
        self._offset *= max(0.0, 1.0 - fade)
        self._share = min(1.0, self._share + fade)

    def pass_to(self, turn: int | None, joints: JointState, reference_rad: Floats, *, anew: bool = False) -> None:
        """Hand propulsion over to a joint, or to none. anew: the wanted torque may have jumped, even of the same."""
        if turn == self._turn and not anew:
            return
        if self._turn is not None and turn != self._turn:
            i = self._turn
            push = joints.torque_nm[i] + self._damping[i] * joints.velocity_rad_s[i]
            self._offset[i] = joints.angle_rad[i] + push / self._stiffness[i] - reference_rad[i]
        if turn is not None:
            self._torque_before_nm, self._share, self._offset[turn] = joints.torque_nm[turn], 0.0, 0.0
        self._turn = turn

    def positions_rad(self, reference_rad: Floats) -> Floats:
        """Targets of the joints in position mode."""
        return reference_rad + self._offset

    def torque_nm(self, wanted_nm: float) -> float:
        """Target of the joint in torque mode."""
        return (1.0 - self._share) * self._torque_before_nm + self._share * wanted_nm


class BumplessReference:
    """The reference of joints that are all in position mode, and setpoints that follow it without a jump."""

    def __init__(self, robot: Description, blend_s: float) -> None:
        """blend_s: in which a jump of the reference fades out."""
        self._robot = robot
        self._blend_s = blend_s
        self._hand_over = HandOver(robot)
        self.reference_rad: Floats | None = None  # of the tick before; None before the first

    def to(self, view: View, reference_rad: Floats, *, restarted: bool = False) -> RequestedSetpoints:
        """Follow a reference. restarted: it may have jumped."""
        if self.reference_rad is None:
            self._hand_over.start(view.joints, reference_rad)
        elif restarted:
            self._hand_over.shift(reference_rad - self.reference_rad)
        self.reference_rad = reference_rad
        self._hand_over.fade(view.period_s / self._blend_s)
        return positions(self._robot, self._hand_over.positions_rad(reference_rad).tolist())

    def let_go(self) -> None:
        """Joints leave position mode; when they are back in it, they start from the torques that are there then."""
        self.reference_rad = None

    def hold(self, view: View, why: str) -> Action:
        """Every joint keeps its reference, or its pose before there was one."""
        reference = np.array(view.joints.angle_rad) if self.reference_rad is None else self.reference_rad
        return Action(self.to(view, reference), Report(why=why, reference_rad=reference.tolist()))
