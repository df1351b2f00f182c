"""Bad links between a robot and its controller, measured: `python -m verification.links [--write]`; needs root."""

import argparse
import os
import platform
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import msgspec
import numpy as np

from snakesim_hal.run_log.host_record import BLACK_BOX, HOST_RECORD, HostRecord
from snakesim_operator.results.run_log import RunRecord
from verification.links.lab import LinkLab, lab

PAGE = Path(__file__).parents[2] / "docs" / "benchmarks" / "lab-links.md"
ARMED_S = 10.0
ARM_LIMIT_S = 20.0
WRITTEN_S = 1.0  # until rows are on disk


@dataclass(frozen=True)
class LinkCondition:
    """A link that is bad in one way, for as long as the robot is armed."""

    name: str
    loss: float = 0.0
    delay_s: float = 0.0
    jitter_s: float = 0.0
    rate_hz: int = 100


# Each way, so that a round trip takes twice as long, and is lost about twice as often. A lease is longer at 50 Hz.
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


def held(condition: LinkCondition, trial_count: int) -> str:
    """A line of the table: how long an armed robot keeps going, how fast, and what ends it."""
    armed_s: list[float] = []
    ended: list[str] = []
    with (
        tempfile.TemporaryDirectory() as folder,
        lab(Path(folder), f"rate_hz={condition.rate_hz}") as made,
    ):
        made.link.set_quality(
            loss=condition.loss, delay_s=condition.delay_s, jitter_s=condition.jitter_s
        )
        for _ in range(trial_count):
            try:
                made.arm(ARM_LIMIT_S)
            except AssertionError:
                armed_s.append(0.0)
                ended.append("not armed")
                continue
            began = time.monotonic()
            while (
                time.monotonic() - began < ARMED_S
                and (status := made.status)
                and status.lifecycle == "armed"
            ):
                time.sleep(0.001)
            armed_s.append(time.monotonic() - began)
            status = made.status
            if status is not None and status.lifecycle == "fault":
                ended.append(status.faults[0].what)
            else:
                made.disarm()
        time.sleep(WRITTEN_S)
        speed, latency = moved(Path(folder))
    names = ", ".join(f"{name} {ended.count(name)}" for name in dict.fromkeys(ended)) or "-"
    median_s, min_s = statistics.median(armed_s), min(armed_s)
    kept = sum(seconds >= ARMED_S for seconds in armed_s)
    return (
        f"| {condition.name} | {kept} of {trial_count} | {median_s:.1f} | {min_s:.2f} "
        f"| {names} | {speed} | {latency} |"
    )


def moved(folder: Path) -> tuple[str, str]:
    """Speed while armed, and the time from state to command, as text."""
    if not (folder / BLACK_BOX).is_file():
        return "-", "-"
    host = msgspec.json.decode((folder / HOST_RECORD).read_bytes(), type=HostRecord)
    record = RunRecord.load(folder)
    steps_m = np.hypot(*np.diff(record.position_w_m[:, :2], axis=0).T)
    steps_s = np.diff(record.time_s)
    driven = (
        (steps_s < 0.1) & np.isfinite(steps_m) & (np.abs(record.torque_nm[1:]).max(axis=1) > 0.05)
    )
    speed = steps_m[driven].sum() / max(steps_s[driven].sum(), 1e-9)
    p50, p99 = (host.state_to_command_us[p] for p in ("p50", "p99"))
    return (
        f"{speed:.2f}",
        "-" if p50 is None or p99 is None else f"{p50 / 1000:.1f} / {p99 / 1000:.1f}",
    )


def event(
    name: str,
    trial_count: int,
    break_it: Callable[[LinkLab], None],
    mend: Callable[[LinkLab], None],
    broken_s: float,
) -> str:
    """A line of the other table: until the robot has stopped, and from the repair until it is armed again."""
    stopped_ms: list[float] = []
    again_s: list[float] = []
    with tempfile.TemporaryDirectory() as folder, lab(Path(folder)) as made:
        for _ in range(trial_count):
            made.arm()
            time.sleep(1.0)
            assert made.status is not None and made.status.lifecycle == "armed", made.status
            began = time.monotonic()
            break_it(made)
            stopped_ms.append(
                1000 * made.until(lambda status: status.lifecycle == "fault", "stopped")
            )
            time.sleep(max(broken_s - (time.monotonic() - began), 0.0))
            mend(made)
            again_s.append(made.arm())
    stopped = f"{statistics.median(stopped_ms):.0f} / {max(stopped_ms):.0f}"
    return f"| {name} | {trial_count} | {stopped} | {statistics.median(again_s):.2f} / {max(again_s):.2f} |"


def events(trial_count: int) -> list[str]:
    """What breaks, and is mended."""
    cut, mend = (lambda made: made.link.make(cut=True)), (lambda made: made.link.make())
    return [
        event("link cut for 0.5 s", trial_count, cut, mend, 0.5),
        event(
            "link cut for 5 s, and the machine joins again",
            max(trial_count // 4, 1),
            cut,
            mend,
            5.0,
        ),
        event(
            "router killed, and a new one started",
            trial_count,
            LinkLab.kill_router,
            LinkLab.start_router,
            0.2,
        ),
    ]


def has_netem() -> bool:
    """Whether this kernel has the queueing discipline `netem`."""
    probe = ["unshare", "--net", "tc", "qdisc", "add", "dev", "lo", "root", "netem", "delay", "1ms"]
    return subprocess.run(probe, capture_output=True, check=False).returncode == 0


HEAD = """\
# Bad links between a robot and its controller

How long does a robot keep moving if the network link to its controller loses or delays packets? How fast does it stop
and resume if the link or the router fails? This page contains the measurements.

In short:

- The robot stops if a command arrives later than one lease period.
- At 100 Hz, no robot stayed armed for 10 s on a link with 5 % loss, or with a delay of 20 +- 10 ms each way.
- A lower rate helps against delay, but not against loss.
- After a cut link or a killed router, the robot stops within 60 ms. It can be armed again less than one second after
  the repair.

## How it was measured

Three machines run as network namespaces. The first runs the host of `triplet` with the simulator, at 100 Hz in real
time. The second runs a router, and the third guidance, navigation and control.

The link between router and controller is bad. It is a pair of TAP interfaces with a process between them
(`verification/links/relay.py`). `netem` is not used, {netem}. The process drops and delays Ethernet
frames **each way**, so a round trip takes twice the delay. TCP runs unchanged above it, and frames keep their order.

The operator arms and watches the host over a socket pair. The network therefore does not affect the measurements of
the host. All machines share the cores of one computer. Host, controller, router and link run with real-time priority.

`python -m verification.links --write --trials {trials}` (root) wrote this page on {day}, on {cpus} cores with Linux
{kernel} at a load of {load}.

## A link that is bad all the time

The table shows how many trials lasted {armed:g} s, how long the robot stayed armed, and which fault ended it. A lease
lasts 50 ms at 100 Hz and 100 ms at 50 Hz.

A lost packet is expensive, because TCP detects it late. It detects it when the next packets arrive at the earliest,
and often only after a timer of 200 ms. To compare delays with `netem`, note that `netem` delays one interface. A delay
of 20 +- 10 ms on one interface corresponds to the round trip of the condition 10 +- 5 ms.

| Link | Lasted | Armed, median s | Armed, shortest s | Ended by | Driven speed, m/s | State to command, p50 / p99 ms |
|---|---|---|---|---|---|---|
"""
EVENTS = """
## A link or a router that fails and returns

*Stopped after* is the time until the host has stopped the robot. *Armed again after* is the time from the repair until
the robot is armed again. An operator sends `reset` and then `arm` without waiting. Both columns contain the median and
the worst value.

| Event | Trials | Stopped after, ms | Armed again after, s |
|---|---|---|---|
"""


def main() -> None:
    """Measure; print, or write the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    parser.add_argument("--trials", type=int, default=20)
    wanted = parser.parse_args()
    head = HEAD.format(
        trials=wanted.trials,
        day=date.today(),
        cpus=os.cpu_count(),
        kernel=platform.release(),
        armed=ARMED_S,
        netem="although this kernel has it"
        if has_netem()
        else "because this kernel does not have it",
        load=f"{os.getloadavg()[1]:.1f}",
    )
    lines: list[str] = []
    for condition in CONDITIONS:
        lines.append(held(condition, max(wanted.trials // 4, 1)))
        print(lines[-1], flush=True)
    happened = events(wanted.trials)
    print("\n".join(happened))
    if wanted.write:
        PAGE.write_text(
            head + "\n".join(lines) + "\n" + EVENTS + "\n".join(happened) + "\n", encoding="utf-8"
        )


if __name__ == "__main__":
    main()
