"""The task of this recipe: advance as far as possible in 6 s, on ground where belly scales give directional friction.

The scenario is `scales`: a link slides forward more easily than backward or sideways. The friction coefficient differs
from seed to seed, and no policy observes it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

# Before NumPy, so that its arithmetic is that of `snakesim run`.
from snakesim.environments import SnakeEnv, SnakeVectorEnv

# isort: split
import numpy as np
from numpy.typing import NDArray

from snakesim.training.exported import read_learned_parameters
from snakesim.training.form import OBSERVE, PolicyArrays
from snakesim_gnc.control.policy import PolicyModel

Floats = NDArray[np.float64]
ComputeTargets = Callable[[NDArray[np.float32]], Any]
"""Returns joint angles in rad, (n, joints), for n observations."""

SCENARIO = "scales"
FRAME_SKIP = 1  # 100 targets a second; with 20 a second, the same wave needs three times the energy
DURATION_S = 6.0  # of an episode
TICKS_PER_EPISODE = 600
ENVIRONMENT: dict[str, Any] = {
    "scenario": SCENARIO,
    "frame_skip": FRAME_SKIP,
    "duration": DURATION_S,
    "randomize": {"scene.ground.friction": (0.15, 0.25)},
}

# First seeds of four sets of episodes that have no seed in common.
TUNING_SEED = 1_000_001
VALIDATION_SEED = 2_000_001
TEST_SEED = 3_000_001
TRAINING_SEED = 4_000_001


@dataclass(frozen=True)
class GaitResult:
    """What a gait reached in episodes with different seeds."""

    advance_m: Floats  # (episodes,)
    energy_j: Floats  # (episodes,) sum over joints of |torque x velocity| over time


def make_environments(count: int, reward: Mapping[str, float] | None = None) -> SnakeVectorEnv:
    """Make environments that are stepped together, and that are reset in the step that ends their episode.

    Args:
        count: Number of environments.
        reward: Weights of the terms of the reward. None takes the default weights.
    """
    return SnakeVectorEnv(
        count,
        autoreset_mode="SameStep",
        thread_count=1,
        observe=OBSERVE,
        reward=reward,
        **ENVIRONMENT,
    )


def count_observed_values() -> dict[str, int]:
    """Return the number of values in each part of an observation."""
    env = SnakeEnv(observe=OBSERVE, **ENVIRONMENT)
    return {name: len(part.names) for name, part in env.parts.items()}


def load_wave(file: str) -> PolicyArrays:
    """Return the wave of a policy file that `tune_serpenoid.py` has written, for the robot of the task."""
    axes = [joint.axis for joint in SnakeEnv(**ENVIRONMENT).description.joints]
    parameters = read_learned_parameters(file)
    return PolicyArrays.make_from_parameters(parameters, axes, count_observed_values())


def measure_gait(compute_targets: ComputeTargets, first_seed: int, count: int) -> GaitResult:
    """Run a gait for one episode in each of `count` environments, whose seeds count up from the first one."""
    env = make_environments(count)
    observations, _ = env.reset(seed=first_seed)
    advance_m = np.zeros(count)
    energy_j = np.zeros(count)
    is_running = np.ones(count, dtype=bool)
    while is_running.any():
        observations, _, terminated, truncated, infos = env.step(compute_targets(observations))
        is_ending = is_running & (terminated | truncated)
        is_running = is_running & ~is_ending
        # An environment whose episode ended has begun another one, which is not counted.
        for rows, values in ((is_running, infos), (is_ending, infos.get("final_info"))):
            if rows.any():
                advance_m[rows] = values["advance_m"][rows]
                energy_j[rows] += values["energy_j"][rows]
    env.close()
    return GaitResult(advance_m, energy_j)


def measure_policy(file: str, first_seed: int, count: int) -> GaitResult:
    """Run a policy file, as `measure_gait` does."""
    model = PolicyModel(SnakeEnv(**ENVIRONMENT).description, file)
    return measure_gait(
        lambda observations: [model(observation) for observation in observations],
        first_seed,
        count,
    )
