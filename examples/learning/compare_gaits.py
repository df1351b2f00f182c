"""Compare a learned gait with a serpenoid that is tuned for the same energy, on seeds that no search has used.

    python examples/learning/compare_gaits.py --policy runs/gait/ppo/policy.onnx --ticks 705600 \
        --out runs/gait/serpenoid.onnx

First, the energy of the policy is measured on the validation seeds. The serpenoid is then tuned for the farthest
advance whose mean energy stays within this budget. At last, both run on the test seeds.
"""

import argparse
from pathlib import Path

import gait_task

# isort: split
import numpy as np
from gait_task import Floats, GaitResult
from tune_serpenoid import tune_serpenoid

RESAMPLES = 10_000
SEARCH_SEED = 2
BUDGET_EPISODES = 16


def compute_interval(values: Floats) -> tuple[float, float]:
    """Return the 95 % confidence interval of a mean, by bootstrap."""
    rng = np.random.default_rng(0)
    means = rng.choice(values, (RESAMPLES, len(values))).mean(axis=1)
    low, high = np.percentile(means, [2.5, 97.5])
    return float(low), float(high)


def describe(name: str, values: Floats, unit: str) -> str:
    """Return a mean with its confidence interval, for the terminal."""
    low, high = compute_interval(values)
    return f"{name}: {values.mean():.3f} {unit} (95 %: {low:.3f} to {high:.3f})"


def print_result(name: str, result: GaitResult) -> None:
    """Print what a gait reached."""
    print(name)
    print("  " + describe("advance", result.advance_m, "m"))
    print("  " + describe("energy", result.energy_j, "J"))
    print("  " + describe("energy per meter", result.energy_j / result.advance_m, "J/m"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", required=True, help="policy file of learn_gait_ppo.py")
    parser.add_argument("--ticks", type=int, required=True, help="control cycles of the tuning")
    parser.add_argument("--episodes", type=int, default=32, help="test episodes of each gait")
    parser.add_argument("--out", type=Path, required=True, help="policy file of the serpenoid")
    arguments = parser.parse_args()

    validation = gait_task.measure_policy(
        arguments.policy, gait_task.VALIDATION_SEED, BUDGET_EPISODES
    )
    budget_j = float(validation.energy_j.mean())
    print(f"energy budget of the serpenoid: {budget_j:.1f} J")
    wave = tune_serpenoid(budget_j, arguments.ticks, SEARCH_SEED, arguments.out)
    print({name: round(value, 3) for name, value in wave.items()})

    learned = gait_task.measure_policy(arguments.policy, gait_task.TEST_SEED, arguments.episodes)
    tuned = gait_task.measure_policy(str(arguments.out), gait_task.TEST_SEED, arguments.episodes)
    print_result("learned gait", learned)
    print_result("tuned serpenoid", tuned)
    print(describe("learned minus tuned, same seeds", learned.advance_m - tuned.advance_m, "m"))


if __name__ == "__main__":
    main()
