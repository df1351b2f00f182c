"""Numbers with a unit and bounds, as types. A decoder rejects NaN, infinity and absurd values.

The bounds here are sanity bounds of the wire, far beyond any snake robot; a robot's own limits are in its robot
file and are enforced by the limiter.
"""

from typing import Annotated

from msgspec import Meta

MAX_COUNT = 2**62
MAX_JOINTS = 256
MAX_CONTACTS = 512
MAX_IMAGE_WIDTH = 1280
MAX_IMAGE_HEIGHT = 960
MAX_PIXELS = MAX_IMAGE_WIDTH * MAX_IMAGE_HEIGHT
MAX_BEAMS = 4096
MAX_PARAMETERS_JSON = 8192  # characters
MAX_SCHEMA = 65536  # characters
MAX_CUSTOM_SENSORS = 16  # sensors with a custom message
MAX_CUSTOM_SCHEMA = 8192  # characters of the schema of each
MAX_SHARED_SETTINGS = 256  # of a process
MAX_PREVIEW_BYTES = 128 * 1024
MAX_TARGET = 1e5  # of a setpoint or a torque limit, in the unit of its mode


def bounded(low: float, high: float, unit: str) -> Meta:
    """Return the bounds of a number with a unit: from `low` to `high`.

    Args:
        low: The smallest number that is allowed.
        high: The largest number that is allowed.
        unit: Unit, such as "rad". "1" for a plain number.
    """
    return Meta(ge=_normalize(low), le=_normalize(high), extra_json_schema={"unit": unit})


def above(high: float, unit: str) -> Meta:
    """Return the bounds of a setting with a unit: more than zero, at most `high`.

    Args:
        high: The largest number that is allowed.
        unit: Unit, such as "rad". "1" for a plain number.
    """
    return Meta(gt=0, le=_normalize(high), extra_json_schema={"unit": unit})


def from_zero(high: float, unit: str) -> Meta:
    """Return the bounds of a setting with a unit: from zero to `high`.

    Args:
        high: The largest number that is allowed.
        unit: Unit, such as "rad". "1" for a plain number.
    """
    return Meta(ge=0, le=_normalize(high), extra_json_schema={"unit": unit})


def _normalize(number: float) -> float:
    """Return a whole number as `int`.

    Python keeps one of two equal types such as `Annotated[float, ge=2]` and `Annotated[float, ge=2.0]`: that of the
    module imported first. So the schemas would depend on the order of imports.
    """
    return int(number) if number == int(number) else number


def describe(text: str) -> Meta:
    """Return the meaning of a field, for readers of the schema."""
    return Meta(description=text)


Angle = Annotated[float, bounded(-1e4, 1e4, "rad")]
AngularVelocity = Annotated[float, bounded(-1e5, 1e5, "rad/s")]
Torque = Annotated[float, bounded(-1e5, 1e5, "N·m")]
Force = Annotated[float, bounded(-1e7, 1e7, "N")]
Length = Annotated[float, bounded(-1e6, 1e6, "m")]
Velocity = Annotated[float, bounded(-1e5, 1e5, "m/s")]
Acceleration = Annotated[float, bounded(-1e7, 1e7, "m/s²")]
Voltage = Annotated[float, bounded(-1e3, 1e3, "V")]
Current = Annotated[float, bounded(-1e4, 1e4, "A")]
Temperature = Annotated[float, bounded(-273.15, 1e4, "°C")]
Unit = Annotated[float, bounded(-1.001, 1.001, "1")]
Scalar = Annotated[float, bounded(-1e12, 1e12, "1")]
Pixels = Annotated[float, bounded(-1e5, 1e5, "px")]
FocalLength = Annotated[float, above(1e5, "px")]
Distance = Annotated[float, from_zero(1e4, "m")]
Microseconds = Annotated[float, from_zero(1e8, "µs")]
Speed = Annotated[float, bounded(0.1, 10.0, "1")]  # of robot time, beside the wall clock
Fraction = Annotated[float, bounded(0.0, 1.0, "1")]

Target = Annotated[
    float, bounded(-MAX_TARGET, MAX_TARGET, "rad, rad/s or N·m, depending on the joint's mode")
]
TorqueLimit = Annotated[float, bounded(0.0, MAX_TARGET, "N·m")]

Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
Tick = Annotated[
    int,
    Meta(ge=0, le=MAX_COUNT),
    describe("number of a control period, from 0 at the start of the host"),
]
Nanoseconds = Annotated[int, Meta(ge=0, le=MAX_COUNT, extra_json_schema={"unit": "ns"})]
Stamp = Annotated[
    Nanoseconds, describe("robot time: as in hal/clock, from 0 at the start of the host")
]
LinkIndex = Annotated[int, Meta(ge=0, le=MAX_JOINTS)]
Name = Annotated[str, Meta(min_length=1, max_length=64)]
Reason = Annotated[str, Meta(max_length=500)]

Vector = tuple[Length, Length, Length]
UnitVector = tuple[Unit, Unit, Unit]
Quaternion = tuple[Unit, Unit, Unit, Unit]
ForceVector = tuple[Force, Force, Force]
TorqueVector = tuple[Torque, Torque, Torque]
VelocityVector = tuple[Velocity, Velocity, Velocity]
AngularVelocityVector = tuple[AngularVelocity, AngularVelocity, AngularVelocity]
AccelerationVector = tuple[Acceleration, Acceleration, Acceleration]

Angles = Annotated[list[Angle], Meta(max_length=MAX_JOINTS)]
AngularVelocities = Annotated[list[AngularVelocity], Meta(max_length=MAX_JOINTS)]
Torques = Annotated[list[Torque], Meta(max_length=MAX_JOINTS)]
Targets = Annotated[list[Target], Meta(max_length=MAX_JOINTS)]
TorqueLimits = Annotated[list[TorqueLimit], Meta(max_length=MAX_JOINTS)]
Flags = Annotated[list[bool], Meta(max_length=MAX_JOINTS)]
Ages = Annotated[list[Nanoseconds], Meta(max_length=MAX_JOINTS)]
