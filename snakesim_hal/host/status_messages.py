"""Builds parts of the messages that a host publishes about a tick and its state. Pure."""

from collections.abc import Sequence

from snakesim_hal.safety.authority import TickOutput
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import AppliedCommand, RobotDescription

# How a run can do without a message, by its key.
WAYS_OUT = {
    keys.POSE: "mission.localization=dead_reckoning does without, and so does a robot without [sensors.pose]"
}


def make_applied_command(
    description: RobotDescription, tick: int, tick_output: TickOutput
) -> AppliedCommand:
    """Return the message with the applied setpoints of a tick."""
    setpoints = tick_output.setpoints
    return AppliedCommand(
        tick=tick,
        timestamp_ns=tick * description.period_ns,
        sequence=tick_output.command_sequence,
        mode=setpoints.mode,
        target=setpoints.target,
        torque_limit_nm=setpoints.torque_limit_nm,
        limited={
            description.joints[i].name: word for i, word in tick_output.limit_by_joint.items()
        },
    )


def describe_wait(service: str, missing: Sequence[str]) -> str:
    """Return the text that the host waits for a service, and which messages the service is missing."""
    if not missing:
        return f"waiting for {service}"
    ways_out = "".join(f" ({WAYS_OUT[key]})" for key in missing if key in WAYS_OUT)
    return f"waiting for {service}, which has no {', '.join(missing)} yet{ways_out}"
