"""The robot file: the parameters of a chain of joint modules. A module is one joint with half a body on either side.

Chained modules are bolted together, so n modules make n joints and n + 1 rigid links. The tail link and the head link
are half as long as the others. A robot whose links differ in another way lists them in `[[links]]`.
"""

import hashlib
import math
from collections.abc import Collection, Sequence
from typing import Annotated, get_args

import msgspec
from msgspec import Meta

from snakesim_hal.base.errors import shorten
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.plugins import SENSORS, load_plugin, require_base_class
from snakesim_hal.model.robot_file.checked import StartCheckRecord
from snakesim_hal.model.robot_file.joints import (
    DriveMode,
    Joint,
    JointDrive,
    JointExceptions,
    JointMotor,
    JointSupply,
    MotionLimits,
    MotorHeat,
    make_joints,
)
from snakesim_hal.model.robot_file.links import Link
from snakesim_hal.model.robot_file.sensor_model import SensorModel
from snakesim_hal.model.robot_file.sensors import (
    CustomSensor,
    LinkName,
    MountedSensor,
    SensorSections,
)
from snakesim_hal.model.scene_file.friction import PassiveWheels, Skin, validate_skin
from snakesim_hal.wire import keys
from snakesim_hal.wire.custom_sample import make_message_schema
from snakesim_hal.wire.messages import (
    Axis,
    JointDescription,
    JointMode,
    LinkDescription,
    Measurement,
    RobotDescription,
    SensorDescription,
    StopMode,
)
from snakesim_hal.wire.quantities import MAX_JOINTS, above


class ChainLayout(FileStruct, frozen=True, kw_only=True):
    """Number of modules, and axes of their joints."""

    modules: Annotated[int, Meta(ge=1, le=MAX_JOINTS)]
    """Number of joint modules, and so of joints. The robot has one link more."""

    axes: Annotated[list[Axis], Meta(min_length=1, max_length=MAX_JOINTS)]
    """Axes of the joints, `yaw` (left and right) or `pitch` (up and down), as a pattern that is repeated from tail to
    head.
    """


class ModuleBody(FileStruct, frozen=True, kw_only=True):
    """Body of one module."""

    length_m: Annotated[float, above(2, "m")]
    """Distance between the joint axes of two neighboring modules."""

    radius_m: Annotated[float, above(1, "m")]
    """Radius of the body, which has a circular cross-section."""

    mass_kg: Annotated[float, above(100, "kg")]
    """Mass of one module with everything in it."""


class SafetyParameters(FileStruct, frozen=True, kw_only=True):
    """Behavior of the joints in a fault, and limits of commands."""

    action: StopMode = "damp"
    """Stop mode: what the joints do in a fault. `damp` brakes them, `hold` holds their angles, `passive` switches the
    motors off.
    """

    max_step_rad: Annotated[float, above(3.2, "rad")] = 0.35
    """Maximum difference between a position target and the measured angle. The command limiter clips targets beyond it.
    """

    max_isolated_joints: Annotated[int, Meta(ge=0, le=MAX_JOINTS)] = 0
    """Number of faulty joints that may be isolated: the robot continues without them, and stops at one more."""


class RobotFile(FileStruct, frozen=True, kw_only=True):
    """A whole robot file."""

    name: Annotated[str, Meta(min_length=1, max_length=40, pattern="^[A-Za-z0-9_-]+$")]
    """Name of the robot: letters, digits, `_` and `-`. It is also the default namespace of its keys on the network."""

    description: str = ""
    """Description in one line, which lists of robots show."""

    # Body.
    chain: ChainLayout
    """Number of modules, and the axes of their joints."""

    module: ModuleBody
    """Size and mass of one module."""

    links: Annotated[list[Link], Meta(max_length=MAX_JOINTS + 1)] = []
    """Every link, tail to head, for a robot whose links differ. Empty: the links follow from the modules."""

    skin: Skin | None = None
    """Scales or a skin that slide more easily in one direction; none: links rub equally in all directions."""

    wheels: PassiveWheels | None = None
    """Passive wheels under the links; none: the robot has no wheels."""

    # All joints.
    limits: MotionLimits
    """Limits of every joint."""

    motor: JointMotor
    """Motor of every joint."""

    drive: JointDrive = JointDrive()
    """Connection, mounting and abilities of every joint's drive."""

    heat: MotorHeat = MotorHeat()
    """How every motor warms up."""

    supply: JointSupply = JointSupply()
    """Electrical supply of every joint."""

    # What differs in single joints, by name.
    joints: Annotated[dict[str, JointExceptions], Meta(max_length=MAX_JOINTS)] = {}
    """Values that differ in single joints, as sections such as `[joints.joint_3]`. `joint_1` is at the tail."""

    safety: SafetyParameters = SafetyParameters()
    """Stop mode, and limits of commands."""

    sensors: SensorSections = SensorSections()
    """Sensors of the robot."""

    checked: StartCheckRecord | None = None
    """Record of the last start check, which `snakesim robot check` writes. None: the robot was never checked."""

    def __post_init__(self) -> None:
        """Check joints, links and sensors against each other. Raises ValueError, which the file reader explains."""
        _ = self.joint_table  # raises for joints that are not possible
        joint_count = self.chain.modules
        if self.links and len(self.links) != joint_count + 1:
            raise ValueError(
                f"[[links]] has {len(self.links)} entries, and {joint_count} joints connect {joint_count + 1} links; "
                f"list each, tail to head, or none"
            )
        validate_skin(self.skin, self.wheels, [f"link_{i}" for i in range(joint_count + 1)])
        for sensor in (*self.sensors.depth, *self.sensors.range, *self.sensors.custom):
            self._validate_sensor_placement(sensor)

    def _validate_sensor_placement(self, sensor: MountedSensor) -> None:
        """Raise ValueError if a sensor is on a link that does not exist, or would be inside of its link."""
        link = self.link_index(sensor.link)
        head = self.chain.modules
        if link > head:
            raise ValueError(
                f"sensor {sensor.name!r} is on link {link}, and the links are 0 (tail) to {head} (head)"
            )
        if sensor.position_m is None and link != head:
            raise ValueError(
                f"sensor {sensor.name!r} is on link {link}: give `position_m`; only the tip of the head is the default"
            )

    def link_index(self, link: LinkName) -> int:
        """Return the number of a link, from 0 at the tail."""
        match link:
            case "tail":
                return 0
            case "head":
                return self.chain.modules
            case number:
                return number

    @property
    def axes(self) -> list[Axis]:
        """Return the axis of every joint, tail to head."""
        pattern = self.chain.axes
        return [pattern[i % len(pattern)] for i in range(self.chain.modules)]

    @property
    def joint_table(self) -> list[Joint]:
        """Return every joint as built, tail to head."""
        return [*_get_joint_table(self)]

    @property
    def link_lengths_m(self) -> list[float]:
        """Return the length of every link, tail to head."""
        if self.links:
            return [link.length_m for link in self.links]
        return [self.module.length_m * part for part in self._modules_per_link]

    @property
    def link_masses_kg(self) -> list[float]:
        """Return the mass of every link, tail to head."""
        if self.links:
            return [link.mass_kg for link in self.links]
        return [self.module.mass_kg * part for part in self._modules_per_link]

    @property
    def length_m(self) -> float:
        """Return the length of the straight robot, without the caps of tail and head."""
        if self.links:
            return math.fsum(self.link_lengths_m)
        return self.chain.modules * self.module.length_m

    @property
    def _modules_per_link(self) -> list[float]:
        """Return how many modules make up each link: half a module the tail and the head, and one module the others."""
        return [0.5] + [1.0] * (self.chain.modules - 1) + [0.5]


_cached_joint_table: tuple[RobotFile, list[Joint]] | None = None


def _get_joint_table(robot: RobotFile) -> list[Joint]:
    """Return every joint of a robot. The result for the last robot is cached, because simulators read it many times."""
    global _cached_joint_table
    cached = _cached_joint_table
    if cached is not None and cached[0] is robot:
        return cached[1]
    joints = make_joints(
        robot.axes, robot.joints, robot.limits, robot.motor, robot.drive, robot.heat, robot.supply
    )
    _cached_joint_table = (robot, joints)
    return joints


def describe_joints(robot: RobotFile) -> list[JointDescription]:
    """Return the descriptions of all joints, tail to head."""
    return [_describe_joint(joint) for joint in robot.joint_table]


def list_serial_numbers(robot: RobotDescription) -> list[str]:
    """Return the serial number of every drive, tail to head; none if no drive reports one."""
    serials = [joint.serial for joint in robot.joints]
    return serials if any(serials) else []


def _describe_joint(joint: Joint) -> JointDescription:
    """Return the description of one joint that the HAL publishes."""
    limits = joint.limits
    motor = joint.motor
    drive_modes = [mode for mode in JointMode if mode.name.lower() in joint.drive.modes]
    measures: list[Measurement] = [
        quantity for quantity in get_args(Measurement) if quantity in joint.drive.measures
    ]
    return JointDescription(
        name=joint.name,
        axis=joint.axis,
        # Limits.
        angle_min_rad=limits.lower_rad,
        angle_max_rad=limits.upper_rad,
        speed_limit_rad_s=limits.speed_rad_s,
        acceleration_limit_rad_s2=limits.acceleration_rad_s2,
        torque_limit_nm=limits.torque_nm,
        torque_rate_limit_nm_s=limits.torque_rate_nm_s,
        derate_from_c=limits.derate_from_c,
        stop_at_c=limits.stop_at_c,
        min_voltage_v=limits.min_voltage_v,
        # Motor.
        stiffness_nm_per_rad=motor.stiffness_nm_per_rad,
        damping_nm_s_per_rad=motor.damping_nm_s_per_rad,
        velocity_gain_nm_s_per_rad=motor.velocity_gain_nm_s_per_rad,
        rotor_kg_m2=motor.armature_kg_m2,
        # Drive.
        modes=[JointMode.PASSIVE, *drive_modes],
        measures=measures,
    )


def restrict_drive_modes(robot: RobotFile, modes: Collection[DriveMode]) -> RobotFile:
    """Return the robot with drives that have only those of their control modes that are in `modes`."""
    all_drives = msgspec.structs.replace(
        robot.drive, modes=[mode for mode in robot.drive.modes if mode in modes]
    )
    joints: dict[str, JointExceptions] = {}
    for name, exceptions in robot.joints.items():
        if exceptions.modes is None:
            joints[name] = exceptions
        else:
            common_modes = [mode for mode in exceptions.modes if mode in modes]
            joints[name] = msgspec.structs.replace(exceptions, modes=common_modes)
    return msgspec.structs.replace(robot, drive=all_drives, joints=joints)


def remove_measurements(robot: RobotFile, missing: Collection[Measurement]) -> RobotFile:
    """Return the robot with drives that do not measure the quantities in `missing`."""
    measured = [quantity for quantity in robot.drive.measures if quantity not in missing]
    joints: dict[str, JointExceptions] = {}
    for name, exceptions in robot.joints.items():
        if exceptions.measures is None:
            joints[name] = exceptions
        else:
            kept = [quantity for quantity in exceptions.measures if quantity not in missing]
            joints[name] = msgspec.structs.replace(exceptions, measures=kept)
    return msgspec.structs.replace(
        robot, drive=msgspec.structs.replace(robot.drive, measures=measured), joints=joints
    )


def describe_robot(
    robot: RobotFile,
    *,
    backend: str,
    period_ns: int,
    lease_ns: int,
    config_hash: str,
    emulated: bool = False,
    simulated_time: bool = False,
) -> RobotDescription:
    """Return the description of a robot that the HAL publishes.

    Args:
        robot: Robot file.
        backend: Name of the backend.
        period_ns: Duration of the control cycle.
        lease_ns: Duration of a command lease.
        config_hash: Hash of the whole configuration.
        emulated: Whether no real motor moves.
        simulated_time: Whether any wall-clock time may pass between two ticks.

    Raises:
        ConfigError: The class of a custom sensor cannot be loaded, or has no message.
    """
    joints = describe_joints(robot)
    return RobotDescription(
        robot=robot.name,
        # Host and run.
        backend=backend,
        layout=compute_layout_hash(joints),
        config_hash=config_hash,
        period_ns=period_ns,
        lease_ns=lease_ns,
        emulated=emulated,
        simulated_time=simulated_time,
        # Safety.
        max_step_rad=robot.safety.max_step_rad,
        stop_mode=robot.safety.action,
        max_isolated_joints=robot.safety.max_isolated_joints,
        # Parts.
        joints=joints,
        links=_describe_links(robot),
        sensors=_describe_sensors(robot, period_ns),
        custom={
            keys.custom_key(sensor.name): _make_custom_schema(sensor)
            for sensor in robot.sensors.custom
        },
    )


def _describe_links(robot: RobotFile) -> list[LinkDescription]:
    """Return the descriptions of all links that the HAL publishes, tail to head."""
    radius_m = robot.module.radius_m
    links: list[LinkDescription] = []
    for i, (length_m, mass_kg) in enumerate(
        zip(robot.link_lengths_m, robot.link_masses_kg, strict=True)
    ):
        links.append(
            LinkDescription(name=f"link_{i}", length_m=length_m, radius_m=radius_m, mass_kg=mass_kg)
        )
    return links


def _describe_sensors(robot: RobotFile, period_ns: int) -> list[SensorDescription]:
    """Return the descriptions of all sensors that the HAL publishes. No rate exceeds that of the control cycle."""
    cycle_rate_hz = 1e9 / period_ns
    joint_sensor = SensorDescription(
        key=keys.JOINTS, rate_hz=cycle_rate_hz, delay_s=robot.sensors.joints.delay_s
    )
    sensors = [joint_sensor]
    for key, sensor in robot.sensors.iterate_published():
        delay_s = sensor.delay_s
        if isinstance(
            sensor, MountedSensor
        ):  # its sample arrives at least one period after the measurement
            delay_s = max(delay_s, period_ns * 1e-9)
        sensors.append(
            SensorDescription(key=key, rate_hz=min(sensor.rate_hz, cycle_rate_hz), delay_s=delay_s)
        )
    return sensors


def add_drive_identities(
    robot: RobotDescription, serials: Sequence[str], firmware: Sequence[str]
) -> RobotDescription:
    """Return a description with the serial number and the firmware version of every drive.

    Args:
        robot: Description without serial numbers and firmware versions.
        serials: Serial number of every drive, tail to head.
        firmware: Firmware version of every drive, tail to head.
    """
    joints = [
        msgspec.structs.replace(joint, serial=serial, firmware=version)
        for joint, serial, version in zip(robot.joints, serials, firmware, strict=True)
    ]
    return msgspec.structs.replace(robot, joints=joints)


def _make_custom_schema(sensor: CustomSensor) -> str:
    """Return the schema of a custom sensor's message. Raises ConfigError if its class cannot be loaded or has none."""
    model = load_plugin(SENSORS, sensor.model)
    label = f"sensor {sensor.name!r}: model {shorten(sensor.model)}"
    require_base_class(model, SensorModel, label)
    return make_message_schema(model.message, label)


def compute_layout_hash(joints: list[JointDescription]) -> str:
    """Return a hash of names, order and axes of the joints. Commands fit every robot with the same hash."""
    text = ";".join(f"{joint.name}:{joint.axis}" for joint in joints)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
