"""`python -m benchmarks [--write]`: measure, print, and keep the table in benchmarks/RESULTS.md."""

import argparse
import platform
import statistics
from collections.abc import Callable
from pathlib import Path

from benchmarks.bus import FULLEST_FRAMES_PER_S, say_frame_costs
from benchmarks.cycle import cycle, load_table
from benchmarks.echo import echo_us
from benchmarks.physics import BareLoop, config_of, motion, sensing, wire_bytes
from benchmarks.size import install_mb
from benchmarks.table import HEADER, row
from benchmarks.whole import BESIDE, highest_rate_hz, latency_us, lockstep_tick_us

RESULTS = Path(__file__).parent / "RESULTS.md"
REPEATS = 3
LATENCY_REPEATS = 9  # more: how fast a virtual machine wakes up changes within seconds
STEPS = ("0.002", "0.001")  # seconds; the first is the default


def main() -> int:
    """Print every line as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"keep the table in {RESULTS.name}")
    write = parser.parse_args().write
    text: list[str] = []

    def say(line: str) -> None:
        print(line, flush=True)
        text.append(line)

    say("# Benchmarks\n")
    say(f"Printed by `make bench` on {platform.machine()}, Python {platform.python_version()}, a shared machine:")
    say("read the ratios, not the times. Each ratio is a median of pairs measured in turn in one run.\n")
    say(HEADER)
    config = config_of()
    state, command = wire_bytes(config)
    ticks: dict[str, list[float]] = {step: [] for step in STEPS}
    for step in STEPS:
        stepped = config_of(f"backends.sim.timestep_s={step}")
        physics = f"physics in steps of {float(step) * 1000:g} ms"
        published, alone, mujoco = sensing(stepped)
        what = f"simulator tick, all sensors published; {physics}"
        say(row(what, "the physics alone", published, alone, 1.15))
        what = f"the physics alone, with our ground and friction; {physics}"
        say(row(what, "`mj_step` of the same states, without", alone, mujoco, None))
        floors: list[float] = []
        unrecorded: list[float] = []
        for _ in range(REPEATS):
            ticks[step].append(lockstep_tick_us(step))
            unrecorded.append(lockstep_tick_us(step, "--no-record"))
            points, controller_us = motion(stepped)
            floors.append(BareLoop(stepped).tick_us(points) + echo_us(state, command) + controller_us)
        what, bare = f"lockstep tick, three GNC processes; {physics}", "bare physics + raw echo + controller"
        say(row(what, bare, ticks[step], floors, 1.5))
        say(row(f"the same without a recording (`--no-record`); {physics}", bare, unrecorded, floors, 1.5))

    latencies: list[float] = []
    beside: list[float] = []
    echoes: list[float] = []
    for _ in range(LATENCY_REPEATS):
        latencies.append(latency_us())
        beside.append(latency_us(*BESIDE))
        echoes.append(echo_us(state, command, rounds=300, period_s=config.period_ns * 1e-9))
    what = "realtime state-to-command, p50, controller included"
    say(row(what, "raw echo of the same bytes at the same 100 Hz", latencies, echoes, 2.0))
    say(row(f"{what}, beside the driver", "the same raw echo", beside, echoes, 1.5))
    say(row("the same, beside the driver", "control in a process of its own", beside, latencies, 1.0))

    period_us = config.period_ns / 1000
    factors = [f"{period_us / statistics.median(ticks[s]):.1f} (steps of {float(s) * 1000:g} ms)" for s in STEPS]
    say(f"\nLockstep, 13 joints at 100 Hz, times real time: {', '.join(factors)}.")
    for where, arguments in (("", ()), (", beside the driver", BESIDE)):
        best, shares = highest_rate_hz(*arguments)
        listed = ", ".join(f"{rate} Hz {100 * share:.1f} %" for rate, share in shares.items())
        say(f"Highest rate at which 99 % of ticks get their command within the tick{where}: {best} Hz ({listed}).")
    say("\n## CAN\n")
    tell_bus(say)
    say("\n## Size\n\n| installed | MB, without SnakeSIM's own | the largest |\n|---|---|---|")
    for extra in ("", "can", "sim", "record", "report", "console", "train", "all"):
        sizes = install_mb(extra)
        largest = sorted(sizes.items(), key=lambda item: -item[1])[:6]
        listed = ", ".join(f"{name} {size:.0f}" for name, size in largest)
        say(f"| `{f'snakesim[{extra}]' if extra else 'snakesim'}` | {sum(sizes.values()):.0f} | {listed} |")
    if write:
        RESULTS.write_text("\n".join(text) + "\n", encoding="utf-8")
    return 0


def tell_bus(say: Callable[[str], None]) -> None:
    """What the bus costs, and how regular it is."""
    frame_us = say_frame_costs(say, REPEATS)
    share = frame_us * 1e-6 * FULLEST_FRAMES_PER_S  # none of the frames is stuffed
    say(f"\nA saturated bus, {FULLEST_FRAMES_PER_S:.0f} frames/s, takes {share:.1%} of one core (half of one allowed).")
    took = cycle()
    say(
        f"Control cycle at 100 Hz, 13 joints: a command is ready, and its first setpoint is on the bus "
        f"{took.command_to_first_ms[0]:.2f} ms later (p99 {took.command_to_first_ms[1]:.2f}), its last "
        f"{took.command_to_last_ms[0]:.2f} ms (p99 {took.command_to_last_ms[1]:.2f}). Sync is off its period by "
        f"{took.sync_jitter_ms[0]:.3f} ms (p99 {took.sync_jitter_ms[1]:.3f}).\n"
    )
    for line in load_table():
        say(line)
    say("")


if __name__ == "__main__":
    raise SystemExit(main())
