"""How a run ended, of its record: `complete`, or a sentence."""

from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.run_log.host_record import HostRecord
from snakesim_operator.results.record import RunRecord

COMPLETE = "complete"
AT_GOAL = "snakesim run, at the goal"  # who asks the host to finish a run that lasts until its goal
UNKNOWN = "unknown: "  # how a sentence begins that says why nobody knows


def ended(record: RunRecord) -> str:
    """As far as the record tells."""
    host, config = record.host, record.config
    if not record.alone:
        return ended_early(host, config) or COMPLETE
    if any(fault.reach == "robot" for fault in host.faults):
        return next(fault.cause for fault in host.faults if fault.reach == "robot")
    span_s = float(record.time_s[-1] - record.time_s[0]) + 1 / config.rate_hz if len(record.time_s) else 0.0
    done = f"after {span_s:.2f} of {config.duration_s:g} s"
    if span_s > config.duration_s - 0.5 / config.rate_hz:
        return COMPLETE
    if not record.whole:
        return f"{UNKNOWN}the recording breaks off {done}"
    if host.lifecycle == "armed":
        return f"{UNKNOWN}the recording was ended {done}, with the robot armed"
    return f"{host.lifecycle} ({host.why}) {done}"


def ended_early(host: HostRecord, config: RunConfig) -> str:
    """By what the host wrote; empty when it was complete."""
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
