"""Sensor messages from the modules' reports: joint state, contacts, IMUs, power, and the base's pose.

Every value was sampled at the tick's Sync. A missing one keeps its last value, with its age.
"""

import math
from collections.abc import Sequence

import numpy as np

from snakesim_can_backend.bus.load import ReportSchedule
from snakesim_can_backend.driver.reports import ModuleReports
from snakesim_can_backend.protocol.codec import load_layouts
from snakesim_can_backend.protocol.definitions import HEALTH_PERIOD_S, Opcode
from snakesim_drivers.motion_capture.mocap import MocapReceiver
from snakesim_drivers.mounting import Mounting
from snakesim_hal.backend import Samples
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import tangents
from snakesim_hal.model.measured_force import FeltForce
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contact, Contacts, Imu, JointState, Message, Power, SensorDescription
from snakesim_hal.wire.quantities import Vector

LONG_AGO_NS = 3600 * 10**9
HEALTH_LASTS_S = 2.5 * HEALTH_PERIOD_S  # one report may be lost
NO_TORQUE = (0.0, 0.0, 0.0)


class SampleBuilder:
    """Makes messages from a `Reading`."""

    def __init__(
        self, config: RunConfig, reports: ReportSchedule, reading: ModuleReports, mocap: MocapReceiver | None
    ) -> None:
        self._reading, self._reports, self._mocap = reading, reports, mocap
        self._mounting = Mounting(config.robot.joint_table)
        self._period_ns, self._lease_ns = config.period_ns, config.lease_ns
        self._radius_m, self._lengths_m = config.robot.module.radius_m, config.robot.link_lengths_m
        self._threshold_n = config.robot.sensors.contacts.threshold_n if config.robot.sensors.contacts else 0.0
        self._felt = FeltForce(max(reports.contact_every, 1) * config.period_ns * 1e-9)
        layouts = load_layouts()
        contact = layouts[Opcode.CONTACT].signals
        self._contact_scales = [contact[name].scale for name in ("force_x", "along", "bearing")]
        self._rate_scale = layouts[Opcode.GYRO].signals["rate_x"].scale
        self._acceleration_scale = layouts[Opcode.ACCELEROMETER].signals["acceleration_x"].scale
        health = layouts[Opcode.HEALTH].signals
        self._health = [health[name] for name in ("voltage", "current", "motor_temperature", "board_temperature")]
        self._health_every = max(round(HEALTH_PERIOD_S * config.rate_hz), 1)
        self._health_lasts = round(HEALTH_LASTS_S * config.rate_hz)  # Syncs

    def make_samples(self, tick: int, timestamp_ns: int) -> Samples:
        """All new samples at `tick`."""
        others: dict[str, Message] = {}
        if contacts_due(self._reports, self._reading.sync):
            others[keys.CONTACTS] = self._contacts(tick, timestamp_ns)
        imu = self._imu(tick, timestamp_ns)
        if imu is not None:
            others[keys.IMU] = imu
        if tick % self._health_every == 0:
            others[keys.POWER] = self._power(tick, timestamp_ns)
        pose = self._mocap.newest(tick, timestamp_ns) if self._mocap is not None else None
        if pose is not None:
            others[keys.POSE] = pose
        return Samples(self._joints(tick, timestamp_ns), others)

    def _joints(self, tick: int, timestamp_ns: int) -> JointState:
        reading = self._reading
        angle, velocity, torque = joint_values(reading, self._mounting).tolist()
        ages = [
            (reading.sync - module.sync) * self._period_ns if module.sync >= 0 else LONG_AGO_NS
            for module in reading.modules
        ]
        return JointState(
            tick=tick,
            timestamp_ns=timestamp_ns,
            angle_rad=angle,
            velocity_rad_s=velocity,
            torque_nm=torque,
            valid=[age <= self._lease_ns for age in ages],
            age_ns=ages,
        )

    def _contacts(self, tick: int, timestamp_ns: int) -> Contacts:
        felt = [self._contact(link, raw) for link, raw in self._reading.list_contacts()]
        strong = [contact for contact in felt if math.hypot(*contact.force_l) >= self._threshold_n]
        self._felt.add({contact.link: math.hypot(*contact.force_l) for contact in felt})
        return Contacts(tick=tick, timestamp_ns=timestamp_ns, contacts=strong, measured_force_n=self._felt.max_n)

    def _contact(self, link: int, raw: tuple[int, ...]) -> Contact:
        newton, metre, radian = self._contact_scales
        outward, position = locate_on_capsule(raw[3] * metre, raw[4] * radian, self._lengths_m[link], self._radius_m)
        normal = (-outward[0], -outward[1], -outward[2])
        tangent_1, tangent_2 = tangents(normal)
        return Contact(
            link=link,
            obstacle=None,  # unknown to a force sensor
            position_l=position,
            normal_l=normal,
            tangent_1_l=tangent_1,
            tangent_2_l=tangent_2,
            force_l=(raw[0] * newton, raw[1] * newton, raw[2] * newton),
            torque_l=NO_TORQUE,
        )

    def _imu(self, tick: int, timestamp_ns: int) -> Imu | None:
        found = self._reading.take_imu_reports()
        if not found:
            return None
        return Imu(
            tick=tick,
            timestamp_ns=timestamp_ns,
            link=[link for link, _, _ in found],
            angular_velocity_rad_s=[_scaled(rates, self._rate_scale) for _, rates, _ in found],
            acceleration_m_s2=[_scaled(values, self._acceleration_scale) for _, _, values in found],
        )

    def _power(self, tick: int, timestamp_ns: int) -> Power:
        rows = self._reading.health()
        columns = [
            [0.0 if row is None else signal.decode(row[i]) for row in rows] for i, signal in enumerate(self._health)
        ]
        return Power(
            tick=tick,
            timestamp_ns=timestamp_ns,
            voltage_v=columns[0],
            current_a=columns[1],
            motor_c=columns[2],
            board_c=columns[3],
            leak=[row is not None and bool(row[4]) for row in rows],
            valid=[
                row is not None and self._reading.sync - module.health_sync <= self._health_lasts
                for row, module in zip(rows, self._reading.modules, strict=True)
            ],
        )


def joint_values(reading: ModuleReports, mounting: Mounting) -> Floats:
    """Angle, velocity and torque of every joint, (3, n_joints): the modules' shafts, behind sign, zero and gear."""
    angle, velocity, torque = reading.shaft_values()
    at_joints = (
        mounting.joint_angle_rad(angle),
        mounting.joint_velocity_rad_s(velocity),
        mounting.joint_torque_nm(torque),
    )
    return np.stack(at_joints)


def contacts_due(reports: ReportSchedule, sync: int) -> bool:
    """Whether the modules report forces at a Sync."""
    return reports.contact_every > 0 and (sync & 0xFF) % reports.contact_every == 0


def describe_sensors(
    config: RunConfig, reports: ReportSchedule, *, pose_delay_s: float | None
) -> list[SensorDescription]:
    """The sensors of this robot's modules, with their rates; pose_delay_s: of motion capture, None without it."""
    rate = config.rate_hz
    sensors = [SensorDescription(key=keys.JOINTS, rate_hz=rate, delay_s=0.0)]
    if reports.contact_every:
        sensors.append(SensorDescription(key=keys.CONTACTS, rate_hz=rate / reports.contact_every, delay_s=0.0))
    if reports.imu_every:
        sensors.append(SensorDescription(key=keys.IMU, rate_hz=rate / reports.imu_every, delay_s=0.0))
    sensors.append(SensorDescription(key=keys.POWER, rate_hz=1 / HEALTH_PERIOD_S, delay_s=0.0))
    if pose_delay_s is not None:
        sensors.append(SensorDescription(key=keys.POSE, rate_hz=rate, delay_s=pose_delay_s))
    return sensors


def locate_on_capsule(along_m: float, bearing_rad: float, length_m: float, radius_m: float) -> tuple[Vector, Vector]:
    """Outward normal and point of a link's capsule at a place along it and a bearing about it.

    Beyond its ends a capsule is a sphere, and its normal tilts forward or back.
    """
    base_m = min(max(along_m, 0.0), length_m)
    lean = min(max((along_m - base_m) / radius_m, -1.0), 1.0)
    across = math.sqrt(1.0 - lean * lean)
    outward = (lean, across * math.cos(bearing_rad), across * math.sin(bearing_rad))
    return outward, (base_m + radius_m * outward[0], radius_m * outward[1], radius_m * outward[2])


def _scaled(raw: Sequence[int], scale: float) -> Vector:
    x, y, z = raw
    return (x * scale, y * scale, z * scale)
