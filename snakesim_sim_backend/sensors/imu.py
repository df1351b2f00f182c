"""The IMU of every link."""

import mujoco
import numpy as np

from snakesim_hal.model.robot_file.sensors import ImuSensor
from snakesim_hal.wire.messages import Imu
from snakesim_sim_backend.sensors.scope import Normal


class ImuReader:
    """Angular velocity and specific force (as of an accelerometer: 1 g upwards at rest) at every link's middle."""

    def __init__(self, data: mujoco.MjData, sensor: ImuSensor, count: int, noise: Normal) -> None:
        self._count = count
        self._values = data.sensordata  # gyros of all links, then accelerometers: see add_imus
        sigma = [sensor.angular_velocity_noise_rad_s, sensor.acceleration_noise_m_s2]
        self._sigma = np.repeat(sigma, 3 * count)
        self._noise = noise if any(sigma) else None
        self._links = list(range(count))

    def read(self, tick: int, timestamp_ns: int) -> Imu:
        """Return one entry per link, tail to head."""
        values = self._values
        if self._noise is not None:
            values = values + self._sigma * self._noise(len(self._sigma))
        triples = list(map(tuple, values.reshape(-1, 3).tolist()))
        return Imu(
            tick=tick,
            timestamp_ns=timestamp_ns,
            link=self._links,
            angular_velocity_rad_s=triples[: self._count],
            acceleration_m_s2=triples[self._count :],
        )
