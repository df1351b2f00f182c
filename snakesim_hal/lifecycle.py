"""The lifecycle of a robot: disarmed, armed, fault, estop, and nothing else. One pure function.

    disarmed --arm--> armed --disarm--> disarmed
    any but estop --fault--> fault --clear--> disarmed
    any --estop--> estop --clear--> disarmed

Fault and estop are latched: only an explicit clear leads out, and it leads to disarmed, never to armed.
"""

from typing import Literal

from snakesim_hal.messages import LifecycleState

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
