"""A wave whose joints yield to, and join in with, what they and their neighbors measure. Needs no map.

    target = (amplitude + growth share + gains x contact forces) sin(phase - lag turns) + bend
             + FELT_RAD tanh(sum of gains x measured), which changes by at most FELT_RAD_S

turns counts the joints that bend from the head on, share goes from 0 at the head to 1 at the tail. It is the law of the
shipped policy `lab` (`snakesim train`, `docs/environments.md`) with its numbers, and with the contacts that guidance
tells, measured or estimated. The policy was trained on an angle for every 50 ms; at every tick, and as fast as drives
are, what is felt would cost a quarter more energy.

It was trained on one robot. Another one moves by the same curve: its angles and lags grow with the distance between its
joints, and a torque counts by how much it is of the joints' limit.
"""

import math

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.controller import View
from snakesim_gnc.control.undulation import LateralUndulation, aside_rad
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.wire.messages import Description

AMPLITUDE_RAD, GROWTH_RAD, PERIOD_S, LAG_RAD = 0.637896, -0.616543, math.tau / 5.391202, 0.391127
# Towards a goal abeam, 13 times a joint at the tail, and how much more at the head.
STEERING_RAD, HEAD_STEERING_RAD = 0.158285 * 13, 0.039155 * 13
FELT_RAD, FELT_RAD_S = 0.4, 5.0
# Of the joint behind, of the joint itself and of the one ahead.
ANGLE_GAINS = np.array([-0.646916, -0.096146, 0.21155]) / 0.5  # 1/rad
VELOCITY_GAINS = np.array([0.172301, 0.047595, 0.425563]) / 2.0  # s/rad
TORQUE_GAINS = np.array([0.556468, -0.344171, -0.676491]) / 5.0  # 1/(N m)
CONTACT_GAINS = np.array([0.335405, 0.117568]) / 50.0  # rad/N, of the links behind and ahead of a joint
TRAINED_SPACING_M, TRAINED_TORQUE_NM = 0.11, 7.0  # of the robot that it was trained on: planar13


def spacings(robot: Description) -> float:
    """How far apart a robot's joints are, as a multiple of those of the robot that the waves were trained on."""
    return PlanarBody(robot).spacing_m / TRAINED_SPACING_M


class FeltWave(LateralUndulation):
    """A wave bent towards the goal, largest at the head, that feels its way."""

    def __init__(self, robot: Description, *, slower: float = 1.0) -> None:
        """slower: how many times as long all that it does takes."""
        apart = spacings(robot)
        super().__init__(robot, LateralUndulation.Settings(period_s=slower * PERIOD_S, lag_rad=apart * LAG_RAD))
        count = len(self._body.bends)
        share = np.arange(count)[::-1] / max(count - 1, 1)
        self._swing_rad = apart * (AMPLITUDE_RAD + GROWTH_RAD * share)
        self._measured_rad: NDArray[np.float64] | None = None
        self._max_measured_rad, self._measured_rad_s = apart * FELT_RAD, apart * FELT_RAD_S / slower
        self._gains = ANGLE_GAINS / apart, VELOCITY_GAINS / apart, TORQUE_GAINS
        self._limits = np.array(self._body.torque_limit_nm) / TRAINED_TORQUE_NM  # as multiples of the trained one's
        self._steering_rad = (STEERING_RAD + HEAD_STEERING_RAD * (1.0 - share)) / count

    def start_from(self, angles_rad: NDArray[np.float64]) -> None:
        """What is felt then counts at once: the change to a wave is smooth anyway."""
        super().start_from(angles_rad)
        self._measured_rad = None

    def reference_rad(self, view: View, passed_s: float) -> NDArray[np.float64]:
        """Angles of all joints, a time later than before."""
        reference, bends, joints = super().reference_rad(view, passed_s), self._body.bends, view.joints
        felt = np.zeros(len(bends))
        shares = np.array(joints.torque_nm) / self._limits
        for measured, gains in zip((joints.angle_rad, joints.velocity_rad_s, shares), self._gains, strict=True):
            beside = np.pad(np.array(measured)[bends], 1)
            felt += gains[0] * beside[:-2] + gains[1] * beside[1:-1] + gains[2] * beside[2:]
        felt, upper_rad = self._max_measured_rad * np.tanh(felt), self._measured_rad_s * passed_s
        if self._measured_rad is not None:
            felt = self._measured_rad + np.clip(felt - self._measured_rad, -upper_rad, upper_rad)
        self._measured_rad = felt
        reference[bends] += felt
        return reference

    def _bend_rad(self, view: View) -> float | NDArray[np.float64]:
        """Towards the goal, not along a path: where obstacles push the body, it does not follow one."""
        if view.world is None or view.trajectory is None:
            return 0.0
        nodes = self._body.nodes_w(view.world, view.joints.angle_rad).T
        to_goal = (view.trajectory.goal_w or view.trajectory.path_w[-1]) - nodes[-1]
        return self._steering_rad * math.sin(aside_rad(nodes, to_goal))

    def _amplitude_rad(self, view: View, _waves: NDArray[np.float64], _passed_s: float) -> NDArray[np.float64]:
        forces_n = np.zeros(len(self._robot.links))
        for contact in view.world.contacts if view.world is not None else ():
            forces_n[contact.link] += math.hypot(*contact.force_w)
        behind, ahead = forces_n[:-1][self._body.bends], forces_n[1:][self._body.bends]
        return self._swing_rad + CONTACT_GAINS[0] * behind + CONTACT_GAINS[1] * ahead
