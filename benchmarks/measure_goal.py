"""Measures one goal of `benchmarks.checkouts` with the packages on the search path, and prints the value.

    PYTHONPATH=CHECKOUT python -P benchmarks/measure_goal.py recorded

It is a script of its own, so that the same code measures every checkout.
"""

import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks import environments, physics, whole
from benchmarks.sections import MANY, ROUND_S, ROUNDS
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.wire import keys
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.recording.writer import RecordingWriter


def measure_recorded_loop() -> float:
    """Return how many seconds of robot time a run with a recording of all messages makes in a second of CPU time."""
    config = load_scenario(
        "peg_row", [parse_set_option(f"duration_s={whole.IN_PROCESS_S:g}")]
    ).config
    with tempfile.TemporaryDirectory() as folder, InProcessRun(config) as run:
        session = run.network.create_session()
        began_s = time.process_time()
        recording = RecordingWriter(Path(folder, RECORDING_FILENAME), config.robot.name)
        for row in keys.SPACE:
            session.on_latched_arrival(row.key, recording.write_arrival)
        for _ in run.iterate_ticks():
            recording.flush_when_due()
        recording.close({})
        return whole.IN_PROCESS_S / (time.process_time() - began_s)


def measure_lockstep_tick_us() -> float:
    """Return the wall time of a lockstep tick with five processes, without the recorder."""
    return whole.measure_tick_us("--no-record")


def measure_simulator_tick_us() -> float:
    """Return the CPU time of a tick of the simulator without its physics."""
    return statistics.median(physics.measure_tick_times(physics.load_config()).own_us)


def measure_environment_ratio() -> float:
    """Return the CPU time of a step of one environment of `mamba_flat`, divided by that of the bare chain."""
    return measure_ratio(
        environments.make_environment_step("mamba_flat"), environments.make_bare_step("mamba_flat")
    )


def measure_environments_ratio() -> float:
    """Return the CPU time of a step of 64 environments of `peg_row`, divided by that of a bare `Batch`."""
    return measure_ratio(
        environments.make_vector_step("peg_row", MANY),
        environments.make_bare_batch_step("peg_row", MANY),
    )


def measure_ratio(step: environments.Step, other_step: environments.Step) -> float:
    """Return the median ratio of the CPU times of two steps, which are measured in turn."""
    ratios: list[float] = []
    for _ in range(ROUNDS):
        steps_per_s = environments.measure_steps_per_s(step, ROUND_S)
        ratios.append(environments.measure_steps_per_s(other_step, ROUND_S) / steps_per_s)
    return statistics.median(ratios)


MEASUREMENTS: dict[str, Callable[[], float]] = {
    "loop": whole.measure_loop_in_process,
    "recorded": measure_recorded_loop,
    "lockstep": measure_lockstep_tick_us,
    "simulator": measure_simulator_tick_us,
    "environment": measure_environment_ratio,
    "environments": measure_environments_ratio,
}

if __name__ == "__main__":
    print("measured", MEASUREMENTS[sys.argv[1]]())
