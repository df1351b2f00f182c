"""Angle, velocity and torque of every joint."""

from collections import deque

import mujoco
import numpy as np

from snakesim_hal.model.sensors import JointSensor
from snakesim_hal.wire.messages import JointState
from snakesim_sim_backend.actuators import Motors
from snakesim_sim_backend.model.build import of_joints
from snakesim_sim_backend.sensors.scope import Normal
from snakesim_sim_backend.sensors.timing import round_to_ticks


class JointReader:
    """Angle, velocity and torque of every joint, every tick.

    A delayed reading has the timestamp of its tick, and its age is the delay. Until the first one is delivered, the
    reading of the start is used.
    """

    def __init__(self, data: mujoco.MjData, sensor: JointSensor, motors: Motors, noise: Normal, period_ns: int) -> None:
        count = motors.count
        self._unmeasured = [2 * count + i for i in motors.without_torque]
        self._count = count
        self._angles, self._velocities = of_joints(data, count)
        self._torques = motors.applied_nm()
        sigma = [sensor.angle_noise_rad, sensor.velocity_noise_rad_s, sensor.torque_noise_nm]
        self._sigma = np.repeat(sigma, count)
        self._noise = noise if any(sigma) else None
        self._all_valid = [True] * count
        self._waiting: deque[tuple[int, list[float]]] = deque(maxlen=1 + round_to_ticks(sensor.delay_s, period_ns))

    def read(self, tick: int, timestamp_ns: int) -> JointState:
        """Measure all joints with noise, and return the reading that is delivered at this tick.

        It is older than the tick by the delay of the joint sensors.

        Args:
            tick: tick of the message.
            timestamp_ns: robot time of the tick.
        """
        values = np.concatenate((self._angles, self._velocities, self._torques))
        count = self._count
        if self._noise is not None:
            values += self._sigma * self._noise(3 * count)
        if self._unmeasured:
            values[self._unmeasured] = 0.0
        self._waiting.append((timestamp_ns, values.tolist()))
        sampled_ns, numbers = self._waiting[0]
        return JointState(
            tick=tick,
            timestamp_ns=timestamp_ns,
            angle_rad=numbers[:count],
            velocity_rad_s=numbers[count : 2 * count],
            torque_nm=numbers[2 * count :],
            valid=self._all_valid,
            age_ns=[timestamp_ns - sampled_ns] * count,
        )
