"""A search goes on with its own file only, and what it prints is of that search."""

import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import optuna
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import resolve_file_path
from snakesim_hal.model.textfiles import read_text
from snakesim_operator.features.evaluate import optimize as search
from snakesim_operator.features.evaluate.case import CaseOutcome, EvaluationCase
from snakesim_operator.features.evaluate.optimize import SearchRequest, run_optimization
from snakesim_testing.messages import raises_error

PROPULSION = "control.propulsion_n"
FIRST = {
    "scenario": "triplet",
    "vary": [f"{PROPULSION}=5:40"],
    "set": ["duration_s=2"],
    "goal": "path_distance_m",
    "minimize": False,
    "trials": 2,
    "seeds": 1,
    "seed": 1,
}


@pytest.fixture(autouse=True, scope="module")
def quick_runs() -> Iterator[None]:
    """Every run has a result at once: its propulsion, and something for its seed."""

    class InstantWorkers:
        def count_workers(self) -> int:
            return 2

        def run_cases(
            self, cases: Sequence[EvaluationCase]
        ) -> Iterator[tuple[EvaluationCase, CaseOutcome]]:
            for case in cases:
                config = msgspec.json.decode(case.config)
                value = (
                    config["controllers"]["obstacle_triplet"]["propulsion_n"] + 100 * config["seed"]
                )
                yield case, CaseOutcome(numbers={"path_distance_m": value, "advance_m": value})

    @contextmanager
    def instant_workers(*_arguments: Any) -> Iterator[InstantWorkers]:
        yield InstantWorkers()

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(search, "start_workers", instant_workers)
        yield


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the first search."""
    storage = tmp_path_factory.mktemp("kept") / "search.db"
    searched(storage)
    return storage


def searched(storage: Path, **other: Any) -> None:
    assert run_optimization(SearchRequest(**{**FIRST, **other, "storage": storage})) == 0


def printed(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(
    "other",
    [
        {"minimize": True},
        {"goal": "advance_m"},
        {"set": ["duration_s=3"]},
        {"set": []},
        {"vary": [f"{PROPULSION}=5:20"]},
        {"vary": [f"{PROPULSION}=5.0:40.0"]},
        {"seeds": 2},
        {"seed": 7},
        {"scenario": "peg_row"},
    ],
)
def test_another_search_is_refused_with_every_difference(kept: Path, other: dict[str, Any]) -> None:
    before = kept.read_bytes()
    with raises_error(ConfigError, code="evaluation/other-search", field=f"--storage {kept}"):
        searched(kept, **other)
    assert kept.read_bytes() == before


def test_a_scenario_file_that_has_changed_is_another_search(tmp_path: Path) -> None:
    scenario = tmp_path / "own.toml"
    text = read_text(resolve_file_path("triplet", "scenarios"))
    scenario.write_text(text)
    searched(tmp_path / "search.db", scenario=str(scenario))
    assert "rate_hz = 100" in text
    scenario.write_text(text.replace("rate_hz = 100", "rate_hz = 50"))
    with raises_error(ConfigError, code="evaluation/other-search"):
        searched(tmp_path / "search.db", scenario=str(scenario))


def test_search_file_of_unknown_search_stays_unchanged(tmp_path: Path) -> None:
    storage = tmp_path / "search.db"
    study = optuna.create_study(
        storage=f"sqlite:///{storage}", study_name="triplet path_distance_m"
    )
    study.add_trial(optuna.trial.create_trial(value=1.0))
    with raises_error(ConfigError, code="evaluation/other-search"):
        searched(storage)
    assert len(study.get_trials()) == 1


@pytest.mark.parametrize("name", ["a?b 50%20.db", "{x}#&ä.db"])
def test_search_accepts_any_file_name(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    searched(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    printed(capsys)
    searched(tmp_path / name, trials=3)
    assert "holds 2 trials already" in printed(capsys)[0]


@pytest.mark.parametrize("what", ["text", "folder"])
def test_search_invalid_request_is_named(tmp_path: Path, what: str) -> None:
    storage = tmp_path / "search.db"
    storage.mkdir() if what == "folder" else storage.write_text("mine\n" * 1000)
    with raises_error(ConfigError, code="file/not-writable", field="search.db"):
        searched(storage)


def test_search_trials_are_numbered_from_one_to_requested_count(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also after a kill, which leaves trials without a result."""
    storage = tmp_path / "search.db"
    searched(storage)
    study = optuna.load_study(study_name=None, storage=f"sqlite:///{storage}")
    study.ask({PROPULSION: optuna.distributions.IntDistribution(5, 40)})
    searched(storage, trials=5)
    lines = printed(capsys)
    numbers = [int(line.split()[1].strip(":")) for line in lines if line.startswith("trial ")]
    assert numbers == list(range(1, 6))
    best = next(line for line in lines[::-1] if line.startswith("best "))
    value, _, number = best.removeprefix("best path_distance_m: ").partition(", trial ")
    assert any(
        line.startswith(f"trial {number}:") and line.endswith(f": {value}") for line in lines
    )


def test_search_printout_for_several_seeds_names_the_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    searched(tmp_path / "search.db", seeds=3, seed=5)
    *_, best, about, command = printed(capsys)
    words = shlex.split(command)
    propulsion = float(
        next(word for word in words if word.startswith(PROPULSION)).partition("=")[2]
    )
    assert best.startswith(f"best path_distance_m: {propulsion + 600:.4g}, trial ")
    assert "seed=5" in words
    assert about == f"  the mean of 3 runs; the first of them, {propulsion + 500:.4g}, again:"
