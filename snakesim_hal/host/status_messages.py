"""Parts of what a host tells of a tick and of its state. Pure."""

from collections.abc import Sequence

from snakesim_hal.safety.authority import Decision
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import AppliedCommand, Description

WITHOUT = {keys.POSE: "mission.localization=dead_reckoning does without, and so does a robot without [sensors.pose]"}
"""How a run can do without a message."""


def applied_message(description: Description, tick: int, decision: Decision) -> AppliedCommand:
    """The applied setpoints of a tick."""
    points = decision.setpoints
    return AppliedCommand(
        tick=tick,
        timestamp_ns=tick * description.period_ns,
        sequence=decision.sequence,
        mode=points.mode,
        target=points.target,
        torque_limit_nm=points.torque_limit_nm,
        limited={description.joints[i].name: word for i, word in decision.limited.items()},
    )


def waiting_for(service: str, lacks: Sequence[str]) -> str:
    """That a service is waited for, and which keys it lacks."""
    if not lacks:
        return f"waiting for {service}"
    ways_out = "".join(f" ({WITHOUT[key]})" for key in lacks if key in WITHOUT)
    return f"waiting for {service}, which has no {', '.join(lacks)} yet{ways_out}"
