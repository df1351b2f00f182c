"""Sensor readings of modules at a Sync: the state of the physics model, with the robot file's noise and threshold.

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
from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.physics.physics_model import LinkLoad, PhysicsModel
from snakesim_hal.wire.messages import Imu


class ModuleSensors:
    """Sensors of neighboring modules on one bus, with a noise generator of their own."""

    def __init__(
        self,
        robot: RobotFile,
        physics_model: PhysicsModel,
        mounting: DriveMounting,
        first_joint_index: int,
        seed: Sequence[int],
    ) -> None:
        """Create the emulated sensors of the modules on one bus, with a noise generator of their own.

        Args:
            robot: Robot file, with noise and thresholds.
            physics_model: Physics model whose motion and contacts are measured.
            mounting: Sign, gear and zero from each joint to the shaft of its module.
            first_joint_index: Index in the robot of the first joint on this bus, 0 at the tail.
            seed: Entropy for `numpy.random.default_rng`, from which the noise is drawn.
        """
        # The joints of this bus.
        self._physics_model = physics_model
        self._mounting = mounting
        self._first_joint = first_joint_index
        self._joint_count = len(mounting.sign)
        self._joints = slice(first_joint_index, first_joint_index + self._joint_count)

        # Sensors and their noise.
        self._draw_standard_normal = np.random.default_rng(seed).standard_normal
        self._contact_sensor = robot.sensors.contacts
        self._imu_sensor = robot.sensors.imu
        joints = robot.sensors.joints
        # One row each for angle in rad, velocity in rad/s and torque in N·m; one column for each joint.
        sigmas = [joints.angle_noise_rad, joints.velocity_noise_rad_s, joints.torque_noise_nm]
        self._joint_sigma = np.repeat(sigmas, self._joint_count).reshape(3, self._joint_count)
        self._has_joint_noise = any(sigmas)
        self._torque_sigma_nm = joints.torque_noise_nm

    def read(
        self, torque_nm: Floats, derated: NDArray[np.bool_], is_imu_due: Sequence[bool]
    ) -> list[ModuleReadings]:
        """Return the current readings of every module on this bus.

        Args:
            torque_nm: Torques of all motors of the chain, (n_joints,).
            derated: Whether each motor of the chain is derated, (n_joints,).
            is_imu_due: Whether each module on this bus reports its IMU and shaft load.
        """
        readings = self._read_joints(torque_nm, derated)
        self._add_contacts(readings)
        if any(is_imu_due):
            self._add_imus(readings, is_imu_due)
        return readings

    def _read_joints(self, torque_nm: Floats, derated: NDArray[np.bool_]) -> list[ModuleReadings]:
        """Return readings with angle, velocity and torque of the modules' shafts."""
        model = self._physics_model
        joint_slice = self._joints
        joints = np.stack(
            (
                model.angle_rad[joint_slice],
                model.velocity_rad_s[joint_slice],
                torque_nm[joint_slice],
            )
        )
        if self._has_joint_noise:
            joints += self._joint_sigma * self._draw_standard_normal((3, self._joint_count))
        angle_rad, velocity_rad_s, joint_torque_nm = joints
        rows = zip(
            ANGLE.to_raw_array(self._mounting.to_drive_angle_rad(angle_rad)),
            VELOCITY.to_raw_array(self._mounting.to_drive_velocity_rad_s(velocity_rad_s)),
            TORQUE.to_raw_array(self._mounting.to_drive_torque_nm(joint_torque_nm)),
            derated[joint_slice],
            strict=True,
        )
        return [
            ModuleReadings(angle, velocity, torque, bool(hot))
            for angle, velocity, torque, hot in rows
        ]

    def _add_contacts(self, readings: list[ModuleReadings]) -> None:
        """Add the contacts whose force is above the threshold."""
        sensor = self._contact_sensor
        if sensor is None:
            return
        contacts: dict[int, tuple[int, ...]] = {}  # by link
        for load in self._physics_model.loads():
            if math.hypot(*load.force_l) >= sensor.threshold_n:
                contacts[load.link] = encode_contact(self._add_contact_noise(load))
        if not contacts:
            return
        for i, reading in enumerate(readings):
            tail_link = self._first_joint + i
            reading.tail_contact = contacts.get(tail_link, NO_CONTACT)
            reading.contact = contacts.get(tail_link + 1, NO_CONTACT)

    def _add_contact_noise(self, load: LinkLoad) -> LinkLoad:
        sensor = self._contact_sensor
        if sensor is None or not (sensor.position_noise_m or sensor.force_noise_n):
            return load
        noise = self._draw_standard_normal(6).tolist()
        x, y, z = load.position_l
        force_x, force_y, force_z = load.force_l
        sigma_m = sensor.position_noise_m
        sigma_n = sensor.force_noise_n
        position = (x + sigma_m * noise[0], y + sigma_m * noise[1], z + sigma_m * noise[2])
        force = (
            force_x + sigma_n * noise[3],
            force_y + sigma_n * noise[4],
            force_z + sigma_n * noise[5],
        )
        return LinkLoad(load.link, position, force)

    def _add_imus(self, readings: list[ModuleReadings], due: Sequence[bool]) -> None:
        """Add shaft load, gyro and accelerometer to the readings of the modules that report them."""
        shaft_torque_nm = self._physics_model.shaft_torque_nm()[self._joints]
        noise_nm = self._torque_sigma_nm * self._draw_standard_normal(self._joint_count)
        shaft_loads = SHAFT_LOAD.to_raw_array(
            self._mounting.to_drive_torque_nm(shaft_torque_nm + noise_nm)
        )
        imu = self._physics_model.imu() if self._imu_sensor is not None else None
        for i, reading in enumerate(readings):
            if not due[i]:
                continue
            reading.shaft_load = shaft_loads[i]
            if imu is not None:
                self._add_imu(reading, imu, link_index=self._first_joint + i + 1)

    def _add_imu(self, reading: ModuleReadings, imu: Imu, link_index: int) -> None:
        """Add the IMU of a link, if it has one."""
        sensor = self._imu_sensor
        if sensor is None or link_index not in imu.link:
            return
        index = imu.link.index(link_index)
        rate_rad_s = np.array(imu.angular_velocity_rad_s[index])
        acceleration_m_s2 = np.array(imu.acceleration_m_s2[index])
        reading.gyro = RATE.to_raw_array(
            rate_rad_s + sensor.angular_velocity_noise_rad_s * self._draw_standard_normal(3)
        )
        reading.acceleration = ACCELERATION.to_raw_array(
            acceleration_m_s2 + sensor.acceleration_noise_m_s2 * self._draw_standard_normal(3)
        )
