"""The four states of the paper's Figure 6, as one pure function."""

from snakesim_gnc.control.advance import MOVING_M, WINDOW_S
from snakesim_hal.wire.messages import LocomotionState

PUSH_POINTS_NEEDED = 3


def locomotion_state(
    *,
    hal_answers: bool = True,
    armed: bool = True,
    missing: str = "",
    rests: str = "",
    usable_push_points: int | None = None,
    obstacle: str = "",
    advanced_m: float | None,
) -> tuple[LocomotionState, str]:
    """The state, and the reason for it in words. To locomote is to move, as it is measured, and to mean to.

    missing: what control would need to act and does not have, such as a fresh pose. rests: why nobody wants to move.
    usable_push_points: None for a controller that does not push off obstacles.
    obstacle: what the controller itself says is in the way (no feasible triplet, a jam), empty when nothing is.
    advanced_m: how far the body has come within the last second; None when nobody measures it.
    """
    if not hal_answers:
        return "PowerOff", "no clock from the HAL: no backend, or it is without power"
    if not armed:
        return "Idle", f"the robot is not armed; {missing}" if missing else "the robot is not armed"
    if missing:
        return "NotLocomoting", missing
    if rests:
        return "Idle", f"nobody wants to move: {rests}"
    if usable_push_points is not None and usable_push_points < PUSH_POINTS_NEEDED:
        why = f"{usable_push_points} usable push-points, {PUSH_POINTS_NEEDED} are needed"
        return "NotLocomoting", f"{why}; {obstacle}" if obstacle else why
    if obstacle:
        return "NotLocomoting", obstacle
    if advanced_m is None:
        return "NotLocomoting", "nobody measures whether the body moves"
    if advanced_m < MOVING_M:
        return "NotLocomoting", f"standing still: less than {MOVING_M * 1e3:g} mm in {WINDOW_S:g} s"
    return "Locomoting", "pushing" if usable_push_points is not None else "moving"
