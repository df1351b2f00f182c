"""Reads limits and friction of a URDF's joints.

The most common value becomes the value of all joints in the robot file; joints with other values have exceptions.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.model.files import decode
from snakesim_hal.model.joints import MAX_TURN_RAD
from snakesim_hal.model.joints import Joint as BuiltJoint
from snakesim_hal.model.robot import RobotFile
from snakesim_operator.features.robots.imported import Imported
from snakesim_operator.features.robots.urdf_tree import UrdfJoint
from snakesim_operator.features.robots.xml_tree import Element

MAX_LIMIT_RAD = 6.2832  # one revolution; a larger number must be in degrees


@dataclass(frozen=True)
class JointNumber:
    """A number that a URDF has for a joint, and its place in a robot file."""

    tag: str
    attribute: str
    section: str
    key: str
    unit: str
    maximum: float  # as in snakesim_hal.model.joints
    usual: float  # a larger one is allowed, and reported as doubtful
    other_unit: str  # in which it is often written by mistake

    @property
    def is_limit(self) -> bool:
        """Whether the number limits the motor. A limit must be above 0; friction and damping may be 0."""
        return self.section == "limits"


NUMBERS = (
    JointNumber("limit", "velocity", "limits", "speed_rad_s", "rad/s", 100.0, 20.0, "degrees per second"),
    JointNumber("limit", "effort", "limits", "torque_nm", "N·m", 1000.0, 50.0, "N·mm"),
    JointNumber("dynamics", "damping", "motor", "viscous_nm_s_per_rad", "N·m·s/rad", 100.0, 5.0, "N·mm·s/rad"),
    JointNumber("dynamics", "friction", "motor", "friction_nm", "N·m", 100.0, 5.0, "N·mm"),
)


@dataclass(frozen=True)
class AngleRange:
    """The range of a joint, by the robot file's sign."""

    lower_rad: float
    upper_rad: float


def put_limits(found: Imported, joints: list[UrdfJoint], source: str, *, own: bool) -> None:
    """Put limits and friction into the values of a robot file.

    Args:
        found: The import, whose values and report are extended.
        joints: The joints, tail to head.
        source: The file, for error messages.
        own: Whether the values so far are those of the same robot, as it was exported. Then only differences are put.

    Raises:
        ConfigError: A number is out of its range.
    """
    ranges = [_read_range(found, joint, negated) for joint, negated in zip(joints, found.negated, strict=True)]
    if not own:
        _put_common_range(found, ranges, source)
    built = decode(found.table, RobotFile).joint_table
    columns = {number.key: _complete_column(found, number, joints, built, own=own) for number in NUMBERS}
    if not own:
        for number in NUMBERS:
            [(common, _)] = Counter(columns[number.key]).most_common(1)
            found.table.set_value(f"{number.section}.{number.key}", common, source)
    _put_exceptions(found, joints, ranges, columns, source)


def _read_range(found: Imported, joint: UrdfJoint, negated: bool) -> AngleRange:
    """Return the range of a joint, at most half a revolution to either side. Raises ConfigError.

    negated: whether the robot file's angle is minus the URDF's.
    """
    element = joint.element
    if element.attributes["type"] == "continuous":
        found.changes.add(
            f"continuous joints turn by {MAX_TURN_RAD} rad to either side here; where there are no end stops, give "
            f"`cable_turns`",
            joint.place(),
        )
        return AngleRange(-MAX_TURN_RAD, MAX_TURN_RAD)
    limit = element.first("limit")
    if limit is None:
        raise element.error("is revolute and has no <limit>; add lower and upper, in rad")
    lower = _read_limit_rad(found, joint, limit, "lower")
    upper = _read_limit_rad(found, joint, limit, "upper")
    if not lower < 0 < upper:
        raise limit.error(
            f"of joint {joint.name!r} is {lower:g} to {upper:g} rad; a joint must be able to turn to either side of "
            f"zero: `lower` below 0, `upper` above 0"
        )
    if negated:
        return AngleRange(-upper, -lower)
    return AngleRange(lower, upper)


def _read_limit_rad(found: Imported, joint: UrdfJoint, limit: Element, attribute: str) -> float:
    """Return one side of the range, cut to half a revolution. The cut is reported. Raises ConfigError."""
    limit_rad = limit.number(attribute, "0")
    if abs(limit_rad) > MAX_LIMIT_RAD:
        radians = math.radians(limit_rad)
        raise limit.error(
            f"of joint {joint.name!r} has `{attribute}` = {limit_rad:g} rad; a joint turns by {MAX_LIMIT_RAD} rad at "
            f"most. URDF has radians: if this is in degrees, write {radians:.5g}. A joint without end stops has "
            f'type="continuous"'
        )
    if abs(limit_rad) <= MAX_TURN_RAD:
        return limit_rad
    cut = MAX_TURN_RAD if limit_rad > 0 else -MAX_TURN_RAD
    found.changes.add(
        f"`{attribute}` = {limit_rad:g} rad became {cut:g} rad, half a turn, which is the most that a robot file has; "
        f"if these are degrees, write radians",
        joint.place("limit"),
    )
    return cut


def _complete_column(
    found: Imported, number: JointNumber, joints: Sequence[UrdfJoint], built: Sequence[BuiltJoint], *, own: bool
) -> list[float]:
    """Return a number of every joint, tail to head. Where the file gives none, a value is assumed and reported.

    Args:
        found: The import, whose report is extended.
        number: Which number.
        joints: The joints of the URDF.
        built: The joints by the values so far: of the same robot if `own`, otherwise of the robot `--like`.
        own: Whether the values so far are those of the same robot.

    Raises:
        ConfigError: A joint has no motor, while others have one.
    """
    values = [_read_number(found, number, joint) for joint in joints]
    known = [value for value in values if value]
    completed: list[float] = []
    for joint, value, as_built in zip(joints, values, built, strict=True):
        if value is not None and (value > 0 or not number.is_limit):
            completed.append(value)
            continue
        if value is not None and known:
            raise _motorless_error(number, joint, max(known))
        assumed, origin = _assume(number, as_built, known, own=own)
        given_text = "no value" if value is None else f"{value:g}"
        found.assumptions.add(
            f"<{number.tag} {number.attribute}> has {given_text}: {assumed:g} {number.unit}, {origin}",
            joint.place(number.tag),
        )
        completed.append(assumed)
    return completed


def _assume(number: JointNumber, built: BuiltJoint, known: Sequence[float], *, own: bool) -> tuple[float, str]:
    """Return the value for a joint for which the file gives none, and the origin of this value."""
    section = built.limits if number.is_limit else built.motor
    default = getattr(section, number.key)
    if own:
        return default, f"from {number.section}.{number.key} of its <snakesim> element"
    if not number.is_limit:
        return 0.0, "the URDF default for a missing value"
    if known:
        return min(known), "the smallest of the other joints; is there a motor in this joint?"
    return default, "from the robot of --like, because no joint has a value"


def _motorless_error(number: JointNumber, joint: UrdfJoint, other: float) -> Exception:
    limit = joint.element.first("limit") or joint.element
    return limit.error(
        f"of joint {joint.name!r} has `{number.attribute}` = 0 {number.unit}, and other joints have up to {other:g}: a "
        f"joint without a motor. A robot file has a motor in every joint; give a value above 0 and at most "
        f'{number.maximum:g} {number.unit}, or make the joint type="fixed"'
    )


def _read_number(found: Imported, number: JointNumber, joint: UrdfJoint) -> float | None:
    """Return a number of a joint, or None if the file gives none. Raises ConfigError for one out of its range."""
    element = joint.element.first(number.tag)
    if element is None or number.attribute not in element.attributes:
        return None
    value = element.number(number.attribute)
    if not 0 <= value <= number.maximum:
        bound = "above 0" if number.is_limit else "0 or more"
        raise element.error(
            f"of joint {joint.name!r} has `{number.attribute}` = {value:g} {number.unit}; expected {bound} and at most "
            f"{number.maximum:g} {number.unit}. Is it in {number.other_unit}, or does it stand for no limit?"
        )
    if value > number.usual:
        found.doubts.add(
            f"`{number.attribute}` = {value:g} {number.unit} is much for a snake robot; is it in {number.other_unit}?",
            joint.place(number.tag),
        )
    return value


def _put_common_range(found: Imported, ranges: list[AngleRange], source: str) -> None:
    """Put the most common range: `angle_rad`, and the other side if the range is not symmetric."""
    table = found.table
    common = Counter(ranges).most_common(1)[0][0]
    limits = table.values.get("limits", {})
    for side in ("angle_min_rad", "angle_max_rad"):
        limits.pop(side, None)
    table.set_value("limits.angle_rad", max(-common.lower_rad, common.upper_rad), source)
    if -common.lower_rad < common.upper_rad:
        table.set_value("limits.angle_min_rad", common.lower_rad, source)
    if -common.lower_rad > common.upper_rad:
        table.set_value("limits.angle_max_rad", common.upper_rad, source)


def _put_exceptions(
    found: Imported, joints: list[UrdfJoint], ranges: list[AngleRange], columns: dict[str, list[float]], source: str
) -> None:
    """Put what differs in one joint from the sections for all joints.

    Args:
        found: The import, whose values and report are extended.
        joints: The joints of the URDF, tail to head.
        ranges: Their ranges.
        columns: Their other numbers, by the key of the robot file.
        source: The file, for error messages.
    """
    differences: dict[str, list[str]] = {}
    for i, built in enumerate(decode(found.table, RobotFile).joint_table):
        compared = [
            ("angle_min_rad", ranges[i].lower_rad, built.limits.lower_rad, "rad"),
            ("angle_max_rad", ranges[i].upper_rad, built.limits.upper_rad, "rad"),
        ]
        for number in NUMBERS:
            section = built.limits if number.is_limit else built.motor
            compared.append((number.key, columns[number.key][i], getattr(section, number.key), number.unit))
        for key, in_urdf, in_sections, unit in compared:
            if in_urdf == in_sections:
                continue
            found.table.set_value(f"joints.{built.name}.{key}", in_urdf, source)
            differences.setdefault(key, []).append(f"{built.name} ({joints[i].name}) {in_urdf:g} {unit}")
    for key, values in differences.items():
        found.changes.add(f"{key} differs from that of the others: {', '.join(values)}")
