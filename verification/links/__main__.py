"""Measure bad links between a robot and its controller: `python -m verification.links [--write] [--trials N]`.

The result is two tables: how long a robot stays armed over links that are bad all the time, and how soon it stops and
is armed again if a link or a router fails. `--write` writes them to docs/benchmarks/lab-links.md. Needs root.
"""

import argparse
import os
import platform
import subprocess
from datetime import date
from pathlib import Path

from verification.links.trials import (
    CONDITIONS,
    LONG_CUT,
    MAX_ARMED_S,
    ROUTER_KILLED,
    SHORT_CUT,
    measure_condition,
    measure_event,
)

PAGE = Path(__file__).parents[2] / "docs" / "benchmarks" / "lab-links.md"
NETEM_TEST = "unshare --net tc qdisc add dev lo root netem delay 1ms"
TRIALS_RATIO = 4  # rows with long trials have this many times fewer of them

LINKS_TEMPLATE = """\
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
EVENTS_SECTION = """
## A link or a router that fails and returns

*Stopped after* is the time until the host has stopped the robot. *Armed again after* is the time from the repair until
the robot is armed again. An operator sends `reset` and then `arm` without waiting. Both columns contain the median and
the worst value.

| Event | Trials | Stopped after, ms | Armed again after, s |
|---|---|---|---|
"""


def has_netem() -> bool:
    """Return whether this kernel has the queueing discipline `netem`."""
    return subprocess.run(NETEM_TEST.split(), capture_output=True, check=False).returncode == 0


def measure_conditions(trial_count: int) -> list[str]:
    """Measure all links that are bad all the time, print each row, and return the rows."""
    rows: list[str] = []
    for condition in CONDITIONS:
        row = measure_condition(condition, trial_count)
        print(row, flush=True)
        rows.append(row)
    return rows


def measure_events(trial_count: int, long_trial_count: int) -> list[str]:
    """Measure all failures of links and routers, print each row, and return the rows."""
    rows: list[str] = []
    for event in (SHORT_CUT, LONG_CUT, ROUTER_KILLED):
        row = measure_event(event, long_trial_count if event is LONG_CUT else trial_count)
        print(row, flush=True)
        rows.append(row)
    return rows


def main() -> None:
    """Run all trials and print their tables, or also write the page."""
    parser = argparse.ArgumentParser(prog="python -m verification.links", description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    parser.add_argument("--trials", type=int, default=20, help="trials of an event (20)")
    arguments = parser.parse_args()
    long_trial_count = max(arguments.trials // TRIALS_RATIO, 1)
    netem_reason = (
        "although this kernel has it" if has_netem() else "because this kernel does not have it"
    )
    introduction = LINKS_TEMPLATE.format(
        trials=arguments.trials,
        day=date.today(),
        cpus=os.cpu_count(),
        kernel=platform.release(),
        armed=MAX_ARMED_S,
        netem=netem_reason,
        load=f"{os.getloadavg()[1]:.1f}",
    )
    condition_rows = measure_conditions(long_trial_count)
    event_rows = measure_events(arguments.trials, long_trial_count)
    if arguments.write:
        condition_table = "\n".join(condition_rows) + "\n"
        event_table = "\n".join(event_rows) + "\n"
        page = introduction + condition_table + EVENTS_SECTION + event_table
        PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
