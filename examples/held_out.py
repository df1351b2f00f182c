"""Try a policy on random scenes that its search never saw.

    python examples/held_out.py POLICY FIRST_SEED COUNT [KEY=VALUE ...]

POLICY is the name of a shipped policy or the path of a file. KEY=VALUE changes the scenario, as `--set` does, for
example `backend=can`. Every scene is one episode of 40 s.
"""

import sys
from dataclasses import dataclass

# Before NumPy, so that its arithmetic is that of `snakesim run`.
from snakesim.environments import SnakeEnv

# isort: split
import numpy as np

from snakesim_gnc.control.policy import PolicyModel
from snakesim_hal.model.scenario import parse_set_option

SCENARIO = "surveyed_clutter"
DURATION_S = 40.0
STUCK_S = 12.0  # without progress until an episode ends, as in `snakesim study evaluate`
PROGRESS_M = 0.03  # what counts as progress


@dataclass
class Episode:
    """How one episode ended."""

    status: str  # `goal` if the robot has reached it
    advance_m: float
    time_s: float
    energy_j: float


def run_episode(env: SnakeEnv, model: PolicyModel, seed: int) -> Episode:
    """Run the policy on the scene of one seed, until the goal, the time limit, or no more progress."""
    observation, info = env.reset(seed=seed)
    energy_j = 0.0
    best_advance_m = 0.0
    progress_time_s = 0.0
    is_over = False
    while not is_over and info["time_s"] - progress_time_s < STUCK_S:
        action = np.array(model(np.asarray(observation)))
        observation, _reward, terminated, truncated, info = env.step(action)
        is_over = terminated or truncated
        energy_j += info["energy_j"]
        if info["advance_m"] > best_advance_m + PROGRESS_M:
            best_advance_m = info["advance_m"]
            progress_time_s = info["time_s"]
    return Episode(info.get("ended", "stuck"), info["advance_m"], info["time_s"], energy_j)


def main() -> None:
    name, first_seed, count, *changes = sys.argv[1:]
    settings = {override.key: override.value for override in map(parse_set_option, changes)}
    model = PolicyModel(SnakeEnv(SCENARIO).description, name)
    env = SnakeEnv(
        SCENARIO,
        observe=tuple(model.parts),
        frame_skip=model.frame_skip,
        duration=DURATION_S,
        set=settings,
    )

    reached = []
    for seed in range(int(first_seed), int(first_seed) + int(count)):
        episode = run_episode(env, model, seed)
        print(
            f"{seed}: {episode.status}, {episode.advance_m:.2f} m in {episode.time_s:.2f} s, {episode.energy_j:.0f} J",
            flush=True,
        )
        if episode.status == "goal":
            reached.append(episode)
    env.close()

    print(f"{name} {' '.join(changes)}: reached the goal in {len(reached)} of {count}")
    if reached:
        speed_m_s = np.median([episode.advance_m / episode.time_s for episode in reached])
        energy_j_per_m = np.median([episode.energy_j / episode.advance_m for episode in reached])
        print(f"medians of those: {speed_m_s:.2f} m/s, {energy_j_per_m:.0f} J/m")


if __name__ == "__main__":
    main()
