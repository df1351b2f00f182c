"""Measurements of a robot behind a bad link, and of links and routers that fail.

`measure_condition` and `measure_event` each start a lab, run their trials, and return one row of a Markdown table.
"""

import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from snakesim_hal.run_log.host_record import BLACK_BOX, HOST_RECORD, HostRecord
from snakesim_operator.results.run_log import RunRecord
from verification.links.link_lab import LinkLab, start_link_lab

MAX_ARMED_S = 10.0  # a trial ends after this time
ARM_TIMEOUT_S = 20.0
STATUS_POLL_S = 0.001
RECORD_DELAY_S = 1.0  # until the host has written the last rows to disk
STEADY_S = 1.0  # the robot moves for this time before a link fails
MAX_ROW_INTERVAL_S = 0.1  # the record has a longer gap where the robot was not armed
MIN_DRIVEN_TORQUE_NM = 0.05  # the robot is not driven if all joints have less
LINK_CUT_S = 0.5
LONG_LINK_CUT_S = 5.0  # the router ends the session of the services in this time
ROUTER_ABSENT_S = 0.2
UNKNOWN = "-"


@dataclass(frozen=True)
class LinkCondition:
    """Properties that a link has during all of a trial. Loss, delay and jitter apply to each direction."""

    name: str
    loss: float = 0.0  # probability that a packet is dropped
    delay_s: float = 0.0
    jitter_s: float = 0.0
    rate_hz: int = 100  # of the controller


# A round trip takes twice the delay, and is lost about twice as often. The lease is longer at 50 Hz.
CONDITIONS = (
    LinkCondition("good"),
    LinkCondition("1 % of packets lost", loss=0.01),
    LinkCondition("5 % of packets lost", loss=0.05),
    LinkCondition("5 +- 2.5 ms", delay_s=0.005, jitter_s=0.0025),
    LinkCondition("10 +- 5 ms", delay_s=0.01, jitter_s=0.005),
    LinkCondition("20 +- 10 ms", delay_s=0.02, jitter_s=0.01),
    LinkCondition("20 +- 10 ms, at 50 Hz", delay_s=0.02, jitter_s=0.01, rate_hz=50),
    LinkCondition("5 % of packets lost, at 50 Hz", loss=0.05, rate_hz=50),
)


@dataclass(frozen=True)
class LinkEvent:
    """A failure of the link or of the router, and its repair."""

    name: str
    fail: Callable[[LinkLab], None]
    repair: Callable[[LinkLab], None]
    failed_s: float  # time from failure to repair


def cut_link(link_lab: LinkLab) -> None:
    """Cut the link between router and services."""
    link_lab.link.set_quality(cut=True)


def restore_link(link_lab: LinkLab) -> None:
    """Make the link between router and services perfect."""
    link_lab.link.set_quality()


SHORT_CUT = LinkEvent(f"link cut for {LINK_CUT_S:g} s", cut_link, restore_link, LINK_CUT_S)
LONG_CUT = LinkEvent(
    f"link cut for {LONG_LINK_CUT_S:g} s, and the machine joins again",
    cut_link,
    restore_link,
    LONG_LINK_CUT_S,
)
ROUTER_KILLED = LinkEvent(
    "router killed, and a new one started",
    LinkLab.kill_router,
    LinkLab.start_router,
    ROUTER_ABSENT_S,
)


@dataclass(frozen=True)
class ArmedTrial:
    """One trial of a bad link."""

    armed_s: float
    ending: str | None  # name of the fault, or None if the robot stayed armed


def measure_condition(condition: LinkCondition, trial_count: int) -> str:
    """Measure how long a robot stays armed over a bad link, how fast it moves, and which fault ends a trial.

    Returns:
        A row of the table in docs/benchmarks/lab-links.md.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        start_link_lab(Path(folder), f"rate_hz={condition.rate_hz}") as link_lab,
    ):
        link_lab.link.set_quality(
            loss=condition.loss, delay_s=condition.delay_s, jitter_s=condition.jitter_s
        )
        trials = [_run_armed_trial(link_lab) for _ in range(trial_count)]
        time.sleep(RECORD_DELAY_S)
        speed = describe_speed(Path(folder))
        latency = describe_latency(Path(folder))
    durations_s = [trial.armed_s for trial in trials]
    completed_count = sum(armed_s >= MAX_ARMED_S for armed_s in durations_s)
    return (
        f"| {condition.name} | {completed_count} of {trial_count} "
        f"| {statistics.median(durations_s):.1f} | {min(durations_s):.2f} "
        f"| {count_endings(trials)} | {speed} | {latency} |"
    )


def _run_armed_trial(link_lab: LinkLab) -> ArmedTrial:
    """Arm the robot, and wait until it stops or MAX_ARMED_S have passed."""
    try:
        link_lab.arm(ARM_TIMEOUT_S)
    except AssertionError:
        return ArmedTrial(0.0, "not armed")
    start_s = time.monotonic()
    while time.monotonic() - start_s < MAX_ARMED_S and link_lab.is_armed():
        time.sleep(STATUS_POLL_S)
    armed_s = time.monotonic() - start_s
    status = link_lab.read_status()
    if status is not None and status.lifecycle == "fault":
        return ArmedTrial(armed_s, status.faults[0].what)
    link_lab.disarm()
    return ArmedTrial(armed_s, None)


def count_endings(trials: list[ArmedTrial]) -> str:
    """Return the faults that ended trials and how often, such as `lease_expired 4, not armed 1`."""
    endings = [trial.ending for trial in trials if trial.ending is not None]
    if not endings:
        return UNKNOWN
    return ", ".join(f"{ending} {endings.count(ending)}" for ending in dict.fromkeys(endings))


def describe_speed(folder: Path) -> str:
    """Return the speed of the robot while it was driven, in m/s, from the record of its run."""
    if not (folder / BLACK_BOX).is_file():
        return UNKNOWN
    record = RunRecord.load(folder)
    steps_m = np.hypot(*np.diff(record.position_w_m[:, :2], axis=0).T)
    steps_s = np.diff(record.time_s)
    is_contiguous = (steps_s < MAX_ROW_INTERVAL_S) & np.isfinite(steps_m)
    has_torque = np.abs(record.torque_nm[1:]).max(axis=1) > MIN_DRIVEN_TORQUE_NM
    is_driven = is_contiguous & has_torque
    speed_m_s = steps_m[is_driven].sum() / max(steps_s[is_driven].sum(), 1e-9)
    return f"{speed_m_s:.2f}"


def describe_latency(folder: Path) -> str:
    """Return the time from a state to its command, as `p50 / p99` in ms, from the statistics of the host."""
    if not (folder / BLACK_BOX).is_file():
        return UNKNOWN
    host = msgspec.json.decode((folder / HOST_RECORD).read_bytes(), type=HostRecord)
    p50_us = host.state_to_command_us["p50"]
    p99_us = host.state_to_command_us["p99"]
    if p50_us is None or p99_us is None:
        return UNKNOWN
    return f"{p50_us / 1000:.1f} / {p99_us / 1000:.1f}"


def measure_event(event: LinkEvent, trial_count: int) -> str:
    """Measure how soon the robot stops after a failure, and how soon it is armed again after the repair.

    Returns:
        A row of the second table in docs/benchmarks/lab-links.md.
    """
    stop_times_ms: list[float] = []
    rearm_times_s: list[float] = []
    with tempfile.TemporaryDirectory() as folder, start_link_lab(Path(folder)) as link_lab:
        for _ in range(trial_count):
            link_lab.arm()
            time.sleep(STEADY_S)
            assert link_lab.is_armed(), link_lab.host.status
            failure_s = time.monotonic()
            event.fail(link_lab)
            stop_s = link_lab.wait_until(lambda status: status.lifecycle == "fault", "stopped")
            stop_times_ms.append(1000 * stop_s)
            time.sleep(max(event.failed_s - (time.monotonic() - failure_s), 0.0))
            event.repair(link_lab)
            rearm_times_s.append(link_lab.arm())
    return (
        f"| {event.name} | {trial_count} "
        f"| {statistics.median(stop_times_ms):.0f} / {max(stop_times_ms):.0f} "
        f"| {statistics.median(rearm_times_s):.2f} / {max(rearm_times_s):.2f} |"
    )
