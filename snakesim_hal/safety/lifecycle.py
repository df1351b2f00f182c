"""The lifecycle of a robot: disarmed, armed, fault, estop; and the conditions for arming. Pure functions.

    disarmed --arm--> armed --disarm--> disarmed
    any but estop --fault--> fault --reset--> disarmed
    any --estop--> estop --reset--> disarmed

Fault and estop are latched: only an explicit reset ends them, and leads to disarmed, never to armed.
Each unmet condition for arming has a reason as text and as one word.
"""

from typing import Literal, NamedTuple

from snakesim_hal.base.arrays import Floats
from snakesim_hal.safety.joint_limits import JointMask
from snakesim_hal.wire.messages import (
    JointCommand,
    JointMode,
    LifecycleRequest,
    LifecycleState,
    RobotDescription,
)

LifecycleEvent = Literal["arm", "disarm", "fault", "estop", "reset"]

_TRANSITIONS: dict[tuple[LifecycleState, LifecycleEvent], LifecycleState] = {
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


def next_state(state: LifecycleState, event: LifecycleEvent) -> LifecycleState | None:
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

    refusal: str  # one of REFUSAL_ORDER
    reason: str  # for people


def find_address_mismatches(
    request: LifecycleRequest, description: RobotDescription
) -> list[UnmetCondition]:
    """Return an unmet condition for each name in a request to arm that does not match this robot.

    The request must name the robot, its backend, and the hash of its configuration.
    """
    unmet: list[UnmetCondition] = []
    if request.robot != description.robot:
        reason = f"this robot is {description.robot!r}, the request names {request.robot!r}"
        unmet.append(UnmetCondition("wrong_robot", reason))
    if request.backend != description.backend:
        reason = f"this backend is {description.backend!r}, the request names {request.backend!r}"
        unmet.append(UnmetCondition("wrong_backend", reason))
    if request.config_hash != description.config_hash:
        requested_hash = "none"
        if request.config_hash is not None:
            requested_hash = repr(request.config_hash)
        reason = (
            f"the configuration is {description.config_hash!r}, the request names {requested_hash}: "
            f"read hal/description, and arm with its config_hash"
        )
        unmet.append(UnmetCondition("wrong_config", reason))
    return unmet


def find_far_targets(
    command: JointCommand, angle_rad: Floats, description: RobotDescription, isolated: JointMask
) -> list[str]:
    """Return a text for each joint that a command would move at once. At arming, a command must hold the pose.

    Args:
        command: Newest command before the arming.
        angle_rad: (n_joints,) measured angles.
        description: Robot as its backend describes it, with `max_step_rad`.
        isolated: (n_joints,) mask of joints that stay passive and are not checked.

    Returns:
        An empty list if the command holds every joint.
    """
    reasons: list[str] = []
    max_step_rad = description.max_step_rad
    for joint, mode, target, measured_rad, is_isolated in zip(
        description.joints,
        command.mode,
        command.target,
        angle_rad.tolist(),
        isolated.tolist(),
        strict=True,
    ):
        if is_isolated:
            continue
        match mode:
            case JointMode.PASSIVE:
                pass
            case JointMode.POSITION:
                if abs(target - measured_rad) > max_step_rad:
                    reasons.append(
                        f"{joint.name} has a target {target - measured_rad:+.2f} rad from its angle; at most "
                        f"{max_step_rad} rad at arming"
                    )
            case _:
                reasons.append(
                    f"{joint.name} is commanded in mode {mode.name.lower()}; it must hold its position at arming"
                )
    return reasons
