"""A wave whose joints react to the measured angles, speeds, torques and contact forces around them. It uses no map.

For joint i, with phase phi, and with n = 0, 1, 2, ... counted from the head over the joints that bend:

    target_i   = (A_i + sum_c g_c F_c) sin(phi - n lag) + bend_i + feedback_i
    A_i        = AMPLITUDE_RAD + GROWTH_RAD x,   x = 0 at the head, 1 at the tail
    feedback_i = MAX_FEEDBACK_RAD tanh(sum over the joints behind, at and ahead of i of
                 angle gain * q + velocity gain * q' + torque gain * tau)

F_c are the contact forces on the links behind and ahead of the joint. feedback_i changes by at most
MAX_FEEDBACK_RAD_S. bend_i turns the body towards the goal.

Source: the shipped policy `lab` (`snakesim policy train`, `docs/development/shipped-policies.md`), with its numbers,
and with measured or estimated contacts. The policy was trained with one action every 50 ms. If feedback were applied
in every tick as fast as the drives are, the body would need a quarter more energy; the limit of its rate avoids this.

The policy was trained on one robot. For another robot, angles and lags scale with the distance between its joints, so
that it has the same curve, and torques scale with the torque limits of its joints.
"""

import math

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.undulation import LateralUndulation, LateralUndulationParameters, aside_rad
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.controller import Observation
from snakesim_hal.wire.messages import Description

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
CONTACT_GAINS = np.array([0.335405, 0.117568]) / 50.0  # rad/N, for the links behind and ahead of a joint
MAX_FEEDBACK_RAD = 0.4
MAX_FEEDBACK_RAD_S = 5.0

# The robot of the training: planar13.
TRAINED_SPACING_M = 0.11
TRAINED_TORQUE_NM = 7.0


def spacing_ratio(robot: Description) -> float:
    """Return the distance between a robot's joints, divided by that of the robot that the waves were trained on."""
    return PlanarBody(robot).spacing_m / TRAINED_SPACING_M


class ForceFeedbackWave(LateralUndulation):
    """A wave that bends towards the goal and yields to measured forces; its amplitude is largest at the head."""

    def __init__(self, robot: Description, *, time_scale: float = 1.0) -> None:
        """Scale a wave that was trained on one robot to the size and torque of another.

        Args:
            robot: description of the robot.
            time_scale: factor on all times; 2 moves at half the speed.
        """
        scale = spacing_ratio(robot)
        super().__init__(robot, LateralUndulationParameters(period_s=time_scale * PERIOD_S, lag_rad=scale * LAG_RAD))
        count = len(self._body.bends)
        x = np.arange(count)[::-1] / max(count - 1, 1)  # 0 at the head, 1 at the tail
        self._base_amplitude_rad = scale * (AMPLITUDE_RAD + GROWTH_RAD * x)
        self._steering_rad = (STEERING_RAD + HEAD_STEERING_RAD * (1.0 - x)) / count
        # Feedback.
        self._gains = (ANGLE_GAINS / scale, VELOCITY_GAINS / scale, TORQUE_GAINS)
        self._torque_scale = np.array(self._body.torque_limit_nm) / TRAINED_TORQUE_NM
        self._max_feedback_rad = scale * MAX_FEEDBACK_RAD
        self._max_feedback_rad_s = scale * MAX_FEEDBACK_RAD_S / time_scale
        self._feedback_rad: NDArray[np.float64] | None = None  # of the last tick; None: the next is not limited

    def start_from(self, angles_rad: NDArray[np.float64]) -> None:
        """Choose the phase, and apply the feedback at once: the change to a wave is smooth anyway."""
        super().start_from(angles_rad)
        self._feedback_rad = None

    def reference_rad(self, observation: Observation, passed_s: float) -> NDArray[np.float64]:
        """Return the angles of all joints, (n_joints,), `passed_s` later than in the last call."""
        reference = super().reference_rad(observation, passed_s)
        feedback_rad = self._measure_feedback(observation)
        if self._feedback_rad is not None:
            max_change_rad = self._max_feedback_rad_s * passed_s
            change_rad = np.clip(feedback_rad - self._feedback_rad, -max_change_rad, max_change_rad)
            feedback_rad = self._feedback_rad + change_rad
        self._feedback_rad = feedback_rad
        reference[self._body.bends] += feedback_rad
        return reference

    def _measure_feedback(self, observation: Observation) -> NDArray[np.float64]:
        """Return MAX_FEEDBACK_RAD tanh(sum of gains x measurements), (n_bends,)."""
        bends = self._body.bends
        joints = observation.joints
        scaled_torque_nm = np.array(joints.torque_nm) / self._torque_scale
        total = np.zeros(len(bends))
        for values, gains in zip((joints.angle_rad, joints.velocity_rad_s, scaled_torque_nm), self._gains, strict=True):
            padded = np.pad(np.array(values)[bends], 1)  # the first and the last joint have one neighbor
            total += gains[0] * padded[:-2] + gains[1] * padded[1:-1] + gains[2] * padded[2:]
        return self._max_feedback_rad * np.tanh(total)

    def _bend_rad(self, observation: Observation) -> float | NDArray[np.float64]:
        """Return the bend towards the goal. It ignores the path, which a body pushed by obstacles does not follow."""
        if observation.world is None or observation.trajectory is None:
            return 0.0
        nodes_w = self._body.nodes_w(observation.world, observation.joints.angle_rad).T
        goal_w = observation.trajectory.goal_w or observation.trajectory.path_w[-1]
        return self._steering_rad * math.sin(aside_rad(nodes_w, goal_w - nodes_w[-1]))

    def _amplitude_rad(
        self, observation: Observation, _waves: NDArray[np.float64], _passed_s: float
    ) -> NDArray[np.float64]:
        """Return A_i + sum of gains x contact forces, (n_bends,)."""
        forces_n = np.zeros(len(self.robot.links))
        if observation.world is not None:
            for contact in observation.world.contacts:
                forces_n[contact.link] += math.hypot(*contact.force_w)
        behind_n = forces_n[:-1][self._body.bends]
        ahead_n = forces_n[1:][self._body.bends]
        return self._base_amplitude_rad + CONTACT_GAINS[0] * behind_n + CONTACT_GAINS[1] * ahead_n
