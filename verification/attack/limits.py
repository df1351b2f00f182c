"""What setpoints may be, by the robot's own description: whoever commands, nothing else may reach the motors."""

from typing import Any

from verification.attack.means.wire import PASSIVE, POSITION, TORQUE, VELOCITY

ROUNDING = 1e-6


def beyond_limits(robot: dict[str, Any], applied: list[dict[str, Any]]) -> list[str]:
    """What was applied and must not have been; empty when all is within the limits."""
    found: list[str] = []
    period_s, before = robot["period_ns"] * 1e-9, None
    for row in applied:
        for i, joint in enumerate(robot["joints"]):
            mode, target, limit_nm = row["mode"][i], row["target"][i], row["torque_limit_nm"][i]
            where = f"tick {row['tick']}, {joint['name']}"
            low, high = {
                PASSIVE: (-1e9, 1e9),
                POSITION: (joint["angle_min_rad"], joint["angle_max_rad"]),
                VELOCITY: (-joint["speed_limit_rad_s"], joint["speed_limit_rad_s"]),
                TORQUE: (-joint["torque_limit_nm"], joint["torque_limit_nm"]),
            }[mode]
            if not low - ROUNDING <= target <= high + ROUNDING:
                found.append(
                    f"{where}: target {target:g} in mode {mode}, allowed are {low:g} to {high:g}"
                )
            if not 0 <= limit_nm <= joint["torque_limit_nm"] + ROUNDING:
                found.append(
                    f"{where}: torque limit {limit_nm:g}, at most {joint['torque_limit_nm']:g}"
                )
            if (
                before is not None
                and before["tick"] == row["tick"] - 1
                and before["mode"][i] == mode == POSITION
            ):
                # A joint that is pushed takes the target along, by as much as a target may be away from it.
                step = abs(target - before["target"][i])
                most = joint["speed_limit_rad_s"] * period_s + robot["max_step_rad"]
                if step > most + ROUNDING:
                    found.append(f"{where}: target jumps by {step:g} rad, at most {most:g}")
        before = row
    return found
