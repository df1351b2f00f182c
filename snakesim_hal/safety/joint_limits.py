"""The values that the limiter works with: a robot's limits, its measured state, and the last setpoints.

All arrays have the shape (n_joints,), tail to head, in the order of `RobotDescription.joints`.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.freshness import max_state_age_ns
from snakesim_hal.wire.messages import JointDescription, JointMode, RobotDescription

Ints = NDArray[np.int64]
JointMask = NDArray[np.bool_]  # (n_joints,): which joints


@dataclass(frozen=True)
class JointLimits:
    """The limits of a robot, as its description states them."""

    # Limits as vectors, (n_joints,) each.
    angle_min_rad: Floats
    angle_max_rad: Floats
    speed_rad_s: Floats
    acceleration_rad_s2: Floats
    torque_nm: Floats
    # Limits of the whole robot.
    max_step_rad: float  # maximum distance of an angle target from the measured angle
    period_s: float
    lease_ns: int
    max_state_age_ns: int  # an older joint state is rejected
    layout: str
    # The same limits joint by joint, for loops over plain floats.
    joints: tuple[JointDescription, ...]
    # Modes that the joints support.
    has_velocity_mode: JointMask
    has_all_modes: bool  # whether every joint supports every mode

    @staticmethod
    def from_description(description: RobotDescription) -> "JointLimits":
        """Collect the limits of all joints from the description of a robot, as vectors and joint by joint."""
        joints = description.joints

        def collect_field(field: str) -> Floats:
            return np.array([getattr(joint, field) for joint in joints], dtype=np.float64)

        return JointLimits(
            angle_min_rad=collect_field("angle_min_rad"),
            angle_max_rad=collect_field("angle_max_rad"),
            speed_rad_s=collect_field("speed_limit_rad_s"),
            acceleration_rad_s2=collect_field("acceleration_limit_rad_s2"),
            torque_nm=collect_field("torque_limit_nm"),
            max_step_rad=description.max_step_rad,
            period_s=description.period_ns * 1e-9,
            lease_ns=description.lease_ns,
            max_state_age_ns=max_state_age_ns(description),
            layout=description.layout,
            joints=tuple(joints),
            has_velocity_mode=np.array(
                [joint.supports_mode(JointMode.VELOCITY) for joint in joints]
            ),
            has_all_modes=all(joint.supports_mode(mode) for joint in joints for mode in JointMode),
        )

    def clip_angles(self, angle_rad: Floats) -> Floats:
        """Return the angles clamped to the angle limits, (n_joints,)."""
        return np.clip(angle_rad, self.angle_min_rad, self.angle_max_rad)


@dataclass(frozen=True)
class MeasuredState:
    """The measured state of the joints, (n_joints,) each."""

    angle_rad: Floats
    velocity_rad_s: Floats
    torque_nm: Floats


@dataclass(frozen=True)
class AppliedSetpoints:
    """Limited setpoints of the joints, (n_joints,) each."""

    mode: Ints  # values of `JointMode`
    target: Floats  # rad, rad/s or N·m, depending on the mode
    torque_limit_nm: Floats
