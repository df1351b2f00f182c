"""The learning curve: a table, and a figure of it."""

import csv
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from snakesim.training.search import Generation
from snakesim_hal.model.textfiles import exported
from snakesim_operator.features.figures.inherited import PLAIN_TEXT, import_matplotlib


def write_curve(folder: Path, generations: Sequence[Generation]) -> None:
    """`curve.csv` and `curve.png` in a folder."""
    with exported(folder / "curve.csv") as partial, partial.open("x", newline="") as file:
        table = csv.DictWriter(file, list(asdict(generations[0])))
        table.writeheader()
        table.writerows(asdict(one) for one in generations)
    _draw(folder / "curve.png", generations)


def _draw(file: Path, generations: Sequence[Generation]) -> None:
    import_matplotlib()
    from matplotlib import rc_context

    with rc_context(PLAIN_TEXT):
        _draw_plain(file, generations)


def _draw_plain(file: Path, generations: Sequence[Generation]) -> None:
    from matplotlib.figure import Figure  # no window, whatever the display

    figure = Figure(figsize=(6, 3.5), layout="constrained")
    axes = figure.subplots()
    ran = [one.episodes for one in generations]
    axes.plot(ran, [one.best_reward for one in generations], ":", color="0.5", label="best of a generation")
    axes.plot(ran, [one.mean_reward for one in generations], color="0.5", label="mean of a generation")
    checked = [(one.episodes, one.check_reward) for one in generations if one.check_reward is not None]
    axes.plot(*zip(*checked, strict=True), "o-", color="tab:blue", label="mean policy, on other fields")
    axes.set(xlabel="episodes", ylabel="reward of an episode")
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)
    with exported(file) as partial:
        figure.savefig(partial, dpi=120)
