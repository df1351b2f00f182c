"""Torques that hold the shape of the body without pushing it along its path, and drives that damp such torques.

    tau_shape = k (theta(s) - q) + d (theta' v - q')

holds the shape, with gains k and d so low that obstacles decide the shape. Its component along theta' is removed,
because it would move the body along the path.
"""

from collections.abc import Sequence

import numpy as np

from snakesim_gnc.control.obstacle_aided.parameters import ObstacleAidedParameters
from snakesim_gnc.control.obstacle_aided.push_control import ACTUATION_DELAY_S
from snakesim_hal.base.arrays import Floats
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import JointDescription

# Sum of theta'^2 below which the shape hardly depends on the place on the path.
MIN_SLOPE_SQUARED_PER_M2 = 20.0


def compute_shape_torques_nm(
    observation: Observation,
    theta: Floats,
    theta_prime: Floats,
    speed_m_s: float,
    pushing_joints: Sequence[int],
    parameters: ObstacleAidedParameters,
) -> Floats:
    """Compute tau_shape, without its component along the path.

    Args:
        observation: The inputs of this tick, with the joint angles q and velocities q'.
        theta: (n_joints,) joint angles of the body on the path, rad.
        theta_prime: (n_joints,) their derivatives by the arc length, rad/m.
        speed_m_s: Speed v of the body along the path.
        pushing_joints: Indices of the joints that push; only their torques are free of a component along the path.
        parameters: The gains k and d.

    Returns:
        (n_joints,) torques in N·m.
    """
    angle_error_rad = theta - np.array(observation.joints.angle_rad)
    velocity_error_rad_s = theta_prime * speed_m_s - np.array(observation.joints.velocity_rad_s)
    shape_nm = (
        parameters.shape_nm_per_rad * angle_error_rad
        + parameters.shape_nm_s_per_rad * velocity_error_rad_s
    )
    slope = theta_prime[pushing_joints]
    # Force of tau_shape along the path, by virtual work.
    along_n = float(slope @ shape_nm[pushing_joints])
    return shape_nm - theta_prime * along_n / (slope @ slope + MIN_SLOPE_SQUARED_PER_M2)


def compute_damped_target_rad(
    joint: JointDescription, angle_rad: float, torque_nm: float, velocity_rad_s: float
) -> float:
    """Compute the position target with which the drive of a joint produces a torque.

    The drive works against kp (q(t) - q(t - delay)) + kd q'. This damping is wanted, but not against the motion along
    the path. The torque that it takes at the velocity of the joint on the path is therefore added.

    Args:
        joint: Description of the joint, with its gains kp and kd.
        angle_rad: Its measured angle.
        torque_nm: The torque to produce.
        velocity_rad_s: Velocity of the joint on the path.
    """
    stiffness = joint.stiffness_nm_per_rad
    damping = stiffness * ACTUATION_DELAY_S + joint.damping_nm_s_per_rad
    return angle_rad + (torque_nm + damping * velocity_rad_s) / stiffness
