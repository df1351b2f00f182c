"""A 2-D lidar, or with one beam a range finder, by ray casting."""

import numpy as np

from snakesim_hal.model.robot_file.sensor_model import NoSettings, SensorModel
from snakesim_hal.model.robot_file.sensors import RangeSensor
from snakesim_hal.wire.messages import RangeScan
from snakesim_sim_backend.sensors.mount import SensorMount
from snakesim_sim_backend.sensors.rays import RayBundle
from snakesim_sim_backend.sensors.scope import SensorScope


class RayBeams(SensorModel):
    """Distances along beams without width, all measured at once."""

    message = RangeScan

    def __init__(self, sensor: RangeSensor, scope: SensorScope, settings: NoSettings) -> None:
        del settings
        self._sensor = sensor
        self._noise = scope.noise
        self._mount = SensorMount(sensor, scope)
        self._first_rad = -sensor.fov_rad / 2
        self._step_rad = sensor.fov_rad / max(sensor.beams - 1, 1)
        angles = self._first_rad + self._step_rad * np.arange(sensor.beams)
        rays_s = np.stack([np.cos(angles), np.sin(angles), np.zeros(sensor.beams)], -1)
        self._rays = RayBundle(self._mount, scope, rays_s, sensor.range_max_m)

    def read(self, tick: int, timestamp_ns: int) -> RangeScan:
        """Measure the distances along all beams, from the current place of the sensor.

        Distances have noise. The distance of a beam is None if it hits nothing within the sensor's range, or drops out
        at random.

        Args:
            tick: Tick of the message.
            timestamp_ns: Robot time of the tick in ns.
        """
        sensor = self._sensor
        distances_m = self._rays.cast()
        is_measured = (distances_m >= sensor.range_min_m) & (distances_m <= sensor.range_max_m)
        if sensor.noise_m:
            distances_m = np.maximum(
                distances_m + sensor.noise_m * self._noise.standard_normal(sensor.beams), 0.0
            )
        if sensor.dropout:
            is_measured &= self._noise.random(sensor.beams) >= sensor.dropout
        ranges_m = [
            distance_m if is_valid else None
            for distance_m, is_valid in zip(distances_m.tolist(), is_measured.tolist(), strict=True)
        ]
        return RangeScan(
            tick=tick,
            timestamp_ns=timestamp_ns,
            link=self._mount.link,
            position_l=self._mount.position_l,
            orientation_l_wxyz=self._mount.orientation_l_wxyz,
            angle_min_rad=self._first_rad,
            angle_step_rad=self._step_rad,
            range_min_m=sensor.range_min_m,
            range_max_m=sensor.range_max_m,
            range_m=ranges_m,
        )
