"""`python -m benchmarks.environments [--write]`: environments beside bare physics and Gymnasium's Swimmer, in a table.

Each number is a median over rounds, in which all measurements are taken in turn. Each ratio is the median of the
ratios of the rounds.
"""

import argparse
import multiprocessing
import os
import platform
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np

from benchmarks.physics import open_simulator
from snakesim.environments import SnakeEnv
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.model.scenario import load
from snakesim_hal.wire.messages import Mode

RESULTS = Path(__file__).parent / "ENVIRONMENTS.md"
SCENARIOS = ("peg_row", "surveyed_clutter", "mamba_flat", "mamba_hills")
JOINT_OBSERVATIONS = {"observe": ("angle_rad", "velocity_rad_s", "torque_nm"), "new_field": False, "duration": 3600}
FRAME_SKIP = 5  # ticks in a step: 50 ms of robot time; a step of Swimmer has 40 ms
ROUNDS = 5
SINGLE_ROUND_S = 0.5  # of one environment on one core
PARALLEL_ROUND_S = 1.5  # of several processes
CORES = 2
VECTOR_SIZE = 8  # environments on these cores
Step = Callable[[], Any]
INTRODUCTION = """\
Printed by `python -m benchmarks.environments` on {machine}, Python {python}, a shared machine: read the ratios. A step
is 50 ms of robot time, 5 ticks with 5 physics steps in each; observations are of the joints, and no resets are counted.
*Physics* is `mj_step` with our laws, which MuJoCo's engine applies. *Bare* is `mj_step` without them: on flat ground
the snake then falls, and touches nothing; hills need no such law. The aim is 0.8 of bare on two cores.
"""


class TravelingWave:
    """Joint targets of a traveling wave."""

    def __init__(self, joints: int) -> None:
        self._lag_rad = 0.9 * np.arange(joints)[::-1]
        self._step = 0

    def next_target_rad(self) -> np.ndarray:
        """Return the joint targets of the next step, (joints,)."""
        self._step += 1
        return 0.3 * np.sin(np.pi * 0.05 * self._step - self._lag_rad)


def make_environment_step(scenario: str, **options: Any) -> Step:
    """Return a function that makes one step of an environment whose episode does not end."""
    env = SnakeEnv(scenario, frame_skip=FRAME_SKIP, **JOINT_OBSERVATIONS, **options)
    wave = TravelingWave(len(env.action_names))
    env.reset(seed=1)
    return lambda: env.step(wave.next_target_rad())


def make_physics_step(scenario: str, *, ground: bool) -> Step:
    """Return a function that makes the same step without sensors, command limiter and rewards.

    Args:
        scenario: name of the scenario.
        ground: whether our law of flat ground is computed; otherwise the step is `mj_step` alone.
    """
    config = load(scenario).config
    # Without the laws' C version, which is part of `mj_step`, the step leaves them out.
    backend = open_simulator(config, None if ground else "python")
    joints = config.robot.chain.modules
    modes = [Mode.POSITION] * joints
    limits_nm = [config.robot.limits.torque_nm] * joints
    wave = TravelingWave(joints)
    steps_per_tick = backend.sim.steps_per_tick

    def step() -> None:
        backend.enact(SafeSetpoints(modes, wave.next_target_rad().tolist(), limits_nm), "armed")
        for _ in range(FRAME_SKIP):
            if ground:
                backend.physics.step(steps_per_tick)
            else:
                mujoco.mj_step(backend.sim.model, backend.data, steps_per_tick)

    return step


def make_swimmer_step() -> Step:
    """Return a function that makes one step of Gymnasium's Swimmer: two joints and a body in a plane."""
    env = gymnasium.make("Swimmer-v5").unwrapped
    env.reset(seed=1)
    action = np.array([0.3, -0.3], dtype=np.float32)
    return lambda: env.step(action)


def measure_steps_per_s(step: Step, seconds: float, clock: Callable[[], float] = time.process_time) -> float:
    """Repeat a step, and return the number of steps in a second of the clock.

    Args:
        step: makes one step.
        seconds: how long to repeat it, by the clock.
        clock: returns a time in s; processor time of this process unless given.
    """
    count = 0
    begin_s = clock()
    while (elapsed_s := clock() - begin_s) < seconds:
        step()
        count += 1
    return count / elapsed_s


def read_cpu_s(process: int) -> float:
    """Return the processor time that a process has used so far, in s."""
    stat = Path(f"/proc/{process}/stat").read_text(encoding="utf-8")
    fields = stat.rpartition(")")[2].split()  # those after the program's name, which may hold spaces
    user_ticks = int(fields[11])
    system_ticks = int(fields[12])
    return (user_ticks + system_ticks) / os.sysconf("SC_CLK_TCK")


def measure_vector(scenario: str) -> tuple[float, float]:
    """Measure a vector of environments in several processes.

    Returns:
        Steps of all environments together: per second of wall time, and per second of processor time.
    """
    envs = gymnasium.make_vec(
        "snakesim.environments:SnakeSIM/Scenario-v0",
        num_envs=VECTOR_SIZE,
        scenario=scenario,
        frame_skip=FRAME_SKIP,
        **JOINT_OBSERVATIONS,
    )
    shape = envs.action_space.shape
    assert shape is not None
    processes = [os.getpid()]
    processes += [child.pid for child in multiprocessing.active_children() if child.pid]
    wave = TravelingWave(shape[-1])
    envs.reset(seed=1)

    def step() -> None:
        envs.step(np.broadcast_to(wave.next_target_rad(), shape))

    cpu_before_s = sum(map(read_cpu_s, processes))
    begin_s = time.perf_counter()
    vector_steps_per_s = measure_steps_per_s(step, PARALLEL_ROUND_S, time.perf_counter)
    wall_s = time.perf_counter() - begin_s
    cpu_s = sum(map(read_cpu_s, processes)) - cpu_before_s
    envs.close()
    steps_per_s = VECTOR_SIZE * vector_steps_per_s
    return steps_per_s, steps_per_s * wall_s / cpu_s


def measure_physics(scenario: str, ground: bool) -> float:
    """Return the steps of the physics per second of wall time, on one core. Runs in a worker process."""
    return measure_steps_per_s(make_physics_step(scenario, ground=ground), PARALLEL_ROUND_S, time.perf_counter)


def measure_parallel_physics(scenario: str, *, ground: bool) -> float:
    """Return the steps of the physics per second of wall time, of one process a core together."""
    with ProcessPoolExecutor(CORES) as pool:
        return sum(pool.map(measure_physics, [scenario] * CORES, [ground] * CORES))


def compute_column_medians(rounds: list[list[float]]) -> list[float]:
    """Return the median of each column."""
    return [statistics.median(column) for column in zip(*rounds, strict=True)]


def format_ratio(rounds: list[list[float]], ours: int, theirs: int) -> str:
    """Return the median ratio of two columns, which is taken round by round."""
    return f"{statistics.median(values[ours] / values[theirs] for values in rounds):.2f}"


def format_scenario_row(scenario: str) -> str:
    """Measure one scenario on one core and on two, and return its row of the table."""
    steps = [
        make_environment_step(scenario),
        make_environment_step(scenario, safe=False),
        make_physics_step(scenario, ground=True),
        make_physics_step(scenario, ground=False),
    ]
    one_core: list[list[float]] = []  # a row for each round, a column for each of the steps
    for _ in range(ROUNDS):
        one_core.append([measure_steps_per_s(step, SINGLE_ROUND_S) for step in steps])
    two_cores: list[list[float]] = []
    for _ in range(ROUNDS):
        wall_rate, cpu_rate = measure_vector(scenario)
        physics_rate = measure_parallel_physics(scenario, ground=True)
        bare_rate = measure_parallel_physics(scenario, ground=False)
        two_cores.append([wall_rate, cpu_rate, physics_rate, bare_rate])
    environment, without_limiter, physics, bare = compute_column_medians(one_core)
    vector_wall, vector_cpu, *_ = compute_column_medians(two_cores)
    return (
        f"| `{scenario}` | {environment:.0f} | {without_limiter:.0f} | {physics:.0f} | {bare:.0f} | "
        f"{format_ratio(one_core, 0, 2)} | {format_ratio(one_core, 0, 3)} | {vector_cpu:.0f} | {vector_wall:.0f} | "
        f"{format_ratio(two_cores, 0, 2)} | {format_ratio(two_cores, 0, 3)} |"
    )


@dataclass(frozen=True)
class ComparedEnvironment:
    """An environment in the table that compares with Swimmer."""

    name: str
    step: Step
    degrees_of_freedom: int
    physics_steps: int  # in one step
    step_s: float  # robot time of one step


def format_rows_per_degree_of_freedom() -> list[str]:
    """Measure the first scenario and Gymnasium's Swimmer, and return their rows.

    The columns are comparable because they count physics steps, and seconds of robot time, times degrees of freedom.
    """
    scenario = SCENARIOS[0]
    config = load(scenario).config
    sim = open_simulator(config).sim
    swimmer: Any = gymnasium.make("Swimmer-v5").unwrapped
    compared = [
        ComparedEnvironment(
            name=scenario,
            step=make_environment_step(scenario),
            degrees_of_freedom=sim.model.nv,
            physics_steps=FRAME_SKIP * sim.steps_per_tick,
            step_s=FRAME_SKIP / config.rate_hz,
        ),
        ComparedEnvironment(
            name="Swimmer-v5",
            step=make_swimmer_step(),
            degrees_of_freedom=swimmer.model.nv,
            physics_steps=swimmer.frame_skip,
            step_s=swimmer.dt,
        ),
    ]
    rounds: list[list[float]] = []
    for _ in range(ROUNDS):
        rounds.append([measure_steps_per_s(environment.step, SINGLE_ROUND_S) for environment in compared])
    rows: list[str] = []
    for environment, rate in zip(compared, compute_column_medians(rounds), strict=True):
        freedoms = environment.degrees_of_freedom
        rows.append(
            f"| `{environment.name}` | {freedoms} | {rate:.0f} | {environment.physics_steps} | "
            f"{rate * environment.physics_steps * freedoms / 1e3:.0f} | {rate * environment.step_s * freedoms:.0f} |"
        )
    return rows


def main() -> int:
    """Print every line as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"keep the table in {RESULTS.name}")
    arguments = parser.parse_args()
    lines: list[str] = []

    def report(line: str) -> None:
        print(line, flush=True)
        lines.append(line)

    report("# Environments: steps per second\n")
    report(INTRODUCTION.format(machine=platform.machine(), python=platform.python_version()))
    one_core = "steps per CPU s | without limiter | physics | bare | of physics | of bare"
    two_cores = f"vector of {VECTOR_SIZE}, per CPU s | per s | of physics | of bare"
    report(f"| scenario | {one_core} | {two_cores} |")
    report("|---|---|---|---|---|---|---|---|---|---|---|")
    for scenario in SCENARIOS:
        report(format_scenario_row(scenario))
    report("\nPer degree of freedom, beside Gymnasium's swimmer (no limiter, noise, obstacles or motors), per CPU s:\n")
    columns = "degrees of freedom | steps | physics steps in each | 1000 physics steps x freedoms | robot s x freedoms"
    report(f"| environment | {columns} |")
    report("|---|---|---|---|---|---|")
    for row in format_rows_per_degree_of_freedom():
        report(row)
    if arguments.write:
        RESULTS.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
