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
from snakesim_drivers.mounting import DriveMounting
from snakesim_hal.backend import Samples
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import compute_contact_tangents
from snakesim_hal.model.measured_force import MeasuredForce
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Contact,
    Contacts,
    Imu,
    JointState,
    Message,
    Power,
    SensorDescription,
)
from snakesim_hal.wire.quantities import Vector

NEVER_RECEIVED_AGE_NS = 3600 * 10**9  # age of the state of a module that has sent none
MAX_HEALTH_AGE_S = 2.5 * HEALTH_PERIOD_S  # one report may be lost
SYNC_COUNT_MASK = 0xFF  # modules know the lowest 8 bits of a Sync's number
NO_TORQUE = (0.0, 0.0, 0.0)


class SampleBuilder:
    """Makes messages from the reports of all modules."""

    def __init__(
        self,
        config: RunConfig,
        reports: ReportSchedule,
        module_reports: ModuleReports,
        mocap: MocapReceiver | None,
    ) -> None:
        """Prepare to convert the raw reports of all modules into messages, with the units and scales of the protocol.

        Args:
            config: Configuration of the run, with the robot.
            reports: Which reports the modules send, and how often.
            module_reports: Newest reports of all modules, which are read for each sample.
            mocap: Receiver of the pose of the base; None without motion capture.
        """
        robot = config.robot
        self._module_reports = module_reports
        self._reports = reports
        self._mocap = mocap

        # The robot.
        self._joint_mounting = DriveMounting(robot.joint_table)
        self._radius_m = robot.module.radius_m
        self._lengths_m = robot.link_lengths_m
        self._min_force_n = robot.sensors.contacts.threshold_n if robot.sensors.contacts else 0.0

        # Times.
        self._period_ns = config.period_ns
        self._max_valid_age_ns = config.lease_ns
        self._health_decimation = max(round(HEALTH_PERIOD_S * config.rate_hz), 1)
        self._max_health_age_syncs = round(MAX_HEALTH_AGE_S * config.rate_hz)

        contact_period_s = max(reports.contact_every, 1) * config.period_ns * 1e-9
        self._mean_force = MeasuredForce(contact_period_s)

        # One step of each raw number, and the signals of a Health report.
        layouts = load_layouts()
        contact = layouts[Opcode.CONTACT].signals
        health = layouts[Opcode.HEALTH].signals
        self._newtons_per_count = contact["force_x"].scale
        self._axial_position_step_m = contact["along"].scale
        self._bearing_step_rad = contact["bearing"].scale
        self._rate_step_rad_s = layouts[Opcode.GYRO].signals["rate_x"].scale
        self._acceleration_step_m_s2 = layouts[Opcode.ACCELEROMETER].signals["acceleration_x"].scale
        self._health_signals = [
            health[name]
            for name in ("voltage", "current", "motor_temperature", "board_temperature")
        ]

    def make_samples(self, tick: int, timestamp_ns: int) -> Samples:
        """Return all new samples at a tick."""
        others: dict[str, Message] = {}
        if are_contacts_due(self._reports, self._module_reports.sync):
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
        """Return angles, velocities and torques of all joints as a message.

        Values older than the lease, and those of modules that have not sent any yet, are marked as invalid.

        Args:
            tick: Number of the control cycle.
            timestamp_ns: Robot time of the cycle.
        """
        module_reports = self._module_reports
        angle_rad, velocity_rad_s, torque_nm = to_joint_values(
            module_reports, self._joint_mounting
        ).tolist()
        ages_ns: list[int] = []
        for module in module_reports.modules:
            if module.sync < 0:  # no joint state was received yet
                ages_ns.append(NEVER_RECEIVED_AGE_NS)
            else:
                ages_ns.append((module_reports.sync - module.sync) * self._period_ns)
        return JointState(
            tick=tick,
            timestamp_ns=timestamp_ns,
            angle_rad=angle_rad,
            velocity_rad_s=velocity_rad_s,
            torque_nm=torque_nm,
            valid=[age_ns <= self._max_valid_age_ns for age_ns in ages_ns],
            age_ns=ages_ns,
        )

    def _make_contacts(self, tick: int, timestamp_ns: int) -> Contacts:
        measured_contacts = [
            self._make_contact(link, raw) for link, raw in self._module_reports.list_contacts()
        ]
        contacts_above_threshold = [
            contact
            for contact in measured_contacts
            if math.hypot(*contact.force_l) >= self._min_force_n
        ]
        self._mean_force.add_sample(
            {contact.link: math.hypot(*contact.force_l) for contact in measured_contacts}
        )
        return Contacts(
            tick=tick,
            timestamp_ns=timestamp_ns,
            contacts=contacts_above_threshold,
            measured_force_n=self._mean_force.max_n,
        )

    def _make_contact(self, link_index: int, raw: tuple[int, ...]) -> Contact:
        """Return the contact of a link as a message.

        Args:
            link_index: Index of the link, 0 at the tail.
            raw: Raw numbers of the contact report: force x, y and z, position along the link, and bearing, which is
                the angle about its axis.

        Returns:
            The contact, with all vectors in the frame of the link.
        """
        raw_force_x, raw_force_y, raw_force_z, raw_axial_position, raw_bearing = raw
        newtons_per_count = self._newtons_per_count
        outward, position = locate_on_capsule(
            raw_axial_position * self._axial_position_step_m,
            raw_bearing * self._bearing_step_rad,
            self._lengths_m[link_index],
            self._radius_m,
        )
        # The normal of a contact points from the obstacle into the link, as the force on the link does.
        normal = (-outward[0], -outward[1], -outward[2])
        tangent_1, tangent_2 = compute_contact_tangents(normal)
        return Contact(
            link=link_index,
            obstacle=None,  # unknown to a force sensor
            position_l=position,
            normal_l=normal,
            tangent_1_l=tangent_1,
            tangent_2_l=tangent_2,
            force_l=(
                raw_force_x * newtons_per_count,
                raw_force_y * newtons_per_count,
                raw_force_z * newtons_per_count,
            ),
            torque_l=NO_TORQUE,
        )

    def _make_imu(self, tick: int, timestamp_ns: int) -> Imu | None:
        """Return the new IMU samples of all links; None if there is none."""
        reports = self._module_reports.pop_imu_reports()
        if not reports:
            return None
        return Imu(
            tick=tick,
            timestamp_ns=timestamp_ns,
            link=[link for link, _, _ in reports],
            angular_velocity_rad_s=[
                _scale_vector(rates, self._rate_step_rad_s) for _, rates, _ in reports
            ],
            acceleration_m_s2=[
                _scale_vector(accelerations, self._acceleration_step_m_s2)
                for _, _, accelerations in reports
            ],
        )

    def _make_power(self, tick: int, timestamp_ns: int) -> Power:
        """Return voltage, current and temperatures of every module; 0.0 and invalid where no report has arrived.

        Args:
            tick: Number of the control cycle.
            timestamp_ns: Robot time of the cycle.
        """
        rows = self._module_reports.list_health_reports()
        columns: list[list[float]] = []
        for i, signal in enumerate(self._health_signals):
            columns.append([0.0 if row is None else signal.decode(row[i]) for row in rows])
        voltage_v, current_a, motor_c, board_c = columns
        leak_index = len(self._health_signals)
        valid: list[bool] = []
        for row, module in zip(rows, self._module_reports.modules, strict=True):
            age_syncs = self._module_reports.sync - module.health_sync
            valid.append(row is not None and age_syncs <= self._max_health_age_syncs)
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


def to_joint_values(module_reports: ModuleReports, mounting: DriveMounting) -> Floats:
    """Return the angle in rad, velocity in rad/s and torque in N·m of every joint, (3, n_joints).

    The modules measure at their shafts; sign, homing offset and gear lead from there to the joints.
    """
    shaft_angle, shaft_velocity, shaft_torque = module_reports.shaft_values()
    at_joints = (
        mounting.to_joint_angle_rad(shaft_angle),
        mounting.to_joint_velocity_rad_s(shaft_velocity),
        mounting.to_joint_torque_nm(shaft_torque),
    )
    return np.stack(at_joints)


def are_contacts_due(reports: ReportSchedule, sync: int) -> bool:
    """Return whether the modules report contact forces at a Sync."""
    return reports.contact_every > 0 and (sync & SYNC_COUNT_MASK) % reports.contact_every == 0


def describe_sensors(
    config: RunConfig, reports: ReportSchedule, *, pose_delay_s: float | None
) -> list[SensorDescription]:
    """Return the sensors of this robot's modules, with their rates.

    Args:
        config: Configuration of the run, with the control rate.
        reports: Which reports the modules send, and how often.
        pose_delay_s: Delay of motion capture; None without motion capture.
    """
    rate_hz = config.rate_hz
    sensors = [SensorDescription(key=keys.JOINTS, rate_hz=rate_hz, delay_s=0.0)]
    if reports.contact_every:
        sensors.append(
            SensorDescription(
                key=keys.CONTACTS, rate_hz=rate_hz / reports.contact_every, delay_s=0.0
            )
        )
    if reports.imu_every:
        sensors.append(
            SensorDescription(key=keys.IMU, rate_hz=rate_hz / reports.imu_every, delay_s=0.0)
        )
    sensors.append(SensorDescription(key=keys.POWER, rate_hz=1 / HEALTH_PERIOD_S, delay_s=0.0))
    if pose_delay_s is not None:
        sensors.append(SensorDescription(key=keys.POSE, rate_hz=rate_hz, delay_s=pose_delay_s))
    return sensors


def locate_on_capsule(
    along_m: float, bearing_rad: float, length_m: float, radius_m: float
) -> tuple[Vector, Vector]:
    """Convert the position of a contact, as the sensor of a link measures it, to a point on the link's surface.

    A link is a capsule. Beyond its ends it is a sphere, and its normal tilts forward or back.

    Args:
        along_m: Position along the axis of the link, from its joint.
        bearing_rad: Angle about the axis of the link.
        length_m: Length of the link.
        radius_m: Radius of the capsule.

    Returns:
        The outward normal, a unit vector, and the point in m, both in the link's frame.
    """
    axis_m = min(max(along_m, 0.0), length_m)  # nearest point on the capsule's axis
    axial_normal = min(max((along_m - axis_m) / radius_m, -1.0), 1.0)
    radial_normal = math.sqrt(1.0 - axial_normal * axial_normal)
    outward = (
        axial_normal,
        radial_normal * math.cos(bearing_rad),
        radial_normal * math.sin(bearing_rad),
    )
    point = (axis_m + radius_m * outward[0], radius_m * outward[1], radius_m * outward[2])
    return outward, point


def _scale_vector(raw: Sequence[int], step: float) -> Vector:
    x, y, z = raw
    return (x * step, y * step, z * step)
