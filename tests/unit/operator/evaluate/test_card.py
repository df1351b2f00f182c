"""Score cards: controllers are compared on the fields that both were tried on, and p counts the comparisons."""

from pathlib import Path

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.evaluate.card import (
    CARD_FILENAME,
    compare_cards,
    compute_mcnemar_p,
    correct_p_values_by_holm,
    format_card,
    make_card,
    read_card,
)
from snakesim_operator.features.evaluate.case import CaseOutcome
from snakesim_operator.features.evaluate.suite import EvaluationSuite, make_cases
from snakesim_testing.messages import raises_error


def test_card_p_value_equals_tables() -> None:
    assert compute_mcnemar_p(0, 5) == pytest.approx(0.0625)
    assert compute_mcnemar_p(1, 9) == pytest.approx(22 / 1024)
    assert compute_mcnemar_p(0, 0) == compute_mcnemar_p(3, 3) == 1.0
    assert correct_p_values_by_holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])


def test_cards_pair_by_field_whatever_the_controller_and_its_settings() -> None:
    numbers = {"advance_m": 1.0, "advance_m_s": 0.1, "desired_force_error": None}

    def card(controllers: list[str], seed: int, crosses: bool, **more: float):
        suite = EvaluationSuite(scenario="surveyed_clutter", set={"duration_s": 3.0, **more})
        cases = make_cases(suite, "here", controllers, 6, first_field=seed)
        done = {
            case.id: CaseOutcome(
                numbers={**numbers, "reached_goal": crosses == (case.controller == "hold")}
            )
            for case in cases
        }
        return make_card("mine", cases, done)

    ours = card(["path_following", "hold"], 1, crosses=True)  # hold crosses all six, the other none
    (paired,) = compare_cards(ours, [])
    assert paired.fields == 6
    assert paired.only_one == 0
    assert paired.only_other == 6
    assert paired.p == pytest.approx(2 / 64)
    # Fields 4 to 9: three are shared.
    other = card(["hold"], 4, crosses=False, **{"controllers.path_following.look_ahead_m": 0.05})
    pairs = compare_cards(ours, [other])
    assert [one.fields for one in pairs] == [6, 3, 3]
    assert pairs[2].only_one == 3
    assert all(one.p >= compute_mcnemar_p(one.only_one, one.only_other) for one in pairs)
    assert not compare_cards(
        card(["hold"], 1, crosses=True),
        [card(["hold"], 1, crosses=True, **{"scene.ground.friction": 0.3})],
    )
    said = "\n".join(format_card(ours, pairs))
    assert "desired forces: median error                    unknown" in said
    assert "6/6 (61-100 %)" in said


def test_a_card_on_disk_is_the_card(tmp_path: Path) -> None:
    suite = EvaluationSuite(scenario="surveyed_clutter")
    cases = make_cases(suite, "here", ["hold"], 1, first_field=1)
    card = make_card("mine", cases, {cases[0].id: CaseOutcome(numbers={"reached_goal": False})})
    (tmp_path / CARD_FILENAME).write_bytes(msgspec.json.encode(card))
    assert read_card(tmp_path) == card
    with raises_error(ConfigError, code="file/not-readable"):
        read_card(tmp_path / "nowhere")
