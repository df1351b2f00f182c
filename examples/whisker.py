"""A custom sensor with its own message: a whisker that measures how far it is bent. See docs/how-to/custom-sensors.md.

In the robot file, or as planar13_whiskers.toml beside this file has it:

[[sensors.custom]]
name = "left"
model = "./examples/whisker.py:WhiskerModel"
position_m = [0.08, 0.03, 0.0]
yaw_rad = 1.2
settings = { length_m = 0.12 }
"""

import math
from typing import Annotated

import numpy as np

from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.robot_file.sensor_model import SensorModel
from snakesim_hal.wire.messages import CustomSample
from snakesim_hal.wire.quantities import bounded, describe

STEPS = 45  # to either side


class Whisker(CustomSample, frozen=True, kw_only=True):
    """A hair at a link, and how far what it touches has bent it."""

    bend_rad: Annotated[
        float,
        bounded(-1.6, 1.6, "rad"),
        describe("from its rest, positive to the left; 0: it is free"),
    ]
    bend_max_rad: Annotated[
        float, bounded(0.1, 1.6, "rad"), describe("it bends no further: there it is pressed flat")
    ]

    def find_contradiction(self) -> str:
        if abs(self.bend_rad) <= self.bend_max_rad:
            return ""
        return f"bent by {self.bend_rad} rad, and it bends no further than {self.bend_max_rad} rad"


class WhiskerModel(SensorModel):
    """A straight hair with a hinge at its root, which gives way to the nearer side, as far as it must."""

    class Settings(FileStruct, frozen=True):
        length_m: Annotated[float, bounded(0.01, 0.5, "m")] = 0.1
        bend_max_rad: Annotated[float, bounded(0.1, 1.6, "rad")] = 1.4
        noise_rad: Annotated[float, bounded(0, 0.5, "rad")] = 0.0

    message = Whisker

    def __init__(self, sensor, scope, settings):
        # Only here: a robot whose driver publishes a Whisker needs this file for the message, and no simulator.
        from snakesim_sim_backend.sensors.mount import SensorMount
        from snakesim_sim_backend.sensors.rays import RayBundle

        self._settings, self._noise = settings, scope.noise
        self._mount = SensorMount(sensor, scope)
        step_rad = settings.bend_max_rad / STEPS
        # The least bent first.
        self._bends_rad = step_rad * np.array(sorted(range(-STEPS, STEPS + 1), key=abs))
        fan = np.stack(
            [np.cos(self._bends_rad), np.sin(self._bends_rad), np.zeros(2 * STEPS + 1)], -1
        )
        self._rays = RayBundle(self._mount, scope, fan * settings.length_m, 1.0)

    def read(self, tick, timestamp_ns):
        upper_rad = self._settings.bend_max_rad
        free = np.flatnonzero(self._rays.cast() >= 1.0)  # in lengths of the hair
        bend_rad = (
            self._bends_rad[free[0]] if len(free) else math.copysign(upper_rad, self._bends_rad[1])
        )
        bend_rad += self._settings.noise_rad * self._noise.standard_normal()
        return Whisker(
            tick=tick,
            timestamp_ns=timestamp_ns,
            link=self._mount.link,
            position_l=self._mount.position_l,
            orientation_l_wxyz=self._mount.orientation_l_wxyz,
            bend_rad=float(np.clip(bend_rad, -upper_rad, upper_rad)),
            bend_max_rad=upper_rad,
        )
