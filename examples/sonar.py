"""A custom sensor model: a sonar that measures the distance to the nearest surface in a cone.

[[sensors.range]]
name = "sonar"
model = "./examples/sonar.py:Sonar"
range_max_m = 2.0
settings = { cone_rad = 0.5 }
"""

import math

import numpy as np

from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.robot_file.sensor_model import SensorModel
from snakesim_hal.wire.messages import RangeScan
from snakesim_sim_backend.sensors.mount import SensorMount
from snakesim_sim_backend.sensors.rays import RayBundle

RAYS = 200


class Sonar(SensorModel):
    class Settings(FileStruct, frozen=True):
        cone_rad: float = 0.5  # from edge to edge

    message = RangeScan

    def __init__(self, sensor, scope, settings):
        self._sensor, self._noise = sensor, scope.noise
        self._mount = SensorMount(sensor, scope)
        # Sunflower spiral over the cone's cap.
        off = settings.cone_rad / 2 * np.sqrt((np.arange(RAYS) + 0.5) / RAYS)
        turn = math.pi * (3 - math.sqrt(5)) * np.arange(RAYS)
        cone = np.stack([np.cos(off), np.sin(off) * np.cos(turn), np.sin(off) * np.sin(turn)], -1)
        self._rays = RayBundle(self._mount, scope, cone, sensor.range_max_m)

    def read(self, tick, timestamp_ns):
        sensor = self._sensor
        echoes = self._rays.cast()
        echoes = echoes[(echoes >= sensor.range_min_m) & (echoes <= sensor.range_max_m)]
        nearest = None
        if len(echoes):
            nearest = max(float(echoes.min() + sensor.noise_m * self._noise.standard_normal()), 0.0)
        return RangeScan(
            tick=tick,
            timestamp_ns=timestamp_ns,
            link=self._mount.link,
            position_l=self._mount.position_l,
            orientation_l_wxyz=self._mount.orientation_l_wxyz,
            angle_min_rad=0.0,
            angle_step_rad=0.0,
            range_min_m=sensor.range_min_m,
            range_max_m=sensor.range_max_m,
            range_m=[nearest],
        )
