"""`python -m benchmarks.environment_parts [SCENARIO]`: where the CPU time of a step of one environment goes.

A timer interrupts the process many times. Each time, the innermost function that is listed in PARTS gets the sample.
Python handles an interrupt at its next instruction, so a short part may get samples of its neighbor.
"""

import argparse
import os
import signal
import time
from collections import Counter
from types import FrameType

from benchmarks.environments import make_bare_step, make_environment_step, measure_steps_per_s

SAMPLE_PERIOD_S = 0.0005  # of CPU time
BARE_S = 0.5  # of CPU time, before and after the samples are taken
OTHER = "the rest: the loop over ticks, rewards, ends of episodes"
# Names of functions with their classes, and the part of a step to which they belong.
PARTS = {
    "NativeLaws.step": "physics: `mj_step` with our laws",
    "DivergenceWatch.check": "check for divergence, and the last good state",
    "SimulatedRobots._update_winding_temperatures": "heat of the windings",
    "SimulatedRobots.advance": "torque limits of the motors",
    "SimulatedRobots.enact": "targets to the motors",
    "SensorArrays.sample": "sensors, with noise and rates",
    "ArmedRobots._limit_vectorized": "limiter",
    "ArmedRobots._observe": "plausibility of the joint states",
    "CommandDigests.add": "digest of the setpoints",
    "BodyLocator.compute_body_positions": "forward kinematics, for the advance",
    "BatchObserver.observe": "the rest of the observation, with the noise of the pose",
    "SnakeEnv._make_step_info": "info dict",
    "ActionTargets.convert_action": "check of the action",
}


def find_part(frame: FrameType | None) -> str:
    """Return the part of a step to which the innermost listed function of a stack belongs."""
    while frame is not None:
        part = PARTS.get(frame.f_code.co_qualname)
        if part is not None:
            return part
        frame = frame.f_back
    return OTHER


def main() -> int:
    """Print a table with the CPU time of every part."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.environment_parts", description=__doc__
    )
    parser.add_argument("scenario", nargs="?", default="mamba_flat")
    parser.add_argument("--seconds", type=float, default=5.0, help="CPU time (5)")
    arguments = parser.parse_args()
    step = make_environment_step(arguments.scenario)
    bare_step = make_bare_step(arguments.scenario)
    bare_us = 1e6 / measure_steps_per_s(bare_step, BARE_S)
    sample_counts: Counter[str] = Counter()

    def take_sample(_signal_number: int, frame: FrameType | None) -> None:
        sample_counts[find_part(frame)] += 1

    signal.signal(signal.SIGPROF, take_sample)
    signal.setitimer(signal.ITIMER_PROF, SAMPLE_PERIOD_S, SAMPLE_PERIOD_S)
    step_us = 1e6 / measure_steps_per_s(step, arguments.seconds, time.process_time)
    signal.setitimer(signal.ITIMER_PROF, 0.0)
    bare_us = (bare_us + 1e6 / measure_steps_per_s(bare_step, BARE_S)) / 2

    sample_count = sample_counts.total()
    print(
        f"`{arguments.scenario}`, {sample_count} samples, load average {os.getloadavg()[0]:.1f} on "
        f"{len(os.sched_getaffinity(0))} processors.\n"
    )
    print("| part of a step | CPU time, µs | of the bare chain |\n|---|---|---|")
    for part, count in sample_counts.most_common():
        part_us = step_us * count / sample_count
        print(f"| {part} | {part_us:.0f} | {part_us / bare_us:.2f} |")
    print(f"| whole step | {step_us:.0f} | {step_us / bare_us:.2f} |")
    print(f"| bare chain | {bare_us:.0f} | 1 |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
