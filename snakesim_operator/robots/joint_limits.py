"""Limits and friction of a URDF's joints: what most of them have holds for all, the others have exceptions."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

from snakesim_hal.model.files import Table, decode
from snakesim_hal.model.joints import MAX_TURN_RAD
from snakesim_hal.model.robot import RobotFile
from snakesim_operator.robots.urdf_tree import Joint

SAID = (  # element, attribute, and where a robot file has it
    ("limit", "velocity", "limits", "speed_rad_s"),
    ("limit", "effort", "limits", "torque_nm"),
    ("dynamics", "damping", "motor", "viscous_nm_s_per_rad"),
    ("dynamics", "friction", "motor", "friction_nm"),
)


@dataclass(frozen=True)
class Turning:
    """How far a joint turns, by our sign."""

    least_rad: float
    most_rad: float


def put_limits(
    table: Table, joints: list[Joint], negated: list[bool], source: str, warn: Callable[[str], None], *, own: bool
) -> None:
    """Put what the joints say into a robot file's values; what they do not say stays. Raises ConfigError.

    negated: whether our angle is minus theirs. own: the values are those of the same robot, as exported; then only what
    the joints say otherwise is put.
    """
    endless = [joint.name for joint in joints if joint.element.get("type") == "continuous"]
    if endless:
        turn = f"here they turn by {MAX_TURN_RAD} rad to either side"
        warn(f"{', '.join(endless)}: continuous; {turn}; where there are no end stops, give `cable_turns`")
    angles = [_turning(joint, turned) for joint, turned in zip(joints, negated, strict=True)]
    said = {key: [_number(joint, tag, attribute) for joint in joints] for tag, attribute, _, key in SAID}
    if not own:
        _put_common_angles(table, angles, source)
    for _, attribute, section, key in SAID:
        known = [value for value in said[key] if value is not None]
        if known and not own:
            table.put(f"{section}.{key}", Counter(known).most_common(1)[0][0], source)
        elif not known and section == "limits":
            kept = table.values.get(section, {}).get(key)
            warn(f"no joint says its `{attribute}`; {section}.{key} stays {kept}")
    differ: dict[str, list[str]] = {}
    for i, built in enumerate(decode(table, RobotFile).joint_table):
        found = {
            "angle_min_rad": (angles[i].least_rad, built.limits.least_rad, "rad"),
            "angle_max_rad": (angles[i].most_rad, built.limits.most_rad, "rad"),
            "speed_rad_s": (said["speed_rad_s"][i], built.limits.speed_rad_s, "rad/s"),
            "torque_nm": (said["torque_nm"][i], built.limits.torque_nm, "N·m"),
            "viscous_nm_s_per_rad": (said["viscous_nm_s_per_rad"][i], built.motor.viscous_nm_s_per_rad, "N·m·s/rad"),
            "friction_nm": (said["friction_nm"][i], built.motor.friction_nm, "N·m"),
        }
        for key, (theirs, ours, unit) in found.items():
            if theirs is not None and theirs != ours:
                table.put(f"joints.{built.name}.{key}", theirs, source)
                differ.setdefault(key, []).append(f"{built.name} ({joints[i].name}) {theirs:g} {unit}")
    for key, values in differ.items():
        more = f" and {len(values) - 8} more" if len(values) > 8 else ""
        warn(f"{key} differs from that of the others: {', '.join(values[:8])}{more}")


def _turning(joint: Joint, negated: bool) -> Turning:
    """As the URDF says, at most half a turn to either side."""
    if joint.element.get("type") == "continuous":
        return Turning(-MAX_TURN_RAD, MAX_TURN_RAD)
    limit = joint.element.first("limit")
    if limit is None:
        raise joint.element.wrong("is revolute and has no <limit>; add lower and upper")
    lower, upper = limit.number("lower", "0"), limit.number("upper", "0")
    if not lower < 0 < upper:
        raise limit.wrong(f"is {lower:g} to {upper:g} rad; a joint must be able to turn to either side of zero")
    lower, upper = max(lower, -MAX_TURN_RAD), min(upper, MAX_TURN_RAD)
    return Turning(-upper, -lower) if negated else Turning(lower, upper)


def _number(joint: Joint, tag: str, attribute: str) -> float | None:
    element = joint.element.first(tag)
    if element is None or attribute not in element.attributes:
        return None
    value = element.number(attribute)
    return value if value > 0 or tag == "dynamics" else None


def _put_common_angles(table: Table, angles: list[Turning], source: str) -> None:
    """`angle_rad`, and the sides where they differ."""
    common = Counter(angles).most_common(1)[0][0]
    limits = table.values.get("limits", {})
    for side in ("angle_min_rad", "angle_max_rad"):
        limits.pop(side, None)
    table.put("limits.angle_rad", max(-common.least_rad, common.most_rad), source)
    if -common.least_rad < common.most_rad:
        table.put("limits.angle_min_rad", common.least_rad, source)
    if -common.least_rad > common.most_rad:
        table.put("limits.angle_max_rad", common.most_rad, source)
