"""The lifecycle of a robot: disarmed, armed, fault, estop; and the conditions for arming. Pure functions.

    disarmed --arm--> armed --disarm--> disarmed
    any but estop --fault--> fault --reset--> disarmed
    any --estop--> estop --reset--> disarmed

Fault and estop are latched: only an explicit reset ends them, and leads to disarmed, never to armed.
Each unmet condition for arming has a reason as text and as one word.
"""

from typing import Literal, NamedTuple

from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety.joint_limits import Mask
from snakesim_hal.wire.messages import Description, JointCommand, LifecycleRequest, LifecycleState, Mode

Event = Literal["arm", "disarm", "fault", "estop", "reset"]

_TRANSITIONS: dict[tuple[LifecycleState, Event], LifecycleState] = {
    ("disarmed", "arm"): "armed",
    ("disarmed", "disarm"): "disarmed",
    ("disarmed", "fault"): "fault",
    ("disarmed", "estop"): "estop",
    ("disarmed", "reset"): "disarmed",
    ("armed", "disarm"): "disarmed",
    ("armed", "fault"): "fault",
    ("armed", "estop"): "estop",
    ("fault", "fault"): "fault",
    ("fault", "estop"): "estop",
    ("fault", "reset"): "disarmed",
    ("estop", "estop"): "estop",
    ("estop", "fault"): "estop",
    ("estop", "reset"): "disarmed",
}


def next_state(state: LifecycleState, event: Event) -> LifecycleState | None:
    """Return the state that follows, or None if the event is not allowed in this state."""
    return _TRANSITIONS.get((state, event))


# --- arming --------------------------------------------------------------------------------------------------

# The refusals of a request to arm, the most important first.
REFUSAL_ORDER = (
    "wrong_robot",
    "wrong_backend",
    "wrong_config",
    "wrong_state",
    "not_checked",
    "cable",
    "not_ready",
)


class UnmetCondition(NamedTuple):
    """A condition for arming that is not met."""

    refusal: str  # one of ORDER
    reason: str  # for people


def find_address_mismatches(request: LifecycleRequest, description: Description) -> list[UnmetCondition]:
    """Return the names in a request to arm that do not match this robot."""
    unmet: list[UnmetCondition] = []
    if request.robot != description.robot:
        reason = f"this robot is {description.robot!r}, the request names {request.robot!r}"
        unmet.append(UnmetCondition("wrong_robot", reason))
    if request.backend != description.backend:
        reason = f"this backend is {description.backend!r}, the request names {request.backend!r}"
        unmet.append(UnmetCondition("wrong_backend", reason))
    if request.config_hash != description.config_hash:
        requested = "none"
        if request.config_hash is not None:
            requested = repr(request.config_hash)
        reason = (
            f"the configuration is {description.config_hash!r}, the request names {requested}: read hal/description, "
            f"and arm with its config_hash"
        )
        unmet.append(UnmetCondition("wrong_config", reason))
    return unmet


def find_far_targets(command: JointCommand, angle_rad: Floats, description: Description, isolated: Mask) -> list[str]:
    """Return a reason for each joint that a command would move at once: it must hold the pose at arming.

    Args:
        command: the newest command before the arming.
        angle_rad: (n_joints,), the measured angles.
        description: the robot as its backend describes it: joints, their limits, and the lease term.
        isolated: (n_joints,), joints that stay passive and are not checked.
    """
    reasons: list[str] = []
    max_step_rad = description.max_step_rad
    for joint, mode, target, angle, is_isolated in zip(
        description.joints, command.mode, command.target, angle_rad.tolist(), isolated.tolist(), strict=True
    ):
        if is_isolated:
            continue
        match mode:
            case Mode.PASSIVE:
                continue
            case Mode.POSITION:
                if abs(target - angle) > max_step_rad:
                    reasons.append(
                        f"{joint.name} has a target {target - angle:+.2f} rad from its angle; at most "
                        f"{max_step_rad} rad at arming"
                    )
            case _:
                reasons.append(
                    f"{joint.name} is commanded in mode {mode.name.lower()}; it must hold its position at arming"
                )
    return reasons
