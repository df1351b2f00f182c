"""Bumpless transfer: switches joints between position and torque mode, and to new references, without a torque jump.

A servo in position mode gives tau = kp (target - q) - kd q'. So a joint that returns to position mode starts from the
target that keeps its current torque,

    target = q + (tau + kd q') / kp

and the offset between this target and the reference fades to zero. A joint that enters torque mode starts from its
measured torque, and the requested torque fades in. Both fades advance by the same fraction in a tick.
"""

from typing import Annotated

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import (
    ControllerCommand,
    Observation,
    Telemetry,
    make_position_setpoints,
)
from snakesim_hal.wire.messages import JointState, RobotDescription
from snakesim_hal.wire.quantities import above
from snakesim_hal.wire.setpoints import RequestedSetpoints

MIN_STIFFNESS_NM_PER_RAD = 1e-9  # avoids a division by zero for joints without a position loop

Blend = Annotated[float, above(10, "s")]


class BumplessTransfer:
    """Fades out the differences between the targets and the references of all joints.

    All arrays are (n_joints,), tail to head. At most one joint is in torque mode.
    """

    def __init__(self, robot: RobotDescription) -> None:
        """Prepare the bumpless transfer between control modes; all joints are in position mode at first.

        Args:
            robot: Description of the robot, with the gains of the drives' position loops.
        """
        stiffness = np.array([joint.stiffness_nm_per_rad for joint in robot.joints])
        # Gains of the drives' position loops.
        self._kp = np.maximum(stiffness, MIN_STIFFNESS_NM_PER_RAD)  # N·m/rad
        self._kd = np.array([joint.damping_nm_s_per_rad for joint in robot.joints])  # N·m·s/rad
        # Position mode.
        self._target_offsets_rad = np.zeros(len(robot.joints))  # of each joint: target - reference
        # Torque mode, in which at most one joint is.
        self._torque_joint: int | None = None  # index of that joint
        self._torque_at_switch_nm = 0.0  # torque of that joint when it entered torque mode
        self._ramp_fraction = 1.0  # fraction of the requested torque of that joint, 0 to 1

    def start_in_position_mode(self, joints: JointState, reference_rad: Floats) -> None:
        """Put all joints in position mode, with targets that keep the measured torques.

        Args:
            joints: Measured joint states.
            reference_rad: (n_joints,) reference angles, tail to head.
        """
        torque_nm = np.array(joints.torque_nm)
        velocity_rad_s = np.array(joints.velocity_rad_s)
        target_rad = np.array(joints.angle_rad) + (torque_nm + self._kd * velocity_rad_s) / self._kp
        self._target_offsets_rad = target_rad - reference_rad
        self._torque_joint = None

    def absorb_reference_jump(self, change_rad: Floats) -> None:
        """Keep the position targets where they are although the references have jumped by (n_joints,) angles."""
        self._target_offsets_rad -= change_rad

    def advance_ramps(self, fraction: float) -> None:
        """Reduce the position offsets by a fraction, and raise the torque ramp by the same fraction.

        Call it once a tick.
        """
        self._target_offsets_rad *= max(0.0, 1.0 - fraction)
        self._ramp_fraction = min(1.0, self._ramp_fraction + fraction)

    def switch_torque_joint(
        self,
        torque_joint: int | None,
        joints: JointState,
        reference_rad: Floats,
        *,
        restart_ramp: bool = False,
    ) -> None:
        """Switch which joint is in torque mode, without a jump of the torque of the old or of the new joint.

        The old joint gets a position offset with which its drive produces the measured torque. The requested torque of
        the new joint ramps up from its measured torque. If the joint stays the same, nothing changes.

        Args:
            torque_joint: Index of the joint that is in torque mode from now on; None for no joint.
            joints: Measured joint states.
            reference_rad: (n_joints,) reference angles of all joints, tail to head.
            restart_ramp: Restart the torque ramp even if the joint stays the same, because the requested torque may
                have jumped.
        """
        if torque_joint == self._torque_joint and not restart_ramp:
            return
        released = self._torque_joint
        if released is not None and torque_joint != released:
            # The released joint's target is offset so that its drive produces the measured torque at once.
            load_nm = (
                joints.torque_nm[released] + self._kd[released] * joints.velocity_rad_s[released]
            )
            target_rad = joints.angle_rad[released] + load_nm / self._kp[released]
            self._target_offsets_rad[released] = target_rad - reference_rad[released]
        if torque_joint is not None:
            self._torque_at_switch_nm = joints.torque_nm[torque_joint]
            self._ramp_fraction = 0.0
            self._target_offsets_rad[torque_joint] = 0.0
        self._torque_joint = torque_joint

    def compute_position_targets_rad(self, reference_rad: Floats) -> Floats:
        """Return the position targets of all joints, (n_joints,): references plus offsets."""
        return reference_rad + self._target_offsets_rad

    def compute_torque_target_nm(self, requested_nm: float) -> float:
        """Return the target of the joint in torque mode, between its torque at the switch and the requested torque."""
        return (
            1.0 - self._ramp_fraction
        ) * self._torque_at_switch_nm + self._ramp_fraction * requested_nm


class BumplessFollower:
    """Makes setpoints that follow a reference in position mode without a jump."""

    def __init__(self, robot: RobotDescription, blend_s: float) -> None:
        """Start without a reference.

        Args:
            robot: Description of the robot.
            blend_s: Time in which a jump of the reference fades out.
        """
        self._robot = robot
        self._blend_s = blend_s
        self._bumpless_transfer = BumplessTransfer(robot)
        # Of the tick before; None if the joints were not in position mode.
        self.reference_rad: Floats | None = None

    def make_setpoints(
        self, observation: Observation, reference_rad: Floats, *, may_have_jumped: bool = False
    ) -> RequestedSetpoints:
        """Return setpoints that follow a reference.

        Args:
            observation: Inputs of this tick.
            reference_rad: (n_joints,) reference angles, tail to head.
            may_have_jumped: Whether the reference may have jumped since the last tick. The jump then fades out.
        """
        if self.reference_rad is None:
            self._bumpless_transfer.start_in_position_mode(observation.joints, reference_rad)
        elif may_have_jumped:
            self._bumpless_transfer.absorb_reference_jump(reference_rad - self.reference_rad)
        self.reference_rad = reference_rad
        self._bumpless_transfer.advance_ramps(observation.period_s / self._blend_s)
        return make_position_setpoints(
            self._robot,
            self._bumpless_transfer.compute_position_targets_rad(reference_rad).tolist(),
        )

    def leave_position_mode(self) -> None:
        """Discard the reference, because the joints leave position mode.

        When they return to position mode, their targets start from the torques that they have then.
        """
        self.reference_rad = None

    def hold_pose(self, observation: Observation, reason: str) -> ControllerCommand:
        """Keep every joint at its last reference, or at its measured angle if there was no reference.

        Args:
            observation: Inputs of this tick.
            reason: Why the joints hold, for the telemetry.
        """
        reference_rad = self.reference_rad
        if reference_rad is None:
            reference_rad = np.array(observation.joints.angle_rad)
        setpoints = self.make_setpoints(observation, reference_rad)
        return ControllerCommand(
            setpoints, Telemetry(reason=reason, reference_rad=reference_rad.tolist())
        )
