"""All motors of a chain as vectors. They follow the law of the simulator's motors, so that the two agree.

At every step of the physics model

    demand = kp (position - angle) + kd (velocity - speed) + feedforward        the mode chooses the gains
    demand is limited by the line that falls from a multiple of full torque at rest to 0 at the speed limit
    torque follows the demand as a first-order lag of `response_time_s`, integrated exactly
    torque is clipped to the smallest of the setpoint's limit, the parameter's, and the derated full torque

The torque is the state of a motor. A change of mode or limit changes only the demand, so torque never jumps. Torque is
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
    """The power stages of all joint modules. All are passive at first."""

    def __init__(self, robot: RobotFile, step_s: float) -> None:
        """Start with every motor passive and without torque.

        Args:
            robot: gives limits, lags and inertias of the joints.
            step_s: duration of a step of the physics model.
        """
        joints = robot.joint_table
        count = len(joints)

        # Parameters, (n_joints,).
        self.full_nm: Floats = np.array([joint.limits.torque_nm for joint in joints])
        self._decay = np.array([_lag_decay(joint.motor.response_time_s, step_s) for joint in joints])
        self._fading = self._fading_nm_s(robot, step_s)

        # State.
        self.torque_nm: Floats = np.zeros(count)
        self.heat: Floats = np.zeros(
            count
        )  # N²·m²; sum of torque squared over the steps since `pop_mean_square_torque`
        self._steps = 0  # since `pop_mean_square_torque`

        # Demand, by the latest setpoints: kp (position - angle) + kd (velocity - speed) + feedforward.
        self._kp = np.zeros(count)  # N·m/rad
        self._kd = np.zeros(count)  # N·m·s/rad
        self._position = np.zeros(count)  # rad
        self._velocity = np.zeros(count)  # rad/s
        self._feedforward = np.zeros(count)  # N·m

        # Limits of the demand: top - slope * speed, and its mirror image.
        self._slope = np.zeros(count)  # N·m·s/rad
        self._top = np.full(count, np.inf)  # N·m

        # Limits of the torque, N·m: of the setpoint, of derating, and the smaller of both.
        self._setpoint_limit = self.full_nm.copy()
        self._derated_limit = self.full_nm.copy()
        self._limit = self._setpoint_limit.copy()

        # Buffers, so that a step allocates nothing. `derated` reads the demand of the last step.
        self._demand = np.zeros(count)
        self._cap = np.zeros(count)
        self._spare = np.zeros(count)

    def _fading_nm_s(self, robot: RobotFile, step_s: float) -> Floats:
        """Return how much torque each motor loses per rad/s near its speed limit, (n_joints,), N·m·s/rad."""
        joints = robot.joint_table
        speed_limits_rad_s = np.array([joint.limits.speed_rad_s for joint in joints])
        steepness = np.array([roll_off(joint, robot.module, step_s) for joint in joints])
        return steepness * self.full_nm / speed_limits_rad_s

    def set_demand(
        self, i: int, mode: Mode, target: float, limit_nm: float, gain: float, damping: float, speed: float
    ) -> None:
        """Set the demand of one motor.

        Args:
            i: index of the joint from the tail.
            mode: of the drive.
            target: rad, rad/s or N·m, depending on the mode; ignored in passive mode.
            limit_nm: torque limit of the setpoint.
            gain: kp of position mode, N·m/rad.
            damping: kd of position and velocity mode, N·m·s/rad.
            speed: speed limit, rad/s.
        """
        self._kp[i] = 0.0
        self._kd[i] = 0.0
        self._position[i] = 0.0
        self._velocity[i] = 0.0
        self._feedforward[i] = 0.0
        match mode:
            case Mode.POSITION:
                self._kp[i] = gain
                self._kd[i] = damping
                self._position[i] = target
            case Mode.VELOCITY:
                self._kd[i] = damping
                self._velocity[i] = target
            case Mode.TORQUE:
                self._feedforward[i] = target
            case Mode.PASSIVE:
                pass
        if mode == Mode.PASSIVE:
            self._slope[i] = 0.0
            self._top[i] = math.inf
        else:
            self._slope[i] = self._fading[i]
            self._top[i] = self._fading[i] * speed
        self._setpoint_limit[i] = min(limit_nm, self.full_nm[i])
        self._limit[i] = min(self._setpoint_limit[i], self._derated_limit[i])

    def derate(self, remaining_fraction: Floats) -> None:
        """Limit every torque to a fraction of full torque, (n_joints,), from 0 to 1; lower demands are not reduced."""
        np.multiply(self.full_nm, remaining_fraction, out=self._derated_limit)
        np.minimum(self._setpoint_limit, self._derated_limit, out=self._limit)

    def derated(self) -> NDArray[np.bool_]:
        """Return whether derating limits each torque below its demand, (n_joints,)."""
        wanted_nm = np.minimum(np.abs(self._demand), self._setpoint_limit)
        return wanted_nm > self._limit

    def step(self, angle_rad: Floats, speed_rad_s: Floats) -> Floats:
        """Return the torques for the next step of the physics model, (n_joints,), N·m.

        The result is always the same array, and no step allocates one.

        Args:
            angle_rad: joint angles, (n_joints,).
            speed_rad_s: joint velocities, (n_joints,).
        """
        demand = self._demand
        cap = self._cap
        spare = self._spare
        torque = self.torque_nm

        # demand = kp (position - angle) + kd (velocity - speed) + feedforward
        np.subtract(self._position, angle_rad, out=demand)
        demand *= self._kp
        np.subtract(self._velocity, speed_rad_s, out=spare)
        spare *= self._kd
        demand += spare
        demand += self._feedforward

        # -(top + slope * speed) <= demand <= top - slope * speed
        np.multiply(self._slope, speed_rad_s, out=spare)
        np.subtract(self._top, spare, out=cap)
        np.minimum(demand, cap, out=demand)
        spare += self._top
        np.negative(spare, out=spare)
        np.maximum(demand, spare, out=demand)

        # A lowered limit takes effect no faster than the motor can follow.
        np.abs(torque, out=cap)
        cap *= self._decay
        np.maximum(cap, self._limit, out=cap)

        # torque = demand + decay * (torque - demand), within the limit
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

    def pop_mean_square_torque(self) -> Floats:
        """Return the mean square of each torque since the last call, N²·m², (n_joints,), and start a new mean."""
        mean = self.heat / max(self._steps, 1)
        self.heat[:] = 0.0
        self._steps = 0
        return mean


def _lag_decay(lag_s: float, step_s: float) -> float:
    """Return the fraction of a deviation from the demand that is left after a step; 0 without a lag."""
    if lag_s > 0:
        return math.exp(-step_s / lag_s)
    return 0.0
