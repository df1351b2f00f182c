"""Sensor readings of modules at a Sync: the physics_model's state, with the noise and threshold of the robot file.

The host sets the rates of the modules, and the bus is the delay: rates and delays of the robot file are not used here.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from snakesim_can_backend.emulator.frames import (
    ACCELERATION,
    ANGLE,
    NO_CONTACT,
    RATE,
    SHAFT_LOAD,
    TORQUE,
    VELOCITY,
    ModuleReadings,
    encode_contact,
)
from snakesim_drivers.mounting import Mounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.physics.physics_model import LinkLoad, PhysicsModel


class ModuleSensors:
    """Sensors of neighboring modules on one bus, with a noise generator of their own."""

    def __init__(
        self, robot: RobotFile, physics_model: PhysicsModel, mounting: Mounting, first: int, seed: Sequence[int]
    ) -> None:
        """mounting: of these modules; first: index of their first joint, 0 at the tail."""
        count = len(mounting.sign)
        self._physics_model, self._mounting, self._first, self._count = physics_model, mounting, first, count
        self._noise = np.random.default_rng(seed).standard_normal
        joints = robot.sensors.joints
        sigma = [joints.angle_noise_rad, joints.velocity_noise_rad_s, joints.torque_noise_nm]
        self._joint_sigma = np.repeat(sigma, count).reshape(3, count)
        self._noisy = any(sigma)
        self._contacts, self._imu = robot.sensors.contacts, robot.sensors.imu
        self._torque_sigma = joints.torque_noise_nm

    def read(self, torque_nm: Floats, derated: NDArray[np.bool_], imu_due: Sequence[bool]) -> list[ModuleReadings]:
        """The readings of every module now; torque and derating are those of all motors of the chain."""
        here = slice(self._first, self._first + self._count)
        joints = np.stack(
            (self._physics_model.angle_rad[here], self._physics_model.velocity_rad_s[here], torque_nm[here])
        )
        if self._noisy:
            joints += self._joint_sigma * self._noise((3, self._count))
        angles = self._mounting.drive_angle_rad(joints[0])
        velocities, torques = self._mounting.drive_velocity_rad_s(joints[1]), self._mounting.drive_torque_nm(joints[2])
        readings = [
            ModuleReadings(angle, velocity, torque, bool(hot))
            for angle, velocity, torque, hot in zip(
                ANGLE.to_raw_array(angles),
                VELOCITY.to_raw_array(velocities),
                TORQUE.to_raw_array(torques),
                derated[here],
                strict=True,
            )
        ]
        self._feel(readings)
        if any(imu_due):
            self._weigh(readings, imu_due)
        return readings

    def _feel(self, readings: list[ModuleReadings]) -> None:
        sensor = self._contacts
        if sensor is None:
            return
        touches = {
            load.link: encode_contact(self._blurred(load))
            for load in self._physics_model.loads()
            if math.hypot(*load.force_l) >= sensor.threshold_n
        }
        for i, reading in enumerate(readings if touches else ()):
            reading.tail_contact = touches.get(self._first + i, NO_CONTACT)
            reading.contact = touches.get(self._first + i + 1, NO_CONTACT)

    def _blurred(self, load: LinkLoad) -> LinkLoad:
        sensor = self._contacts
        if sensor is None or not (sensor.position_noise_m or sensor.force_noise_n):
            return load
        a, b, c, d, e, f = self._noise(6).tolist()
        (x, y, z), (fx, fy, fz) = load.position_l, load.force_l
        m, n = sensor.position_noise_m, sensor.force_noise_n
        return LinkLoad(load.link, (x + m * a, y + m * b, z + m * c), (fx + n * d, fy + n * e, fz + n * f))

    def _weigh(self, readings: list[ModuleReadings], due: Sequence[bool]) -> None:
        shaft = self._physics_model.shaft_torque_nm()[self._first : self._first + self._count]
        noise = self._torque_sigma * self._noise(self._count)
        shafts = SHAFT_LOAD.to_raw_array(self._mounting.drive_torque_nm(shaft + noise))
        imu = self._physics_model.imu() if self._imu is not None else None
        for i, reading in enumerate(readings):
            if not due[i]:
                continue
            reading.shaft_load = shafts[i]
            if imu is not None and self._imu is not None and self._first + i + 1 in imu.link:
                at = imu.link.index(self._first + i + 1)
                rate = np.array(imu.angular_velocity_rad_s[at])
                force = np.array(imu.acceleration_m_s2[at])
                reading.gyro = RATE.to_raw_array(rate + self._imu.angular_velocity_noise_rad_s * self._noise(3))
                reading.acceleration = ACCELERATION.to_raw_array(
                    force + self._imu.acceleration_noise_m_s2 * self._noise(3)
                )
