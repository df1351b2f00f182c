"""Describes how a run ended: `complete`, or a sentence."""

from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.run_log.host_record import HostRecord

COMPLETE = "complete"
# Requester in the request that finishes a run at its goal.
GOAL_REQUESTER = "snakesim run, at the goal"
UNKNOWN_PREFIX = "unknown: "  # prefix of a sentence that explains why the ending is unknown


def describe_early_end(host: HostRecord, config: RunConfig) -> str:
    """Describe by the statistics of the host why a run was not complete. Returns an empty text if it was complete."""
    progress = f"after {host.armed_ticks / config.rate_hz:.1f} of {config.duration_s:g} s"
    reached_goal = host.ending_reason.endswith(GOAL_REQUESTER)
    match host.ended:
        case "complete":
            return ""
        case "running":
            return f"the record ends {progress}, and the last second may be missing"
        case "finished" if config.mission.until_goal and reached_goal:
            return ""
        case "stopped" | "finished":
            return f"the host was {host.ended} {host.ending_reason} {progress}"
        case _:
            return f"the run ended {progress}: {host.ending_reason}"


def describe_recorded_end(
    host: HostRecord, config: RunConfig, recorded_s: float, *, finished: bool
) -> str:
    """Describe how a run ended, as far as a recording alone shows it.

    Args:
        host: Statistics of the host, as the recording shows them.
        config: Configuration of the run.
        recorded_s: Robot time from the first recorded tick to the end of the last, in s.
        finished: Whether the recording was closed, and not cut off.

    Returns:
        COMPLETE, or a sentence.
    """
    for fault in host.faults:
        if fault.scope == "robot":
            return fault.cause
    progress = f"after {recorded_s:.2f} of {config.duration_s:g} s"
    half_tick_s = 0.5 / config.rate_hz
    if recorded_s > config.duration_s - half_tick_s:
        return COMPLETE
    if not finished:
        return f"{UNKNOWN_PREFIX}the recording breaks off {progress}"
    if host.lifecycle == "armed":
        return f"{UNKNOWN_PREFIX}the recording was ended {progress}, with the robot armed"
    return f"{host.lifecycle} ({host.reason}) {progress}"
