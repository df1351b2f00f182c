"""Whole runs, as a user starts them: time of a lockstep tick, latency in real time, and the highest rate."""

import subprocess
import sys
import tempfile
from pathlib import Path

import msgspec

from snakesim_hal.base.process import child_environment, python_command
from snakesim_operator.results.run_reader import SUMMARY
from snakesim_operator.results.summary import RunSummary

TRIES = 3
RATES_HZ = (200, 300, 400, 500, 600, 700, 800, 900, 1000, 1200, 1500, 2000)


def run(*arguments: str, scenario: str = "triplet") -> RunSummary:
    """One `snakesim run`; another when it was stopped, as a machine that stands still for 50 ms does to it."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        typed = python_command("-m", "snakesim_operator", "run", scenario, "--out", str(out), *arguments)
        for left in reversed(range(TRIES)):
            ended = subprocess.run(
                typed, env=child_environment(), check=left == 0, stdout=subprocess.DEVNULL, timeout=300
            )
            if ended.returncode == 0:
                break
            print(f"stopped, tried again: snakesim run {scenario} {' '.join(arguments)}", file=sys.stderr)
        return msgspec.json.decode((out / SUMMARY).read_bytes(), type=RunSummary)


def lockstep_tick_us(timestep_s: str, *more: str) -> float:
    """Wall time of one tick of a whole lockstep run with guidance, navigation, control and recorder as processes."""
    summary = run(
        "--clock-mode", "lockstep", "--duration", "10", "--set", f"backends.sim.timestep_s={timestep_s}", *more
    )
    return summary.wall_s / summary.ticks * 1e6


BESIDE = ("--set", "services.control.place=host")


def latency_us(*arguments: str) -> float:
    """State published to command received, median, in real time."""
    found = run("--clock-mode", "realtime", "--duration", "5", *arguments).state_to_command_us["p50"]
    assert found is not None
    return found


def highest_rate_hz(*arguments: str) -> tuple[int, dict[int, float]]:
    """The highest control rate at which 99 % of the ticks got their command within the tick, and that share by rate."""
    shares: dict[int, float] = {}
    best = 0
    for rate in RATES_HZ:
        summary = run("--clock-mode", "realtime", "--duration", "3", "--set", f"rate_hz={rate}", *arguments)
        shares[rate] = summary.answered_fraction or 0.0
        if shares[rate] < 0.99:
            break
        best = rate
    return best, shares
