"""Switches joints between position and torque mode, and to new references, without a jump of the motor torque.

A servo in position mode gives tau = kp (target - q) - kd q'. So a joint that returns to position mode starts from the
target that keeps its present torque,

    target = q + (tau + kd q') / kp

and the offset between this target and the reference fades to zero. A joint that enters torque mode starts from its
present torque, and the requested torque fades in. Both fades advance by the same fraction in a tick.
"""

from typing import Annotated

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import ControllerCommand, Observation, Telemetry, positions
from snakesim_hal.wire.messages import Description, JointState
from snakesim_hal.wire.quantities import above
from snakesim_hal.wire.setpoints import RequestedSetpoints

MIN_STIFFNESS_NM_PER_RAD = 1e-9  # avoids a division by zero for joints without a position loop

Blend = Annotated[float, above(10, "s")]


class HandOver:
    """Fades out the differences between the targets and the references of all joints.

    All arrays are (n_joints,), tail to head. At most one joint is in torque mode.
    """

    def __init__(self, robot: Description) -> None:
        stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        # Gains of the drives' position loops.
        self._kp = np.maximum(stiffness, MIN_STIFFNESS_NM_PER_RAD)  # N·m/rad
        self._kd = np.array([joint.damping_nm_s_per_rad for joint in robot.joints])  # N·m·s/rad
        # Position mode.
        self._offset_rad = np.zeros(len(robot.joints))  # target - reference
        # Torque mode.
        self._torque_joint: int | None = None
        self._start_torque_nm = 0.0
        self._faded_in = 1.0  # fraction of the requested torque, 0 to 1

    def start(self, joints: JointState, reference_rad: Floats) -> None:
        """Put all joints in position mode, with targets that keep the present torques."""
        torque_nm = np.array(joints.torque_nm)
        velocity_rad_s = np.array(joints.velocity_rad_s)
        target_rad = np.array(joints.angle_rad) + (torque_nm + self._kd * velocity_rad_s) / self._kp
        self._offset_rad = target_rad - reference_rad
        self._torque_joint = None

    def shift(self, change_rad: Floats) -> None:
        """Keep the targets where they are although the reference has jumped by `change_rad`."""
        self._offset_rad -= change_rad

    def fade(self, fraction: float) -> None:
        """Reduce the position offsets by a fraction, and fade the requested torque in by the same fraction."""
        self._offset_rad *= max(0.0, 1.0 - fraction)
        self._faded_in = min(1.0, self._faded_in + fraction)

    def pass_to(
        self, torque_joint: int | None, joints: JointState, reference_rad: Floats, *, fade_in_again: bool = False
    ) -> None:
        """Hand the propulsion over to another joint.

        Args:
            torque_joint: index of the joint that is in torque mode from now on; None for no joint.
            joints: measured joint states.
            reference_rad: reference angles of all joints.
            fade_in_again: fade in again even if the joint is the same, because the requested torque may have jumped.
        """
        if torque_joint == self._torque_joint and not fade_in_again:
            return
        released = self._torque_joint
        if released is not None and torque_joint != released:
            # The released joint's target is offset so that its drive produces the measured torque at once.
            load_nm = joints.torque_nm[released] + self._kd[released] * joints.velocity_rad_s[released]
            target_rad = joints.angle_rad[released] + load_nm / self._kp[released]
            self._offset_rad[released] = target_rad - reference_rad[released]
        if torque_joint is not None:
            self._start_torque_nm = joints.torque_nm[torque_joint]
            self._faded_in = 0.0
            self._offset_rad[torque_joint] = 0.0
        self._torque_joint = torque_joint

    def positions_rad(self, reference_rad: Floats) -> Floats:
        """Return the targets of the joints in position mode."""
        return reference_rad + self._offset_rad

    def torque_nm(self, requested_nm: float) -> float:
        """Return the target of the joint in torque mode."""
        return (1.0 - self._faded_in) * self._start_torque_nm + self._faded_in * requested_nm


class BumplessReference:
    """Makes setpoints that follow a reference in position mode without a jump."""

    def __init__(self, robot: Description, blend_s: float) -> None:
        """Start without a reference.

        Args:
            robot: description of the robot.
            blend_s: time in which a jump of the reference fades out.
        """
        self._robot = robot
        self._blend_s = blend_s
        self._hand_over = HandOver(robot)
        self.reference_rad: Floats | None = None  # of the tick before; None: joints have not been in position mode

    def follow(self, observation: Observation, reference_rad: Floats, *, restarted: bool = False) -> RequestedSetpoints:
        """Return setpoints that follow a reference.

        Args:
            observation: inputs of this tick.
            reference_rad: (n_joints,) reference angles, tail to head.
            restarted: the reference may have jumped since the last tick, so that the jump has to fade out.
        """
        if self.reference_rad is None:
            self._hand_over.start(observation.joints, reference_rad)
        elif restarted:
            self._hand_over.shift(reference_rad - self.reference_rad)
        self.reference_rad = reference_rad
        self._hand_over.fade(observation.period_s / self._blend_s)
        return positions(self._robot, self._hand_over.positions_rad(reference_rad).tolist())

    def forget_reference(self) -> None:
        """Note that the joints leave position mode; on return they start from the torques that they have then."""
        self.reference_rad = None

    def hold_pose(self, observation: Observation, reason: str) -> ControllerCommand:
        """Keep every joint at its last reference, or at its pose if there was none.

        Args:
            observation: inputs of this tick.
            reason: why the joints hold, for the telemetry.
        """
        reference_rad = self.reference_rad
        if reference_rad is None:
            reference_rad = np.array(observation.joints.angle_rad)
        setpoints = self.follow(observation, reference_rad)
        return ControllerCommand(setpoints, Telemetry(reason=reason, reference_rad=reference_rad.tolist()))
