"""Decides which of the four states of the paper's Figure 6 the robot is in."""

from snakesim_hal.model.locomotion import MOVING_M, STANDING_STILL
from snakesim_hal.wire.messages import LocomotionState

MIN_PUSH_POINTS = 3  # three contacts make a triplet


def locomotion_state(
    *,
    silence: str = "",
    armed: bool = True,
    missing_inputs: str = "",
    rest_reason: str = "",
    usable_push_points: int | None = None,
    obstruction: str = "",
    standstill_reason: str = "",
    advanced_m: float | None,
) -> tuple[LocomotionState, str]:
    """Return the state of locomotion that control reports, and its reason as text.

    Locomoting means that motion is intended and measured. The first argument that prevents it decides.

    Args:
        silent: how the HAL has stopped sending anything; else empty.
        armed: whether the robot is armed.
        missing: inputs that control does not have, such as a fresh pose; else empty.
        rests: why no motion is intended; empty if motion is intended.
        usable_push_points: their number; None for a controller that does not push off obstacles.
        obstacle: what prevents motion according to the controller, such as a jam; else empty.
        still: what the controller assumes as the cause if the body is stationary without an obstacle; else empty.
        advanced_m: displacement of the body within the last second; None if it is not measured.

    Returns:
        The state, and why the robot is in it.
    """
    if silence:
        return "PowerOff", silence
    if not armed:
        return "Idle", _join_reasons("the robot is not armed", missing_inputs)
    if missing_inputs:
        return "NotLocomoting", missing_inputs
    if rest_reason:
        return "Idle", f"no motion intended: {rest_reason}"
    if usable_push_points is not None and usable_push_points < MIN_PUSH_POINTS:
        too_few = f"{usable_push_points} usable push-points, {MIN_PUSH_POINTS} are needed"
        return "NotLocomoting", _join_reasons(too_few, obstruction)
    if obstruction:
        return "NotLocomoting", obstruction
    if advanced_m is None:
        return "NotLocomoting", "the motion of the body is not measured"
    if advanced_m < MOVING_M:
        return "NotLocomoting", standstill_reason or STANDING_STILL
    if usable_push_points is None:
        return "Locomoting", "moving"
    return "Locomoting", "pushing"


def _join_reasons(reason: str, detail: str) -> str:
    """Return a reason with a detail, which may be empty."""
    if not detail:
        return reason
    return f"{reason}; {detail}"
