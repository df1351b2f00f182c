"""Writes the learning curve of a search: a table, and a figure of it."""

import csv
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from snakesim.training.search import SearchGeneration
from snakesim_hal.model.textfiles import export_atomically
from snakesim_operator.features.figures.inherited import PLAIN_TEXT_STYLE, import_matplotlib


def write_curve(folder: Path, generations: Sequence[SearchGeneration]) -> None:
    """Write `curve.csv` and `curve.png` into a folder."""
    with export_atomically(folder / "curve.csv") as partial, partial.open("x", newline="") as file:
        table = csv.DictWriter(file, list(asdict(generations[0])))
        table.writeheader()
        table.writerows(asdict(generation) for generation in generations)
    _write_figure(folder / "curve.png", generations)


def _write_figure(path: Path, generations: Sequence[SearchGeneration]) -> None:
    """Draw the learning curve into a file, with the text style of all figures."""
    import_matplotlib()
    from matplotlib import rc_context

    with rc_context(PLAIN_TEXT_STYLE):
        _draw_curve(path, generations)


def _draw_curve(path: Path, generations: Sequence[SearchGeneration]) -> None:
    """Draw the learning curve into a file: rewards over the number of episodes.

    The curves are the mean and the best reward of each generation, and the rewards of the mean policy with the check
    seeds.

    Args:
        path: Path of the picture to write.
        generations: Rows of the learning curve.
    """
    from matplotlib.figure import Figure  # unlike pyplot, this works without a display

    episodes = [generation.episodes for generation in generations]
    best_rewards = [generation.best_reward for generation in generations]
    mean_rewards = [generation.mean_reward for generation in generations]
    checked_episodes: list[int] = []
    check_rewards: list[float] = []
    for generation in generations:
        if generation.check_reward is not None:
            checked_episodes.append(generation.episodes)
            check_rewards.append(generation.check_reward)

    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    axes.plot(episodes, best_rewards, ":", color="0.5", label="best of a generation")
    axes.plot(episodes, mean_rewards, color="0.5", label="mean of a generation")
    axes.plot(
        checked_episodes,
        check_rewards,
        "o-",
        color="tab:blue",
        label="mean policy, with other seeds",
    )
    axes.set(xlabel="episodes", ylabel="reward of an episode")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize=8)
    with export_atomically(path) as partial:
        figure.savefig(partial, dpi=120)
