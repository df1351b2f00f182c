"""Score cards: controllers are compared on the seeds that both were tried with, and p counts the comparisons."""

from pathlib import Path

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.evaluate.score_card import (
    CARD_FILENAME,
    ScoreCard,
    compare_cards,
    compute_mcnemar_p,
    correct_p_values_by_holm,
    format_card,
    make_card,
    read_card,
)
from snakesim_operator.features.evaluate.suite import EvaluationSuite
from snakesim_operator.features.evaluate.trial import TrialOutcome
from snakesim_operator.features.evaluate.trial_list import make_trials
from snakesim_testing.messages import raises_error

SEED_COUNT = 6


def make_surveyed_card(
    controllers: list[str], first_seed: int, *, only_hold_succeeds: bool, **values: float
) -> ScoreCard:
    """Make the card of an evaluation in which either `hold` reaches every goal, or every other controller does.

    Args:
        controllers: Names of the controllers.
        first_seed: The first of SEED_COUNT seeds.
        only_hold_succeeds: Whether `hold` is the controller that succeeds.
        **values: Values of the configuration, by key.
    """
    suite = EvaluationSuite(scenario="surveyed_clutter", set={"duration_s": 3.0, **values})
    trials = make_trials(suite, "here", controllers, SEED_COUNT, first_seed=first_seed)
    metrics = {"advance_m": 1.0, "advance_m_s": 0.1, "desired_force_error": None}
    outcome_by_id: dict[str, TrialOutcome] = {}
    for trial in trials:
        reached_goal = only_hold_succeeds == (trial.controller == "hold")
        outcome_by_id[trial.id] = TrialOutcome(metrics={**metrics, "reached_goal": reached_goal})
    return make_card("mine", trials, outcome_by_id)


def test_p_values_equal_published_tables() -> None:
    assert compute_mcnemar_p(0, 5) == pytest.approx(0.0625)
    assert compute_mcnemar_p(1, 9) == pytest.approx(22 / 1024)
    assert compute_mcnemar_p(0, 0) == compute_mcnemar_p(3, 3) == 1.0
    assert correct_p_values_by_holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])


def test_cards_pair_trials_by_seed_whatever_the_controller_settings() -> None:
    card = make_surveyed_card(["path_following", "hold"], 1, only_hold_succeeds=True)
    (comparison,) = compare_cards(card, [])
    assert comparison.pair_count == SEED_COUNT
    assert comparison.only_first_count == 0
    assert comparison.only_second_count == SEED_COUNT
    assert comparison.p == pytest.approx(2 / 64)

    # This card has the seeds 4 to 9, so it shares three seeds with the first one.
    look_ahead = {"controllers.path_following.look_ahead_m": 0.05}
    other_card = make_surveyed_card(["hold"], 4, only_hold_succeeds=False, **look_ahead)
    comparisons = compare_cards(card, [other_card])
    assert [comparison.pair_count for comparison in comparisons] == [SEED_COUNT, 3, 3]
    assert comparisons[2].only_first_count == 3
    assert all(
        comparison.p >= compute_mcnemar_p(comparison.only_first_count, comparison.only_second_count)
        for comparison in comparisons
    )
    text = "\n".join(format_card(card, comparisons))
    assert "desired forces: median error                    unknown" in text
    assert "6/6 (61-100 %)" in text


def test_cards_with_another_ground_have_no_pairs() -> None:
    card = make_surveyed_card(["hold"], 1, only_hold_succeeds=True)
    friction = {"scene.ground.friction": 0.3}
    other_card = make_surveyed_card(["hold"], 1, only_hold_succeeds=True, **friction)
    assert not compare_cards(card, [other_card])


def test_card_on_disk_equals_the_written_card(tmp_path: Path) -> None:
    suite = EvaluationSuite(scenario="surveyed_clutter")
    trials = make_trials(suite, "here", ["hold"], 1, first_seed=1)
    outcome = TrialOutcome(metrics={"reached_goal": False})
    card = make_card("mine", trials, {trials[0].id: outcome})
    (tmp_path / CARD_FILENAME).write_bytes(msgspec.json.encode(card))
    assert read_card(tmp_path) == card
    with raises_error(ConfigError, code="file/not-readable"):
        read_card(tmp_path / "nowhere")


def test_card_of_an_older_version_is_refused(tmp_path: Path) -> None:
    older_card = {
        "suite": "mine",
        "version": "0.1.0",
        "code": "5ac9c67d9d0891ef",
        "machine": "x86_64",
        "fields": [1],
        "scores": [],
        "crossings": [],
    }
    (tmp_path / CARD_FILENAME).write_bytes(msgspec.json.encode(older_card))
    with raises_error(ConfigError, code="file/not-readable"):
        read_card(tmp_path)
