"""The score card of an evaluation: what each controller did in each row, by what code, and how it compares with others.

A field is a random scene with its number. A row is a setting of the suite: one value of a varied key, with the scenario
and all other keys. "Crossed" means that a run reached its goal.

Two controllers are compared on the same fields only, by McNemar's exact test. Its p values are corrected for the number
of comparisons by Holm's method.
"""

import math
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import RunConfig, compute_config_hash
from snakesim_operator.features.evaluate.case import EvaluationCase, compute_code_digest
from snakesim_operator.features.evaluate.store import Results
from snakesim_operator.features.evaluate.table import (
    ResultRow,
    compute_wilson_interval,
    group_results_by_row,
)

CARD_FILENAME = "card.json"


@dataclass(frozen=True)
class CardMetric:
    """A number of the summary whose median is on the card."""

    label: str
    digits: int
    successful_only: bool = False  # of the runs that reached their goal, instead of all runs


METRICS = {
    "advance_m_s": CardMetric("speed, m/s", 3, successful_only=True),
    "body_lengths_s": CardMetric("speed, body lengths/s", 3, successful_only=True),
    "energy_j_per_m": CardMetric("energy, J/m", 1, successful_only=True),
    "cost_of_transport": CardMetric("cost of transport", 3, successful_only=True),
    "propulsive_efficiency": CardMetric("propulsive efficiency", 3, successful_only=True),
    "displacement_m_s": CardMetric("net displacement: speed, m/s", 3),
    "displacement_energy_j_per_m": CardMetric("net displacement: energy, J/m", 1),
    "displacement_cost_of_transport": CardMetric("net displacement: cost of transport", 3),
    "displacement_efficiency": CardMetric("net displacement: efficiency", 3),
    "displacement_slip": CardMetric("slip along the path", 3),
    "lateral_slip": CardMetric("lateral slip", 3),
    "jam_ratio": CardMetric("jam ratio", 3),
    "impulse_n_s_per_m": CardMetric("contact impulse, N·s/m", 1, successful_only=True),
    "torque_headroom": CardMetric("torque headroom", 2),
    "form_closure": CardMetric("form closure, fraction of time", 3),
    "planning_fraction": CardMetric("planning, fraction of cycles", 2),
    "desired_force_correlation": CardMetric("desired forces: correlation with measured", 2),
    "desired_force_error": CardMetric("desired forces: median error", 2),
    "empty_push_points": CardMetric("desired forces: push-points without contact", 2),
}


class GoalResult(msgspec.Struct, frozen=True):
    """One run: whether it reached its goal."""

    controller: str
    row: str
    field: int
    same: str  # hash of the configuration without its controller: equal for runs of two controllers that may be paired
    reached_goal: bool


class ControllerScore(msgspec.Struct, frozen=True):
    """One row with one controller."""

    controller: str
    row: str
    runs: int
    success_count: int | None
    interval: tuple[float, float]  # 95 %, of the success rate
    medians: dict[str, float | None]  # by the metric; null: no run knows it


class EvaluationCard(msgspec.Struct, frozen=True):
    """The file `card.json`."""

    suite: str
    version: str
    code: str  # digest of SnakeSIM's code; a controller's file outside of it does not count
    machine: str
    fields: list[int]
    scores: list[ControllerScore]
    crossings: list[GoalResult]


class ControllerComparison(msgspec.Struct, frozen=True):
    """Two controllers on the fields of one row that both were tried on."""

    row: str
    one: str
    other: str
    fields: int
    only_one: int  # fields that in which only the first controller reached the goal
    only_other: int
    p: float  # corrected for the number of comparisons


def make_card(
    suite: str, cases: Sequence[EvaluationCase], outcome_by_id: Results
) -> EvaluationCard:
    """Make the score card of an evaluation, with this code and this computer.

    Args:
        suite: Name of the evaluation.
        cases: All cases, in the order of the table.
        outcome_by_id: The outcome of each finished case by its id.

    Returns:
        The card. Its fields are those of all cases, its scores and goal results those of the finished ones only.
    """
    goal_results: list[GoalResult] = []
    for case in cases:
        if case.id in outcome_by_id:
            # None if the case could not run, or had no goal; for a comparison both count as not reached.
            has_reached_goal = outcome_by_id[case.id].numbers.get("reached_goal") is True
            goal_results.append(
                GoalResult(
                    controller=case.controller,
                    row=case.setting,
                    field=case.field,
                    same=_hash_without_controller(case),
                    reached_goal=has_reached_goal,
                )
            )
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
    return EvaluationCard(
        suite=suite,
        version=version("snakesim"),
        code=compute_code_digest(),
        machine=machine,
        fields=sorted({case.field for case in cases}),
        scores=[_make_score(row) for row in group_results_by_row(cases, outcome_by_id)],
        crossings=goal_results,
    )


def read_card(path: Path) -> EvaluationCard:
    """Return the card in a file, or in the folder that holds it. Raises ConfigError."""
    file = path / CARD_FILENAME if path.is_dir() else path
    try:
        return msgspec.json.decode(file.read_bytes(), type=EvaluationCard)
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(
            f"--against {path}: no score card ({error}); give the folder of an evaluation",
            code="file/not-readable",
        ) from None


def compare_cards(
    card: EvaluationCard, others: Sequence[EvaluationCard]
) -> list[ControllerComparison]:
    """Compare controllers row by row, with p values corrected for the number of comparisons.

    The first controller of the card is compared with each of its other controllers. Then each of its controllers is
    compared with each controller of the other cards.

    Args:
        card: The score card of this evaluation.
        others: Score cards of other evaluations.
    """
    names = _list_controllers(card)
    comparisons: list[ControllerComparison] = []
    for name in names[1:]:
        comparisons += _compare_controllers(card, names[0], card, name, label=name)
    for other in others:
        for name in names:
            for other_name in _list_controllers(other):
                label = f"{other_name} ({other.version}, {other.code})"
                comparisons += _compare_controllers(card, name, other, other_name, label=label)
    corrected = correct_p_values_by_holm([comparison.p for comparison in comparisons])
    return [
        msgspec.structs.replace(comparison, p=p)
        for comparison, p in zip(comparisons, corrected, strict=True)
    ]


def compute_mcnemar_p(only_one: int, only_other: int) -> float:
    """Return the two-sided p value of McNemar's exact test.

    It is the probability that the n discordant fields split as unevenly as this, if neither controller were better:

        p = min(1, 2 * sum over k <= min(only_one, only_other) of binomial(n, k) / 2^n)

    Source: McNemar (1947), in its exact form by the binomial distribution.
    """
    n = only_one + only_other
    tail = sum(math.comb(n, k) for k in range(min(only_one, only_other) + 1)) / 2**n
    return min(2 * tail, 1.0)


def correct_p_values_by_holm(p_values: Sequence[float]) -> list[float]:
    """Return p values corrected for their number m: of the k-th smallest, the maximum over i <= k of (m - i + 1) p_i.

    Source: Holm (1979), "A simple sequentially rejective multiple test procedure".
    """
    count = len(p_values)
    corrected = [0.0] * count
    running_max = 0.0
    indices_by_p = sorted(range(count), key=lambda i: p_values[i])
    for rank, i in enumerate(indices_by_p):
        running_max = max(running_max, min((count - rank) * p_values[i], 1.0))
        corrected[i] = running_max
    return corrected


def format_card(card: EvaluationCard, comparisons: Sequence[ControllerComparison]) -> list[str]:
    """Return the card for a terminal: the numbers that the table does not have, and the comparisons."""
    lines = [f"score card: {card.suite}, snakesim {card.version}, code {card.code}, {card.machine}"]
    lines.append(
        f"fields {card.fields[0]} to {card.fields[-1]}; medians, speed and cost of the runs that reached the goal"
    )
    for score in card.scores:
        lines += _format_score(score)
    for comparison in comparisons:
        counts = (
            f"{comparison.only_one} fields only by the first, {comparison.only_other} only by the second, "
            f"of {comparison.fields}"
        )
        lines.append(
            f"  {comparison.row}: {comparison.one} against {comparison.other}: {counts}; p = {comparison.p:.2g}"
        )
    if comparisons:
        lines.append(
            f"p: McNemar's exact test, Holm's correction for {len(comparisons)} comparisons"
        )
    return lines


def _format_score(score: ControllerScore) -> list[str]:
    success_text = "no goal"
    if score.success_count is not None:
        low, high = score.interval
        success_text = f"{score.success_count}/{score.runs} ({100 * low:.0f}-{100 * high:.0f} %)"
    lines = [f"  {score.row}, {score.controller}: {success_text}"]
    for key, metric in METRICS.items():
        median = score.medians[key]
        shown = "unknown"
        if median is not None:
            shown = f"{median:z.{metric.digits}f}"
        lines.append(f"    {metric.label:<48}{shown}")
    return lines


def _make_score(row: ResultRow) -> ControllerScore:
    medians = {
        key: _compute_median(row.list_values(key, successful_only=metric.successful_only))
        for key, metric in METRICS.items()
    }
    return ControllerScore(
        controller=row.controller,
        row=row.setting,
        runs=row.runs,
        success_count=row.success_count,
        interval=compute_wilson_interval(row.success_count or 0, row.runs),
        medians=medians,
    )


def _compute_median(values: Sequence[float]) -> float | None:
    if not values:
        return None
    return float(np.median(values))


def _hash_without_controller(case: EvaluationCase) -> str:
    """Return a hash of a case's configuration without its controller.

    It is equal for two cases that differ in the controller only, whose results may be compared as a pair.
    """
    config = msgspec.json.decode(case.config, type=RunConfig)
    return compute_config_hash(msgspec.structs.replace(config, controller="any", controllers={}))


def _list_controllers(card: EvaluationCard) -> list[str]:
    """Return the controllers of a card, in the order in which they were tried."""
    return list(dict.fromkeys(crossing.controller for crossing in card.crossings))


def _compare_controllers(
    card: EvaluationCard,
    controller: str,
    other: EvaluationCard,
    other_controller: str,
    *,
    label: str,
) -> list[ControllerComparison]:
    """Compare the success of two controllers in each row in which both were tried on the same fields.

    McNemar's test of paired outcomes: only fields count in which exactly one of the controllers reached the goal. The
    p-values are not corrected for multiple comparisons yet.

    Args:
        card: The score card with the first controller.
        controller: Name of the first controller.
        other: The score card with the second controller.
        other_controller: Name of the second controller.
        label: Name under which the second controller is shown.

    Returns:
        One comparison for each row with shared fields, in the order of the first card.
    """
    # Configuration without its controller -> whether it reached the goal.
    has_reached_goal_by_config: dict[str, bool] = {}
    for crossing in other.crossings:
        if crossing.controller == other_controller:
            has_reached_goal_by_config[crossing.same] = crossing.reached_goal

    # (first, second) reached the goal, for each shared field.
    pairs_by_row: dict[str, list[tuple[bool, bool]]] = {}
    for crossing in card.crossings:
        if crossing.controller == controller and crossing.same in has_reached_goal_by_config:
            pair = (crossing.reached_goal, has_reached_goal_by_config[crossing.same])
            pairs_by_row.setdefault(crossing.row, []).append(pair)

    comparisons: list[ControllerComparison] = []
    rows_in_order = dict.fromkeys(crossing.row for crossing in card.crossings)
    for row in rows_in_order:
        if row not in pairs_by_row:
            continue
        pairs = pairs_by_row[row]
        only_first = pairs.count((True, False))
        only_second = pairs.count((False, True))
        p = compute_mcnemar_p(only_first, only_second)
        comparisons.append(
            ControllerComparison(row, controller, label, len(pairs), only_first, only_second, p)
        )
    return comparisons
