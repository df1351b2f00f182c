"""The text and the record that `snakesim reproduce` writes, and the list of experiments."""

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.reproduce.command import select_experiments
from snakesim_operator.features.reproduce.comparison_text import (
    describe_difference,
    describe_lines,
    describe_ours,
    list_lines,
    make_record,
)
from snakesim_operator.features.reproduce.experiment import (
    DifferenceReason,
    Experiment,
    ExperimentFindings,
    ExperimentPicture,
    PictureCurve,
    PublishedComparison,
    PublishedSource,
)
from snakesim_operator.features.reproduce.experiments import EXPERIMENTS
from snakesim_operator.features.reproduce.trials import ExperimentTrials
from snakesim_testing.messages import raises_error


class SledgeExperiment(Experiment):
    """An experiment with invented figures, which only these tests use."""

    name = "sledge"
    source = PublishedSource(
        authors="A. Author",
        title="On sledges",
        published_in="Journal 1",
        year=1999,
        place="table 2",
        seen="the table",
    )
    claim = "A sledge slides at 2 m/s."
    published_conditions = "Snow."
    our_conditions = "Ice."
    method = "By a stopwatch."

    def run(self, trials: ExperimentTrials) -> ExperimentFindings:
        raise NotImplementedError


SPEED_COMPARISON = PublishedComparison(
    quantity="speed",
    unit="m/s",
    published=2.0,
    basis="printed",
    ours=1.5,
    interval=(1.25, 1.75),
    runs=3,
)
ORDER_COMPARISON = PublishedComparison(
    quantity="order", unit="", published="a, b", basis="printed", ours="a, b", runs=1
)
FINDINGS = ExperimentFindings(
    comparisons=(SPEED_COMPARISON, ORDER_COMPARISON),
    reasons=(
        DifferenceReason(cause="Ice is smooth.", effect=-0.00004, unit="m/s"),
        DifferenceReason(cause="The wind."),
    ),
    picture=ExperimentPicture(
        x_label="x",
        y_label="y",
        curves=(PictureCurve(label="ours", x=[1.0], y=[2.0], is_ours=True),),
    ),
    notes=("A note.",),
)


def test_comparison_text_contains_source_numbers_and_reasons() -> None:
    assert list(describe_lines(SledgeExperiment(), FINDINGS)) == [
        "sledge",
        "source        A. Author: On sledges. Journal 1, 1999: table 2",
        "seen          the table",
        "claim         A sledge slides at 2 m/s.",
        "conditions    Published: Snow.",
        "              Ours: Ice.",
        "method        By a stopwatch.",
        "              The gait has no feedback, so that every seed gives the same motion.",
        "",
        "speed [m/s]",
        "  published     2 (printed in the source)",
        "  ours          1.5, 95 % interval 1.25 to 1.75 (3 runs)",
        "  difference    -0.5 (-25.0 %)",
        "",
        "order",
        "  published     a, b (printed in the source)",
        "  ours          a, b (1 run)",
        "  difference    none: both are the same",
        "",
        "why they differ",
        "  -0.00004 m/s  Ice is smooth.",
        "  unknown       The wind.",
        "",
        "A note.",
    ]


def test_comparison_of_different_texts_reports_difference() -> None:
    comparison = PublishedComparison(
        quantity="order", unit="", published="a", basis="printed", ours="b", runs=2
    )
    assert describe_difference(comparison) == "they are not the same"
    assert describe_ours(comparison) == "b (2 runs)"


def test_comparison_record_for_scripts_contains_all_numbers() -> None:
    record = msgspec.json.decode(msgspec.json.encode(make_record(SledgeExperiment(), FINDINGS)))
    assert record["name"] == "sledge"
    assert record["source"]["place"] == "table 2"
    assert record["comparisons"][0]["interval"] == [1.25, 1.75]
    assert record["comparisons"][0]["difference"] == -0.5
    assert record["comparisons"][1]["agrees"] is True
    assert record["reasons"][1] == {"cause": "The wind.", "effect": None, "unit": ""}


def test_every_experiment_states_its_source_and_conditions() -> None:
    assert len(EXPERIMENTS) >= 6
    for name, experiment in EXPERIMENTS.items():
        assert experiment.name == name
        source = experiment.source
        sentences = [
            experiment.claim,
            experiment.published_conditions,
            experiment.our_conditions,
            experiment.method,
            source.seen,
        ]
        assert all(sentence.endswith(".") for sentence in sentences), name
        assert all((source.authors, source.title, source.place)), name
        assert 1900 < source.year < 2100, name


def test_experiment_list_has_name_and_year_of_each() -> None:
    lines = list(list_lines(list(EXPERIMENTS.values())))
    assert [line.split()[:2] for line in lines] == [
        [experiment.name, str(experiment.source.year)] for experiment in EXPERIMENTS.values()
    ]


def test_experiment_selection_has_each_once_or_all() -> None:
    names = list(EXPERIMENTS)
    selected = select_experiments([names[2], names[0], names[2]])
    assert [experiment.name for experiment in selected] == [names[2], names[0]]
    assert [experiment.name for experiment in select_experiments(["all"])] == names


@pytest.mark.parametrize("names", [[], ["hu-slithring"]])
def test_experiment_selection_without_or_with_unknown_name_is_refused(names: list[str]) -> None:
    with raises_error(ConfigError, code="command/invalid-option", field="reproduce"):
        select_experiments(names)
