"""Tune a serpenoid wave with CMA-ES: the farthest advance whose mean energy stays within a budget.

    python examples/learning/tune_serpenoid.py --budget-j 40 --ticks 200000 --out runs/gait/wave.onnx

The wave is that of `snakesim policy train --form wave`: amplitude, growth towards the tail, frequency, phase lag, and
two gains that steer along the first heading.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import gait_task

# isort: split
import cmaes
import numpy as np
from learning_curve import measure_processor_s

from snakesim.training.episodes import EpisodeResult, EpisodeRunner
from snakesim.training.exported import write_onnx_file
from snakesim.training.form import WAVE, PolicyArrays

POPULATION = 12
EPISODES_PER_WAVE = 2
# The search starts at the wave of the scenario.
START = {
    "amplitude": 0.7,
    "growth": 0.0,
    "omega": 3.1,
    "lag": 0.5,
    "steering": 0.0,
    "head_steering": 0.0,
}
PENALTY_M_PER_J = 0.05  # steep: a wave above the budget gains less than 0.05 m from another joule


def tune_serpenoid(budget_j: float, ticks: int, seed: int, out: Path) -> dict[str, float]:
    """Search for a wave, write it as a policy file, and return its parameters.

    Args:
        budget_j: Mean energy of an episode that the wave may use.
        ticks: Control cycles to simulate in the search.
        seed: Seed of the search.
        out: Policy file to write.
    """
    start = np.array([START[name] for name in WAVE])
    sigmas = np.array([parameter.sigma for parameter in WAVE.values()])
    optimizer = cmaes.CMA(np.zeros(len(start)), 1.0, seed=seed, population_size=POPULATION)

    def make_wave(point: np.ndarray) -> dict[str, float]:
        return dict(zip(WAVE, (start + sigmas * point).tolist(), strict=True))

    generation_ticks = POPULATION * EPISODES_PER_WAVE * gait_task.TICKS_PER_EPISODE
    generations = max(ticks // generation_ticks, 1)
    with EpisodeRunner(gait_task.ENVIRONMENT, worker_count=1) as runner:
        for generation in range(generations):
            points = [optimizer.ask() for _ in range(POPULATION)]
            first_seed = gait_task.TUNING_SEED + generation * EPISODES_PER_WAVE
            seeds = range(first_seed, first_seed + EPISODES_PER_WAVE)
            episodes = runner.run([make_wave(point) for point in points], seeds)
            losses = [-compute_score_m(results, budget_j) for results in episodes]
            optimizer.tell(list(zip(points, losses, strict=True)))
            print(
                f"generation {generation + 1} of {generations}: best {-min(losses):.3f} m",
                flush=True,
            )
        wave = make_wave(optimizer.mean)
        policy = PolicyArrays.make_from_parameters(wave, runner.axes, runner.sizes)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_onnx_file(out, policy, wave, gait_task.FRAME_SKIP, sys.argv)
    return wave


def compute_score_m(episodes: Sequence[EpisodeResult], budget_j: float) -> float:
    """Return the mean advance, less a penalty for energy above the budget."""
    advance_m = np.mean([episode.advance_m for episode in episodes])
    energy_j = np.mean([episode.energy_j for episode in episodes])
    return float(advance_m - PENALTY_M_PER_J * max(energy_j - budget_j, 0.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--budget-j", type=float, required=True, help="mean energy of an episode")
    parser.add_argument("--ticks", type=int, default=200_000, help="control cycles to simulate")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, required=True, help="policy file to write")
    arguments = parser.parse_args()
    wave = tune_serpenoid(arguments.budget_j, arguments.ticks, arguments.seed, arguments.out)
    print({name: round(value, 3) for name, value in wave.items()})
    result = gait_task.measure_policy(str(arguments.out), gait_task.VALIDATION_SEED, 16)
    print(
        f"{arguments.out}: {result.advance_m.mean():.3f} m, {result.energy_j.mean():.1f} J, "
        f"{measure_processor_s():.0f} s of processor time"
    )


if __name__ == "__main__":
    main()
