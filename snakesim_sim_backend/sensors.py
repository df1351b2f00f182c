"""The robot's sensors: joint state, contacts, IMUs and the base's pose, with the noise, rate and delay of its file.

All values are read after the last physics step. Angles, speeds and the pose are those of the tick itself;
forces, torques and accelerations are those of the step that led to it.
"""

import math
from collections import deque
from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.backend import Samples
from snakesim_hal.model.kinematics import tangents
from snakesim_hal.model.robot import ContactSensor, ImuSensor, JointSensor, PoseSensor, PowerSensor
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.thermal import SUPPLY_V, Thermal, board_c, current_a
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contact, Contacts, Imu, JointState, Message, Pose, Power
from snakesim_hal.wire.quantities import MAX_CONTACTS, Quaternion, Vector
from snakesim_sim_backend.actuators import Motors
from snakesim_sim_backend.contacts import Touch, TouchReader
from snakesim_sim_backend.model import FREE_DOFS, FREE_QPOS, SimModel
from snakesim_sim_backend.sensor_timing import DelayLine, Due, ticks_of

Floats = NDArray[np.float64]
Noise = Callable[[int], Floats]  # n -> (n,) standard normal numbers

NO_TORQUE = (0.0, 0.0, 0.0)  # a point contact carries no moment about its own point


class Sensors:
    """All sensors of the robot, with one noise generator: the same seed and commands give the same bytes."""

    def __init__(
        self, sim: SimModel, data: mujoco.MjData, config: RunConfig, motors: Motors, windings: Thermal
    ) -> None:
        noise = np.random.default_rng(config.seed).standard_normal
        has = config.robot.sensors
        self._joints = JointReader(data, has.joints, motors, noise, config.period_ns)
        self._others: list[tuple[str, Channel]] = []
        if has.contacts is not None:
            reader = ContactReader(sim, data, has.contacts, noise)
            self._others.append((keys.CONTACTS, Channel(reader.read, has.contacts, config)))
        if has.imu is not None:
            reader = ImuReader(data, has.imu, config.robot.chain.modules + 1, noise)
            self._others.append((keys.IMU, Channel(reader.read, has.imu, config)))
        if has.pose is not None:
            reader = PoseReader(data, has.pose, noise)
            self._others.append((keys.POSE, Channel(reader.read, has.pose, config)))
        if has.power is not None:
            reader = PowerReader(data, motors, windings, config.robot.limits.torque_nm)
            self._others.append((keys.POWER, Channel(reader.read, has.power, config)))

    def sample(self, tick: int, stamp_ns: int) -> Samples:
        """Every sensor that is due. Ticks must come in order, each once."""
        others: dict[str, Message] = {}
        for key, channel in self._others:
            arrived = channel.arriving(tick, stamp_ns)
            if arrived is not None:
                others[key] = arrived
        return Samples(self._joints.read(tick, stamp_ns), others)


class Channel:
    """One sensor with its rate and delay."""

    def __init__(
        self,
        read: Callable[[int, int], Contacts | Imu | Pose | Power],
        sensor: ContactSensor | ImuSensor | PoseSensor | PowerSensor,
        config: RunConfig,
    ) -> None:
        self._read = read
        self._due = Due(sensor.rate_hz, config.rate_hz, config.period_ns)
        self._line: DelayLine[Contacts | Imu | Pose | Power] = DelayLine(ticks_of(sensor.delay_s, config.period_ns))

    def arriving(self, tick: int, stamp_ns: int) -> Message | None:
        """Take a sample if due, and return the one that arrives at this tick."""
        taken = self._read(tick, stamp_ns) if self._due.at(stamp_ns) else None
        return self._line.pass_on(tick, taken)


class JointReader:
    """Angle, velocity and torque of every joint, every tick.

    A delayed reading has the stamp of its tick, and its age is the delay. Until the first one has arrived the
    reading of the start is used.
    """

    def __init__(self, data: mujoco.MjData, sensor: JointSensor, motors: Motors, noise: Noise, period_ns: int) -> None:
        count = motors.count
        self._count = count
        self._angles, self._velocities = data.qpos[FREE_QPOS:], data.qvel[FREE_DOFS:]
        self._torques = motors.applied_nm()
        sigma = [sensor.angle_noise_rad, sensor.velocity_noise_rad_s, sensor.torque_noise_nm]
        self._sigma = np.repeat(sigma, count)
        self._noise = noise if any(sigma) else None
        self._all_valid = [True] * count
        self._under_way: deque[tuple[int, list[float]]] = deque(maxlen=1 + ticks_of(sensor.delay_s, period_ns))

    def read(self, tick: int, stamp_ns: int) -> JointState:
        """The reading that arrives at this tick."""
        values = np.concatenate((self._angles, self._velocities, self._torques))
        count = self._count
        if self._noise is not None:
            values += self._sigma * self._noise(3 * count)
        self._under_way.append((stamp_ns, values.tolist()))
        taken_ns, numbers = self._under_way[0]
        return JointState(
            tick=tick,
            stamp_ns=stamp_ns,
            angle_rad=numbers[:count],
            velocity_rad_s=numbers[count : 2 * count],
            torque_nm=numbers[2 * count :],
            valid=self._all_valid,
            age_ns=[stamp_ns - taken_ns] * count,
        )


class ContactReader:
    """Contacts with obstacles, in the frames of the links."""

    def __init__(self, sim: SimModel, data: mujoco.MjData, sensor: ContactSensor, noise: Noise) -> None:
        self._touches = TouchReader(sim, data)
        self._first_body = sim.first_link_body
        self._origins, self._rotations = data.xpos, data.xmat  # (nbody, 3), (nbody, 9)
        self._threshold_n = sensor.threshold_n
        self._sigma_m, self._sigma_n = sensor.position_noise_m, sensor.force_noise_n
        self._noise = noise if self._sigma_m or self._sigma_n else None

    def read(self, tick: int, stamp_ns: int) -> Contacts:
        """All contacts above the threshold."""
        found = [
            self._in_link(touch) for touch in self._touches.read() if math.hypot(*touch.force_w) >= self._threshold_n
        ]
        return Contacts(tick=tick, stamp_ns=stamp_ns, contacts=found[:MAX_CONTACTS])

    def _in_link(self, touch: Touch) -> Contact:
        rotation = self._rotations[touch.body].tolist()  # world_from_link, row by row
        ox, oy, oz = self._origins[touch.body].tolist()
        x, y, z = touch.position_w
        px, py, pz = into(rotation, (x - ox, y - oy, z - oz))
        fx, fy, fz = into(rotation, touch.force_w)
        normal = into(rotation, touch.normal_w)
        if self._noise is not None:
            a, b, c, d, e, f = self._noise(6).tolist()
            m, n = self._sigma_m, self._sigma_n
            px, py, pz, fx, fy, fz = px + m * a, py + m * b, pz + m * c, fx + n * d, fy + n * e, fz + n * f
        tangent_1, tangent_2 = tangents(normal)
        return Contact(
            link=touch.body - self._first_body,
            obstacle=touch.obstacle,
            position_l=(px, py, pz),
            normal_l=normal,
            tangent_1_l=tangent_1,
            tangent_2_l=tangent_2,
            force_l=(fx, fy, fz),
            torque_l=NO_TORQUE,
        )


class ImuReader:
    """Angular velocity and specific force (as of an accelerometer: 1 g upwards at rest) at every link's middle."""

    def __init__(self, data: mujoco.MjData, sensor: ImuSensor, count: int, noise: Noise) -> None:
        self._count = count
        self._values = data.sensordata  # gyros of all links, then accelerometers: see add_imus
        sigma = [sensor.angular_velocity_noise_rad_s, sensor.acceleration_noise_m_s2]
        self._sigma = np.repeat(sigma, 3 * count)
        self._noise = noise if any(sigma) else None
        self._links = list(range(count))

    def read(self, tick: int, stamp_ns: int) -> Imu:
        """One entry a link, tail to head."""
        values = self._values
        if self._noise is not None:
            values = values + self._sigma * self._noise(len(self._sigma))
        triples = list(map(tuple, values.reshape(-1, 3).tolist()))
        return Imu(
            tick=tick,
            stamp_ns=stamp_ns,
            link=self._links,
            angular_velocity_rad_s=triples[: self._count],
            acceleration_m_s2=triples[self._count :],
        )


class PoseReader:
    """Pose and velocity of the base."""

    def __init__(self, data: mujoco.MjData, sensor: PoseSensor, noise: Noise) -> None:
        self._qpos, self._qvel = data.qpos[:FREE_QPOS], data.qvel[:FREE_DOFS]
        sigma = [sensor.position_noise_m, 0.5 * sensor.angle_noise_rad]  # a quaternion turns by half an angle
        self._sigma = np.repeat(sigma, 3)
        self._noise = noise if any(sigma) else None

    def read(self, tick: int, stamp_ns: int) -> Pose:
        """The base, as from motion capture. Velocities have no noise of their own."""
        px, py, pz, w, x, y, z = self._qpos.tolist()
        vx, vy, vz, ox, oy, oz = self._qvel.tolist()
        spin_w = rotate((w, x, y, z), (ox, oy, oz))  # MuJoCo gives a free joint's turning in its own frame
        if self._noise is not None:
            ex, ey, ez, a, b, c = (self._sigma * self._noise(6)).tolist()
            px, py, pz = px + ex, py + ey, pz + ez
            w, x, y, z = (
                w - a * x - b * y - c * z,
                x + a * w + b * z - c * y,
                y + b * w + c * x - a * z,
                z + c * w + a * y - b * x,
            )
            norm = math.sqrt(w * w + x * x + y * y + z * z)
            w, x, y, z = w / norm, x / norm, y / norm, z / norm
        return Pose(
            tick=tick,
            stamp_ns=stamp_ns,
            position_w=(px, py, pz),
            orientation_wxyz=(w, x, y, z),
            velocity_w=(vx, vy, vz),
            angular_velocity_w=spin_w,
        )


class PowerReader:
    """Supply, current and temperatures of the joints' modules. No noise, and never a leak."""

    def __init__(self, data: mujoco.MjData, motors: Motors, windings: Thermal, rated_nm: float) -> None:
        self._velocities, self._torques = data.qvel[FREE_DOFS:], motors.applied_nm()
        self._windings, self._rated_nm = windings, rated_nm
        self._count = motors.count

    def read(self, tick: int, stamp_ns: int) -> Power:
        """The modules' present values."""
        winding_c = self._windings.winding_c
        return Power(
            tick=tick,
            stamp_ns=stamp_ns,
            voltage_v=[SUPPLY_V] * self._count,
            current_a=current_a(self._torques, self._velocities, self._rated_nm, SUPPLY_V).tolist(),
            motor_c=winding_c.tolist(),
            board_c=board_c(winding_c).tolist(),
            leak=[False] * self._count,
            valid=[True] * self._count,
        )


def into(rotation: list[float], v: Vector) -> Vector:
    """A world vector in the frame whose world_from_frame is `rotation`, (9,) row by row."""
    a, b, c, d, e, f, g, h, i = rotation
    x, y, z = v
    return (a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z)


def rotate(wxyz: Quaternion, v: Vector) -> Vector:
    """A vector turned by a unit quaternion."""
    w, x, y, z = wxyz
    tx, ty, tz = 2 * (y * v[2] - z * v[1]), 2 * (z * v[0] - x * v[2]), 2 * (x * v[1] - y * v[0])
    return (
        v[0] + w * tx + y * tz - z * ty,
        v[1] + w * ty + z * tx - x * tz,
        v[2] + w * tz + x * ty - y * tx,
    )
