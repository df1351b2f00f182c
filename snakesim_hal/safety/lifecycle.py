"""The lifecycle of a robot: disarmed, armed, fault, estop; and the conditions for arming. Pure functions.

    disarmed --arm--> armed --disarm--> disarmed
    any but estop --fault--> fault --clear--> disarmed
    any --estop--> estop --clear--> disarmed

Fault and estop are latched: only an explicit clear ends them, and leads to disarmed, never to armed.
Each unmet condition for arming has a reason as text and as one word.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.safety.limiter import Floats
from snakesim_hal.wire.messages import Description, JointCommand, LifecycleRequest, LifecycleState, Mode

Event = Literal["arm", "disarm", "fault", "estop", "clear"]

_TRANSITIONS: dict[tuple[LifecycleState, Event], LifecycleState] = {
    ("disarmed", "arm"): "armed",
    ("disarmed", "disarm"): "disarmed",
    ("disarmed", "fault"): "fault",
    ("disarmed", "estop"): "estop",
    ("disarmed", "clear"): "disarmed",
    ("armed", "disarm"): "disarmed",
    ("armed", "fault"): "fault",
    ("armed", "estop"): "estop",
    ("fault", "fault"): "fault",
    ("fault", "estop"): "estop",
    ("fault", "clear"): "disarmed",
    ("estop", "estop"): "estop",
    ("estop", "fault"): "estop",
    ("estop", "clear"): "disarmed",
}


def after(state: LifecycleState, event: Event) -> LifecycleState | None:
    """The state that follows, or None when the event is not allowed in this state."""
    return _TRANSITIONS.get((state, event))


# --- arming --------------------------------------------------------------------------------------------------

ORDER = (
    "wrong_robot",
    "wrong_backend",
    "wrong_config",
    "wrong_state",
    "not_checked",
    "cable",
    "not_ready",
)  # the most important first


def address_mismatches(request: LifecycleRequest, description: Description) -> list[tuple[str, str]]:
    """Names in a request to arm that do not match this robot: (refusal, reason)."""
    found: list[tuple[str, str]] = []
    if request.robot != description.robot:
        found.append(
            ("wrong_robot", f"this robot is {description.robot!r}, the request names {request.robot!r}"),
        )
    if request.backend != description.backend:
        found.append(
            ("wrong_backend", f"this backend is {description.backend!r}, the request names {request.backend!r}"),
        )
    if request.config_hash != description.config_hash:
        asked = "none" if request.config_hash is None else repr(request.config_hash)
        found.append(
            (
                "wrong_config",
                f"the configuration is {description.config_hash!r}, the request names {asked}: read hal/description, "
                f"and arm with its config_hash",
            )
        )
    return found


def far_targets(
    command: JointCommand, angle_rad: Floats, description: Description, aside: NDArray[np.bool_]
) -> Sequence[str]:
    """Joints that a command would move at once: it must hold the pose at arming. aside: joints that stay passive."""
    far: list[str] = []
    most = description.max_step_rad
    for joint, mode, target, angle, passive in zip(
        description.joints, command.mode, command.target, angle_rad.tolist(), aside.tolist(), strict=True
    ):
        if passive:
            continue
        if mode not in (Mode.POSITION, Mode.PASSIVE):
            far.append(
                f"{joint.name} is commanded in mode {mode.name.lower()}; it must hold its position at arm_session"
            )
        if mode is Mode.POSITION and abs(target - angle) > most:
            far.append(
                f"{joint.name} has a target {target - angle:+.2f} rad from its angle; at most {most} rad at arm_session"
            )
    return far
