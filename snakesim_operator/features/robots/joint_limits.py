"""Limits and friction of a URDF's joints: what most of them have holds for all, the others have exceptions."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from snakesim_hal.model.files import decode
from snakesim_hal.model.joints import MAX_TURN_RAD
from snakesim_hal.model.joints import Joint as BuiltJoint
from snakesim_hal.model.robot import RobotFile
from snakesim_operator.features.robots.imported import Imported
from snakesim_operator.features.robots.urdf_tree import Joint
from snakesim_operator.features.robots.xml_tree import Element

MAX_LIMIT_RAD = 6.2832  # two half turns; what is more has been written in degrees


@dataclass(frozen=True)
class JointNumber:
    """A number that URDF has for a joint, and where a robot file keeps it."""

    tag: str
    attribute: str
    section: str
    key: str
    unit: str
    maximum: float  # as in snakesim_hal.model.joints
    usual: float  # more is no error, and worth a question
    other_unit: str  # in which it is written by mistake

    @property
    def is_limit(self) -> bool:
        """Whether it bounds what a motor does. Such a number is above 0; friction and damping may be 0."""
        return self.section == "limits"


NUMBERS = (
    JointNumber("limit", "velocity", "limits", "speed_rad_s", "rad/s", 100.0, 20.0, "degrees per second"),
    JointNumber("limit", "effort", "limits", "torque_nm", "N·m", 1000.0, 50.0, "N·mm"),
    JointNumber("dynamics", "damping", "motor", "viscous_nm_s_per_rad", "N·m·s/rad", 100.0, 5.0, "N·mm·s/rad"),
    JointNumber("dynamics", "friction", "motor", "friction_nm", "N·m", 100.0, 5.0, "N·mm"),
)


@dataclass(frozen=True)
class Turning:
    """How far a joint turns, by our sign."""

    lower_rad: float
    upper_rad: float


def put_limits(found: Imported, joints: list[Joint], source: str, *, own: bool) -> None:
    """Put what the joints say into a robot file's values. Raises ConfigError.

    own: the values are those of the same robot, as exported. Then only what the joints say otherwise is put.
    """
    angles = [_read_turning(found, joint, negated) for joint, negated in zip(joints, found.negated, strict=True)]
    if not own:
        _put_common_angles(found, angles, source)
    built = decode(found.table, RobotFile).joint_table
    columns = {number.key: _complete(found, number, joints, built, own=own) for number in NUMBERS}
    if not own:
        for number in NUMBERS:
            [(common, _)] = Counter(columns[number.key]).most_common(1)
            found.table.put(f"{number.section}.{number.key}", common, source)
    _put_exceptions(found, joints, angles, columns, source)


def _read_turning(found: Imported, joint: Joint, negated: bool) -> Turning:
    """As the URDF says, at most half a turn to either side. negated: our angle is minus the URDF's."""
    element = joint.element
    if element.attributes["type"] == "continuous":
        found.changes.add(
            f"continuous joints turn by {MAX_TURN_RAD} rad to either side here; where there are no end stops, give "
            f"`cable_turns`",
            joint.place(),
        )
        return Turning(-MAX_TURN_RAD, MAX_TURN_RAD)
    limit = element.first("limit")
    if limit is None:
        raise element.wrong("is revolute and has no <limit>; add lower and upper, in rad")
    lower = _read_limit_rad(found, joint, limit, "lower")
    upper = _read_limit_rad(found, joint, limit, "upper")
    if not lower < 0 < upper:
        raise limit.wrong(
            f"of joint {joint.name!r} is {lower:g} to {upper:g} rad; a joint must be able to turn to either side of "
            f"zero: `lower` below 0, `upper` above 0"
        )
    return Turning(-upper, -lower) if negated else Turning(lower, upper)


def _read_limit_rad(found: Imported, joint: Joint, limit: Element, attribute: str) -> float:
    """One side of the range, cut to half a turn; the cut is reported."""
    said = limit.number(attribute, "0")
    if abs(said) > MAX_LIMIT_RAD:
        radians = math.radians(said)
        raise limit.wrong(
            f"of joint {joint.name!r} has `{attribute}` = {said:g} rad; a joint turns by {MAX_LIMIT_RAD} rad at most. "
            f"URDF has radians: if this is in degrees, write {radians:.5g}. A joint without end stops has "
            f'type="continuous"'
        )
    if abs(said) <= MAX_TURN_RAD:
        return said
    cut = MAX_TURN_RAD if said > 0 else -MAX_TURN_RAD
    found.changes.add(
        f"`{attribute}` = {said:g} rad became {cut:g} rad, half a turn, which is the most that a robot file has; if "
        f"these are degrees, write radians",
        joint.place("limit"),
    )
    return cut


def _complete(
    found: Imported, number: JointNumber, joints: Sequence[Joint], built: Sequence[BuiltJoint], *, own: bool
) -> list[float]:
    """This number of every joint, tail to head, with an assumption, which is reported, where the file says none.

    built: the joints by the values so far, which are those of the same robot (own), or else of `--like`.
    """
    given = [_read_number(found, number, joint) for joint in joints]
    known = [value for value in given if value]
    completed: list[float] = []
    for joint, value, as_built in zip(joints, given, built, strict=True):
        if value is not None and (value > 0 or not number.is_limit):
            completed.append(value)
            continue
        if value is not None and known:
            raise _as_motorless(number, joint, max(known))
        assumed, origin = _assume(number, as_built, known, own=own)
        said = "no value" if value is None else f"{value:g}"
        found.assumptions.add(
            f"<{number.tag} {number.attribute}> has {said}: {assumed:g} {number.unit}, {origin}",
            joint.place(number.tag),
        )
        completed.append(assumed)
    return completed


def _assume(number: JointNumber, built: BuiltJoint, known: Sequence[float], *, own: bool) -> tuple[float, str]:
    """The value for a joint that says none, and where it is from."""
    kept = getattr(built.limits if number.is_limit else built.motor, number.key)
    if own:
        return kept, f"as its <snakesim> element says of {number.section}.{number.key}"
    if not number.is_limit:
        return 0.0, "as URDF says of what is absent"
    if known:
        return min(known), "the smallest of the other joints; is there a motor in this joint?"
    return kept, "as of the robot given by --like, because no joint says one"


def _as_motorless(number: JointNumber, joint: Joint, other: float) -> Exception:
    limit = joint.element.first("limit") or joint.element
    return limit.wrong(
        f"of joint {joint.name!r} has `{number.attribute}` = 0 {number.unit}, and other joints have up to {other:g}: a "
        f"joint without a motor. A robot file has a motor in every joint; give a value above 0 and at most "
        f'{number.maximum:g} {number.unit}, or make the joint type="fixed"'
    )


def _read_number(found: Imported, number: JointNumber, joint: Joint) -> float | None:
    """As the file says, checked; None when it says nothing."""
    element = joint.element.first(number.tag)
    if element is None or number.attribute not in element.attributes:
        return None
    value = element.number(number.attribute)
    if not 0 <= value <= number.maximum:
        least = "above 0" if number.is_limit else "0 or more"
        raise element.wrong(
            f"of joint {joint.name!r} has `{number.attribute}` = {value:g} {number.unit}; expected {least} and at most "
            f"{number.maximum:g} {number.unit}. Is it in {number.other_unit}, or does it stand for no limit?"
        )
    if value > number.usual:
        found.doubts.add(
            f"`{number.attribute}` = {value:g} {number.unit} is much for a snake robot; is it in {number.other_unit}?",
            joint.place(number.tag),
        )
    return value


def _put_common_angles(found: Imported, angles: list[Turning], source: str) -> None:
    """`angle_rad`, and the sides where they differ."""
    table = found.table
    common = Counter(angles).most_common(1)[0][0]
    limits = table.values.get("limits", {})
    for side in ("angle_min_rad", "angle_max_rad"):
        limits.pop(side, None)
    table.put("limits.angle_rad", max(-common.lower_rad, common.upper_rad), source)
    if -common.lower_rad < common.upper_rad:
        table.put("limits.angle_min_rad", common.lower_rad, source)
    if -common.lower_rad > common.upper_rad:
        table.put("limits.angle_max_rad", common.upper_rad, source)


def _put_exceptions(
    found: Imported, joints: list[Joint], angles: list[Turning], columns: dict[str, list[float]], source: str
) -> None:
    """What differs in one joint from the sections for all."""
    differ: dict[str, list[str]] = {}
    for i, built in enumerate(decode(found.table, RobotFile).joint_table):
        wanted = [
            ("angle_min_rad", angles[i].lower_rad, built.limits.lower_rad, "rad"),
            ("angle_max_rad", angles[i].upper_rad, built.limits.upper_rad, "rad"),
        ]
        for number in NUMBERS:
            section = built.limits if number.is_limit else built.motor
            wanted.append((number.key, columns[number.key][i], getattr(section, number.key), number.unit))
        for key, theirs, ours, unit in wanted:
            if theirs != ours:
                found.table.put(f"joints.{built.name}.{key}", theirs, source)
                differ.setdefault(key, []).append(f"{built.name} ({joints[i].name}) {theirs:g} {unit}")
    for key, values in differ.items():
        found.changes.add(f"{key} differs from that of the others: {', '.join(values)}")
