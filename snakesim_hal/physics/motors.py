"""All motors of a chain as vectors, by the law of the simulator's motors, so that the two agree.

At every step of the physics model

    demand = kp (position - angle) + kd (velocity - speed) + feed-forward       the mode chooses the gains
    demand is limited by the line that falls from a multiple of full torque at rest to 0 at the speed limit
    torque follows the demand as a first-order lag of `response_time_s`, integrated exactly
    torque is clipped to the smallest of the setpoint's limit, the parameter's, and the derated full torque

The torque is the motor's state, and a change of mode or limit changes only the demand, so torque never jumps. Torque is
updated before the joint moves under it, which keeps explicit steps stable far beyond 1 ms.
"""

import math

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.physics.motor import roll_off
from snakesim_hal.wire.messages import Mode


class Motors:
    """The power stages of all modules. All passive at first."""

    def __init__(self, robot: RobotFile, step_s: float) -> None:
        joints = robot.joint_table
        count = len(joints)
        lags_s = [joint.motor.response_time_s for joint in joints]
        self.full_nm: Floats = np.array([joint.limits.torque_nm for joint in joints])
        self._decay = np.array([math.exp(-step_s / lag_s) if lag_s > 0 else 0.0 for lag_s in lags_s])
        speeds = np.array([joint.limits.speed_rad_s for joint in joints])
        steepness = np.array([roll_off(joint, robot.module, step_s) for joint in joints])
        self._fading = steepness * self.full_nm / speeds  # N·m less a rad/s
        self.torque_nm: Floats = np.zeros(count)
        self.heat: Floats = np.zeros(count)  # sum of torque squared over the steps since `take_heat`
        self._steps = 0
        self._kp, self._kd = np.zeros(count), np.zeros(count)
        self._position, self._velocity, self._feed = np.zeros(count), np.zeros(count), np.zeros(count)
        self._slope, self._top = np.zeros(count), np.full(count, np.inf)
        self._asked_limit = self.full_nm.copy()
        self._own_limit = self.full_nm.copy()
        self._limit = self._asked_limit.copy()
        self._demand, self._cap, self._spare = np.zeros(count), np.zeros(count), np.zeros(count)

    def drive(
        self, i: int, mode: Mode, target: float, limit_nm: float, gain: float, damping: float, speed: float
    ) -> None:
        """Set the demand of motor i.

        target: rad, rad/s or N·m as the mode says; gain, damping: kp and kd of the mode; speed: the limit, rad/s.
        """
        on = mode != Mode.PASSIVE
        self._kp[i] = gain if mode == Mode.POSITION else 0.0
        self._kd[i] = damping if mode in (Mode.POSITION, Mode.VELOCITY) else 0.0
        self._position[i] = target if mode == Mode.POSITION else 0.0
        self._velocity[i] = target if mode == Mode.VELOCITY else 0.0
        self._feed[i] = target if mode == Mode.TORQUE else 0.0
        self._slope[i] = self._fading[i] if on else 0.0
        self._top[i] = self._fading[i] * speed if on else math.inf
        self._asked_limit[i] = min(limit_nm, self.full_nm[i])
        self._limit[i] = min(self._asked_limit[i], self._own_limit[i])

    def derate(self, remaining_fraction: Floats) -> None:
        """Limit torque to this share of full torque, (n_joints,), from 0 to 1; lower demands are not reduced."""
        np.multiply(self.full_nm, remaining_fraction, out=self._own_limit)
        np.minimum(self._asked_limit, self._own_limit, out=self._limit)

    def derated(self) -> NDArray[np.bool_]:
        """Whether derating limits a torque below the demand, (n_joints,)."""
        return np.minimum(np.abs(self._demand), self._asked_limit) > self._limit

    def step(self, angle_rad: Floats, speed_rad_s: Floats) -> Floats:
        """Torques for the next step of the physics model, (n_joints,); always the same array."""
        demand, cap, spare, torque = self._demand, self._cap, self._spare, self.torque_nm
        np.subtract(self._position, angle_rad, out=demand)
        demand *= self._kp
        np.subtract(self._velocity, speed_rad_s, out=spare)
        spare *= self._kd
        demand += spare
        demand += self._feed
        np.multiply(self._slope, speed_rad_s, out=spare)
        np.subtract(self._top, spare, out=cap)
        np.minimum(demand, cap, out=demand)
        spare += self._top
        np.negative(spare, out=spare)
        np.maximum(demand, spare, out=demand)
        np.abs(torque, out=cap)
        cap *= self._decay
        np.maximum(cap, self._limit, out=cap)  # a lowered limit takes effect no faster than the motor can follow
        torque -= demand
        torque *= self._decay
        torque += demand
        np.minimum(torque, cap, out=torque)
        np.negative(cap, out=cap)
        np.maximum(torque, cap, out=torque)
        np.multiply(torque, torque, out=spare)
        self.heat += spare
        self._steps += 1
        return torque

    def take_heat(self) -> Floats:
        """Mean square of each torque since the last call, N²·m², (n_joints,)."""
        mean = self.heat / max(self._steps, 1)
        self.heat[:] = 0.0
        self._steps = 0
        return mean
