"""Measure the latency of the loop over each way through a lab: `python -m benchmarks.paths [--write]`; needs root.

*Ours* is the time from the publishing of a state to the arrival of the command that answers it. The host runs in real
time at 100 Hz with a controller that holds the pose. *Raw* is the round trip of as many bytes with raw Zenoh between
the same machines, at the same rate and priority. Both are measured in turn, and the median of the ratios counts.
`--write` writes the tables to benchmarks/PATHS.md.
"""

import argparse
import os
import platform
import statistics
import tempfile
from collections.abc import Sequence
from contextlib import ExitStack
from datetime import date
from pathlib import Path

from benchmarks.paths.loops import (
    CAMERA_OPTIONS,
    LoopBenchmark,
    Percentiles,
    measure_loop,
    measure_loop_with_images,
    measure_raw_echo,
    measure_raw_echo_with_images,
)
from benchmarks.paths.ways import CabledMachines
from benchmarks.physics import encode_tick, load_config

RESULTS = Path(__file__).parents[1] / "PATHS.md"
SLOW_LINK_MBIT_S = 6.0
SLOW_LINK = f"tbf rate {SLOW_LINK_MBIT_S:g}mbit burst 16kb latency 50ms"
QUEUES = ("bfifo limit 64kb", "pfifo_fast")  # one queue, or three by priority
MAX_RATIO = 1.5  # aim for each way
MAX_SATURATED_RATIO = 1.3  # aim on the slow link
EXPLANATION = (
    "The table names a run that stops. A lease lasts 50 ms. On such a link a packet of 1500 bytes takes 2 ms, and no",
    "other packet can overtake it. So p99 is longer, also with raw Zenoh. Smaller pieces of an image do not help,",
    "because TCP joins them to whole packets again. With previews instead of images the aim is met: see",
    "[bandwidth](../docs/benchmarks/bandwidth.md).",
    "",
    "The additional time of SnakeSIM is mostly Python that runs once in 10 ms, and so from a cold cache. Half of it is",
    "in the process of control. The five messages of a tick cost little, because those with a reader share a packet.",
)


def main() -> None:
    """Print every line as soon as it is known, and write the page if requested."""
    arguments = _parse_arguments()
    state, command = encode_tick(load_config())
    lines = make_introduction(arguments, state, command)
    print("\n".join(lines), flush=True)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        os.environ["XDG_STATE_HOME"] = folder
        machines = CabledMachines(Path(folder), stack)
        benchmark = LoopBenchmark(Path(folder), arguments.seconds, state, command)
        if not arguments.only_slow:
            lines += measure_ways(machines, benchmark, arguments.repeats)
        lines += measure_slow_link(machines, benchmark, arguments.repeats)
    lines += ["", *EXPLANATION]
    if arguments.write:
        RESULTS.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _parse_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.paths", description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"write the tables to {RESULTS.name}")
    parser.add_argument("--seconds", type=float, default=10.0, help="duration of a run in s (10)")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each kind (3)")
    parser.add_argument("--only-slow", action="store_true", help="measure only the slow link")
    return parser.parse_args()


def make_introduction(arguments: argparse.Namespace, state: bytes, command: bytes) -> list[str]:
    """Return the lines of the page before the first row."""
    return [
        "# The loop through a lab's network",
        "",
        f"Printed by `python -m benchmarks.paths --write --seconds {arguments.seconds:g} "
        f"--repeats {arguments.repeats}` on "
        f"{date.today()}, {os.cpu_count()} cores, Python {platform.python_version()}, load {os.getloadavg()[1]:.1f}.",
        "The machines are network namespaces on one computer. *Ours* is the time from state to command at 100 Hz.",
        f"*Raw* is a Zenoh round trip of {len(state)} and {len(command)} bytes on the same path. Both are measured "
        f"in turn, and are medians of {arguments.repeats}.",
        "",
        "| way | ours p50 / p99, µs | raw p50 / p99, µs | ratio p50 | ratio p99 | aim |",
        "|---|---|---|---|---|---|",
    ]


def measure_ways(
    machines: CabledMachines, benchmark: LoopBenchmark, repeat_count: int
) -> list[str]:
    """Measure the loop and raw Zenoh over each way, print each row, and return the rows."""
    rows: list[str] = []
    for way in machines.list_ways():
        pairs: list[tuple[Percentiles, Percentiles]] = []
        for _ in range(repeat_count):
            ours = measure_loop(way, benchmark)
            raw = measure_raw_echo(way, benchmark)
            pairs.append((ours, raw))
        row = format_row(way.name, pairs, MAX_RATIO)
        print(row, flush=True)
        rows.append(row)
    return rows


def measure_slow_link(
    machines: CabledMachines, benchmark: LoopBenchmark, repeat_count: int
) -> list[str]:
    """Measure the loop over a slow link with and without a client that reads images, and print the table.

    Returns:
        The lines of the table and of its introduction.
    """
    lines = [
        "",
        f"With a camera whose images a client reads by one router over a link of {SLOW_LINK_MBIT_S:g} Mbit/s (`tbf`),",
        "which is less than the images need. *Quiet* is without that client. Before the link is one queue, or",
        "three by priority.",
        "",
        "| queue | watched p50 / p99, µs | quiet p50 / p99, µs | ratio p50 | ratio p99 | aim | images, Mbit/s |",
        "|---|---|---|---|---|---|---|",
    ]
    print("\n".join(lines), flush=True)
    machines.robot.run(*f"tc qdisc add dev robot root handle 1: {SLOW_LINK}".split())
    for queue in QUEUES:
        machines.robot.run(*f"tc qdisc replace dev robot parent 1:1 {queue}".split())
        rows = measure_queue(machines, benchmark, repeat_count, queue)
        print("\n".join(rows), flush=True)
        lines += rows
    way = machines.find_way_by_one_router()
    pairs: list[tuple[Percentiles, Percentiles]] = []
    for _ in range(repeat_count):
        watched = measure_raw_echo_with_images(way, benchmark)
        quiet = measure_raw_echo(way, benchmark)
        pairs.append((watched, quiet))
    raw_row = format_row(f"`{QUEUES[-1]}`, raw Zenoh", pairs, MAX_SATURATED_RATIO) + " |"
    print(raw_row, flush=True)
    return [*lines, raw_row]


def measure_queue(
    machines: CabledMachines, benchmark: LoopBenchmark, repeat_count: int, queue: str
) -> list[str]:
    """Measure the loop over the slow link behind one kind of queue.

    Returns:
        A row with the results of the complete runs, and a row for each run that stopped.
    """
    way = machines.find_way_by_one_router()
    pairs: list[tuple[Percentiles, Percentiles]] = []
    stop_reasons: list[str] = []
    image_rates_mbit_s: list[float] = []
    for _ in range(repeat_count):
        try:
            quiet = measure_loop(way, benchmark, CAMERA_OPTIONS)
            watched, image_rate_mbit_s = measure_loop_with_images(way, benchmark)
        except (RuntimeError, TimeoutError) as error:
            stop_reasons.append(str(error))
            continue
        pairs.append((watched, quiet))
        image_rates_mbit_s.append(image_rate_mbit_s)
    rows: list[str] = []
    if pairs:
        row = format_row(f"`{queue}`", pairs, MAX_SATURATED_RATIO)
        rows.append(f"{row} {statistics.median(image_rates_mbit_s):.1f} |")
    rows += [f"| `{queue}` | {reason} | | | | **missed** | |" for reason in stop_reasons]
    return rows


def format_row(
    name: str, pairs: Sequence[tuple[Percentiles, Percentiles]], max_ratio: float
) -> str:
    """Return a row of a table with medians of both latencies and of their ratios.

    Args:
        name: Name of the way or queue.
        pairs: Latencies that were measured one after the other: the examined one, and the reference.
        max_ratio: Ratio that is the aim.
    """
    examined_us = [statistics.median(examined[i] for examined, _ in pairs) for i in (0, 1)]
    reference_us = [statistics.median(reference[i] for _, reference in pairs) for i in (0, 1)]
    ratios = [
        statistics.median(examined[i] / reference[i] for examined, reference in pairs)
        for i in (0, 1)
    ]
    verdict = "met" if max(ratios) <= max_ratio else "**missed**"
    return (
        f"| {name} | {examined_us[0]:.0f} / {examined_us[1]:.0f} | {reference_us[0]:.0f} / {reference_us[1]:.0f} "
        f"| {ratios[0]:.2f} | {ratios[1]:.2f} | <= {max_ratio:g} {verdict} |"
    )


if __name__ == "__main__":
    main()
