"""What environments observe of many robots: joints, pose, contact forces and winding temperatures.

The values have the noise, rates and delays of the sensors of `SimBackend`, and the same bits. All sensors of a robot
share one stream of random numbers, so the numbers of an IMU are left out although no environment observes it.
"""

import math
from collections import deque
from dataclasses import dataclass

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.sensors import SensorSections
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.wire.quantities import MAX_CONTACTS
from snakesim_sim_backend.batch.noise import NoiseStreams
from snakesim_sim_backend.batch.samples import DelayedValues, Mask, SamplingTicks, Ticks
from snakesim_sim_backend.batch.simulations import NO_CONTACT_ARRAYS, ContactArrays, SimulationBatch
from snakesim_sim_backend.sensors.timing import round_to_ticks

NUMBERS_OF_POSE = 7  # position and quaternion
NUMBERS_OF_VELOCITY = 6  # linear and angular
VALUES_PER_RAW_POSE = 19  # those of pose and velocity, and 6 of noise
DRAWS_PER_CONTACT = 6  # of noise: of position and force
FORCE_DRAW_INDICES = np.arange(3, 6)  # those of the force, among the numbers of a contact
ROUNDING_ERROR = 1e-9  # relative; more than that of the size of a force


def encode_sensor_timing(config: RunConfig) -> bytes:
    """Return what must be equal for all robots that are simulated together: which sensors they have, and when."""
    sensors = config.robot.sensors
    parts: list[object] = [
        config.period_ns,
        config.rate_hz,
        config.robot.chain.modules,
        sensors.joints.delay_s,
    ]
    parts.append(_has_noise(sensors.joints))
    for _, sensor in _remove_mounted_sensors(sensors).iterate_published():
        parts += [type(sensor).__name__, sensor.rate_hz, sensor.delay_s, _has_noise(sensor)]
    return msgspec.json.encode(parts)


@dataclass(frozen=True)
class ContactSample:
    """A sample of contacts whose forces are not computed yet."""

    arrays: ContactArrays
    noise: Floats  # (n, 3), of the forces in the frames of the links


NO_CONTACTS = ContactSample(NO_CONTACT_ARRAYS, np.empty((0, 3)))


class SensorArrays:
    """The sensors of many robots.

    Attributes:
        joints: (robots, 3 * joints), angles, velocities and torques as delivered at this tick. A new array in each
            tick, which never changes afterwards.
        windings: Temperatures, (robots, joints), as the power sensor has delivered them.
    """

    def __init__(self, all_robots: Mask, config: RunConfig, noise: NoiseStreams) -> None:
        """Make the sensors of robots.

        Args:
            all_robots: The mask of all robots. A call with this object is faster than one with an equal mask.
            config: Configuration of one of the robots; those of the others agree with it in `encode_sensor_timing`.
            noise: The random numbers of the robots.
        """
        robots = len(all_robots)
        self._all_robots = all_robots
        sensors = config.robot.sensors
        joints = config.robot.chain.modules
        self._noise = noise
        self._count = robots
        self._joint_count = joints
        self._period_ns = config.period_ns

        def due_ticks(rate_hz: float) -> SamplingTicks:
            return SamplingTicks(rate_hz, config.rate_hz, config.period_ns)

        # Joints.
        self.joints: Floats = np.zeros((robots, 3 * joints))
        self._joint_sigma = np.zeros((robots, 3 * joints))
        self._is_measured = np.ones((robots, 3 * joints), dtype=np.bool_)
        self._all_are_measured = True
        self._joints_have_noise = _has_noise(sensors.joints)
        self.joint_delay_ticks = round_to_ticks(sensors.joints.delay_s, config.period_ns)
        self._joint_delay_queue: deque[Floats] = deque(maxlen=1 + self.joint_delay_ticks)

        # Contacts.
        self._contact_schedule: SamplingTicks | None = None
        if sensors.contacts is not None:
            self._contact_schedule = due_ticks(sensors.contacts.rate_hz)
            self._contacts_have_noise = _has_noise(sensors.contacts)
            self._contact_delay_ticks = round_to_ticks(sensors.contacts.delay_s, config.period_ns)
        self._contact_sigma_n = np.zeros(robots)
        self._contact_threshold_n = np.zeros(robots)
        self._contact_delay_queue: deque[tuple[ContactSample, Mask]] = deque()
        self._contacts = NO_CONTACTS

        # Numbers that IMUs would draw.
        self._imu_schedule: SamplingTicks | None = None
        if sensors.imu is not None and _has_noise(sensors.imu):
            self._imu_schedule = due_ticks(sensors.imu.rate_hz)
        self._imu_draw_count = 6 * (joints + 1)

        # Pose.
        self._pose_schedule: SamplingTicks | None = None
        if sensors.pose is not None:
            self._pose_schedule = due_ticks(sensors.pose.rate_hz)
            self._pose_has_noise = _has_noise(sensors.pose)
            self._raw_poses = DelayedValues(
                all_robots, VALUES_PER_RAW_POSE, sensors.pose.delay_s, config.period_ns
            )
            # A quaternion that can be normalized, until there is a pose.
            self._raw_poses.values[:, 3] = 1.0
        self._pose_sigma = np.zeros((robots, 6))
        self._no_pose_noise = np.zeros((robots, 6))

        # Power.
        self._power_schedule: SamplingTicks | None = None
        self.windings: DelayedValues | None = None
        if sensors.power is not None:
            self._power_schedule = due_ticks(sensors.power.rate_hz)
            self.windings = DelayedValues(
                all_robots, joints, sensors.power.delay_s, config.period_ns
            )

    def restart(self, robot_index: int, config: RunConfig) -> None:
        """Remove all samples of a robot that starts a new episode, and use the noise of its new configuration.

        Args:
            robot_index: Row of the robot.
            config: Configuration of the new episode.
        """
        sensors = config.robot.sensors
        joints = self._joint_count
        # Columns: angles, velocities and torques of all joints.
        sigma = [
            sensors.joints.angle_noise_rad,
            sensors.joints.velocity_noise_rad_s,
            sensors.joints.torque_noise_nm,
        ]
        self._joint_sigma[robot_index] = np.repeat(sigma, joints)
        for i, joint in enumerate(config.robot.joint_table):
            self._is_measured[robot_index, 2 * joints + i] = "torque" in joint.drive.measures
        self._all_are_measured = bool(self._is_measured.all())
        if sensors.contacts is not None:
            self._contact_sigma_n[robot_index] = sensors.contacts.force_noise_n
            self._contact_threshold_n[robot_index] = sensors.contacts.threshold_n
            self._contacts = _remove_robot_contacts(self._contacts, robot_index)
            for queue_index, (sample, due) in enumerate(self._contact_delay_queue):
                other_robots_due = due.copy()
                other_robots_due[robot_index] = False
                self._contact_delay_queue[queue_index] = (sample, other_robots_due)
        if sensors.pose is not None:
            # Of a quaternion.
            pose_sigma = [sensors.pose.position_noise_m, 0.5 * sensors.pose.angle_noise_rad]
            self._pose_sigma[robot_index] = np.repeat(pose_sigma, 3)
            self._raw_poses.restart(robot_index)
        if self.windings is not None:
            self.windings.restart(robot_index)

    def sample(
        self,
        ticks: Ticks,
        active: Mask,
        simulations: SimulationBatch,
        winding_c: Floats,
        *,
        is_reset: bool = False,
    ) -> None:
        """Read the sensors of the active robots at their current ticks.

        The order is that of `SensorSuite.iterate_published`. It decides which random numbers each sensor uses, so that
        a robot has the same noise as in a single run.

        Args:
            ticks: (robots,) current tick of each robot.
            active: (robots,) mask of the robots whose sensors are read. The other robots keep their values.
            simulations: States of all robots.
            winding_c: (robots, joints) temperatures of the windings.
            is_reset: Whether the active robots have just been reset, after the other robots have been sampled in this
                tick.
        """
        if self._contact_schedule is not None:
            self._sample_contacts(
                self._contact_schedule.find_due_robots(ticks, active), simulations, is_reset
            )
        if self._imu_schedule is not None:
            # IMUs are not simulated in batches. Only their random numbers are drawn, so that the other sensors get the
            # same numbers as in a single run.
            self._noise.skip(
                self._imu_draw_count, self._imu_schedule.find_due_robots(ticks, active)
            )
        if self._pose_schedule is not None:
            self._sample_poses(
                self._pose_schedule.find_due_robots(ticks, active), simulations, is_reset
            )
        if self._power_schedule is not None and self.windings is not None:
            due = self._power_schedule.find_due_robots(ticks, active)
            if np.count_nonzero(due):
                self.windings.add(winding_c.copy(), due, is_reset=is_reset)
            elif not is_reset:
                # After a reset, the delay line has advanced already: with the other robots' samples of this tick.
                self.windings.append_empty_tick()
        self._sample_joints(active, simulations, is_reset)

    def _sample_contacts(self, due: Mask, simulations: SimulationBatch, is_reset: bool) -> None:
        contacts = simulations.find_obstacle_contacts(due)
        sample = (
            NO_CONTACTS if contacts is NO_CONTACT_ARRAYS else self._draw_contact_noise(contacts)
        )
        if self._contact_delay_ticks:
            if is_reset and self._contact_delay_queue:
                # The other robots have taken their samples of this tick already: merge the new ones into them.
                last_sample, last_due = self._contact_delay_queue[-1]
                merged_sample = _replace_contacts(last_sample, sample, due)
                self._contact_delay_queue[-1] = (merged_sample, last_due | due)
                return
            self._contact_delay_queue.append((sample, due))
            if len(self._contact_delay_queue) <= self._contact_delay_ticks:
                return
            sample, due = self._contact_delay_queue.popleft()
        self._contacts = _replace_contacts(self._contacts, sample, due)

    def _draw_contact_noise(self, contacts: ContactArrays) -> ContactSample:
        """Select the contacts above the threshold, and draw the random numbers of their forces.

        Every robot has its own stream of random numbers. Its first detected contact uses the next 6 numbers: 3 for the
        position and 3 for the force. Its second contact uses the next 6 numbers, and so on. Positions are not observed
        here, but their numbers are skipped.

        Args:
            contacts: Contacts of all robots, sorted by robot.

        Returns:
            The selected contacts, at most MAX_CONTACTS of each robot.
        """
        is_detected = _find_forces_above_threshold(
            contacts.force_w, self._contact_threshold_n[contacts.robot]
        )
        if not is_detected.all():
            contacts = _select_contacts(contacts, is_detected)
        if not len(contacts.robot):
            return NO_CONTACTS
        contact_count = len(contacts.robot)
        count_by_robot = np.bincount(contacts.robot, minlength=self._count)
        # Row of each robot's first contact.
        first_by_robot = np.cumsum(count_by_robot) - count_by_robot
        # Number of each contact among those of its robot, from 0.
        number_in_robot = np.arange(contact_count) - first_by_robot[contacts.robot]
        noise = np.zeros((contact_count, 3))
        if self._contacts_have_noise:
            next_numbers = self._noise.peek(DRAWS_PER_CONTACT * int(count_by_robot.max()))
            force_columns = DRAWS_PER_CONTACT * number_in_robot[:, None] + FORCE_DRAW_INDICES
            noise = next_numbers[contacts.robot[:, None], force_columns]
            # `peek` leaves the numbers in the streams; each robot has used those of its own contacts.
            self._noise.skip_each(DRAWS_PER_CONTACT * count_by_robot)
        if contact_count > MAX_CONTACTS:
            # A message holds no more contacts of a robot.
            fits_in_message = number_in_robot < MAX_CONTACTS
            return ContactSample(
                _select_contacts(contacts, fits_in_message), noise[fits_in_message]
            )
        return ContactSample(contacts, noise)

    def _sample_poses(self, due: Mask, simulations: SimulationBatch, is_reset: bool) -> None:
        """Store pose, velocity and random numbers of the robots that are due. Noise is added when a pose is read."""
        noise = self._no_pose_noise
        if self._pose_has_noise:
            noise = self._noise.peek(6)
            self._noise.skip(6, due)
        raw = np.concatenate((simulations.base_pose, simulations.base_velocity, noise), axis=1)
        self._raw_poses.add(raw, due, is_reset=is_reset)

    def _sample_joints(self, active: Mask, simulations: SimulationBatch, is_reset: bool) -> None:
        """Read angles, velocities and torques of the active robots with noise, and deliver the reading that is due.

        Readings are delivered after the delay of the joint sensors, which is the length of `_joint_delay_queue`.

        Args:
            active: (robots,) which robots are read.
            simulations: The states of all robots.
            is_reset: Whether the active robots have just been reset. Then the current reading fills the queue.
        """
        joints = self._joint_count
        values = np.concatenate(
            (simulations.angle_rad, simulations.velocity_rad_s, simulations.torque_nm), axis=1
        )
        if self._joints_have_noise:
            values += self._joint_sigma * self._noise.peek(3 * joints)
            self._noise.skip(3 * joints, active)
        if not self._all_are_measured:
            values[~self._is_measured] = 0.0
        if is_reset and self._joint_delay_queue:
            # The reading of the start is used until a delayed one is delivered.
            for queue_index, queued_values in enumerate(self._joint_delay_queue):
                self._joint_delay_queue[queue_index] = np.where(
                    active[:, None], values, queued_values
                )
        else:
            self._joint_delay_queue.append(values)
        delivered = self._joint_delay_queue[0]
        if active is not self._all_robots:
            delivered = np.where(active[:, None], delivered, self.joints)
        self.joints = delivered

    # --- what is observed -----------------------------------------------------------------------------------

    @property
    def has_poses(self) -> Mask:
        """Whether a pose has been delivered in this episode, (robots,)."""
        if self._pose_schedule is None:
            return np.zeros(self._count, dtype=np.bool_)
        return self._raw_poses.is_known

    def read_poses(self) -> Floats:
        """Return the newest positions and quaternions, (robots, 7); they mean something only where `has_poses`."""
        if self._pose_schedule is None:
            return np.zeros((self._count, NUMBERS_OF_POSE))
        raw = self._raw_poses.values
        pose = raw[:, :7].copy()
        if self._pose_has_noise:
            error = self._pose_sigma * raw[:, 13:]
            pose[:, :3] += error[:, :3]
            pose[:, 3:] = _perturb_orientation(raw[:, 3:7], error[:, 3:])
        return pose

    def read_velocities(self) -> Floats:
        """Return the newest velocities in the world, linear and angular, (robots, 6); only where `has_poses`."""
        if self._pose_schedule is None:
            return np.zeros((self._count, NUMBERS_OF_VELOCITY))
        raw = self._raw_poses.values
        velocity = raw[:, 7:13].copy()
        velocity[:, 3:] = _rotate(raw[:, 3:7], raw[:, 10:13])
        return velocity

    def read_contact_forces(self) -> Floats:
        """Return the sum of the magnitudes of all contact forces on every link, (robots, links) in N."""
        forces_n = [[0.0] * (self._joint_count + 1) for _ in range(self._count)]
        contacts = self._contacts.arrays
        if not len(contacts.robot):
            return np.array(forces_n)
        sigma_n = self._contact_sigma_n[contacts.robot, None]
        force_l = _rotate_into(contacts.rotation, contacts.force_w)
        if self._contacts_have_noise:
            force_l = force_l + sigma_n * self._contacts.noise
        for robot, link, force in zip(
            contacts.robot.tolist(), contacts.link.tolist(), force_l.tolist(), strict=True
        ):
            forces_n[robot][link] += math.hypot(*force)
        return np.array(forces_n)


def _remove_mounted_sensors(sensors: SensorSections) -> SensorSections:
    return msgspec.structs.replace(sensors, depth=[], range=[], custom=[])


def _has_noise(sensor: msgspec.Struct) -> bool:
    """Return whether a sensor of the body draws random numbers."""
    return any(value for name, value in msgspec.structs.asdict(sensor).items() if "noise" in name)


def _find_forces_above_threshold(force_w: Floats, thresholds_n: Floats) -> Mask:
    """Return which forces, (n, 3), are at least as large as their thresholds, (n,), as `math.hypot` decides it."""
    x, y, z = force_w.T
    magnitudes_n = np.sqrt(x * x + y * y + z * z)
    is_above_threshold = magnitudes_n >= thresholds_n
    # Near the threshold the square root may round otherwise than `math.hypot`, which a single run uses.
    is_close = np.abs(magnitudes_n - thresholds_n) <= ROUNDING_ERROR * thresholds_n
    for i in np.flatnonzero(is_close).tolist():
        is_above_threshold[i] = math.hypot(*force_w[i].tolist()) >= thresholds_n[i]
    return is_above_threshold


def _select_contacts(contacts: ContactArrays, mask: Mask) -> ContactArrays:
    return ContactArrays(
        contacts.robot[mask], contacts.link[mask], contacts.force_w[mask], contacts.rotation[mask]
    )


def _remove_robot_contacts(sample: ContactSample, robot_index: int) -> ContactSample:
    """Return a sample of contacts without those of one robot."""
    is_other_robot = sample.arrays.robot != robot_index
    return ContactSample(
        _select_contacts(sample.arrays, is_other_robot), sample.noise[is_other_robot]
    )


def _replace_contacts(old: ContactSample, new: ContactSample, due: Mask) -> ContactSample:
    """Return the contacts of all robots after some of them have been sampled.

    Args:
        old: Contacts of all robots before.
        new: New sample. It may contain robots that are not due, because they have been reset during its delay.
        due: (robots,) mask of the robots whose contacts are replaced by those of the new sample.
    """
    if old is NO_CONTACTS and new is NO_CONTACTS:
        return NO_CONTACTS
    if due.all():
        return new
    is_kept = ~due[old.arrays.robot]
    is_due = due[new.arrays.robot]
    contacts = ContactArrays(
        np.concatenate((old.arrays.robot[is_kept], new.arrays.robot[is_due])),
        np.concatenate((old.arrays.link[is_kept], new.arrays.link[is_due])),
        np.concatenate((old.arrays.force_w[is_kept], new.arrays.force_w[is_due])),
        np.concatenate((old.arrays.rotation[is_kept], new.arrays.rotation[is_due])),
    )
    return ContactSample(contacts, np.concatenate((old.noise[is_kept], new.noise[is_due])))


# --- the arithmetic of `sensors.frames` and `sensors.pose` on arrays -------------------------------------------------


def _rotate_into(rotation: Floats, vector_w: Floats) -> Floats:
    """Return the coordinates of world vectors, (n, 3), in the frames whose world_from_frame is (n, 9), row by row."""
    a, b, c, d, e, f, g, h, i = rotation.T
    x, y, z = vector_w.T
    return np.stack((a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z), axis=1)


def _rotate(wxyz: Floats, vector: Floats) -> Floats:
    """Return vectors, (n, 3), rotated by unit quaternions, (n, 4)."""
    w, x, y, z = wxyz.T
    vx, vy, vz = vector.T
    tx = 2 * (y * vz - z * vy)
    ty = 2 * (z * vx - x * vz)
    tz = 2 * (x * vy - y * vx)
    return np.stack(
        (
            vx + w * tx + y * tz - z * ty,
            vy + w * ty + z * tx - x * tz,
            vz + w * tz + x * ty - y * tx,
        ),
        axis=1,
    )


# In the product of a quaternion and (1, a, b, c): the three terms that are added to each component, in order.
FACTOR_OF_TERM = np.array([[0, 0, 1, 2], [1, 1, 2, 0], [2, 2, 0, 1]])  # index in (a, b, c)
COMPONENT_OF_TERM = np.array([[1, 0, 0, 0], [2, 3, 1, 2], [3, 2, 3, 1]])  # index in the quaternion
SIGN_OF_TERM = np.array([[-1.0, 1.0, 1.0, 1.0], [-1.0, 1.0, 1.0, 1.0], [-1.0, -1.0, -1.0, -1.0]])


def _perturb_orientation(wxyz: Floats, half_angles: Floats) -> Floats:
    """Return the unit quaternions along wxyz * (1, half angles): small rotations about axes of the base are added."""
    factors = half_angles.take(FACTOR_OF_TERM, axis=1)  # (n, 3, 4)
    terms = SIGN_OF_TERM * (factors * wxyz.take(COMPONENT_OF_TERM, axis=1))
    quaternion = wxyz + terms[:, 0] + terms[:, 1] + terms[:, 2]
    # In order, so that it does not depend on how many there are.
    squares = np.cumsum(quaternion * quaternion, axis=1)
    return quaternion / np.sqrt(squares[:, 3:])
