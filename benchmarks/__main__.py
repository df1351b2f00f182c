"""`python -m benchmarks [--write]`: measure, print, and keep the table in benchmarks/RESULTS.md."""

import argparse
import platform
import statistics
from pathlib import Path

from benchmarks.bus import MAX_FRAMES_PER_S, report_frame_costs
from benchmarks.cycle import make_load_table, measure_cycle
from benchmarks.echo import measure_echo_us
from benchmarks.physics import BareSimulation, encode_tick, load_config, measure_tick_times, record_motion
from benchmarks.planning import PlanningCosts, format_rates
from benchmarks.size import measure_install_mb
from benchmarks.table import HEADER, format_row
from benchmarks.whole import CONTROL_IN_HOST, find_highest_rate_hz, measure_latency_us, measure_lockstep_tick_us

RESULTS = Path(__file__).parent / "RESULTS.md"
REPEATS = 3
LATENCY_REPEATS = 9  # more: how fast a virtual machine wakes up changes within seconds
LATENCY_ECHO_ROUNDS = 300
TIMESTEPS_S = ("0.002", "0.001")  # of the physics; the first is the default
EXTRAS = ("", "can", "sim", "record", "report", "console", "train", "all")
MAX_PLANNING_RATIO = 0.17  # 1 500 000 nodes/s instead of 250 000
LISTED_PACKAGES = 6  # the largest ones of each installation


class Results:
    """The lines of the report: printed as soon as they are known, and collected for the file."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def add(self, line: str) -> None:
        """Print a line, and keep it."""
        print(line, flush=True)
        self.lines.append(line)


def main() -> int:
    """Do all benchmarks, and print every line as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"keep the table in {RESULTS.name}")
    arguments = parser.parse_args()
    results = Results()
    results.add("# Benchmarks\n")
    results.add(
        f"Printed by `make bench` on {platform.machine()}, Python {platform.python_version()}, a shared machine:"
    )
    results.add("read the ratios, not the times. Each ratio is a median of pairs measured in turn in one run.\n")
    results.add(HEADER)
    tick_us = {timestep_s: report_ticks(results, timestep_s) for timestep_s in TIMESTEPS_S}
    report_latency(results)
    report_planning(results)
    report_speed(results, tick_us)
    results.add("\n## CAN\n")
    report_bus(results)
    results.add("\n## Size\n")
    report_sizes(results)
    if arguments.write:
        RESULTS.write_text("\n".join(results.lines) + "\n", encoding="utf-8")
    return 0


def report_ticks(results: Results, timestep_s: str) -> list[float]:
    """Add the rows about the ticks of the simulator and of lockstep runs.

    Args:
        results: gets the rows.
        timestep_s: step of the physics, as text for `--set`.

    Returns:
        The time of a lockstep tick in µs, in each repetition.
    """
    config = load_config(f"backends.sim.timestep_s={timestep_s}")
    state, command = encode_tick(load_config())
    physics = f"physics in steps of {float(timestep_s) * 1000:g} ms"
    times = measure_tick_times(config)
    subject = f"simulator tick, all sensors published; {physics}"
    results.add(format_row(subject, "the physics alone", times.published_us, times.physics_us, 1.15))
    subject = f"the physics alone, with our ground and friction; {physics}"
    results.add(format_row(subject, "`mj_step` of the same states, without", times.physics_us, times.mujoco_us, 1.3))
    results.add(format_row(subject, "the same with the laws in Python", times.physics_us, times.python_us, None))

    recorded_us: list[float] = []
    unrecorded_us: list[float] = []
    minimum_us: list[float] = []
    for _ in range(REPEATS):
        recorded_us.append(measure_lockstep_tick_us(timestep_s))
        unrecorded_us.append(measure_lockstep_tick_us(timestep_s, "--no-record"))
        setpoints, controller_us = record_motion(config)
        physics_us = BareSimulation(config).measure_physics_us(setpoints)
        minimum_us.append(physics_us + measure_echo_us(state, command) + controller_us)
    reference = "bare physics + raw echo + controller"
    subject = f"lockstep tick, three GNC processes; {physics}"
    results.add(format_row(subject, reference, recorded_us, minimum_us, 1.5))
    subject = f"the same without a recording (`--no-record`); {physics}"
    results.add(format_row(subject, reference, unrecorded_us, minimum_us, 1.5))
    return recorded_us


def report_latency(results: Results) -> None:
    """Add the rows about the time from a state to its command in real time."""
    config = load_config()
    state, command = encode_tick(config)
    latencies_us: list[float] = []
    in_host_us: list[float] = []
    echoes_us: list[float] = []
    for _ in range(LATENCY_REPEATS):
        latencies_us.append(measure_latency_us())
        in_host_us.append(measure_latency_us(*CONTROL_IN_HOST))
        echo_us = measure_echo_us(state, command, rounds=LATENCY_ECHO_ROUNDS, period_s=config.period_ns * 1e-9)
        echoes_us.append(echo_us)
    subject = "realtime state-to-command, p50, controller included"
    results.add(format_row(subject, "raw echo of the same bytes at the same 100 Hz", latencies_us, echoes_us, 2.0))
    results.add(format_row(f"{subject}, in the host", "the same raw echo", in_host_us, echoes_us, 1.5))
    results.add(format_row("the same, in the host", "control in a process of its own", in_host_us, latencies_us, 1.0))


def report_planning(results: Results) -> None:
    """Add the row and the rates of the path search."""
    costs = PlanningCosts()
    native_us: list[float] = []
    python_us: list[float] = []
    for _ in range(REPEATS):
        native_round_us, python_round_us = costs.measure_kilonode_us()
        native_us += native_round_us
        python_us += python_round_us
    subject = "path search in C, 1000 nodes"
    results.add(format_row(subject, "the same search in Python", native_us, python_us, MAX_PLANNING_RATIO))
    results.add(f"\n{format_rates(native_us, python_us)}")


def report_speed(results: Results, tick_us: dict[str, list[float]]) -> None:
    """Add how much faster than real time lockstep runs are, and the highest rates in real time.

    Args:
        results: gets the lines.
        tick_us: times of a lockstep tick in µs, by timestep of the physics.
    """
    period_us = load_config().period_ns / 1000
    factors: list[str] = []
    for timestep_s, times_us in tick_us.items():
        factor = period_us / statistics.median(times_us)
        factors.append(f"{factor:.1f} (steps of {float(timestep_s) * 1000:g} ms)")
    results.add(f"\nLockstep, 13 joints at 100 Hz, times real time: {', '.join(factors)}.")
    for where, arguments in (("", ()), (", control in the host", CONTROL_IN_HOST)):
        highest_hz, fractions = find_highest_rate_hz(*arguments)
        rates = ", ".join(f"{rate_hz} Hz {100 * fraction:.1f} %" for rate_hz, fraction in fractions.items())
        results.add(
            f"Highest rate at which 99 % of ticks get their command within the tick{where}: {highest_hz} Hz ({rates})."
        )


def report_bus(results: Results) -> None:
    """Add what a CAN bus costs, and how regular it is."""
    frame_us = report_frame_costs(results.add, REPEATS)
    core_fraction = frame_us * 1e-6 * MAX_FRAMES_PER_S
    results.add(
        f"\nA saturated bus, {MAX_FRAMES_PER_S:.0f} frames/s, takes {core_fraction:.1%} of one core "
        "(half of one allowed)."
    )
    cycle = measure_cycle()
    first_ms, first_p99_ms = cycle.command_to_first_setpoint_ms
    last_ms, last_p99_ms = cycle.command_to_last_setpoint_ms
    jitter_ms, jitter_p99_ms = cycle.sync_jitter_ms
    results.add(
        f"Control cycle at 100 Hz, 13 joints: a command is ready, and its first setpoint is on the bus "
        f"{first_ms:.2f} ms later (p99 {first_p99_ms:.2f}), its last {last_ms:.2f} ms (p99 {last_p99_ms:.2f}). "
        f"Sync is off its period by {jitter_ms:.3f} ms (p99 {jitter_p99_ms:.3f}).\n"
    )
    for line in make_load_table():
        results.add(line)
    results.add("")


def report_sizes(results: Results) -> None:
    """Add a table with the size of each installation."""
    results.add("| installed | MB, without SnakeSIM's own | the largest |\n|---|---|---|")
    for extra in EXTRAS:
        sizes_mb = measure_install_mb(extra)
        by_size = sorted(sizes_mb.items(), key=lambda item: -item[1])
        largest = ", ".join(f"{name} {size_mb:.0f}" for name, size_mb in by_size[:LISTED_PACKAGES])
        installation = f"snakesim[{extra}]" if extra else "snakesim"
        results.add(f"| `{installation}` | {sum(sizes_mb.values()):.0f} | {largest} |")


if __name__ == "__main__":
    raise SystemExit(main())
