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

from benchmarks import physics, whole
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


MEASUREMENTS: dict[str, Callable[[], float]] = {
    "loop": whole.measure_loop_in_process,
    "recorded": measure_recorded_loop,
    "lockstep": measure_lockstep_tick_us,
    "simulator": measure_simulator_tick_us,
}

if __name__ == "__main__":
    print("measured", MEASUREMENTS[sys.argv[1]]())
