"""The four states of the paper's Figure 6, as one pure function."""

from snakesim_hal.messages import LocomotionState

PUSH_POINTS_NEEDED = 3


def locomotion_state(
    *, hal_answers: bool, armed: bool, wants_to_move: bool, usable_push_points: int | None, obstacle: str = ""
) -> tuple[LocomotionState, str]:
    """The state, and the reason for it in words.

    usable_push_points: None for a controller that does not push off obstacles; it locomotes whenever it wants to.
    obstacle: what the controller itself says is in the way (no feasible triplet, a jam), empty when nothing is.
    """
    if not hal_answers:
        return "PowerOff", "no clock from the HAL: no backend, or it is without power"
    if not armed:
        return "Idle", "the robot is not armed"
    if not wants_to_move:
        return "Idle", "nobody wants to move: speed zero, or the path is finished"
    if usable_push_points is not None and usable_push_points < PUSH_POINTS_NEEDED:
        why = f"{usable_push_points} usable push-points, {PUSH_POINTS_NEEDED} are needed"
        return "NotLocomoting", f"{why}; {obstacle}" if obstacle else why
    if obstacle:
        return "NotLocomoting", obstacle
    return "Locomoting", "pushing" if usable_push_points is not None else "moving"
