"""`python -m benchmarks.environments [--write]`: environments beside bare MuJoCo and Gymnasium's Swimmer, in tables.

Each number is a median over rounds, in which all measurements are taken in turn. Each ratio is the median of the
ratios of the rounds.
"""

import argparse
import os
import platform
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from mujoco.batch import Batch

from benchmarks.physics import open_simulator
from snakesim.environments import SnakeEnv, SnakeVectorEnv
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import load_scenario
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.laws.version import choose_laws

RESULTS = Path(__file__).parent / "ENVIRONMENTS.md"
SCENARIOS = ("peg_row", "surveyed_clutter", "mamba_flat", "mamba_hills")
JOINT_OBSERVATIONS = {
    "observe": ("angle_rad", "velocity_rad_s", "torque_nm"),
    "new_field": False,
    "duration": 3600,
}
FRAME_SKIP = 5  # ticks in a step: 50 ms of robot time; a step of Swimmer has 40 ms
ROUNDS = 5
SINGLE_ROUND_S = 0.5  # of one environment on one core
VECTOR_ROUND_S = 1.5
THREADS = 2
VECTOR_SIZES = (8, 64)
STEP_S = 0.002  # of the physics
PLANE_FRICTION = 0.3  # under the bare chain
Step = Callable[[], Any]
INTRODUCTION = """\
Printed by `python -m benchmarks.environments` on {machine}, Python {python}, load average {load}: read the ratios.
The laws of ground and friction run in {laws}. A step is 50 ms of robot time: 5 ticks with 5 physics steps in each.
Observations are those of the joints, and resets are not counted. *Bare chain* is `mj_step` for a chain with the robot's
links, joints and gains on a plane. It has MuJoCo's own contacts, and no sensors, limiter, obstacles or rewards.
"""
ONE_CORE = """\
One environment, per CPU second. The last column is the time of a step of the environment, divided by that of the bare
chain. The goal is 1.1.
"""
MANY = """\
Many environments in one process on {threads} threads. *Bare batch* steps as many bare chains by `mujoco.batch.Batch`
on as many threads. The goal is 0.7 of it.
"""


class TravelingWave:
    """Joint targets of a traveling wave."""

    def __init__(self, joint_count: int) -> None:
        self._lag_rad = 0.9 * np.arange(joint_count)[::-1]
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


def make_physics_step(scenario: str) -> Step:
    """Return a function that makes the same step without sensors, command limiter and rewards."""
    config = load_scenario(scenario).config
    backend = open_simulator(config)
    joints = config.robot.chain.modules
    modes = [JointMode.POSITION] * joints
    limits_nm = [config.robot.limits.torque_nm] * joints
    wave = TravelingWave(joints)
    steps_per_tick = backend.sim.steps_per_tick

    def step() -> None:
        backend.enact(SafeSetpoints(modes, wave.next_target_rad().tolist(), limits_nm), "armed")
        for _ in range(FRAME_SKIP):
            backend.physics.step(steps_per_tick)

    return step


def make_bare_chain(robot: RobotFile) -> mujoco.MjModel:
    """Return a chain with the links, joints and gains of a robot on a plane, with MuJoCo's own contacts."""
    radius_m = robot.module.radius_m
    lengths_m = robot.link_lengths_m
    masses_kg = robot.link_masses_kg
    joints = robot.joint_table
    links = ""
    motors = ""
    exclusions = ""
    for i, (length_m, mass_kg) in enumerate(zip(lengths_m, masses_kg, strict=True)):
        if i == 0:
            links += f'<body name="link_0" pos="0 0 {radius_m}"><freejoint/>'
        else:
            joint = joints[i - 1]
            axis = "0 0 1" if joint.axis == "yaw" else "0 1 0"
            limits = f'range="{joint.limits.lower_rad} {joint.limits.upper_rad}"'
            links += f'<body name="link_{i}" pos="{lengths_m[i - 1]} 0 0">'
            links += f'<joint name="{joint.name}" axis="{axis}" {limits} armature="{joint.motor.armature_kg_m2}"/>'
            gains = (
                f'kp="{joint.motor.stiffness_nm_per_rad}" kv="{joint.motor.damping_nm_s_per_rad}"'
            )
            torques = f'forcerange="{-joint.limits.torque_nm} {joint.limits.torque_nm}"'
            motors += f'<position joint="{joint.name}" {gains} {torques}/>'
            exclusions += f'<exclude body1="link_{i - 1}" body2="link_{i}"/>'
        links += f'<geom type="capsule" fromto="0 0 0 {length_m} 0 0" size="{radius_m}" mass="{mass_kg}"/>'
    links += "</body>" * len(lengths_m)
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco>
        <option timestep="{STEP_S}" integrator="implicitfast" jacobian="dense"><flag island="disable"/></option>
        <worldbody><geom type="plane" size="0 0 1" friction="{PLANE_FRICTION}"/>{links}</worldbody>
        <contact>{exclusions}</contact><actuator>{motors}</actuator></mujoco>"""
    )


def make_bare_step(scenario: str) -> Step:
    """Return a function that makes the same step of a bare chain."""
    config = load_scenario(scenario).config
    model = make_bare_chain(config.robot)
    data = mujoco.MjData(model)
    wave = TravelingWave(config.robot.chain.modules)
    steps_per_tick = round(config.period_ns * 1e-9 / STEP_S)

    def step() -> None:
        data.ctrl[:] = wave.next_target_rad()
        for _ in range(FRAME_SKIP):
            mujoco.mj_step(model, data, steps_per_tick)

    return step


def make_bare_batch_step(scenario: str, count: int) -> Step:
    """Return a function that makes the same step of many bare chains."""
    config = load_scenario(scenario).config
    batch = Batch(make_bare_chain(config.robot), count, THREADS)
    inputs = batch.bind("ctrl")
    wave = TravelingWave(config.robot.chain.modules)
    steps_per_tick = round(config.period_ns * 1e-9 / STEP_S)

    def step() -> None:
        inputs[:] = wave.next_target_rad()
        for _ in range(FRAME_SKIP):
            batch.step(nstep=steps_per_tick)

    return step


def make_vector_step(scenario: str, count: int) -> Step:
    """Return a function that makes a step of many environments whose episodes do not end."""
    envs = SnakeVectorEnv(
        count, scenario=scenario, frame_skip=FRAME_SKIP, thread_count=THREADS, **JOINT_OBSERVATIONS
    )
    wave = TravelingWave(len(envs.single_action_space.sample()))
    envs.reset(seed=1)
    shape = envs.action_space.shape
    assert shape is not None
    return lambda: envs.step(np.broadcast_to(wave.next_target_rad(), shape))


def make_swimmer_step() -> Step:
    """Return a function that makes one step of Gymnasium's Swimmer: two joints and a body in a plane."""
    env = gymnasium.make("Swimmer-v5").unwrapped
    env.reset(seed=1)
    action = np.array([0.3, -0.3], dtype=np.float32)
    return lambda: env.step(action)


def measure_steps_per_s(
    step: Step, seconds: float, clock: Callable[[], float] = time.process_time
) -> float:
    """Repeat a step, and return the number of steps in a second of the clock.

    Args:
        step: makes one step.
        seconds: how long to repeat it, by the clock.
        clock: returns a time in s; processor time of all threads of this process unless given.
    """
    count = 0
    begin_s = clock()
    while (elapsed_s := clock() - begin_s) < seconds:
        step()
        count += 1
    return count / elapsed_s


def measure_both_clocks(step: Step, seconds: float) -> tuple[float, float]:
    """Return the number of steps in a second of wall time, and in a second of processor time."""
    cpu_before_s = time.process_time()
    begin_s = time.perf_counter()
    per_s = measure_steps_per_s(step, seconds, time.perf_counter)
    wall_s = time.perf_counter() - begin_s
    cpu_s = time.process_time() - cpu_before_s
    return per_s, per_s * wall_s / cpu_s


def compute_column_medians(rounds: Sequence[Sequence[float]]) -> list[float]:
    """Return the median of each column."""
    return [statistics.median(column) for column in zip(*rounds, strict=True)]


def format_ratio(rounds: Sequence[Sequence[float]], first: int, second: int) -> str:
    """Return the median ratio of two columns, which is taken round by round."""
    return f"{statistics.median(values[first] / values[second] for values in rounds):.2f}"


def format_single_row(scenario: str) -> str:
    """Measure one environment of a scenario, and return its row of the table."""
    steps = [
        make_environment_step(scenario),
        make_environment_step(scenario, safe=False),
        make_physics_step(scenario),
        make_bare_step(scenario),
    ]
    rounds: list[list[float]] = []  # a row for each round, a column for each of the steps
    for _ in range(ROUNDS):
        rounds.append([measure_steps_per_s(step, SINGLE_ROUND_S) for step in steps])
    environment, without_limiter, physics, bare = compute_column_medians(rounds)
    return (
        f"| `{scenario}` | {environment:.0f} | {without_limiter:.0f} | {physics:.0f} | {bare:.0f} | "
        f"{format_ratio(rounds, 0, 2)} | {format_ratio(rounds, 3, 0)} |"
    )


def format_vector_row(scenario: str, count: int) -> str:
    """Measure many environments of a scenario, and return their row of the table."""
    steps = [make_vector_step(scenario, count), make_bare_batch_step(scenario, count)]
    rounds: list[list[float]] = []  # of each of the steps: per s, and per CPU s
    for _ in range(ROUNDS):
        rounds.append(
            [rate for step in steps for rate in measure_both_clocks(step, VECTOR_ROUND_S)]
        )
    per_s, per_cpu_s, bare_per_s, bare_per_cpu_s = (
        count * rate for rate in compute_column_medians(rounds)
    )
    return (
        f"| `{scenario}` | {count} | {per_s:.0f} | {bare_per_s:.0f} | {format_ratio(rounds, 0, 2)} | "
        f"{per_cpu_s:.0f} | {bare_per_cpu_s:.0f} | {format_ratio(rounds, 1, 3)} |"
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
    config = load_scenario(scenario).config
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
        rounds.append(
            [measure_steps_per_s(environment.step, SINGLE_ROUND_S) for environment in compared]
        )
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
    parser.add_argument("--write", action="store_true", help=f"keep the tables in {RESULTS.name}")
    arguments = parser.parse_args()
    lines: list[str] = []

    def report(line: str) -> None:
        print(line, flush=True)
        lines.append(line)

    laws = {"c": "C", "python": "Python"}[choose_laws()]
    machine = platform.machine()
    load_average = f"{os.getloadavg()[0]:.1f} on {len(os.sched_getaffinity(0))} cores"
    report("# Environments: steps per second\n")
    report(
        INTRODUCTION.format(
            machine=machine, python=platform.python_version(), load=load_average, laws=laws
        )
    )
    report(ONE_CORE)
    report(
        "| scenario | environment | without limiter | physics | bare chain | of physics | time of bare |"
    )
    report("|---|---|---|---|---|---|---|")
    for scenario in SCENARIOS:
        report(format_single_row(scenario))
    report("\n" + MANY.format(threads=THREADS))
    columns = "per s | bare batch, per s | of bare | per CPU s | bare batch, per CPU s | of bare"
    report(f"| scenario | environments | {columns} |")
    report("|---|---|---|---|---|---|---|---|")
    for scenario in SCENARIOS:
        for count in VECTOR_SIZES:
            report(format_vector_row(scenario, count))
    report(
        "\nPer degree of freedom, beside Gymnasium's swimmer (no limiter, noise, obstacles or motors), per CPU s:\n"
    )
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
