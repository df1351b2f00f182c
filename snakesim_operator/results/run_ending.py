"""How a run ended, of its record: `complete`, or a sentence."""

from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_operator.results.record import RunRecord

COMPLETE = "complete"
AT_GOAL = "snakesim run, at the goal"  # the requester that finishes a run which lasts until its goal
UNKNOWN = "unknown: "  # how a sentence begins that explains why the ending is not known


def ended(record: RunRecord) -> str:
    """Return COMPLETE, or a sentence that describes how the run ended, as far as the record shows it."""
    host = record.host
    config = record.config
    if not record.alone:
        return ended_early(host, config) or COMPLETE
    for fault in host.faults:
        if fault.reach == "robot":
            return fault.cause
    recorded_s = 0.0
    if len(record.time_s):
        recorded_s = float(record.time_s[-1] - record.time_s[0]) + 1 / config.rate_hz
    done = f"after {recorded_s:.2f} of {config.duration_s:g} s"
    if recorded_s > config.duration_s - 0.5 / config.rate_hz:
        return COMPLETE
    if not record.whole:
        return f"{UNKNOWN}the recording breaks off {done}"
    if host.lifecycle == "armed":
        return f"{UNKNOWN}the recording was ended {done}, with the robot armed"
    return f"{host.lifecycle} ({host.reason}) {done}"


def ended_early(host: HostRecord, config: RunConfig) -> str:
    """Return how a run ended that was not complete, by the host's own record; empty if it was complete."""
    done = f"after {host.armed_ticks / config.rate_hz:.1f} of {config.duration_s:g} s"
    match host.ended:
        case "complete":
            return ""
        case "running":
            return f"the record ends {done}, and may lack the last second"
        case "finished" if config.mission.until_goal and host.ended_why.endswith(AT_GOAL):
            return ""
        case "stopped" | "finished":
            return f"the host was {host.ended} {host.ended_why} {done}"
        case _:
            return f"the run ended {done}: {host.ended_why}"
