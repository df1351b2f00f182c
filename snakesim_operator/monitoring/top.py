"""`snakesim topic rate`: every key of the robots on a network, as a table that is redrawn every second."""

import contextlib
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import msgspec

from snakesim_hal.base.terminal import PrintLine, overwrite_lines, print_json, print_line
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.session import Session
from snakesim_hal.network.streams import ReceivedSample
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import TICK_TIMES, RobotDescription, TimingStatistics
from snakesim_operator.base.targets import RobotSelection, open_sessions
from snakesim_operator.monitoring.traffic import CommandLatency, KeyTraffic, NetworkTraffic

PERIOD_S = 1.0
SINGLE_MEASUREMENT_S = 2.0  # long enough for two samples of the slowest key that repeats itself
KEY_COLUMNS = (
    f"{'key':<29} {'writer':<17} {'Hz':>7} {'jitter':>9} {'max gap':>9} {'bytes':>8} "
    f"{'age':>8} {'received':>8}"
)
TICK_TIME_COLUMNS = (
    f"{'while armed, ms':<47} {'median':>9} {'99 %':>9} {'most':>9}  "
    f"{'histogram, from the shortest to the longest'}"
)
HISTOGRAM_BARS = "▁▂▃▄▅▆▇█"


def show_traffic(
    selection: RobotSelection, print_text: PrintLine = print_line, *, once: bool, as_json: bool
) -> int:
    """Measure the traffic of all selected robots, and print it every second until Ctrl-C.

    Args:
        selection: Selects the robots.
        print_text: Prints a line of a table.
        once: Whether to measure for SINGLE_MEASUREMENT_S, print one table and end.
        as_json: Whether to print a line of JSON for each table.

    Returns:
        The exit code: 1 with `once` if nothing arrived, otherwise 0.

    Raises:
        NotConnectedError: No robot is reachable.
    """
    with contextlib.ExitStack() as stack:
        traffics = [
            _subscribe_to_traffic(link.namespace, session)
            for link, session in open_sessions(selection, stack)
        ]
        drawn_line_count = 0
        while True:
            time.sleep(SINGLE_MEASUREMENT_S if once else PERIOD_S)
            snapshot = _evaluate_traffic(traffics)
            if as_json:
                _print_json_snapshot(snapshot, print_text)
            elif sys.stdout.isatty() and not once:
                drawn_line_count = overwrite_lines(snapshot.format_table(), drawn_line_count)
            else:
                for line in snapshot.format_table():
                    print_text(line)
            if once:
                return 0 if snapshot.lines else 1


def _subscribe_to_traffic(namespace: str | None, session: Session) -> NetworkTraffic:
    """Subscribe to everything on a network, and return the object that collects what arrives from now on.

    Args:
        namespace: Namespace of the only robot that is measured. None if keys begin with the namespace of a robot.
        session: Session on this network.
    """
    traffic = NetworkTraffic(namespace)

    def add_unknown_key(arrival: ReceivedSample) -> None:
        if not traffic.is_known_key(arrival.key):
            traffic.add(arrival)

    # The key space is subscribed key by key, because a lab's router may grant no wildcard.
    for row in keys.SPACE:
        key = row.key if namespace is not None else f"**/{row.key}"
        if row.kind == "latched":
            session.on_latched_arrival(key, traffic.add)
        elif row.kind == "stream":
            session.on_arrival(key, traffic.add)
    session.on_arrival("**", add_unknown_key)
    return traffic


@dataclass(frozen=True)
class TrafficSnapshot:
    """The measured traffic on all networks at one time, as one table of `snakesim topic rate` prints it."""

    lines: Sequence[KeyTraffic]
    latencies: Sequence[CommandLatency]
    # By robot; without those that have no times yet.
    tick_times: Mapping[str, Mapping[str, TimingStatistics]]
    descriptions: Mapping[str, RobotDescription]  # by robot
    left_out: int  # messages on more keys than are counted

    def format_table(self) -> list[str]:
        """Return the table as lines of text: robot by robot, with unknown keys at the end of each."""
        if not self.lines:
            return ["nothing arrives"]
        table: list[str] = []
        for robot in dict.fromkeys(line.robot for line in self.lines):
            if table:
                table.append("")
            table += self._format_robot(robot)
        if self.left_out:
            table.append(
                f"and {self.left_out} messages on still more keys: a client floods this network"
            )
        return table

    def _format_robot(self, robot: str) -> list[str]:
        """Return the lines of one robot; the name is empty for keys that belong to no robot."""
        table: list[str] = []
        if robot:
            table.append(f"{robot}: {describe_what_moves(self.descriptions.get(robot))}")
        else:
            table.append("of no robot:")
        table.append(KEY_COLUMNS)
        table += [_format_key(line) for line in self.lines if line.robot == robot]
        table += [_format_latency(latency) for latency in self.latencies if latency.robot == robot]
        if robot in self.tick_times:
            table.append(TICK_TIME_COLUMNS)
            table += [
                _format_timing(name, timing) for name, timing in self.tick_times[robot].items()
            ]
        return table


def _evaluate_traffic(traffics: Sequence[NetworkTraffic]) -> TrafficSnapshot:
    """Measure rates, latencies and tick times of all networks now, and return them as one snapshot."""
    now_ns = time.monotonic_ns()
    lines: list[KeyTraffic] = []
    latencies: list[CommandLatency] = []
    tick_times: dict[str, Mapping[str, TimingStatistics]] = {}
    descriptions: dict[str, RobotDescription] = {}
    left_out = 0
    for traffic in traffics:
        lines += traffic.measure_keys(now_ns)
        latencies += traffic.measure_latencies()
        tick_times |= {robot: times for robot, times in traffic.read_tick_times().items() if times}
        descriptions |= traffic.read_descriptions()
        left_out += traffic.keys_left_out
    return TrafficSnapshot(lines, latencies, tick_times, descriptions, left_out)


def _print_json_snapshot(snapshot: TrafficSnapshot, print_text: PrintLine) -> None:
    """Print a snapshot as one line of JSON."""
    # A robot without a description is missing in `emulated`: whether it is emulated is unknown.
    emulated = {robot: description.emulated for robot, description in snapshot.descriptions.items()}
    content = {
        "emulated": emulated,
        "keys": snapshot.lines,
        "latencies": snapshot.latencies,
        "tick_times": snapshot.tick_times,
        "left_out": snapshot.left_out,
    }
    print_json(msgspec.to_builtins(content), print_text)


def _format_timing(name: str, timing: TimingStatistics) -> str:
    """Return the line of a duration, with its histogram from the shortest to the longest."""
    max_count = max(timing.bins)
    bars = ""
    for count in timing.bins:
        bars += HISTOGRAM_BARS[(len(HISTOGRAM_BARS) - 1) * count // max_count] if count else " "
    description = TICK_TIMES.get(name, "")
    numbers = "".join(
        f" {time_us * 1e-3:>9.3f}" for time_us in (timing.median_us, timing.p99_us, timing.max_us)
    )
    return f"{name:<10} {description:<36}{numbers}  {timing.low_us * 1e-3:>9.3f} |{bars}|"


def _format_latency(latency: CommandLatency) -> str:
    """Return the line of a robot's latency."""
    text = (
        f"state to command, as measured here: {latency.arrival_median_ms:.2f} ms in the median, "
        f"at most {latency.arrival_p99_ms:.2f} ms for 99 % of {latency.count} commands"
    )
    if latency.motors_median_ms is not None:
        text += f"; to the motors, in robot time: {latency.motors_median_ms:.0f} and {latency.motors_p99_ms:.0f} ms"
    return text


def _format_key(line: KeyTraffic) -> str:
    """Return the line of one key."""
    writer = line.writer or "UNKNOWN"
    rate = _format_number(line.rate_hz, ".1f", "")
    jitter = _format_number(line.jitter_ms, ".2f", " ms")
    max_gap = _format_number(line.gap_max_ms, ".1f", " ms")
    age = _format_number(line.age_ms, ".0f", " ms")
    last_arrival = _format_number(line.received_ago_s, ".1f", " s")
    failure = f"  {line.failure}" if line.failure else ""
    return (
        f"{line.key[:29]:<29} {writer[:17]:<17} {rate:>7} {jitter:>9} {max_gap:>9} {line.bytes:>8} "
        f"{age:>8} {last_arrival:>8}{failure}"
    )


def _format_number(value: float | None, number_format: str, unit: str) -> str:
    """Return a number with its unit, or `-` for an unknown one."""
    return "-" if value is None else f"{value:{number_format}}{unit}"
