"""Limits and friction of a URDF's joints. A robot file has one set for all joints: the tightest, which is reported."""

from collections.abc import Callable

from snakesim_hal.model.files import Table
from snakesim_operator.robots.urdf_tree import Joint

FULL_TURN_RAD = 3.14159


def put_limits(table: Table, joints: list[Joint], source: str, warn: Callable[[str], None]) -> None:
    """Put what the joints say into a robot file's values; what they do not say stays. Raises ConfigError."""
    endless = [joint.name for joint in joints if joint.element.get("type") == "continuous"]
    if endless:
        warn(f"{', '.join(endless)}: continuous; here they turn by {FULL_TURN_RAD} rad to either side")
    angles = {joint.name: _angle(joint, warn) for joint in joints}
    _put(table, "limits.angle_rad", angles, min, source, warn)
    said: dict[str, dict[str, float]] = {
        "speed_rad_s": {},
        "torque_nm": {},
        "viscous_nm_s_per_rad": {},
        "friction_nm": {},
    }
    for joint in joints:
        for tag, attribute, key in (
            ("limit", "velocity", "speed_rad_s"),
            ("limit", "effort", "torque_nm"),
            ("dynamics", "damping", "viscous_nm_s_per_rad"),
            ("dynamics", "friction", "friction_nm"),
        ):
            element = joint.element.first(tag)
            if element is not None and element.has(attribute):
                value = element.number(attribute)
                if value > 0 or tag == "dynamics":
                    said[key][joint.name] = value
    for key, values in said.items():
        dotted = f"{'limits' if key in ('speed_rad_s', 'torque_nm') else 'motor'}.{key}"
        if values:
            _put(table, dotted, values, min if dotted.startswith("limits") else max, source, warn)
        elif dotted.startswith("limits"):
            kept = table.values.get("limits", {}).get(key)
            warn(f"no joint says its `{'effort' if key == 'torque_nm' else 'velocity'}`; {dotted} stays {kept}")


def _angle(joint: Joint, warn: Callable[[str], None]) -> float:
    """To either side of zero."""
    if joint.element.get("type") == "continuous":
        return FULL_TURN_RAD
    limit = joint.element.first("limit")
    if limit is None:
        raise joint.element.wrong("is revolute and has no <limit>; add lower and upper")
    lower, upper = limit.number("lower", "0"), limit.number("upper", "0")
    if not lower < 0 < upper:
        raise limit.wrong(f"is {lower:g} to {upper:g} rad; a joint must be able to turn to either side of zero")
    if abs(lower + upper) > 1e-9:
        warn(
            f"joint {joint.name!r} turns from {lower:g} to {upper:g} rad; here by {min(-lower, upper):g} to either side"
        )
    return min(-lower, upper, FULL_TURN_RAD)


def _put(
    table: Table,
    dotted: str,
    values: dict[str, float],
    choose: Callable[..., float],
    source: str,
    warn: Callable[[str], None],
) -> None:
    chosen = choose(values.values())
    others = [f"{name!r} {value:g}" for name, value in values.items() if value != chosen]
    if others:
        shown = ", ".join(others[:8]) + (f" and {len(others) - 8} more" if len(others) > 8 else "")
        warn(f"{dotted} = {chosen:g} for all joints; the file has {shown}")
    table.put(dotted, chosen, source)
