"""The robot file: the parameters of a chain of joint modules. A module is one joint with half a body on either side.

Chained modules are bolted together, so n modules make n joints and n + 1 rigid links; tail and head link are half as
long as the others. A robot whose links differ otherwise lists them in `[[links]]`.
"""

import hashlib
import math
from collections.abc import Collection, Sequence
from typing import Annotated, get_args

import msgspec
from msgspec import Meta

from snakesim_hal.base.errors import short
from snakesim_hal.model.checked import Checked
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.joints import Drive, DriveMode, Heat, Joint, JointExceptions, Limits, Motor, Supply, table
from snakesim_hal.model.links import Link
from snakesim_hal.model.plugins import SENSORS, find_plugin
from snakesim_hal.model.sensors import LinkName, Mounted, OwnSensor, Sensors
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import (
    Axis,
    Description,
    JointDescription,
    LinkDescription,
    Measurement,
    Mode,
    SensorDescription,
    StopMode,
)
from snakesim_hal.wire.own_sample import schema_of
from snakesim_hal.wire.quantities import MAX_JOINTS, above


class Chain(FileStruct, frozen=True, kw_only=True):
    """Number of modules, and axes of their joints."""

    modules: Annotated[int, Meta(ge=1, le=MAX_JOINTS)]
    axes: Annotated[list[Axis], Meta(min_length=1, max_length=MAX_JOINTS)]  # repeated from tail to head


class Module(FileStruct, frozen=True, kw_only=True):
    """Body of one module."""

    length_m: Annotated[float, above(2, "m")]
    radius_m: Annotated[float, above(1, "m")]
    mass_kg: Annotated[float, above(100, "kg")]


class Safety(FileStruct, frozen=True, kw_only=True):
    """Behaviour of the joints in a fault, and limits of commands."""

    action: StopMode = "damp"
    max_step_rad: Annotated[float, above(3.2, "rad")] = 0.35  # of a position target from the measured
    max_isolated_joints: Annotated[int, Meta(ge=0, le=MAX_JOINTS)] = 0  # isolated, before the robot stops


class RobotFile(FileStruct, frozen=True, kw_only=True):
    """A whole robot file."""

    name: Annotated[str, Meta(min_length=1, max_length=40, pattern="^[A-Za-z0-9_-]+$")]
    about: str = ""
    chain: Chain
    module: Module
    links: Annotated[list[Link], Meta(max_length=MAX_JOINTS + 1)] = []  # tail to head; none: made of the modules
    limits: Limits  # from here to `supply`: of all joints, but for `joints`
    motor: Motor
    drive: Drive = Drive()
    heat: Heat = Heat()
    supply: Supply = Supply()
    joints: Annotated[dict[str, JointExceptions], Meta(max_length=MAX_JOINTS)] = {}  # name -> what differs in it
    safety: Safety = Safety()
    sensors: Sensors = Sensors()
    checked: Checked | None = None  # by whom its joints were found to be as this file says

    def __post_init__(self) -> None:
        """Links and joints must be those there are; sensors sit on a link, and not inside of it. Raises ValueError."""
        _ = self.joint_table
        last = self.chain.modules
        if self.links and len(self.links) != last + 1:
            raise ValueError(
                f"[[links]] has {len(self.links)} entries, and {last} joints connect {last + 1} links; list each, "
                f"tail to head, or none"
            )
        for sensor in (*self.sensors.depth, *self.sensors.range, *self.sensors.own):
            link = self.link_index(sensor.link)
            if link > last:
                raise ValueError(
                    f"sensor {sensor.name!r} is on link {link}, and the links are 0 (tail) to {last} (head)"
                )
            if sensor.position_m is None and link != last:
                raise ValueError(
                    f"sensor {sensor.name!r} is on link {link}: give `position_m`; only the tip of the head "
                    f"is the default"
                )

    def link_index(self, link: LinkName) -> int:
        """The number of a link, from 0 at the tail."""
        return {"tail": 0, "head": self.chain.modules}[link] if isinstance(link, str) else link

    @property
    def axes(self) -> list[Axis]:
        """Axis of every joint, tail to head."""
        pattern = self.chain.axes
        return [pattern[i % len(pattern)] for i in range(self.chain.modules)]

    @property
    def joint_table(self) -> list[Joint]:
        """Every joint as built, tail to head."""
        return table(self.axes, self.joints, self.limits, self.motor, self.drive, self.heat, self.supply)

    @property
    def link_lengths_m(self) -> list[float]:
        """Length of every link, tail to head."""
        if self.links:
            return [link.length_m for link in self.links]
        return [self.module.length_m * share for share in self._shares]

    @property
    def link_masses_kg(self) -> list[float]:
        """Mass of every link, tail to head."""
        if self.links:
            return [link.mass_kg for link in self.links]
        return [self.module.mass_kg * share for share in self._shares]

    @property
    def length_m(self) -> float:
        """Length of the straight robot, without the caps of tail and head."""
        if self.links:
            return math.fsum(self.link_lengths_m)
        return self.chain.modules * self.module.length_m

    @property
    def _shares(self) -> list[float]:
        return [0.5] + [1.0] * (self.chain.modules - 1) + [0.5]


def described(robot: RobotFile) -> list[JointDescription]:
    """The joints, tail to head."""
    return [
        JointDescription(
            name=joint.name,
            axis=joint.axis,
            angle_min_rad=joint.limits.lower_rad,
            angle_max_rad=joint.limits.upper_rad,
            speed_limit_rad_s=joint.limits.speed_rad_s,
            acceleration_limit_rad_s2=joint.limits.acceleration_rad_s2,
            torque_limit_nm=joint.limits.torque_nm,
            torque_rate_limit_nm_s=joint.limits.torque_rate_nm_s,
            stiffness_nm_per_rad=joint.motor.stiffness_nm_per_rad,
            damping_nm_s_per_rad=joint.motor.damping_nm_s_per_rad,
            velocity_gain_nm_s_per_rad=joint.motor.velocity_gain_nm_s_per_rad,
            rotor_kg_m2=joint.motor.armature_kg_m2,
            derate_from_c=joint.limits.derate_from_c,
            stop_at_c=joint.limits.stop_at_c,
            min_voltage_v=joint.limits.min_voltage_v,
            modes=[Mode.PASSIVE, *(mode for mode in Mode if mode.name.lower() in joint.drive.modes)],
            measures=[one for one in get_args(Measurement) if one in joint.drive.measures],
        )
        for joint in robot.joint_table
    ]


def with_modes(robot: RobotFile, modes: Collection[DriveMode]) -> RobotFile:
    """The robot on drives that have these modes alone, whatever else its file says of its joints."""
    drive = msgspec.structs.replace(robot.drive, modes=[mode for mode in robot.drive.modes if mode in modes])
    joints = {
        name: own
        if own.modes is None
        else msgspec.structs.replace(own, modes=[mode for mode in own.modes if mode in modes])
        for name, own in robot.joints.items()
    }
    return msgspec.structs.replace(robot, drive=drive, joints=joints)


def describe(
    robot: RobotFile,
    *,
    backend: str,
    period_ns: int,
    lease_ns: int,
    config_hash: str,
    emulated: bool = False,
    simulated_time: bool = False,
) -> Description:
    """The description that the HAL publishes, from a robot file. Raises ConfigError for the class of a sensor in it.

    emulated: nothing real moves; simulated_time: and between two ticks any time may pass.
    """
    joints = described(robot)
    links = [
        LinkDescription(name=f"link_{i}", length_m=length, radius_m=robot.module.radius_m, mass_kg=mass)
        for i, (length, mass) in enumerate(zip(robot.link_lengths_m, robot.link_masses_kg, strict=True))
    ]
    rate_hz = 1e9 / period_ns
    sensors = [SensorDescription(key=keys.JOINTS, rate_hz=rate_hz, delay_s=robot.sensors.joints.delay_s)]
    for key, sensor in robot.sensors.published():
        delay_s = max(sensor.delay_s, period_ns * 1e-9) if isinstance(sensor, Mounted) else sensor.delay_s
        sensors.append(SensorDescription(key=key, rate_hz=min(sensor.rate_hz, rate_hz), delay_s=delay_s))
    return Description(
        robot=robot.name,
        backend=backend,
        layout=layout_hash(joints),
        config_hash=config_hash,
        period_ns=period_ns,
        lease_ns=lease_ns,
        max_step_rad=robot.safety.max_step_rad,
        stop_mode=robot.safety.action,
        max_isolated_joints=robot.safety.max_isolated_joints,
        emulated=emulated,
        simulated_time=simulated_time,
        joints=joints,
        links=links,
        sensors=sensors,
        own={keys.own(sensor.name): _own_schema(sensor) for sensor in robot.sensors.own},
    )


def identified(robot: Description, serials: Sequence[str], firmware: Sequence[str]) -> Description:
    """A description in which every joint's drive says who it is, tail to head."""
    joints = [
        msgspec.structs.replace(joint, serial=serial, firmware=version)
        for joint, serial, version in zip(robot.joints, serials, firmware, strict=True)
    ]
    return msgspec.structs.replace(robot, joints=joints)


def _own_schema(sensor: OwnSensor) -> str:
    """Of the message that the sensor's class names. Raises ConfigError."""
    model = find_plugin(SENSORS, sensor.model)
    return schema_of(getattr(model, "message", None), f"sensor {sensor.name!r}: model {short(sensor.model)}")


def layout_hash(joints: list[JointDescription]) -> str:
    """Hash of names, order and axes: two robots with the same hash take the same vectors."""
    text = ";".join(f"{joint.name}:{joint.axis}" for joint in joints)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
