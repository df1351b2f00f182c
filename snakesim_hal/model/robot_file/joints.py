"""The joints of a robot file: sections for all joints, and a table of exceptions for single ones.

`[limits]`, `[motor]`, `[drive]`, `[heat]` and `[supply]` are for every joint. `[joints.joint_3]` contains the values
that differ for one joint, with the same keys. `make_joints` combines them into one `Joint` for each, tail to head.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Axis, Measurement
from snakesim_hal.wire.quantities import above, bounded, from_zero

MAX_TURN_RAD = 3.14159  # to either side
MAX_ID = 2**29  # exclusive; extended CAN identifiers have 29 bits

Side = Annotated[float, bounded(-MAX_TURN_RAD, MAX_TURN_RAD, "rad")]
Torque = Annotated[float, above(1000, "N·m")]
Celsius = Annotated[float, above(300, "°C")]
Lag = Annotated[float, from_zero(1, "s")]
RotorInertia = Annotated[float, from_zero(10, "kg·m²")]
Friction = Annotated[float, from_zero(100, "N·m")]
Viscosity = Annotated[float, from_zero(100, "N·m·s/rad")]
TorqueConstant = Annotated[float, above(1000, "N·m/A")]
Text = Annotated[str, Meta(max_length=100)]
Sign = Literal[1, -1]
Zero = Annotated[float, bounded(-1e4, 1e4, "rad")]
Gear = Annotated[float, above(1e4, "1")]
Backlash = Annotated[float, from_zero(0.5, "rad")]
DeadZone = Annotated[float, from_zero(0.5, "rad")]
SlipTorque = Annotated[float, from_zero(1000, "N·m")]


class MotionLimits(FileStruct, frozen=True, kw_only=True):
    """Limits of a joint. Enforced by the limiter and by the motor."""

    angle_rad: Annotated[float, above(MAX_TURN_RAD, "rad")]
    """Maximum angle of the joint to either side of its zero."""

    angle_min_rad: Side | None = None
    """Lowest angle, if it is not minus `angle_rad`. None: minus `angle_rad`."""

    angle_max_rad: Side | None = None
    """Highest angle, if it is not `angle_rad`. None: `angle_rad`."""

    cable_turns: Annotated[float, above(100, "turns")] | None = None
    """Revolutions to either side that the cable of a joint without end stops can take. None: the joint has end stops.
    """

    cable_unwound: Text = ""
    """Date at which the cable was unwound with the joint at its zero. Empty: unknown.

    `snakesim robot calibrate zero` writes it.
    """

    # Motion.
    speed_rad_s: Annotated[float, above(100, "rad/s")]
    """Maximum speed of the joint."""

    acceleration_rad_s2: Annotated[float, above(1e5, "rad/s²")]
    """Maximum acceleration of a commanded motion."""

    torque_nm: Torque
    """Maximum torque of the joint."""

    torque_rate_nm_s: Annotated[float, above(1e5, "N·m/s")]
    """Maximum rate at which a commanded torque changes."""

    derate_from_c: Celsius = 80.0
    """Temperature of the winding above which the torque limit is reduced, down to a fifth of it at `stop_at_c`."""

    stop_at_c: Celsius = 105.0
    """Temperature of the winding at which the robot stops with a fault."""

    min_voltage_v: Annotated[float, from_zero(1000, "V")] = 18.0
    """Supply voltage below which the robot stops with a fault."""

    def __post_init__(self) -> None:
        """Raise ValueError for limits that contradict each other. The file reader turns it into a ConfigError.

        Derating must start before the robot stops, the joint must have travel, and its cable must allow all of it.
        """
        if self.stop_at_c <= self.derate_from_c:
            raise ValueError(
                f"`stop_at_c` = {self.stop_at_c:g} °C must be above `derate_from_c` = {self.derate_from_c:g} °C, "
                f"so that torque is derated before the robot stops"
            )
        if self.lower_rad >= self.upper_rad:
            raise ValueError(
                f"it may turn from {self.lower_rad:g} to {self.upper_rad:g} rad, which leaves no travel: "
                f"`angle_min_rad` (or minus `angle_rad`) must be below `angle_max_rad` (or `angle_rad`)"
            )
        max_turns = max(-self.lower_rad, self.upper_rad) / (2 * math.pi)
        if self.cable_turns is not None and self.cable_turns < max_turns:
            raise ValueError(
                f"`cable_turns` = {self.cable_turns:g} turns is less than its limits of {self.lower_rad:g} to "
                f"{self.upper_rad:g} rad: narrow the limits"
            )

    @property
    def lower_rad(self) -> float:
        """Return the joint's lowest angle."""
        return -self.angle_rad if self.angle_min_rad is None else self.angle_min_rad

    @property
    def upper_rad(self) -> float:
        """Return the joint's highest angle."""
        return self.angle_rad if self.angle_max_rad is None else self.angle_max_rad


class JointMotor(FileStruct, frozen=True, kw_only=True):
    """Motor of a joint, as seen at the joint: behind the gear."""

    # Gains: of position mode, and of velocity mode.
    stiffness_nm_per_rad: Annotated[float, above(1e5, "N·m/rad")]
    """Gain of position mode: torque for each radian between the target and the angle."""

    damping_nm_s_per_rad: Annotated[float, from_zero(1e4, "N·m·s/rad")]
    """Damping of position mode: torque against each rad/s of joint speed."""

    velocity_gain_nm_s_per_rad: Annotated[float, above(1e4, "N·m·s/rad")]
    """Gain of velocity mode: torque for each rad/s between the target and the speed."""

    # Dynamics.
    response_time_s: Lag
    """Time constant with which the torque follows its command. 0: at once."""

    latency_s: Lag = 0.0
    """Time from the tick of a target until the motor follows it. The simulator delays targets by it; emulated drives
    have the latency of their bus instead. `snakesim robot identify` writes it.
    """

    armature_kg_m2: RotorInertia
    """Inertia of the rotor, as seen at the joint."""

    friction_nm: Friction = 0.0
    """Coulomb friction of motor and gear."""

    viscous_nm_s_per_rad: Viscosity = 0.0
    """Viscous friction of motor and gear."""

    # Torque.
    torque_constant_nm_per_a: TorqueConstant | None = None
    """Torque for each ampere at the drive's shaft, before a `gear`. None: unknown."""

    rated_nm: Torque | None = None
    """Torque for which [heat] gives temperatures and losses. None: `limits.torque_nm`."""

    peak_nm: Torque | None = None
    """Torque that no torque limit may exceed. None: unknown."""


DriveMode = Literal["position", "velocity", "torque"]
Modes = Annotated[list[DriveMode], Meta(max_length=3)]
Measures = Annotated[list[Measurement], Meta(max_length=3)]


class JointDrive(FileStruct, frozen=True, kw_only=True):
    """How a joint's drive is connected and mounted: drive angle = zero_rad + sign * gear * joint angle."""

    # Connection.
    driver: Text = ""
    """Driver type, such as `dynamixel`. Empty: the only driver type of the backend."""

    port: Text = ""
    """Bus or serial port, such as can0. Empty: joints are distributed evenly over those in the backend's settings."""

    # Mounting.
    sign: Sign = 1
    """1 if the drive rotates with the joint, -1 if it rotates against it."""

    zero_rad: Zero = 0.0
    """Angle that the drive measures when the joint is at its zero."""

    gear: Gear = 1.0
    """Revolutions of the drive's shaft for each revolution of the joint."""

    # Abilities: control modes, and what it measures beside the angle.
    modes: Modes = msgspec.field(default_factory=lambda: ["position", "velocity", "torque"])
    """Control modes that the drive supports. `position` must be one of them."""

    measures: Measures = msgspec.field(default_factory=lambda: ["torque", "temperature", "voltage"])
    """Quantities that the drive measures beside its angle."""

    def __post_init__(self) -> None:
        """Check that the drive can hold its position, as it must when a robot is armed. Raises ValueError."""
        if "position" not in self.modes:
            raise ValueError(
                f"in `modes` = {self.modes}, position is missing: joints hold their pose in it when armed; add it, "
                f"or leave `modes` out"
            )


class MotorHeat(FileStruct, frozen=True, kw_only=True):
    """How a motor warms up. The defaults are typical of a small geared servo. None was measured.

    Together they give 5 K/W from winding to water, a guess of the right order for a housing of 100 mm.
    """

    ambient_c: Annotated[float, bounded(-50, 100, "°C")] = 20.0
    """Temperature of the air or water around the robot."""

    rise_at_rated_k: Annotated[float, above(1000, "K")] = 240.0
    """Final temperature rise of the winding at standstill under the rated torque."""

    time_constant_s: Annotated[float, above(1e5, "s")] = 60.0
    """Time constant with which the winding warms up and cools down."""

    loss_at_rated_w: Annotated[float, from_zero(1e5, "W")] = 48.0
    """Copper loss at the rated torque."""

    board_fraction: Annotated[float, from_zero(1, "1")] = 0.3
    """Temperature rise of the electronics as a fraction of the winding's rise. The default is a guess."""


class JointSupply(FileStruct, frozen=True, kw_only=True):
    """Electrical supply of a joint."""

    voltage_v: Annotated[float, above(1000, "V")] = 24.0
    """Nominal supply voltage."""

    idle_a: Annotated[float, from_zero(1000, "A")] = 0.05
    """Current that the electronics of one joint draw without a motor current."""


class _SingleJointFields(FileStruct, frozen=True, kw_only=True):
    """Fields that only single joints have: no section for all joints contains them."""

    id: Annotated[int, Meta(ge=0, lt=MAX_ID)] | None = None
    """Id of the drive on its bus. None: the joint's number, from 1 at the tail."""


# Every field of the sections for all joints is an optional field of the exceptions of one joint. Only the ambient
# temperature is always the same for all.
_exception_fields = [
    (field.name, field.type | None, None)
    for section in (MotionLimits, JointMotor, JointDrive, MotorHeat, JointSupply)
    for field in msgspec.structs.fields(section)
    if field.name != "ambient_c"
]
_exceptions_base: Any = msgspec.defstruct(
    "_JointExceptionsBase",
    _exception_fields,
    bases=(_SingleJointFields,),
    frozen=True,
    kw_only=True,
)


class JointExceptions(_exceptions_base):
    """What differs in one joint from the sections for all: their fields, and the drive's id."""

    exceptions_to = (MotionLimits, JointMotor, JointDrive, MotorHeat, JointSupply)


SectionT = TypeVar("SectionT", MotionLimits, JointMotor, JointDrive, MotorHeat, JointSupply)


@dataclass(frozen=True)
class Joint:
    """One joint as built: the sections for all joints, with its exceptions in them."""

    name: str
    axis: Axis
    id: int  # on its bus
    limits: MotionLimits
    motor: JointMotor
    drive: JointDrive
    heat: MotorHeat
    supply: JointSupply

    @property
    def rated_nm(self) -> float:
        """Return the torque for which `heat` gives temperatures and losses."""
        return self.limits.torque_nm if self.motor.rated_nm is None else self.motor.rated_nm


def make_joints(
    axes: Sequence[Axis],
    exceptions: Mapping[str, JointExceptions],
    limits: MotionLimits,
    motor: JointMotor,
    drive: JointDrive,
    heat: MotorHeat,
    supply: JointSupply,
) -> list[Joint]:
    """Return every joint as built, tail to head.

    Args:
        axes: Axis of every joint, tail to head.
        exceptions: Values that differ in single joints, by the name of the joint.
        limits: Limits of every joint without exceptions.
        motor: Motor of every joint without exceptions.
        drive: Drive of every joint without exceptions.
        heat: Heat parameters of every joint without exceptions.
        supply: Electrical supply of every joint without exceptions.

    Raises:
        ValueError: `exceptions` names a joint that does not exist, or a joint has values that contradict each other.
            The error names the joint.
    """
    names = [f"joint_{i + 1}" for i in range(len(axes))]
    for name in exceptions:
        if name not in names:
            raise ValueError(
                f"[joints.{name}]: this robot has {names[0]} to {names[-1]}, by [chain]"
            )
    joints: list[Joint] = []
    for i, (name, axis) in enumerate(zip(names, axes, strict=True)):
        joint_exceptions = exceptions.get(name, JointExceptions())
        try:
            joint = Joint(
                name=name,
                axis=axis,
                id=i + 1 if joint_exceptions.id is None else joint_exceptions.id,
                limits=_apply_limit_exceptions(limits, joint_exceptions),
                motor=_apply_exceptions(motor, joint_exceptions),
                drive=_apply_exceptions(drive, joint_exceptions),
                heat=_apply_exceptions(heat, joint_exceptions),
                supply=_apply_exceptions(supply, joint_exceptions),
            )
            _validate_joint(joint)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        joints.append(joint)
    _validate_response_times(joints)
    _validate_drive_ids(joints)
    return joints


def _apply_limit_exceptions(
    common: MotionLimits, joint_exceptions: JointExceptions
) -> MotionLimits:
    """Return the limits of one joint. Its `angle_rad` replaces all angle limits of the section for all joints."""
    if joint_exceptions.angle_rad is not None:
        common = msgspec.structs.replace(
            common, angle_rad=joint_exceptions.angle_rad, angle_min_rad=None, angle_max_rad=None
        )
    return _apply_exceptions(common, joint_exceptions)


def _apply_exceptions(section: SectionT, joint_exceptions: JointExceptions) -> SectionT:
    """Return a section in which one joint's exceptions replace the values for all joints."""
    replacements: dict[str, Any] = {}
    for name in section.__struct_fields__:
        value = getattr(joint_exceptions, name, None)
        if value is not None:
            replacements[name] = value
    if not replacements:
        return section
    return msgspec.structs.replace(section, **replacements)


def _validate_joint(joint: Joint) -> None:
    """Raise ValueError for values of one joint that contradict each other across sections."""
    limits = joint.limits
    peak_nm = joint.motor.peak_nm
    if peak_nm is not None and limits.torque_nm > peak_nm:
        raise ValueError(
            f"`torque_nm` = {limits.torque_nm:g} N·m is more than its motor's `peak_nm` = {peak_nm:g} N·m; lower it"
        )
    if limits.cable_turns is not None and joint.drive.gear != 1.0:
        raise ValueError(
            f"`gear` = {joint.drive.gear:g} with `cable_turns`: behind a gear a drive wakes up in one of several "
            f"turns, and the joint's cannot be counted; use an encoder at the joint (`gear` = 1), or end stops and no "
            f"`cable_turns`"
        )
    if joint.supply.voltage_v <= limits.min_voltage_v:
        raise ValueError(
            f"`supply.voltage_v` = {joint.supply.voltage_v:g} V is not above `limits.min_voltage_v` = "
            f"{limits.min_voltage_v:g} V, where the robot stops: it could never be armed"
        )


def _validate_response_times(joints: Sequence[Joint]) -> None:
    """Raise ValueError if some joints have a motor lag, and other joints have none."""
    without_lag = [joint for joint in joints if joint.motor.response_time_s <= 0]
    if without_lag and len(without_lag) < len(joints):
        raise ValueError(
            f"{without_lag[0].name}: `response_time_s` = 0 s, and other joints have more; give all of them "
            f"some, or none"
        )


def _validate_drive_ids(joints: Sequence[Joint]) -> None:
    """Raise ValueError if several drives on one bus have the same id."""
    names_by_address: dict[tuple[str, str, int], list[str]] = {}
    for joint in joints:
        address = (joint.drive.driver, joint.drive.port, joint.id)
        names_by_address.setdefault(address, []).append(joint.name)
    for (_, port, drive_id), names in names_by_address.items():
        if len(names) > 1:
            bus_name = f"port {port!r}" if port else "one bus"
            raise ValueError(
                f"{', '.join(names)}: all have the id {drive_id} on {bus_name}; without an `id` a joint has its number"
            )
