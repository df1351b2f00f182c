"""`snakesim topic rate`: every key of the robots on a network, as a table that is redrawn every second."""

import contextlib
import sys
import time
from collections.abc import Mapping

import msgspec

from snakesim_hal.base.terminal import PrintLine, overwrite_lines, print_json, print_line
from snakesim_hal.model.what_moves import describe_what_moves
from snakesim_hal.network.session import Arrival, Session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import TICK_TIMES, Description, Timing
from snakesim_operator.base.targets import RobotSelection, sessions_on
from snakesim_operator.monitoring.traffic import KeyTraffic, Latency, Traffic

PERIOD_S = 1.0
ONCE_S = 2.0  # long enough for two samples of the slowest key that repeats itself
HEAD = f"{'key':<29} {'writer':<17} {'Hz':>7} {'jitter':>9} {'max gap':>9} {'bytes':>8} {'age':>8} {'heard':>8}"

TIMES_HEAD = (
    f"{'while armed, ms':<47} {'median':>9} {'99 %':>9} {'most':>9}  {'histogram, from the shortest to the longest'}"
)
BARS = "▁▂▃▄▅▆▇█"


def top(where: RobotSelection, say: PrintLine = print_line, *, once: bool, as_json: bool) -> int:
    """Until Ctrl-C. Returns 1 when nothing was heard, 0 otherwise. Raises NotConnectedError.

    once: listen for a moment, print one table, end. as_json: a line of JSON for each table.
    """
    with contextlib.ExitStack() as stack:
        traffics = [_listen(link.namespace, session) for link, session in sessions_on(where, stack)]
        drawn = 0
        while True:
            time.sleep(ONCE_S if once else PERIOD_S)
            now_ns = time.monotonic_ns()
            lines = [line for traffic in traffics for line in traffic.lines(now_ns)]
            latencies = [latency for traffic in traffics for latency in traffic.latencies()]
            times = {robot: found for traffic in traffics for robot, found in traffic.tick_times().items() if found}
            descriptions = {robot: found for traffic in traffics for robot, found in traffic.descriptions().items()}
            left_out = sum(traffic.keys_left_out for traffic in traffics)
            if as_json:
                content = {
                    "emulated": {robot: found.emulated for robot, found in descriptions.items()},  # missing: unknown
                    "keys": lines,
                    "latencies": latencies,
                    "tick_times": times,
                    "left_out": left_out,
                }
                print_json(msgspec.to_builtins(content), say)
            else:
                table = table_of(lines, latencies, times, left_out, descriptions)
                if sys.stdout.isatty() and not once:
                    drawn = overwrite_lines(table, drawn)
                else:
                    for line in table:
                        say(line)
            if once:
                return 0 if lines else 1


def _listen(namespace: str | None, session: Session) -> Traffic:
    """Subscribe to everything on a network."""
    traffic = Traffic(namespace)

    def take_strange(arrival: Arrival) -> None:
        if not traffic.is_known(arrival.key):
            traffic.add(arrival)

    # Key by key, because a lab's router may grant no wildcard; the last value of those that are latched, too.
    for row in keys.SPACE:
        key = row.key if namespace is not None else f"**/{row.key}"
        if row.kind == "latched":
            session.on_latched_arrival(key, traffic.add)
        elif row.kind == "stream":
            session.on_arrival(key, traffic.add)
    session.on_arrival("**", take_strange)
    return traffic


def table_of(
    lines: list[KeyTraffic],
    latencies: list[Latency],
    times: Mapping[str, Mapping[str, Timing]],
    left_out: int,
    descriptions: Mapping[str, Description],
) -> list[str]:
    """Returns the table as lines of text: robot by robot, what is not of the key space at the end of each."""
    if not lines:
        return ["nothing arrives"]
    text: list[str] = []
    for robot in dict.fromkeys(line.robot for line in lines):
        if text:
            text.append("")
        name = f"{robot}: {describe_what_moves(descriptions.get(robot))}" if robot else "of no robot:"
        text += [name, HEAD]
        text += [_row(line) for line in lines if line.robot == robot]
        for latency in latencies:
            if latency.robot == robot:
                text.append(_latency(latency))
        if robot in times:
            text += [TIMES_HEAD, *(_times(name, timing) for name, timing in times[robot].items())]
    if left_out:
        text.append(f"and {left_out} messages on still more keys: somebody floods this network")
    return text


def _times(name: str, timing: Timing) -> str:
    """A line of how long something took, with its histogram from the shortest to the longest."""
    most = max(timing.bins)
    bars = "".join(" " if not count else BARS[(len(BARS) - 1) * count // most] for count in timing.bins)
    numbers = "".join(f" {us * 1e-3:>9.3f}" for us in (timing.median_us, timing.p99_us, timing.max_us))
    return f"{name:<10} {TICK_TIMES.get(name, ''):<36}{numbers}  {timing.low_us * 1e-3:>9.3f} |{bars}|"


def _latency(latency: Latency) -> str:
    text = (
        f"state to command, as heard here: {latency.heard_median_ms:.2f} ms in the median, "
        f"at most {latency.heard_p99_ms:.2f} ms for 99 % of {latency.count} commands"
    )
    if latency.motors_median_ms is not None:
        text += f"; to the motors, in robot time: {latency.motors_median_ms:.0f} and {latency.motors_p99_ms:.0f} ms"
    return text


def _row(line: KeyTraffic) -> str:
    def number(value: float | None, form: str, unit: str) -> str:
        return "-" if value is None else f"{value:{form}}{unit}"

    writer = line.writer or "STRANGER"
    failure = f"  {line.failure}" if line.failure else ""
    return (
        f"{line.key[:29]:<29} {writer[:17]:<17} {number(line.rate_hz, '.1f', ''):>7} "
        f"{number(line.jitter_ms, '.2f', ' ms'):>9} {number(line.gap_max_ms, '.1f', ' ms'):>9} {line.bytes:>8} "
        f"{number(line.age_ms, '.0f', ' ms'):>8} {number(line.heard_ago_s, '.1f', ' s'):>8}{failure}"
    )
