"""The four states of the paper's Figure 6, as one pure function."""

from snakesim_hal.model.locomotion import MOVING_M, STANDING_STILL
from snakesim_hal.wire.messages import LocomotionState

PUSH_POINTS_NEEDED = 3


def locomotion_state(
    *,
    silent: str = "",
    armed: bool = True,
    missing: str = "",
    rests: str = "",
    usable_push_points: int | None = None,
    obstacle: str = "",
    still: str = "",
    advanced_m: float | None,
) -> tuple[LocomotionState, str]:
    """The state, and its reason as text. Locomoting means intended and measured motion.

    silent: how the HAL says nothing at all any more. missing: inputs that control lacks, such as a fresh pose.
    rests: why no motion is intended.
    usable_push_points: None for a controller that does not push off obstacles.
    obstacle: what prevents motion according to the controller (no feasible triplet, a jam), else empty.
    still: why it stands, if it should turn out to stand, though nothing prevents motion for certain; else empty.
    advanced_m: displacement of the body within the last second; None when it is not measured.
    """
    if silent:
        return "PowerOff", silent
    if not armed:
        return "Idle", f"the robot is not armed; {missing}" if missing else "the robot is not armed"
    if missing:
        return "NotLocomoting", missing
    if rests:
        return "Idle", f"no motion intended: {rests}"
    if usable_push_points is not None and usable_push_points < PUSH_POINTS_NEEDED:
        why = f"{usable_push_points} usable push-points, {PUSH_POINTS_NEEDED} are needed"
        return "NotLocomoting", f"{why}; {obstacle}" if obstacle else why
    if obstacle:
        return "NotLocomoting", obstacle
    if advanced_m is None:
        return "NotLocomoting", "the motion of the body is not measured"
    if advanced_m < MOVING_M:
        return "NotLocomoting", still or STANDING_STILL
    return "Locomoting", "pushing" if usable_push_points is not None else "moving"
