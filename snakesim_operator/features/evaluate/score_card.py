"""The score card of an evaluation: the results of each controller in each condition, by which code, and comparisons.

Two controllers are compared in pairs of trials that have the same condition and the same seed, and so the same random
scene. McNemar's exact test uses the pairs in which only one of the two reached its goal. Its p values are corrected for
the number of comparisons by Holm's method.
"""

import math
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.scenario import RunConfig, compute_config_hash
from snakesim_operator.features.evaluate.condition_results import (
    ConditionResults,
    group_outcomes_by_condition,
)
from snakesim_operator.features.evaluate.store import OutcomeById
from snakesim_operator.features.evaluate.trial import EvaluationTrial, compute_code_digest
from snakesim_operator.results.metrics.intervals import compute_wilson_interval

CARD_FILENAME = "card.json"


@dataclass(frozen=True)
class CardMetric:
    """A number of the summary whose median is on the card."""

    label: str
    digits: int
    successful_only: bool = False  # of the trials that reached their goal, instead of all trials


CARD_METRICS = {
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
    """Whether one trial reached its goal."""

    controller: str
    condition_name: str
    seed: int
    pairing_hash: str  # equal for trials whose configurations differ in nothing but the controller
    reached_goal: bool


class ControllerScore(msgspec.Struct, frozen=True):
    """The results of one controller in one condition."""

    controller: str
    condition_name: str
    trial_count: int
    success_count: int | None
    success_interval: tuple[float, float]  # 95 %, of the success rate
    medians: dict[str, float | None]  # by the metric; null if no trial has a known value


class ScoreCard(msgspec.Struct, frozen=True, kw_only=True):
    """The file `card.json`."""

    format: Literal["snakesim.score_card/1"] = "snakesim.score_card/1"
    suite: str
    version: str
    code: str  # digest of SnakeSIM's code; a controller's file outside of it does not count
    machine: str
    seeds: list[int]
    scores: list[ControllerScore]
    goal_results: list[GoalResult]


class ControllerComparison(msgspec.Struct, frozen=True, kw_only=True):
    """Two controllers in one condition, on the seeds with which both were tried."""

    condition_name: str
    first_controller: str
    second_controller: str
    pair_count: int
    only_first_count: int  # pairs in which only the first controller reached the goal
    only_second_count: int
    p: float  # corrected for the number of comparisons


def make_card(
    suite: str, trials: Sequence[EvaluationTrial], outcome_by_id: OutcomeById
) -> ScoreCard:
    """Make the score card of an evaluation, with this code and this computer.

    Args:
        suite: Name of the evaluation.
        trials: All trials, in the order of the table.
        outcome_by_id: The outcome of each finished trial by its id.

    Returns:
        The card. Its seeds are those of all trials, its scores and goal results those of the finished ones only.
    """
    goal_results: list[GoalResult] = []
    for trial in trials:
        if trial.id not in outcome_by_id:
            continue
        # None if the trial could not run, or had no goal; for a comparison both count as not reached.
        has_reached_goal = outcome_by_id[trial.id].metrics.get("reached_goal") is True
        goal_results.append(
            GoalResult(
                controller=trial.controller,
                condition_name=trial.condition_name,
                seed=trial.seed,
                pairing_hash=_hash_without_controller(trial),
                reached_goal=has_reached_goal,
            )
        )
    machine = f"{platform.machine()}, {os.cpu_count()} cores, {platform.system()}, Python {platform.python_version()}"
    results = group_outcomes_by_condition(trials, outcome_by_id)
    return ScoreCard(
        suite=suite,
        version=version("snakesim"),
        code=compute_code_digest(),
        machine=machine,
        seeds=sorted({trial.seed for trial in trials}),
        scores=[_make_score(condition_results) for condition_results in results],
        goal_results=goal_results,
    )


def read_card(path: Path) -> ScoreCard:
    """Return the card in a file, or in the folder that holds it. Raises ConfigError."""
    file = path / CARD_FILENAME if path.is_dir() else path
    try:
        return msgspec.json.decode(file.read_bytes(), type=ScoreCard)
    except msgspec.ValidationError as error:
        raise ConfigError(
            f"--against {path}: no score card of this version of SnakeSIM ({error}); "
            "repeat that evaluation with the same seeds, into another folder",
            code="file/not-readable",
        ) from None
    except (OSError, msgspec.DecodeError) as error:
        raise ConfigError(
            f"--against {path}: no score card ({error}); give the folder of an evaluation",
            code="file/not-readable",
        ) from None


def compare_cards(card: ScoreCard, others: Sequence[ScoreCard]) -> list[ControllerComparison]:
    """Compare controllers in each condition, with p values corrected for the number of comparisons.

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


def compute_mcnemar_p(only_first_count: int, only_second_count: int) -> float:
    """Return the two-sided p value of McNemar's exact test.

    It is the probability that the n discordant pairs split as unevenly as this, if neither controller were better:

        p = min(1, 2 * sum over k <= min(only_first_count, only_second_count) of binomial(n, k) / 2^n)

    Source: McNemar (1947), in its exact form by the binomial distribution.
    """
    n = only_first_count + only_second_count
    smaller_count = min(only_first_count, only_second_count)
    tail = sum(math.comb(n, k) for k in range(smaller_count + 1)) / 2**n
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


def format_card(card: ScoreCard, comparisons: Sequence[ControllerComparison]) -> list[str]:
    """Return the card for a terminal: the numbers that the table does not have, and the comparisons."""
    lines = [f"score card: {card.suite}, snakesim {card.version}, code {card.code}, {card.machine}"]
    lines.append(
        f"seeds {card.seeds[0]} to {card.seeds[-1]}; medians, speed and cost of the trials that reached the goal"
    )
    for score in card.scores:
        lines += _format_score(score)
    for comparison in comparisons:
        lines.append(
            f"  {comparison.condition_name}: {comparison.first_controller} against {comparison.second_controller}: "
            f"with {comparison.pair_count} seeds, {comparison.only_first_count} times only the first reached the goal, "
            f"{comparison.only_second_count} times only the second; p = {comparison.p:.2g}"
        )
    if comparisons:
        lines.append(
            f"p: McNemar's exact test, Holm's correction for {len(comparisons)} comparisons"
        )
    return lines


def _format_score(score: ControllerScore) -> list[str]:
    success_text = "no goal"
    if score.success_count is not None:
        low, high = score.success_interval
        success_text = (
            f"{score.success_count}/{score.trial_count} ({100 * low:.0f}-{100 * high:.0f} %)"
        )
    lines = [f"  {score.condition_name}, {score.controller}: {success_text}"]
    for name, metric in CARD_METRICS.items():
        median = score.medians[name]
        median_text = "unknown"
        if median is not None:
            median_text = f"{median:z.{metric.digits}f}"
        lines.append(f"    {metric.label:<48}{median_text}")
    return lines


def _make_score(results: ConditionResults) -> ControllerScore:
    medians = {
        name: _compute_median(results.list_values(name, successful_only=metric.successful_only))
        for name, metric in CARD_METRICS.items()
    }
    return ControllerScore(
        controller=results.controller,
        condition_name=results.condition_name,
        trial_count=results.trial_count,
        success_count=results.success_count,
        success_interval=compute_wilson_interval(results.success_count or 0, results.trial_count),
        medians=medians,
    )


def _compute_median(values: Sequence[float]) -> float | None:
    if not values:
        return None
    return float(np.median(values))


def _hash_without_controller(trial: EvaluationTrial) -> str:
    """Return a hash of a trial's configuration without its controller.

    It is equal for two trials that differ in the controller only, whose results may be compared as a pair.
    """
    config = msgspec.json.decode(trial.config, type=RunConfig)
    return compute_config_hash(msgspec.structs.replace(config, controller="any", controllers={}))


def _list_controllers(card: ScoreCard) -> list[str]:
    """Return the controllers of a card, in the order in which they were tried."""
    return list(dict.fromkeys(result.controller for result in card.goal_results))


def _compare_controllers(
    card: ScoreCard,
    controller: str,
    other_card: ScoreCard,
    other_controller: str,
    *,
    label: str,
) -> list[ControllerComparison]:
    """Compare the success of two controllers in each condition in which both were tried with the same seeds.

    The p values are not corrected for the number of comparisons yet.

    Args:
        card: The score card with the first controller.
        controller: Name of the first controller.
        other_card: The score card with the second controller.
        other_controller: Name of the second controller.
        label: Name under which the second controller is shown.

    Returns:
        One comparison for each condition with pairs of trials, in the order of the first card.
    """
    reached_goal_by_hash: dict[str, bool] = {}  # of the second controller
    for result in other_card.goal_results:
        if result.controller == other_controller:
            reached_goal_by_hash[result.pairing_hash] = result.reached_goal

    # For each pair, whether the first controller reached the goal, and whether the second one did.
    pairs_by_condition: dict[str, list[tuple[bool, bool]]] = {}
    for result in card.goal_results:
        if result.controller == controller and result.pairing_hash in reached_goal_by_hash:
            pair = (result.reached_goal, reached_goal_by_hash[result.pairing_hash])
            pairs_by_condition.setdefault(result.condition_name, []).append(pair)

    comparisons: list[ControllerComparison] = []
    condition_names = dict.fromkeys(result.condition_name for result in card.goal_results)
    for condition_name in condition_names:
        if condition_name not in pairs_by_condition:
            continue
        pairs = pairs_by_condition[condition_name]
        only_first_count = pairs.count((True, False))
        only_second_count = pairs.count((False, True))
        comparisons.append(
            ControllerComparison(
                condition_name=condition_name,
                first_controller=controller,
                second_controller=label,
                pair_count=len(pairs),
                only_first_count=only_first_count,
                only_second_count=only_second_count,
                p=compute_mcnemar_p(only_first_count, only_second_count),
            )
        )
    return comparisons
