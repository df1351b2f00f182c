"""Whole runs, started as a user starts them: time of a lockstep tick, latency in real time, and the highest rate."""

import subprocess
import sys
import tempfile
import time
from pathlib import Path

import msgspec

from snakesim_hal.base.process import make_child_environment, make_python_command
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_operator.results.run_reader import SUMMARY_FILENAME
from snakesim_operator.results.summary import RunSummary

ATTEMPTS = 3  # a machine that pauses for 50 ms stops a run in real time
RUN_TIMEOUT_S = 300
RATES_HZ = (200, 300, 400, 500, 600, 700, 800, 900, 1000, 1200, 1500, 2000)
MIN_ANSWERED_FRACTION = 0.99  # of the ticks, for a rate that counts as reached
IN_PROCESS_SCENARIO = "peg_row"
IN_PROCESS_S = 20.0  # of robot time
CONTROL_IN_HOST = ("--set", "services.control.process=host")


def run(*arguments: str, scenario: str = "triplet") -> RunSummary:
    """Do one `snakesim run` and return its summary. A run that was stopped is tried again.

    Raises:
        CalledProcessError: the last attempt was stopped, too.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = make_python_command(
            "-m", "snakesim_operator", "run", scenario, "--out", str(out), *arguments
        )
        for attempts_left in reversed(range(ATTEMPTS)):
            completed = subprocess.run(
                command,
                env=make_child_environment(),
                check=attempts_left == 0,
                stdout=subprocess.DEVNULL,
                timeout=RUN_TIMEOUT_S,
            )
            if completed.returncode == 0:
                break
            print(
                f"stopped, tried again: snakesim run {scenario} {' '.join(arguments)}",
                file=sys.stderr,
            )
        summary = (out / SUMMARY_FILENAME).read_bytes()
        return msgspec.json.decode(summary, type=RunSummary)


def measure_tick_us(*arguments: str) -> float:
    """Return the wall time of one tick of a lockstep run with all services and the recorder as processes.

    Args:
        arguments: further arguments of `snakesim run`.
    """
    summary = run("--clock-mode", "lockstep", "--duration", "10", *arguments)
    return summary.wall_s / summary.ticks * 1e6


def measure_speed_in_process(*arguments: str) -> float:
    """Return how many times faster than real time a run in one process is.

    Args:
        arguments: further arguments of `snakesim run`.
    """
    summary = run(
        "--in-process", "--duration", f"{IN_PROCESS_S:g}", *arguments, scenario=IN_PROCESS_SCENARIO
    )
    return IN_PROCESS_S / summary.wall_s


def measure_loop_in_process() -> float:
    """Return how many seconds of robot time a run without a recording makes in a second of CPU time."""
    config = load_scenario(
        IN_PROCESS_SCENARIO, [parse_set_option(f"duration_s={IN_PROCESS_S:g}")]
    ).config
    with InProcessRun(config) as in_process_run:
        began_s = time.process_time()
        for _ in in_process_run.iterate_ticks():
            pass
        return IN_PROCESS_S / (time.process_time() - began_s)


def measure_latency_us(*arguments: str) -> float:
    """Return the median time from the publication of a state to the reception of its command, in real time."""
    summary = run("--clock-mode", "realtime", "--duration", "5", *arguments)
    latency_us = summary.state_to_command_us["p50"]
    assert latency_us is not None
    return latency_us


def find_highest_rate_hz(*arguments: str) -> tuple[int, dict[int, float]]:
    """Find the highest control rate at which 99 % of the ticks get their command within the tick.

    Returns:
        That rate (0 if none was reached), and for each rate that was tried the fraction of ticks with a command.
    """
    answered_fractions: dict[int, float] = {}
    highest_hz = 0
    for rate_hz in RATES_HZ:
        summary = run(
            "--clock-mode", "realtime", "--duration", "3", "--set", f"rate_hz={rate_hz}", *arguments
        )
        answered_fractions[rate_hz] = summary.answered_fraction or 0.0
        if answered_fractions[rate_hz] < MIN_ANSWERED_FRACTION:
            break
        highest_hz = rate_hz
    return highest_hz, answered_fractions
