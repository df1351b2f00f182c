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
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.physics.motor import compute_torque_roll_off
from snakesim_hal.wire.messages import JointMode


class PowerStages:
    """The power stages of all joint modules. All are passive at first."""

    def __init__(self, robot: RobotFile, step_s: float) -> None:
        """Start with every motor passive and without torque.

        Args:
            robot: Robot file with the limits, lags and inertias of the joints.
            step_s: Duration of a step of the physics model.
        """
        joints = robot.joint_table
        count = len(joints)

        # Parameters, (n_joints,).
        self.full_torque_nm: Floats = np.array([joint.limits.torque_nm for joint in joints])
        self._lag_decay = np.array(
            [_compute_lag_decay(joint.motor.response_time_s, step_s) for joint in joints]
        )
        self._roll_off_slope = self._compute_roll_off_slopes(robot, step_s)  # N·m·s/rad

        # State.
        self.torque_nm: Floats = np.zeros(count)
        # Sum of torque squared over the steps since the last `pop_mean_square_torque`, N²·m², and their number.
        self.torque_squared_sum: Floats = np.zeros(count)
        self._step_count = 0

        # Demanded torque, by the latest setpoints: kp (position - angle) + kd (velocity - speed) + feedforward.
        self._kp = np.zeros(count)  # N·m/rad
        self._kd = np.zeros(count)  # N·m·s/rad
        self._position = np.zeros(count)  # rad
        self._velocity = np.zeros(count)  # rad/s
        self._feedforward = np.zeros(count)  # N·m

        # Speed-dependent limit of the demand: stall torque - slope * speed, and its mirror image.
        self._slope = np.zeros(count)  # N·m·s/rad
        # N·m, extrapolated to speed 0: above full torque.
        self._stall_torque = np.full(count, np.inf)

        # Limits of the torque, N·m: of the setpoint, of derating, and the smaller of both.
        self._setpoint_limit = self.full_torque_nm.copy()
        self._derated_limit = self.full_torque_nm.copy()
        self._limit = self._setpoint_limit.copy()

        # Intermediate results of a step, so that it allocates no memory, (n_joints,). `find_derated` reads the demand.
        self._demand = np.zeros(count)  # N·m
        self._damping_torque = np.zeros(count)  # N·m, kd (velocity - speed)
        self._torque_lost_by_speed = np.zeros(count)  # N·m, slope * speed
        self._max_demand = np.zeros(count)  # N·m, at this speed
        self._min_demand = np.zeros(count)  # N·m, at this speed
        self._max_torque = np.zeros(count)  # N·m
        self._min_torque = np.zeros(count)  # N·m
        self._torque_squared = np.zeros(count)  # N²·m²

    def _compute_roll_off_slopes(self, robot: RobotFile, step_s: float) -> Floats:
        """Return how much torque each motor loses per rad/s near its speed limit, (n_joints,), N·m·s/rad."""
        joints = robot.joint_table
        speed_limits_rad_s = np.array([joint.limits.speed_rad_s for joint in joints])
        steepness = np.array(
            [compute_torque_roll_off(joint, robot.module, step_s) for joint in joints]
        )
        return steepness * self.full_torque_nm / speed_limits_rad_s

    def set_demand(
        self,
        joint_index: int,
        mode: JointMode,
        target: float,
        torque_limit_nm: float,
        stiffness: float,
        damping: float,
        speed_limit_rad_s: float,
    ) -> None:
        """Set mode, target, gains, torque limit and speed limit of one motor.

        Args:
            joint_index: Index of the joint, from 0 at the tail.
            mode: Control mode of the drive.
            target: Target in rad, rad/s or N·m, depending on the mode. Ignored in passive mode.
            torque_limit_nm: Torque limit of the setpoint. Full torque limits it further.
            stiffness: Proportional gain kp of position mode, N·m/rad.
            damping: Derivative gain kd of position mode, and gain of velocity mode, N·m·s/rad.
            speed_limit_rad_s: Speed limit. Near it, the torque that accelerates the motor falls to 0.
        """
        self._kp[joint_index] = 0.0
        self._kd[joint_index] = 0.0
        self._position[joint_index] = 0.0
        self._velocity[joint_index] = 0.0
        self._feedforward[joint_index] = 0.0
        match mode:
            case JointMode.POSITION:
                self._kp[joint_index] = stiffness
                self._kd[joint_index] = damping
                self._position[joint_index] = target
            case JointMode.VELOCITY:
                self._kd[joint_index] = damping
                self._velocity[joint_index] = target
            case JointMode.TORQUE:
                self._feedforward[joint_index] = target
            case JointMode.PASSIVE:
                pass
        if mode == JointMode.PASSIVE:  # without a limit: the demand of a passive motor is 0
            self._slope[joint_index] = 0.0
            self._stall_torque[joint_index] = math.inf
        else:
            self._slope[joint_index] = self._roll_off_slope[joint_index]
            self._stall_torque[joint_index] = self._roll_off_slope[joint_index] * speed_limit_rad_s
        self._setpoint_limit[joint_index] = min(torque_limit_nm, self.full_torque_nm[joint_index])
        self._limit[joint_index] = min(
            self._setpoint_limit[joint_index], self._derated_limit[joint_index]
        )

    def apply_derating(self, remaining_fraction: Floats) -> None:
        """Limit every torque to a fraction of full torque, (n_joints,), from 0 to 1; lower demands are not reduced."""
        np.multiply(self.full_torque_nm, remaining_fraction, out=self._derated_limit)
        np.minimum(self._setpoint_limit, self._derated_limit, out=self._limit)

    def find_derated(self) -> NDArray[np.bool_]:
        """Return whether derating limits each torque below its demand, (n_joints,)."""
        requested_nm = np.minimum(np.abs(self._demand), self._setpoint_limit)
        return requested_nm > self._limit

    def compute_torques(self, angle_rad: Floats, speed_rad_s: Floats) -> Floats:
        """Return the torques for the next step of the physics model, (n_joints,), N·m.

        The result is always the same array, and no step allocates one.

        Args:
            angle_rad: Joint angles, (n_joints,).
            speed_rad_s: Joint velocities, (n_joints,).
        """
        demand = self._demand
        torque = self.torque_nm

        # demand = kp (position - angle) + kd (velocity - speed) + feedforward
        np.subtract(self._position, angle_rad, out=demand)
        demand *= self._kp
        damping_torque = self._damping_torque
        np.subtract(self._velocity, speed_rad_s, out=damping_torque)
        damping_torque *= self._kd
        demand += damping_torque
        demand += self._feedforward

        # demand <= stall torque - slope * speed
        torque_lost_by_speed = self._torque_lost_by_speed
        np.multiply(self._slope, speed_rad_s, out=torque_lost_by_speed)
        max_demand = self._max_demand
        np.subtract(self._stall_torque, torque_lost_by_speed, out=max_demand)
        np.minimum(demand, max_demand, out=demand)

        # demand >= -(stall torque + slope * speed)
        min_demand = self._min_demand
        np.add(torque_lost_by_speed, self._stall_torque, out=min_demand)
        np.negative(min_demand, out=min_demand)
        np.maximum(demand, min_demand, out=demand)

        # A lowered limit takes effect no faster than the motor can follow: max torque >= decay * |torque|
        max_torque = self._max_torque
        np.abs(torque, out=max_torque)
        max_torque *= self._lag_decay
        np.maximum(max_torque, self._limit, out=max_torque)

        # torque = demand + decay * (torque - demand)
        torque -= demand
        torque *= self._lag_decay
        torque += demand

        # -max torque <= torque <= max torque
        np.minimum(torque, max_torque, out=torque)
        min_torque = self._min_torque
        np.negative(max_torque, out=min_torque)
        np.maximum(torque, min_torque, out=torque)

        # For the heat of the windings.
        torque_squared = self._torque_squared
        np.multiply(torque, torque, out=torque_squared)
        self.torque_squared_sum += torque_squared
        self._step_count += 1
        return torque

    def pop_mean_square_torque(self) -> Floats:
        """Return the mean square of each torque since the last call, N²·m², (n_joints,), and start a new mean."""
        mean = self.torque_squared_sum / max(self._step_count, 1)
        self.torque_squared_sum[:] = 0.0
        self._step_count = 0
        return mean


def _compute_lag_decay(lag_s: float, step_s: float) -> float:
    """Return the fraction of a deviation from the demand that is left after a step; 0 without a lag."""
    if lag_s > 0:
        return math.exp(-step_s / lag_s)
    return 0.0
