"""The joints of a robot file: sections for all of them, and a table of exceptions for single ones.

`[limits]`, `[motor]`, `[drive]`, `[heat]` and `[supply]` hold for every joint; `[joints.joint_3]` says what differs in
one, by the same names. `table` puts them together: one `Joint` each, tail to head.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.messages import Axis, Measurement
from snakesim_hal.wire.quantities import above, bounded, from_zero

MAX_TURN_RAD = 3.14159

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


class Limits(FileStruct, frozen=True, kw_only=True):
    """Limits of a joint; enforced by the limiter and by the motor."""

    angle_rad: Annotated[float, above(MAX_TURN_RAD, "rad")]  # to either side
    angle_min_rad: Side | None = None  # of a side that differs
    angle_max_rad: Side | None = None
    # To either side, that the cable of a joint without end stops bears.
    cable_turns: Annotated[float, above(100, "turns")] | None = None
    cable_unwound: Text = ""  # when it was, at the joint's zero; written by `snakesim joints zero`
    speed_rad_s: Annotated[float, above(100, "rad/s")]
    acceleration_rad_s2: Annotated[float, above(1e5, "rad/s²")]
    torque_nm: Torque
    torque_rate_nm_s: Annotated[float, above(1e5, "N·m/s")]
    derate_from_c: Celsius = 80.0  # of the winding: above it torque is derated
    stop_at_c: Celsius = 105.0  # a fifth of the torque is left, and the robot stops
    min_voltage_v: Annotated[float, from_zero(1000, "V")] = 18.0  # below it the robot stops

    def __post_init__(self) -> None:
        """Derating must begin before the robot stops, and a joint must turn. Raises ValueError, for the file reader."""
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

        if self.cable_turns is not None and self.cable_turns < max(-self.lower_rad, self.upper_rad) / (2 * math.pi):
            raise ValueError(
                f"`cable_turns` = {self.cable_turns:g} turns is less than its limits of {self.lower_rad:g} to "
                f"{self.upper_rad:g} rad: narrow the limits"
            )

    @property
    def lower_rad(self) -> float:
        """The joint's lowest angle."""
        return -self.angle_rad if self.angle_min_rad is None else self.angle_min_rad

    @property
    def upper_rad(self) -> float:
        """The joint's highest angle."""
        return self.angle_rad if self.angle_max_rad is None else self.angle_max_rad


class Motor(FileStruct, frozen=True, kw_only=True):
    """Motor of a joint, as seen at the joint: behind the gear."""

    stiffness_nm_per_rad: Annotated[float, above(1e5, "N·m/rad")]  # position mode
    damping_nm_s_per_rad: Annotated[float, from_zero(1e4, "N·m·s/rad")]  # position mode
    velocity_gain_nm_s_per_rad: Annotated[float, above(1e4, "N·m·s/rad")]  # velocity mode
    response_time_s: Lag  # first-order lag of the torque
    armature_kg_m2: RotorInertia  # rotor inertia seen at the joint
    friction_nm: Friction = 0.0
    viscous_nm_s_per_rad: Viscosity = 0.0
    torque_constant_nm_per_a: TorqueConstant | None = None  # of the drive's shaft, before a `gear`; none: not known
    rated_nm: Torque | None = None  # that heats it as [heat] says; none: `limits.torque_nm`
    peak_nm: Torque | None = None  # that it can give at all: no limit may be above it; none: not known


DriveMode = Literal["position", "velocity", "torque"]
Modes = Annotated[list[DriveMode], Meta(max_length=3)]
Measures = Annotated[list[Measurement], Meta(max_length=3)]


class Drive(FileStruct, frozen=True, kw_only=True):
    """How a joint's drive is connected and mounted: drive angle = zero_rad + sign * gear * joint angle."""

    driver: Text = ""  # of its protocol, such as dynamixel; empty: the backend's only one
    port: Text = ""  # bus or serial port, such as can0; empty: as the backend's settings say
    sign: Sign = 1  # -1: mounted the other way round, so that the drive turns against the joint
    zero_rad: Zero = 0.0  # what the drive measures at the joint's zero
    gear: Gear = 1.0  # turns of the drive's shaft in one turn of the joint
    modes: Modes = msgspec.field(default_factory=lambda: ["position", "velocity", "torque"])  # that it can be in
    measures: Measures = msgspec.field(default_factory=lambda: ["torque", "temperature", "voltage"])

    def __post_init__(self) -> None:
        """A robot is armed by holding its pose. Raises ValueError, for the file reader."""
        if "position" not in self.modes:
            raise ValueError(
                f"`modes` = {self.modes} lacks position, in which every joint holds its pose when it is armed; add it, "
                f"or leave `modes` out"
            )


class Heat(FileStruct, frozen=True, kw_only=True):
    """How a motor warms up. The defaults are typical of a small geared servo; none was measured."""

    ambient_c: Annotated[float, bounded(-50, 100, "°C")] = 20.0
    # Of the winding, at rest under the rated torque, for ever.
    rise_at_rated_k: Annotated[float, above(1000, "K")] = 240.0
    time_constant_s: Annotated[float, above(1e5, "s")] = 60.0
    # 5 K/W from winding to water, a guess of the right order for a housing of 100 mm.
    loss_at_rated_w: Annotated[float, from_zero(1e5, "W")] = 48.0
    # Of the winding's rise, in the electronics beside it; a guess.
    board_fraction: Annotated[float, from_zero(1, "1")] = 0.3


class Supply(FileStruct, frozen=True, kw_only=True):
    """Electrical supply of a joint."""

    voltage_v: Annotated[float, above(1000, "V")] = 24.0
    idle_a: Annotated[float, from_zero(1000, "A")] = 0.05


class _Id(FileStruct, frozen=True, kw_only=True):
    id: Annotated[int, Meta(ge=0, lt=2**29)] | None = None  # on its bus; none: the joint's number


_OF_ALL = {"ambient_c"}  # the water is the same for all
_differing = (
    (field.name, field.type | None, None)
    for section in (Limits, Motor, Drive, Heat, Supply)
    for field in msgspec.structs.fields(section)
    if field.name not in _OF_ALL
)
_of_one: Any = msgspec.defstruct("_OfOne", [*_differing], bases=(_Id,), frozen=True, kw_only=True)


class JointExceptions(_of_one):
    """What differs in one joint from the sections for all: their fields, and the drive's id."""


SectionT = TypeVar("SectionT", Limits, Motor, Drive, Heat, Supply)


@dataclass(frozen=True)
class Joint:
    """One joint as built: the sections for all joints, with its exceptions in them."""

    name: str
    axis: Axis
    id: int
    limits: Limits
    motor: Motor
    drive: Drive
    heat: Heat
    supply: Supply

    @property
    def rated_nm(self) -> float:
        """The torque that heats its motor as `heat` says."""
        return self.limits.torque_nm if self.motor.rated_nm is None else self.motor.rated_nm


def table(
    axes: Sequence[Axis],
    exceptions: Mapping[str, JointExceptions],
    limits: Limits,
    motor: Motor,
    drive: Drive,
    heat: Heat,
    supply: Supply,
) -> list[Joint]:
    """Every joint, tail to head; raises ValueError, which names the joint, for what no joint can be."""
    names = [f"joint_{i + 1}" for i in range(len(axes))]
    for name in exceptions:
        if name not in names:
            raise ValueError(f"[joints.{name}]: this robot has {names[0]} to {names[-1]}, by [chain]")
    joints: list[Joint] = []
    for i, (name, axis) in enumerate(zip(names, axes, strict=True)):
        own = exceptions.get(name, JointExceptions())
        try:
            joint = Joint(
                name=name,
                axis=axis,
                id=i + 1 if own.id is None else own.id,
                limits=_limits(limits, own),
                motor=_with(motor, own),
                drive=_with(drive, own),
                heat=_with(heat, own),
                supply=_with(supply, own),
            )
            _check(joint)
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from None
        joints.append(joint)
    _check_all(joints)
    return joints


def _limits(common: Limits, own: JointExceptions) -> Limits:
    if own.angle_rad is not None:  # to either side, whatever those of all are
        common = msgspec.structs.replace(common, angle_rad=own.angle_rad, angle_min_rad=None, angle_max_rad=None)
    return _with(common, own)


def _with(section: SectionT, own: JointExceptions) -> SectionT:
    """A section with one joint's exceptions."""
    said = {name: getattr(own, name, None) for name in section.__struct_fields__}
    differs = {name: value for name, value in said.items() if value is not None}
    return msgspec.structs.replace(section, **differs) if differs else section


def _check(joint: Joint) -> None:
    limits, peak_nm = joint.limits, joint.motor.peak_nm
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


def _check_all(joints: Sequence[Joint]) -> None:
    lags = [joint.motor.response_time_s > 0 for joint in joints]
    if any(lags) and not all(lags):
        raise ValueError(
            f"{joints[lags.index(False)].name}: `response_time_s` = 0 s, and other joints have more; give all of them "
            f"some, or none"
        )
    at = [(joint.drive.driver, joint.drive.port, joint.id) for joint in joints]
    for (driver_type, port, number), count in Counter(at).items():
        if count > 1:
            same = ", ".join(
                joint.name for joint, one in zip(joints, at, strict=True) if one == (driver_type, port, number)
            )
            where = f"port {port!r}" if port else "one bus"
            raise ValueError(f"{same}: all have the id {number} on {where}; without an `id` a joint has its number")
