"""Checks the setpoints that reached the motors against the limits in the robot's own description.

The limits hold no matter which client commands the robot.
"""

from collections.abc import Iterator
from typing import Any

from verification.attack.tools.wire import PASSIVE, POSITION, TORQUE, VELOCITY

ROUNDING_TOLERANCE = 1e-6  # rad, rad/s or Nm
NO_LIMIT = 1e9  # a passive joint ignores its target


def find_limit_violations(
    description: dict[str, Any], applied_setpoints: list[dict[str, Any]]
) -> list[str]:
    """Return a sentence for each applied setpoint that is beyond a limit.

    Args:
        description: Message of `hal/description`, which contains the limits.
        applied_setpoints: Messages of `hal/applied`, oldest first.

    Returns:
        The violations; empty if every setpoint is within the limits.
    """
    violations: list[str] = []
    previous: dict[str, Any] | None = None
    for setpoints in applied_setpoints:
        for index, joint in enumerate(description["joints"]):
            where = f"tick {setpoints['tick']}, {joint['name']}"
            found = [
                *_check_target(joint, setpoints, index),
                *_check_torque_limit(joint, setpoints, index),
                *_check_target_step(description, previous, setpoints, index),
            ]
            violations.extend(f"{where}: {violation}" for violation in found)
        previous = setpoints
    return violations


def _check_target(joint: dict[str, Any], setpoints: dict[str, Any], index: int) -> Iterator[str]:
    """Yield a violation if the target is outside the range of its mode."""
    mode = setpoints["mode"][index]
    target = setpoints["target"][index]
    ranges = {
        PASSIVE: (-NO_LIMIT, NO_LIMIT),
        POSITION: (joint["angle_min_rad"], joint["angle_max_rad"]),
        VELOCITY: (-joint["speed_limit_rad_s"], joint["speed_limit_rad_s"]),
        TORQUE: (-joint["torque_limit_nm"], joint["torque_limit_nm"]),
    }
    low, high = ranges[mode]
    if not low - ROUNDING_TOLERANCE <= target <= high + ROUNDING_TOLERANCE:
        yield f"target {target:g} in mode {mode}, allowed are {low:g} to {high:g}"


def _check_torque_limit(
    joint: dict[str, Any], setpoints: dict[str, Any], index: int
) -> Iterator[str]:
    """Yield a violation if the torque limit is negative or above that of the joint."""
    torque_limit_nm = setpoints["torque_limit_nm"][index]
    max_nm = joint["torque_limit_nm"]
    if not 0 <= torque_limit_nm <= max_nm + ROUNDING_TOLERANCE:
        yield f"torque limit {torque_limit_nm:g} Nm, allowed are at most {max_nm:g} Nm"


def _check_target_step(
    description: dict[str, Any],
    previous: dict[str, Any] | None,
    setpoints: dict[str, Any],
    index: int,
) -> Iterator[str]:
    """Yield a violation if a position target changes too much within one tick."""
    if previous is None or previous["tick"] != setpoints["tick"] - 1:
        return
    modes = (previous["mode"][index], setpoints["mode"][index])
    if modes != (POSITION, POSITION):
        return
    joint = description["joints"][index]
    period_s = description["period_ns"] * 1e-9
    step_rad = abs(setpoints["target"][index] - previous["target"][index])
    # A pushed joint moves its target along, by as much as a target may differ from the measured angle.
    max_step_rad = joint["speed_limit_rad_s"] * period_s + description["max_step_rad"]
    if step_rad > max_step_rad + ROUNDING_TOLERANCE:
        yield f"target changes by {step_rad:g} rad, allowed are at most {max_step_rad:g} rad"
