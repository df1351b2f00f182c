"""Angle, velocity and torque of every joint."""

from collections import deque

import mujoco
import numpy as np

from snakesim_hal.model.robot_file.sensors import JointSensor
from snakesim_hal.wire.messages import JointState
from snakesim_sim_backend.actuators import ModelMotors
from snakesim_sim_backend.model.build import view_joint_states
from snakesim_sim_backend.sensors.scope import Normal
from snakesim_sim_backend.sensors.timing import round_to_ticks


class JointReader:
    """Angle, velocity and torque of every joint, every tick.

    A delayed reading has the timestamp of its tick, and its age is the delay. Until the first one is delivered, the
    reading of the start is used.
    """

    def __init__(
        self,
        data: mujoco.MjData,
        sensor: JointSensor,
        motors: ModelMotors,
        noise: Normal,
        period_ns: int,
    ) -> None:
        count = motors.count
        self._unmeasured_torque_indices = [
            2 * count + i for i in motors.joints_without_torque_sensor
        ]
        self._count = count
        self._angles, self._velocities = view_joint_states(data, count)
        self._torques = motors.get_applied_torque_nm()
        sigma = [sensor.angle_noise_rad, sensor.velocity_noise_rad_s, sensor.torque_noise_nm]
        self._sigma = np.repeat(sigma, count)
        self._noise = noise if any(sigma) else None
        self._all_valid = [True] * count
        # Timestamps and values, oldest first. It drops the delivered reading when it is full.
        delay_ticks = round_to_ticks(sensor.delay_s, period_ns)
        self._delay_queue: deque[tuple[int, list[float]]] = deque(maxlen=1 + delay_ticks)

    def read(self, tick: int, timestamp_ns: int) -> JointState:
        """Measure all joints with noise, and return the reading that is delivered at this tick.

        The returned reading is older than the tick by the delay of the joint sensors.

        Args:
            tick: Tick of the message.
            timestamp_ns: Robot time of the tick in ns.
        """
        values = np.concatenate((self._angles, self._velocities, self._torques))
        count = self._count
        if self._noise is not None:
            values += self._sigma * self._noise(3 * count)
        if self._unmeasured_torque_indices:
            values[self._unmeasured_torque_indices] = 0.0
        self._delay_queue.append((timestamp_ns, values.tolist()))
        measured_ns, delivered_values = self._delay_queue[0]
        return JointState(
            tick=tick,
            timestamp_ns=timestamp_ns,
            angle_rad=delivered_values[:count],
            velocity_rad_s=delivered_values[count : 2 * count],
            torque_nm=delivered_values[2 * count :],
            valid=self._all_valid,
            age_ns=[timestamp_ns - measured_ns] * count,
        )
