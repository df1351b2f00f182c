"""Writes the learning curve of a search: a table, and a figure of it."""

import csv
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from snakesim.training.search import Generation
from snakesim_hal.model.textfiles import exported
from snakesim_operator.features.figures.inherited import PLAIN_TEXT, import_matplotlib


def write_curve(folder: Path, generations: Sequence[Generation]) -> None:
    """Write `curve.csv` and `curve.png` into a folder."""
    with exported(folder / "curve.csv") as partial, partial.open("x", newline="") as file:
        table = csv.DictWriter(file, list(asdict(generations[0])))
        table.writeheader()
        table.writerows(asdict(generation) for generation in generations)
    _write_figure(folder / "curve.png", generations)


def _write_figure(file: Path, generations: Sequence[Generation]) -> None:
    import_matplotlib()
    from matplotlib import rc_context

    with rc_context(PLAIN_TEXT):
        _draw_curve(file, generations)


def _draw_curve(file: Path, generations: Sequence[Generation]) -> None:
    """Draw rewards over episodes: of each population, and of the mean policy where it was checked."""
    from matplotlib.figure import Figure  # needs no window, whatever the display

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
    axes.plot(checked_episodes, check_rewards, "o-", color="tab:blue", label="mean policy, on other fields")
    axes.set(xlabel="episodes", ylabel="reward of an episode")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, fontsize=8)
    with exported(file) as partial:
        figure.savefig(partial, dpi=120)
