"""Makes the sensor messages from the modules' reports: joint state, contacts, IMUs, power, and the base's pose.

Every value was sampled at the Sync of the control cycle. A missing one keeps its last value, with its age.
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
from snakesim_hal.model.measured_force import MeasuredForce
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contact, Contacts, Imu, JointState, Message, Power, SensorDescription
from snakesim_hal.wire.quantities import Vector

NO_STATE_AGE_NS = 3600 * 10**9  # age of the state of a module that has sent none
HEALTH_LIFETIME_S = 2.5 * HEALTH_PERIOD_S  # one report may be lost
SYNC_COUNT_MASK = 0xFF  # modules know the lowest 8 bits of a Sync's number
NO_TORQUE = (0.0, 0.0, 0.0)


class SampleBuilder:
    """Makes messages from the reports of all modules."""

    def __init__(
        self, config: RunConfig, reports: ReportSchedule, reading: ModuleReports, mocap: MocapReceiver | None
    ) -> None:
        """Prepare to convert the raw reports of all modules into messages, with the units and scales of the protocol.

        Args:
            config: the run, with the robot.
            reports: which reports the modules send, and how often.
            reading: the newest reports.
            mocap: receives the pose of the base; None: there is no motion capture.
        """
        robot = config.robot
        self._reading = reading
        self._reports = reports
        self._mocap = mocap

        # The robot.
        self._mounting = Mounting(robot.joint_table)
        self._radius_m = robot.module.radius_m
        self._lengths_m = robot.link_lengths_m
        self._min_force_n = robot.sensors.contacts.threshold_n if robot.sensors.contacts else 0.0

        # Times.
        self._period_ns = config.period_ns
        self._lease_ns = config.lease_ns
        self._health_decimation = max(round(HEALTH_PERIOD_S * config.rate_hz), 1)
        self._health_lifetime_syncs = round(HEALTH_LIFETIME_S * config.rate_hz)

        contact_period_s = max(reports.contact_every, 1) * config.period_ns * 1e-9
        self._mean_force = MeasuredForce(contact_period_s)

        # One step of each raw number, and the signals of a Health report.
        layouts = load_layouts()
        contact = layouts[Opcode.CONTACT].signals
        health = layouts[Opcode.HEALTH].signals
        self._force_step_n = contact["force_x"].scale
        self._along_step_m = contact["along"].scale
        self._bearing_step_rad = contact["bearing"].scale
        self._rate_step_rad_s = layouts[Opcode.GYRO].signals["rate_x"].scale
        self._acceleration_step_m_s2 = layouts[Opcode.ACCELEROMETER].signals["acceleration_x"].scale
        self._health_signals = [
            health[name] for name in ("voltage", "current", "motor_temperature", "board_temperature")
        ]

    def make_samples(self, tick: int, timestamp_ns: int) -> Samples:
        """Return all new samples at a tick."""
        others: dict[str, Message] = {}
        if contacts_due(self._reports, self._reading.sync):
            others[keys.CONTACTS] = self._make_contacts(tick, timestamp_ns)
        imu = self._make_imu(tick, timestamp_ns)
        if imu is not None:
            others[keys.IMU] = imu
        if tick % self._health_decimation == 0:
            others[keys.POWER] = self._make_power(tick, timestamp_ns)
        if self._mocap is not None:
            pose = self._mocap.read_newest(tick, timestamp_ns)
            if pose is not None:
                others[keys.POSE] = pose
        return Samples(self._make_joint_state(tick, timestamp_ns), others)

    def _make_joint_state(self, tick: int, timestamp_ns: int) -> JointState:
        """Return angles, velocities and torques of all joints as a message; values older than the lease are invalid.

        Args:
            tick: number of the control cycle.
            timestamp_ns: robot time of the cycle.
        """
        reading = self._reading
        angle_rad, velocity_rad_s, torque_nm = joint_values(reading, self._mounting).tolist()
        ages_ns: list[int] = []
        for module in reading.modules:
            if module.sync < 0:
                ages_ns.append(NO_STATE_AGE_NS)
            else:
                ages_ns.append((reading.sync - module.sync) * self._period_ns)
        return JointState(
            tick=tick,
            timestamp_ns=timestamp_ns,
            angle_rad=angle_rad,
            velocity_rad_s=velocity_rad_s,
            torque_nm=torque_nm,
            valid=[age_ns <= self._lease_ns for age_ns in ages_ns],
            age_ns=ages_ns,
        )

    def _make_contacts(self, tick: int, timestamp_ns: int) -> Contacts:
        measured = [self._make_contact(link, raw) for link, raw in self._reading.list_contacts()]
        strong = [contact for contact in measured if math.hypot(*contact.force_l) >= self._min_force_n]
        self._mean_force.add({contact.link: math.hypot(*contact.force_l) for contact in measured})
        return Contacts(tick=tick, timestamp_ns=timestamp_ns, contacts=strong, measured_force_n=self._mean_force.max_n)

    def _make_contact(self, link: int, raw: tuple[int, ...]) -> Contact:
        """Return the contact of a link from the raw numbers of its report."""
        force_x, force_y, force_z, along, bearing = raw
        step_n = self._force_step_n
        outward, position = locate_on_capsule(
            along * self._along_step_m,
            bearing * self._bearing_step_rad,
            self._lengths_m[link],
            self._radius_m,
        )
        normal = (-outward[0], -outward[1], -outward[2])
        tangent_1, tangent_2 = tangents(normal)
        return Contact(
            link=link,
            obstacle=None,  # unknown to a force sensor
            position_l=position,
            normal_l=normal,
            tangent_1_l=tangent_1,
            tangent_2_l=tangent_2,
            force_l=(force_x * step_n, force_y * step_n, force_z * step_n),
            torque_l=NO_TORQUE,
        )

    def _make_imu(self, tick: int, timestamp_ns: int) -> Imu | None:
        """Return the new IMU samples of all links; None if there is none."""
        reports = self._reading.take_imu_reports()
        if not reports:
            return None
        return Imu(
            tick=tick,
            timestamp_ns=timestamp_ns,
            link=[link for link, _, _ in reports],
            angular_velocity_rad_s=[_scale_vector(rates, self._rate_step_rad_s) for _, rates, _ in reports],
            acceleration_m_s2=[
                _scale_vector(accelerations, self._acceleration_step_m_s2) for _, _, accelerations in reports
            ],
        )

    def _make_power(self, tick: int, timestamp_ns: int) -> Power:
        """Return voltage, current and temperatures of every module; 0.0 and invalid where no report has arrived.

        Args:
            tick: number of the control cycle.
            timestamp_ns: robot time of the cycle.
        """
        rows = self._reading.health()
        columns: list[list[float]] = []
        for i, signal in enumerate(self._health_signals):
            columns.append([0.0 if row is None else signal.decode(row[i]) for row in rows])
        voltage_v, current_a, motor_c, board_c = columns
        leak_index = len(self._health_signals)
        valid: list[bool] = []
        for row, module in zip(rows, self._reading.modules, strict=True):
            age_syncs = self._reading.sync - module.health_sync
            valid.append(row is not None and age_syncs <= self._health_lifetime_syncs)
        return Power(
            tick=tick,
            timestamp_ns=timestamp_ns,
            voltage_v=voltage_v,
            current_a=current_a,
            motor_c=motor_c,
            board_c=board_c,
            leak=[row is not None and bool(row[leak_index]) for row in rows],
            valid=valid,
        )


def joint_values(reading: ModuleReports, mounting: Mounting) -> Floats:
    """Return the angle in rad, velocity in rad/s and torque in N·m of every joint, (3, n_joints).

    The modules measure at their shafts; sign, homing offset and gear lead from there to the joints.
    """
    shaft_angle, shaft_velocity, shaft_torque = reading.shaft_values()
    at_joints = (
        mounting.to_joint_angle_rad(shaft_angle),
        mounting.to_joint_velocity_rad_s(shaft_velocity),
        mounting.to_joint_torque_nm(shaft_torque),
    )
    return np.stack(at_joints)


def contacts_due(reports: ReportSchedule, sync: int) -> bool:
    """Return whether the modules report contact forces at a Sync."""
    return reports.contact_every > 0 and (sync & SYNC_COUNT_MASK) % reports.contact_every == 0


def describe_sensors(
    config: RunConfig, reports: ReportSchedule, *, pose_delay_s: float | None
) -> list[SensorDescription]:
    """Return the sensors of this robot's modules, with their rates.

    Args:
        config: configuration of the run, with the robot and the settings of its backend.
        reports: which reports the modules send, and how often.
        pose_delay_s: delay of motion capture; None: there is none.
    """
    rate_hz = config.rate_hz
    sensors = [SensorDescription(key=keys.JOINTS, rate_hz=rate_hz, delay_s=0.0)]
    if reports.contact_every:
        sensors.append(SensorDescription(key=keys.CONTACTS, rate_hz=rate_hz / reports.contact_every, delay_s=0.0))
    if reports.imu_every:
        sensors.append(SensorDescription(key=keys.IMU, rate_hz=rate_hz / reports.imu_every, delay_s=0.0))
    sensors.append(SensorDescription(key=keys.POWER, rate_hz=1 / HEALTH_PERIOD_S, delay_s=0.0))
    if pose_delay_s is not None:
        sensors.append(SensorDescription(key=keys.POSE, rate_hz=rate_hz, delay_s=pose_delay_s))
    return sensors


def locate_on_capsule(along_m: float, bearing_rad: float, length_m: float, radius_m: float) -> tuple[Vector, Vector]:
    """Convert the place of a contact on a link, as its sensor measures it, to a point on the link's surface.

    A link is a capsule. Beyond its ends it is a sphere, and its normal tilts forward or back.

    Args:
        along_m: place along the link, from its joint.
        bearing_rad: angle about the link.
        length_m: length of the link.
        radius_m: radius of the capsule.

    Returns:
        The outward normal, a unit vector, and the point in m, both in the link's frame.
    """
    axis_m = min(max(along_m, 0.0), length_m)  # the nearest place on the capsule's axis
    lean = min(max((along_m - axis_m) / radius_m, -1.0), 1.0)
    across = math.sqrt(1.0 - lean * lean)
    outward = (lean, across * math.cos(bearing_rad), across * math.sin(bearing_rad))
    point = (axis_m + radius_m * outward[0], radius_m * outward[1], radius_m * outward[2])
    return outward, point


def _scale_vector(raw: Sequence[int], step: float) -> Vector:
    x, y, z = raw
    return (x * step, y * step, z * step)
