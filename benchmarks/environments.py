"""`python -m benchmarks.environments [--write]`: environments beside bare physics and Gymnasium's Swimmer, in a table.

Each number is a median over rounds in which all of them are taken in turn, each ratio that of the ratios of a round.
"""

import argparse
import multiprocessing
import os
import platform
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
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
OF_JOINTS = {"observe": ("angle_rad", "velocity_rad_s", "torque_nm"), "new_field": False, "duration": 3600}
SKIP = 5  # ticks in a step: 50 ms of robot time; that of Swimmer is 40 ms
ROUNDS, ROUND_S, TOGETHER_S = 5, 0.5, 1.5
CORES, MANY = 2, 8  # processors, and environments on them
Step = Callable[[], Any]
ABOUT = """\
Printed by `python -m benchmarks.environments` on {machine}, Python {python}, a shared machine: read the ratios. A step
is 50 ms of robot time, 5 ticks with 5 physics steps in each; observations are of the joints, and no resets are counted.
*Physics* is `mj_step` with our law of flat ground, which is Python in every physics step. *Bare* is `mj_step` without
it: on flat ground the snake then falls, and touches nothing; hills need no such law. The aim is 0.8 of bare on two
cores.
"""


class Wave:
    """Targets of a travelling wave."""

    def __init__(self, joints: int) -> None:
        self._lag_rad, self._k = 0.9 * np.arange(joints)[::-1], 0

    def next(self) -> np.ndarray:
        """Those of the next step, (joints,)."""
        self._k += 1
        return 0.3 * np.sin(np.pi * 0.05 * self._k - self._lag_rad)


def environment(scenario: str, **more: Any) -> Step:
    """A step of an environment, whose episode does not end."""
    env = SnakeEnv(scenario, frame_skip=SKIP, **OF_JOINTS, **more)
    wave = Wave(len(env.action_names))
    env.reset(seed=1)
    return lambda: env.step(wave.next())


def physics(scenario: str, *, ground: bool) -> Step:
    """The same without sensors, limiter and rewards. ground: with our law of flat ground, else `mj_step` alone."""
    config = load(scenario).config
    backend, joints = open_simulator(config), config.robot.chain.modules
    modes, full_nm = [Mode.POSITION] * joints, [config.robot.limits.torque_nm] * joints
    wave, steps = Wave(joints), backend.sim.steps_per_tick

    def step() -> None:
        backend.enact(SafeSetpoints(modes, wave.next().tolist(), full_nm), "armed")
        for _ in range(SKIP):
            if ground:
                backend.physics.step(steps)
            else:
                mujoco.mj_step(backend.sim.model, backend.data, steps)

    return step


def swimmer() -> Step:
    """Gymnasium's own: two joints and a body in a plane."""
    env = gymnasium.make("Swimmer-v5").unwrapped
    env.reset(seed=1)
    action = np.array([0.3, -0.3], dtype=np.float32)
    return lambda: env.step(action)


def steps_per_s(step: Step, seconds: float, clock: Callable[[], float] = time.process_time) -> float:
    """How often a step is made in a second of the clock."""
    count, begun = 0, clock()
    while (spent := clock() - begun) < seconds:
        step()
        count += 1
    return count / spent


def cpu_s(process: int) -> float:
    """Processor time of a process so far."""
    words = Path(f"/proc/{process}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def vector(scenario: str) -> tuple[float, float]:
    """Steps of all environments of a vector: per second of the wall clock, and per second of all its processes."""
    envs = gymnasium.make_vec(
        "snakesim.environments:SnakeSIM/Scenario-v0",
        num_envs=MANY,
        scenario=scenario,
        frame_skip=SKIP,
        **OF_JOINTS,
    )
    shape = envs.action_space.shape
    assert shape is not None
    processes = [os.getpid(), *(child.pid for child in multiprocessing.active_children() if child.pid)]
    wave = Wave(shape[-1])
    envs.reset(seed=1)
    before_s, begun = sum(map(cpu_s, processes)), time.perf_counter()
    rate = steps_per_s(lambda: envs.step(np.broadcast_to(wave.next(), shape)), TOGETHER_S, time.perf_counter)
    wall_s, spent_s = time.perf_counter() - begun, sum(map(cpu_s, processes)) - before_s
    envs.close()
    return MANY * rate, MANY * rate * wall_s / spent_s


def physics_for(scenario: str, ground: bool) -> float:
    """In a process of its own."""
    return steps_per_s(physics(scenario, ground=ground), TOGETHER_S, time.perf_counter)


def physics_together(scenario: str, *, ground: bool) -> float:
    """Steps per second of the wall clock, of a process a core together."""
    with ProcessPoolExecutor(CORES) as pool:
        return sum(pool.map(physics_for, [scenario] * CORES, [ground] * CORES))


def medians(rounds: list[list[float]]) -> list[float]:
    """Of each column."""
    return [statistics.median(column) for column in zip(*rounds, strict=True)]


def ratio(rounds: list[list[float]], ours: int, theirs: int) -> str:
    """Of two columns, round by round."""
    return f"{statistics.median(of[ours] / of[theirs] for of in rounds):.2f}"


def row(scenario: str) -> str:
    """One scenario, on one core and on two."""
    steps = [
        environment(scenario),
        environment(scenario, safe=False),
        physics(scenario, ground=True),
        physics(scenario, ground=False),
    ]
    alone = [[steps_per_s(step, ROUND_S) for step in steps] for _ in range(ROUNDS)]
    both = [
        [*vector(scenario), *(physics_together(scenario, ground=ground) for ground in (True, False))]
        for _ in range(ROUNDS)
    ]
    ours, unsafe, law, bare = medians(alone)
    wall, cpu, *_ = medians(both)
    return (
        f"| `{scenario}` | {ours:.0f} | {unsafe:.0f} | {law:.0f} | {bare:.0f} | {ratio(alone, 0, 2)} | "
        f"{ratio(alone, 0, 3)} | {cpu:.0f} | {wall:.0f} | {ratio(both, 0, 2)} | {ratio(both, 0, 3)} |"
    )


def per_freedom() -> list[str]:
    """Rows that compare with Swimmer: a step of the solver, and a second of robot time, times degrees of freedom."""
    config = load(SCENARIOS[0]).config
    model, theirs = open_simulator(config).sim, gymnasium.make("Swimmer-v5").unwrapped
    each = [
        (SCENARIOS[0], environment(SCENARIOS[0]), model.model.nv, SKIP * model.steps_per_tick, SKIP / config.rate_hz),
        ("Swimmer-v5", swimmer(), theirs.model.nv, theirs.frame_skip, theirs.dt),  # pyright: ignore
    ]
    rounds = [[steps_per_s(step, ROUND_S) for _, step, *_ in each] for _ in range(ROUNDS)]
    return [
        f"| `{name}` | {freedoms} | {rate:.0f} | {solver} | {rate * solver * freedoms / 1e3:.0f} | "
        f"{rate * robot_s * freedoms:.0f} |"
        for (name, _, freedoms, solver, robot_s), rate in zip(each, medians(rounds), strict=True)
    ]


def main() -> int:
    """Print every line as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"keep the table in {RESULTS.name}")
    write = parser.parse_args().write
    text: list[str] = []

    def say(line: str) -> None:
        print(line, flush=True)
        text.append(line)

    say("# Environments: steps per second\n")
    say(ABOUT.format(machine=platform.machine(), python=platform.python_version()))
    one, two = "steps per CPU s | without limiter | physics | bare", "vector of 8, per CPU s | per s"
    say(f"| scenario | {one} | of physics | of bare | {two} | of physics | of bare |")
    say("|---|---|---|---|---|---|---|---|---|---|---|")
    for scenario in SCENARIOS:
        say(row(scenario))
    say("\nPer degree of freedom, beside Gymnasium's swimmer (no limiter, noise, obstacles or motors), per CPU s:\n")
    columns = "degrees of freedom | steps | physics steps in each | 1000 physics steps x freedoms | robot s x freedoms"
    say(f"| environment | {columns} |")
    say("|---|---|---|---|---|---|")
    for line in per_freedom():
        say(line)
    if write:
        RESULTS.write_text("\n".join(text) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
