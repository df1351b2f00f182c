"""The score card of an evaluation: what each controller did in each row, by what code, and how it pairs with others.

Two controllers are compared on the same fields only (McNemar's exact test of the fields that one crossed and the other
did not), and p is corrected for how many comparisons there are (Holm).
"""

import math
import os
import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import RunConfig, config_hash
from snakesim_operator.features.evaluate.case import Case, code_digest
from snakesim_operator.features.evaluate.store import Results
from snakesim_operator.features.evaluate.table import Line, lines_of, wilson

CARD = "card.json"
OF_CROSSED, OF_ALL = True, False
METRICS = {  # number of the summary -> its name, digits, and of which runs the median is
    "advance_m_s": ("speed, m/s", 3, OF_CROSSED),
    "body_lengths_s": ("speed, body lengths/s", 3, OF_CROSSED),
    "energy_j_per_m": ("energy, J/m", 1, OF_CROSSED),
    "cost_of_transport": ("cost of transport", 3, OF_CROSSED),
    "propulsive_efficiency": ("propulsive efficiency", 3, OF_CROSSED),
    "jam_ratio": ("jam ratio", 3, OF_ALL),
    "impulse_n_s_per_m": ("contact impulse, N·s/m", 1, OF_CROSSED),
    "torque_headroom": ("torque headroom", 2, OF_ALL),
    "form_closure": ("form closure, share of time", 3, OF_ALL),
    "planning_fraction": ("planning, share of turns", 2, OF_ALL),
    "desired_force_correlation": ("solved forces: correlation with measured", 2, OF_ALL),
    "desired_force_error": ("solved forces: median error", 2, OF_ALL),
    "empty_push_points": ("solved forces: push-points that carried nothing", 2, OF_ALL),
}


class Crossing(msgspec.Struct, frozen=True):
    """One run: whether it crossed, and what names its field whatever the controller."""

    controller: str
    row: str
    field: int
    same: str
    crossed: bool


class Score(msgspec.Struct, frozen=True):
    """One row with one controller; a metric that no run knows is null."""

    controller: str
    row: str
    runs: int
    crossed: int | None
    interval: tuple[float, float]  # 95 %
    medians: dict[str, float | None]


class Card(msgspec.Struct, frozen=True):
    """The file `card.json`."""

    suite: str
    version: str
    code: str  # digest of SnakeSIM's code; a controller's file outside of it is not looked at
    machine: str
    fields: list[int]
    scores: list[Score]
    crossings: list[Crossing]


class Paired(msgspec.Struct, frozen=True):
    """Two controllers on the fields of one row that both were tried on."""

    row: str
    one: str
    other: str
    fields: int
    only_one: int  # crossed
    only_other: int
    p: float  # corrected


def card_of(suite: str, cases: Sequence[Case], done: Results) -> Card:
    """Of all cases that are done."""
    crossings = [
        Crossing(case.controller, case.setting, case.field, _same(case), done[case.id].numbers.get("crossed") is True)
        for case in cases
        if case.id in done
    ]
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
    fields = sorted({case.field for case in cases})
    scores = [_score(line) for line in lines_of(cases, done)]
    return Card(suite, version("snakesim"), code_digest(), machine, fields, scores, crossings)


def read_card(path: Path) -> Card:
    """A card, or the folder that holds it. Raises ConfigError."""
    file = path / CARD if path.is_dir() else path
    try:
        return msgspec.json.decode(file.read_bytes(), type=Card)
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(f"--against {path}: no score card ({error}); give the folder of an evaluation") from None


def compare(card: Card, others: Sequence[Card]) -> list[Paired]:
    """Its first controller with each other one, then each of its with those of other cards, row by row."""
    names = list(dict.fromkeys(one.controller for one in card.crossings))
    found = [paired for name in names[1:] for paired in _paired(card, names[0], card, name, name)]
    for other in others:
        for name in names:
            for theirs in dict.fromkeys(one.controller for one in other.crossings):
                found += _paired(card, name, other, theirs, f"{theirs} ({other.version}, {other.code})")
    return [msgspec.structs.replace(one, p=p) for one, p in zip(found, holm([one.p for one in found]), strict=True)]


def mcnemar(only_one: int, only_other: int) -> float:
    """Exact, two-sided: p of as uneven a split of the fields on which they differ, if neither were better."""
    differ = only_one + only_other
    tail = sum(math.comb(differ, k) for k in range(min(only_one, only_other) + 1)) / 2**differ
    return min(2 * tail, 1.0)


def holm(values: Sequence[float]) -> list[float]:
    """p of each, corrected for how many there are (Holm 1979)."""
    corrected, highest = [0.0] * len(values), 0.0
    for rank, i in enumerate(sorted(range(len(values)), key=lambda i: values[i])):
        highest = max(highest, min((len(values) - rank) * values[i], 1.0))
        corrected[i] = highest
    return corrected


def text(card: Card, pairs: Sequence[Paired]) -> list[str]:
    """For a terminal: the numbers that the table does not have, and the pairs."""
    found = [f"score card: {card.suite}, snakesim {card.version}, code {card.code}, {card.machine}"]
    found.append(f"fields {card.fields[0]} to {card.fields[-1]}; medians, speed and cost of the runs that crossed")
    for score in card.scores:
        low, high = (100 * end for end in score.interval)
        crossed = "no goal" if score.crossed is None else f"{score.crossed}/{score.runs} ({low:.0f}-{high:.0f} %)"
        found.append(f"  {score.row}, {score.controller}: {crossed}")
        for key, (name, digits, _) in METRICS.items():
            value = score.medians[key]
            found.append(f"    {name:<48}{'unknown' if value is None else f'{value:z.{digits}f}'}")
    for one in pairs:
        words = f"{one.only_one} fields only by the first, {one.only_other} only by the second, of {one.fields}"
        found.append(f"  {one.row}: {one.one} against {one.other}: {words}; p = {one.p:.2g}")
    if pairs:
        found.append(f"p: McNemar's exact test, Holm's correction for {len(pairs)} comparisons")
    return found


def _score(line: Line) -> Score:
    medians = {key: _median(line.values(key, of_crossed=which)) for key, (_, _, which) in METRICS.items()}
    return Score(line.controller, line.setting, line.runs, line.crossed, wilson(line.crossed or 0, line.runs), medians)


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _same(case: Case) -> str:
    config = msgspec.json.decode(case.config, type=RunConfig)
    return config_hash(msgspec.structs.replace(config, controller="any", controllers={}))


def _paired(card: Card, one: str, other: Card, name: str, called: str) -> list[Paired]:
    theirs = {crossing.same: crossing.crossed for crossing in other.crossings if crossing.controller == name}
    found: list[Paired] = []
    for row in dict.fromkeys(crossing.row for crossing in card.crossings):
        both = [
            (crossing.crossed, theirs[crossing.same])
            for crossing in card.crossings
            if (crossing.controller, crossing.row) == (one, row) and crossing.same in theirs
        ]
        if both:
            ours_only, theirs_only = both.count((True, False)), both.count((False, True))
            p = mcnemar(ours_only, theirs_only)
            found.append(Paired(row, one, called, len(both), ours_only, theirs_only, p))
    return found
