"""Decides which of the four states of the paper's Figure 6 the robot is in."""

from snakesim_hal.model.locomotion import MOVING_M, STANDING_STILL
from snakesim_hal.wire.messages import LocomotionState

MIN_PUSH_POINT_COUNT = 3  # three contacts make a triplet


def determine_locomotion_state(
    *,
    silence_reason: str = "",
    is_armed: bool = True,
    missing_inputs: str = "",
    rest_reason: str = "",
    usable_push_points: int | None = None,
    obstruction_reason: str = "",
    standstill_reason: str = "",
    recent_displacement_m: float | None,
) -> tuple[LocomotionState, str]:
    """Return the state of locomotion that control reports, and its reason as text.

    Locomoting means that motion is intended and measured. The first argument in this order that prevents it decides.

    Args:
        silence_reason: Which messages of the HAL have stopped; empty while the HAL sends messages.
        is_armed: Whether the robot is armed.
        missing_inputs: Inputs that control does not have, such as a fresh pose; empty if it has all.
        rest_reason: Why no motion is intended; empty if motion is intended.
        usable_push_points: Number of push-points that the controller can use; None for a controller that does not push
            off obstacles.
        obstruction_reason: What prevents motion according to the controller, such as a jam; empty if nothing does.
        standstill_reason: What the controller assumes as the cause if the body is stationary although nothing prevents
            motion; empty if it has no assumption.
        recent_displacement_m: Displacement of the body within the last second; None if it is not measured.

    Returns:
        The state, and why the robot is in it.
    """
    if silence_reason:
        return "PowerOff", silence_reason
    if not is_armed:
        return "Idle", _join_reasons("the robot is not armed", missing_inputs)
    if missing_inputs:
        return "NotLocomoting", missing_inputs
    if rest_reason:
        return "Idle", f"no motion intended: {rest_reason}"
    if usable_push_points is not None and usable_push_points < MIN_PUSH_POINT_COUNT:
        too_few = f"{usable_push_points} usable push-points, {MIN_PUSH_POINT_COUNT} are needed"
        return "NotLocomoting", _join_reasons(too_few, obstruction_reason)
    if obstruction_reason:
        return "NotLocomoting", obstruction_reason
    if recent_displacement_m is None:
        return "NotLocomoting", "the motion of the body is not measured"
    if recent_displacement_m < MOVING_M:
        return "NotLocomoting", standstill_reason or STANDING_STILL
    if usable_push_points is None:
        return "Locomoting", "moving"
    return "Locomoting", "pushing"


def _join_reasons(reason: str, detail: str) -> str:
    """Return a reason, followed by a detail if the detail is not empty."""
    if not detail:
        return reason
    return f"{reason}; {detail}"
