"""A wave whose joints react to the measured angles, speeds, torques and contact forces around them. It uses no map.

For joint i, with phase phi, and with n = 0, 1, 2, ... counted from the head over the joints that bend:

    target_i   = (A_i + sum_c g_c F_c) sin(phi - n lag) + bend_i + feedback_i
    A_i        = AMPLITUDE_RAD + GROWTH_RAD x,   x = 0 at the head, 1 at the tail
    feedback_i = MAX_FEEDBACK_RAD tanh(sum over the joints behind, at and ahead of i of
                 angle gain * q + velocity gain * q' + torque gain * tau)

F_c are the contact forces on the links behind and ahead of the joint. feedback_i changes by at most
MAX_FEEDBACK_RAD_S. bend_i turns the body towards the goal. After a push, the contact-search gait begins with smoothed
angles, because the feedback oscillates at about 22 Hz through the delay between a measurement and the motion that it
causes.

Source: the shipped policy `lab` (`snakesim policy train`, `docs/development/shipped-policies.md`), with its numbers,
and with measured or estimated contacts. The policy was trained with one action every 50 ms. If feedback were applied
in every tick as fast as the drives are, the body would need a quarter more energy; the limit of its rate avoids this.

The policy was trained on one robot. For another robot, angles and lags scale with the distance between its joints, so
that it has the same curve, and torques scale with the torque limits of its joints.
"""

import math

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.undulation import (
    LateralUndulation,
    LateralUndulationParameters,
    compute_direction_angle_rad,
)
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import RobotDescription

# The trained wave.
AMPLITUDE_RAD = 0.637896
GROWTH_RAD = -0.616543
PERIOD_S = math.tau / 5.391202
LAG_RAD = 0.391127

# Bend of the whole body if the goal is at 90 degrees: the sum over the joints at the tail's value, and what is added
# to it at the head. The policy has 13 joints.
STEERING_RAD = 0.158285 * 13
HEAD_STEERING_RAD = 0.039155 * 13

# Feedback: gains for the joint behind, the joint itself, and the joint ahead.
ANGLE_GAINS = np.array([-0.646916, -0.096146, 0.21155]) / 0.5  # 1/rad
VELOCITY_GAINS = np.array([0.172301, 0.047595, 0.425563]) / 2.0  # s/rad
TORQUE_GAINS = np.array([0.556468, -0.344171, -0.676491]) / 5.0  # 1/(N m)
# Rad/N, for the links behind and ahead of a joint.
CONTACT_GAINS = np.array([0.335405, 0.117568]) / 50.0
MAX_FEEDBACK_RAD = 0.4
MAX_FEEDBACK_RAD_S = 5.0

# The robot of the training: planar13.
TRAINED_SPACING_M = 0.11
TRAINED_TORQUE_NM = 7.0


def compute_joint_spacing_ratio(robot: RobotDescription) -> float:
    """Return the distance between a robot's joints, divided by that of the robot that the waves were trained on."""
    return PlanarBody(robot).spacing_m / TRAINED_SPACING_M


class ForceFeedbackWave(LateralUndulation):
    """A wave that bends towards the goal and yields to measured forces; its amplitude is largest at the head."""

    def __init__(
        self,
        robot: RobotDescription,
        *,
        time_scale: float = 1.0,
        amplitude_scale: float = 1.0,
        smoothing_s: float = 0.0,
    ) -> None:
        """Scale a wave that was trained on one robot to the size and torque of another.

        Args:
            robot: Description of the robot.
            time_scale: Factor on all times; 2 moves at half the speed.
            amplitude_scale: Factor on the amplitude without contact forces.
            smoothing_s: Time constant of a low-pass filter of the reference angles; 0 for no filter.
        """
        scale = compute_joint_spacing_ratio(robot)
        super().__init__(
            robot,
            LateralUndulationParameters(period_s=time_scale * PERIOD_S, lag_rad=scale * LAG_RAD),
        )
        joint_count = len(self._body.yaw_joints)
        x = np.arange(joint_count)[::-1] / max(joint_count - 1, 1)  # 0 at the head, 1 at the tail
        trained_amplitude_rad = AMPLITUDE_RAD + GROWTH_RAD * x
        self._base_amplitude_rad = scale * amplitude_scale * trained_amplitude_rad
        self._steering_rad = (STEERING_RAD + HEAD_STEERING_RAD * (1.0 - x)) / joint_count
        # Feedback.
        self._feedback_gains = (ANGLE_GAINS / scale, VELOCITY_GAINS / scale, TORQUE_GAINS)
        self._torque_scale = np.array(self._body.torque_limit_nm) / TRAINED_TORQUE_NM
        self._max_feedback_rad = scale * MAX_FEEDBACK_RAD
        self._max_feedback_rad_s = scale * MAX_FEEDBACK_RAD_S / time_scale
        # Of the last tick; None if the next is not limited.
        self._feedback_rad: NDArray[np.float64] | None = None
        # Low-pass filter of the reference.
        self._smoothing_s = smoothing_s
        # Of the last tick; None if the next is not filtered.
        self._smooth_reference_rad: NDArray[np.float64] | None = None

    def match_phase_to_angles(self, angles_rad: NDArray[np.float64]) -> None:
        """Set the phase at which the wave is most similar to measured joint angles, (n_joints,) in rad.

        The next tick has neither rate limit nor low-pass filter, because the change to a wave is smooth anyway.
        """
        super().match_phase_to_angles(angles_rad)
        self._feedback_rad = None
        self._smooth_reference_rad = None

    def compute_reference_rad(
        self, observation: Observation, elapsed_s: float
    ) -> NDArray[np.float64]:
        """Advance the wave, and compute the reference angles of all joints with the feedback of the measurements.

        Args:
            observation: The inputs of this tick.
            elapsed_s: Time since the last call, which limits the change of the feedback and of the smoothed angles.

        Returns:
            (n_joints,) angles in rad, tail to head.
        """
        reference = super().compute_reference_rad(observation, elapsed_s)
        feedback_rad = self._compute_feedback_rad(observation)
        if self._feedback_rad is not None:
            max_change_rad = self._max_feedback_rad_s * elapsed_s
            change_rad = np.clip(feedback_rad - self._feedback_rad, -max_change_rad, max_change_rad)
            feedback_rad = self._feedback_rad + change_rad
        self._feedback_rad = feedback_rad
        reference[self._body.yaw_joints] += feedback_rad
        return self._smooth(reference, elapsed_s)

    def _smooth(self, reference_rad: NDArray[np.float64], elapsed_s: float) -> NDArray[np.float64]:
        """Return the reference behind a first-order low-pass filter with the time constant `smoothing_s`."""
        if self._smoothing_s == 0.0:
            return reference_rad
        last_rad = self._smooth_reference_rad
        if last_rad is not None:
            alpha = 1.0 - math.exp(-elapsed_s / self._smoothing_s)
            reference_rad = last_rad + alpha * (reference_rad - last_rad)
        self._smooth_reference_rad = reference_rad
        return reference_rad.copy()

    def _compute_feedback_rad(self, observation: Observation) -> NDArray[np.float64]:
        """Return MAX_FEEDBACK_RAD tanh(sum of gains x measurements), (n_bends,)."""
        bends = self._body.yaw_joints
        joints = observation.joints
        scaled_torque_nm = np.array(joints.torque_nm) / self._torque_scale
        weighted_sum = np.zeros(len(bends))
        for values, gains in zip(
            (joints.angle_rad, joints.velocity_rad_s, scaled_torque_nm),
            self._feedback_gains,
            strict=True,
        ):
            # The first and the last joint have one neighbor.
            padded = np.pad(np.array(values)[bends], 1)
            weighted_sum += gains[0] * padded[:-2] + gains[1] * padded[1:-1] + gains[2] * padded[2:]
        return self._max_feedback_rad * np.tanh(weighted_sum)

    def _compute_bend_rad(self, observation: Observation) -> float | NDArray[np.float64]:
        """Return the bend towards the goal. It ignores the path, which a body pushed by obstacles does not follow."""
        if observation.world is None or observation.trajectory is None:
            return 0.0
        body_points_w = self._body.compute_body_points_w(
            observation.world, observation.joints.angle_rad
        ).T
        goal_w = observation.trajectory.goal_w or observation.trajectory.path_w[-1]
        return self._steering_rad * math.sin(
            compute_direction_angle_rad(body_points_w, goal_w - body_points_w[-1])
        )

    def _compute_amplitude_rad(
        self, observation: Observation, _waves: NDArray[np.float64], _elapsed_s: float
    ) -> NDArray[np.float64]:
        """Return A_i + sum of gains x contact forces, (n_bends,)."""
        forces_n = np.zeros(len(self.robot.links))
        if observation.world is not None:
            for contact in observation.world.contacts:
                forces_n[contact.link] += math.hypot(*contact.force_w)
        behind_n = forces_n[:-1][self._body.yaw_joints]
        ahead_n = forces_n[1:][self._body.yaw_joints]
        return self._base_amplitude_rad + CONTACT_GAINS[0] * behind_n + CONTACT_GAINS[1] * ahead_n
