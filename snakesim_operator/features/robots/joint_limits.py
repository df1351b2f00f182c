"""Reads limits and friction of a URDF's joints.

The most common value becomes the value of all joints in the robot file; joints with other values have exceptions.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.model.files import decode_table
from snakesim_hal.model.robot_file.joints import MAX_TURN_RAD
from snakesim_hal.model.robot_file.joints import Joint as BuiltJoint
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.robots.imported import ImportResult
from snakesim_operator.features.robots.urdf_tree import UrdfJoint
from snakesim_operator.features.robots.xml_tree import XmlElement

MAX_LIMIT_RAD = 6.2832  # one revolution; a larger number must be in degrees


@dataclass(frozen=True)
class JointQuantity:
    """A number that a URDF has for a joint, and its place in a robot file."""

    tag: str
    attribute: str
    section: str
    key: str
    unit: str
    maximum: float  # as in snakesim_hal.model.robot_file.joints
    usual: float  # a larger one is allowed, and reported as doubtful
    other_unit: str  # in which it is often written by mistake

    @property
    def is_limit(self) -> bool:
        """Whether the number limits the motor. A limit must be above 0; friction and damping may be 0."""
        return self.section == "limits"


JOINT_QUANTITIES = (
    JointQuantity(
        "limit", "velocity", "limits", "speed_rad_s", "rad/s", 100.0, 20.0, "degrees per second"
    ),
    JointQuantity("limit", "effort", "limits", "torque_nm", "N·m", 1000.0, 50.0, "N·mm"),
    JointQuantity(
        "dynamics",
        "damping",
        "motor",
        "viscous_nm_s_per_rad",
        "N·m·s/rad",
        100.0,
        5.0,
        "N·mm·s/rad",
    ),
    JointQuantity("dynamics", "friction", "motor", "friction_nm", "N·m", 100.0, 5.0, "N·mm"),
)


@dataclass(frozen=True)
class AngleRange:
    """The range of a joint, by the robot file's sign."""

    lower_rad: float
    upper_rad: float


def convert_joint_limits(
    result: ImportResult, joints: list[UrdfJoint], source: str, *, is_exported: bool
) -> None:
    """Convert the angle limits, motor limits and friction of a URDF's joints into values of a robot file.

    A number that most joints share goes into the section for all joints; the others become exceptions.

    Args:
        result: Result of the import, whose values and report are extended.
        joints: The joints of the URDF, tail to head.
        source: Path of the URDF, for error messages.
        is_exported: Whether SnakeSIM exported this URDF. The values so far are then those of the same robot, and only
            what differs from them is put.

    Raises:
        ConfigError: A number is out of its range.
    """
    ranges = [
        _read_angle_range(result, joint, negated)
        for joint, negated in zip(joints, result.is_negated, strict=True)
    ]
    if not is_exported:
        _set_common_range(result, ranges, source)
    joints_so_far = decode_table(result.table, RobotFile).joint_table
    columns: dict[str, list[float]] = {}  # by the key of the robot file, one value for each joint
    for quantity in JOINT_QUANTITIES:
        columns[quantity.key] = _read_number_of_all_joints(
            result, quantity, joints, joints_so_far, is_exported=is_exported
        )
    if not is_exported:
        for quantity in JOINT_QUANTITIES:
            [(most_common, _)] = Counter(columns[quantity.key]).most_common(1)
            result.table.set_value(f"{quantity.section}.{quantity.key}", most_common, source)
    _set_joint_exceptions(result, joints, ranges, columns, source)


def _read_angle_range(result: ImportResult, joint: UrdfJoint, is_negated: bool) -> AngleRange:
    """Read the angle range of a joint, cut to half a revolution to either side of zero.

    Args:
        result: Result of the import, whose report is extended.
        joint: The joint of the URDF.
        is_negated: Whether the robot file's angle is minus the URDF's.

    Returns:
        The range in rad, with the sign of the robot file.

    Raises:
        ConfigError: The joint has no limits, or zero is not between them.
    """
    element = joint.element
    if element.attributes["type"] == "continuous":
        result.changes.add(
            f"continuous joints turn by {MAX_TURN_RAD} rad to either side here; where there are no end stops, give "
            f"`cable_turns`",
            joint.format_place(),
        )
        return AngleRange(-MAX_TURN_RAD, MAX_TURN_RAD)
    limit = element.find_child("limit")
    if limit is None:
        raise element.make_error("is revolute and has no <limit>; add lower and upper, in rad")
    lower_rad = _read_limit_rad(result, joint, limit, "lower")
    upper_rad = _read_limit_rad(result, joint, limit, "upper")
    if not lower_rad < 0 < upper_rad:
        raise limit.make_error(
            f"of joint {joint.name!r} is {lower_rad:g} to {upper_rad:g} rad; a joint must be able to turn to either "
            f"side of zero: `lower` below 0, `upper` above 0"
        )
    if is_negated:
        return AngleRange(-upper_rad, -lower_rad)
    return AngleRange(lower_rad, upper_rad)


def _read_limit_rad(
    result: ImportResult, joint: UrdfJoint, limit: XmlElement, attribute: str
) -> float:
    """Read one end of a joint's angle range in rad, cut to half a revolution.

    Args:
        result: Result of the import, whose report gets a line if the value is cut.
        joint: The joint of the URDF.
        limit: The <limit> element of the joint.
        attribute: "lower" or "upper".

    Raises:
        ConfigError: The value is so large that it is probably in degrees.
    """
    limit_rad = limit.read_number(attribute, "0")
    if abs(limit_rad) > MAX_LIMIT_RAD:
        if_degrees_rad = math.radians(limit_rad)
        raise limit.make_error(
            f"of joint {joint.name!r} has `{attribute}` = {limit_rad:g} rad; a joint turns by {MAX_LIMIT_RAD} rad at "
            f"most. URDF has radians: if this is in degrees, write {if_degrees_rad:.5g}. A joint without end stops has "
            f'type="continuous"'
        )
    if abs(limit_rad) <= MAX_TURN_RAD:
        return limit_rad
    cut_rad = MAX_TURN_RAD if limit_rad > 0 else -MAX_TURN_RAD
    result.changes.add(
        f"`{attribute}` = {limit_rad:g} rad became {cut_rad:g} rad, half a turn, which is the most that a robot file "
        f"has; if these are degrees, write radians",
        joint.format_place("limit"),
    )
    return cut_rad


def _read_number_of_all_joints(
    result: ImportResult,
    quantity: JointQuantity,
    joints: Sequence[UrdfJoint],
    joints_so_far: Sequence[BuiltJoint],
    *,
    is_exported: bool,
) -> list[float]:
    """Read one number of every joint, tail to head. If the URDF has no value, one is assumed and reported.

    Args:
        result: Result of the import, whose report is extended.
        quantity: Kind of the number, such as the torque limit.
        joints: The joints of the URDF.
        joints_so_far: The joints by the values so far: of the same robot if `is_exported`, otherwise of the robot
            that the user named with `--like`.
        is_exported: Whether SnakeSIM exported this URDF.

    Raises:
        ConfigError: A limit is 0, which means that the joint has no motor, while other joints have one.
    """
    values = [_read_number(result, quantity, joint) for joint in joints]
    positive_values = [value for value in values if value]
    complete_values: list[float] = []
    for joint, value, joint_so_far in zip(joints, values, joints_so_far, strict=True):
        if value is not None:
            is_zero_limit = quantity.is_limit and value == 0
            if not is_zero_limit:
                complete_values.append(value)
                continue
            if positive_values:
                raise _make_motorless_error(quantity, joint, max(positive_values))
        assumed, origin = _assume_number(
            quantity, joint_so_far, positive_values, is_exported=is_exported
        )
        value_text = "no value" if value is None else f"{value:g}"
        result.assumptions.add(
            f"<{quantity.tag} {quantity.attribute}> has {value_text}: {assumed:g} {quantity.unit}, "
            f"{origin}",
            joint.format_place(quantity.tag),
        )
        complete_values.append(assumed)
    return complete_values


def _assume_number(
    quantity: JointQuantity, built: BuiltJoint, known: Sequence[float], *, is_exported: bool
) -> tuple[float, str]:
    """Return the value for a joint for which the file gives none, and the origin of this value."""
    section = built.limits if quantity.is_limit else built.motor
    default = getattr(section, quantity.key)
    if is_exported:
        return default, f"from {quantity.section}.{quantity.key} of its <snakesim> element"
    if not quantity.is_limit:
        return 0.0, "the URDF default for a missing value"
    if known:
        return min(known), "the smallest of the other joints; is there a motor in this joint?"
    return default, "from the robot of --like, because no joint has a value"


def _make_motorless_error(quantity: JointQuantity, joint: UrdfJoint, other: float) -> Exception:
    limit = joint.element.find_child("limit") or joint.element
    return limit.make_error(
        f"of joint {joint.name!r} has `{quantity.attribute}` = 0 {quantity.unit}, and other joints have up to "
        f"{other:g}: a joint without a motor. A robot file has a motor in every joint; give a value above 0 and "
        f'at most {quantity.maximum:g} {quantity.unit}, or make the joint type="fixed"'
    )


def _read_number(result: ImportResult, quantity: JointQuantity, joint: UrdfJoint) -> float | None:
    """Read a number of a joint, such as its torque limit, and report a doubt if it is unusually large.

    Args:
        result: Result of the import, whose report gets a doubt about a number that is unusually large.
        quantity: Kind of the number, with its element, unit and range.
        joint: The joint of the URDF.

    Returns:
        The number; None if the file does not give it.

    Raises:
        ConfigError: The number is out of its range.
    """
    element = joint.element.find_child(quantity.tag)
    if element is None or quantity.attribute not in element.attributes:
        return None
    value = element.read_number(quantity.attribute)
    unit = quantity.unit
    other_unit = quantity.other_unit
    if not 0 <= value <= quantity.maximum:
        bound = "above 0" if quantity.is_limit else "0 or more"
        raise element.make_error(
            f"of joint {joint.name!r} has `{quantity.attribute}` = {value:g} {unit}; expected {bound} and at most "
            f"{quantity.maximum:g} {unit}. Is it in {other_unit}, or does it stand for no limit?"
        )
    if value > quantity.usual:
        result.doubts.add(
            f"`{quantity.attribute}` = {value:g} {unit} is much for a snake robot; is it in {other_unit}?",
            joint.format_place(quantity.tag),
        )
    return value


def _set_common_range(result: ImportResult, ranges: list[AngleRange], source: str) -> None:
    """Put the most common range: `angle_rad`, and the other side if the range is not symmetric."""
    table = result.table
    common_range = Counter(ranges).most_common(1)[0][0]
    limits = table.values.get("limits", {})
    for side in ("angle_min_rad", "angle_max_rad"):
        limits.pop(side, None)
    table.set_value(
        "limits.angle_rad", max(-common_range.lower_rad, common_range.upper_rad), source
    )
    if -common_range.lower_rad < common_range.upper_rad:
        table.set_value("limits.angle_min_rad", common_range.lower_rad, source)
    if -common_range.lower_rad > common_range.upper_rad:
        table.set_value("limits.angle_max_rad", common_range.upper_rad, source)


def _set_joint_exceptions(
    result: ImportResult,
    joints: list[UrdfJoint],
    ranges: list[AngleRange],
    columns: dict[str, list[float]],
    source: str,
) -> None:
    """Write the numbers in which a joint differs from the sections for all joints into a section of that joint.

    Args:
        result: Result of the import, whose values and report are extended.
        joints: The joints of the URDF, tail to head.
        ranges: Angle ranges of the joints.
        columns: Other numbers of the joints, by the key of the robot file.
        source: Path of the URDF, for error messages.
    """
    texts_by_key: dict[str, list[str]] = {}  # by key, one text for each joint that differs
    for joint_index, common_joint in enumerate(decode_table(result.table, RobotFile).joint_table):
        compared_values = [  # key, value in the URDF, value in the sections, unit
            ("angle_min_rad", ranges[joint_index].lower_rad, common_joint.limits.lower_rad, "rad"),
            ("angle_max_rad", ranges[joint_index].upper_rad, common_joint.limits.upper_rad, "rad"),
        ]
        for quantity in JOINT_QUANTITIES:
            section = common_joint.limits if quantity.is_limit else common_joint.motor
            compared_values.append(
                (
                    quantity.key,
                    columns[quantity.key][joint_index],
                    getattr(section, quantity.key),
                    quantity.unit,
                )
            )
        for key, urdf_value, common_value, unit in compared_values:
            if urdf_value == common_value:
                continue
            result.table.set_value(f"joints.{common_joint.name}.{key}", urdf_value, source)
            text = f"{common_joint.name} ({joints[joint_index].name}) {urdf_value:g} {unit}"
            texts_by_key.setdefault(key, []).append(text)
    for key, texts in texts_by_key.items():
        result.changes.add(f"{key} differs from that of the others: {', '.join(texts)}")
