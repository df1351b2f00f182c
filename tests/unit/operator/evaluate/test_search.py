"""A search continues only with its own file, and prints only the results of that search."""

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
from snakesim_operator.features.evaluate.optimize import SearchRequest, run_optimization
from snakesim_operator.features.evaluate.trial import EvaluationTrial, TrialOutcome
from snakesim_testing.messages import raises_error

PROPULSION = "control.propulsion_n"
FIRST_SEARCH = {
    "scenario": "triplet",
    "vary": [f"{PROPULSION}=5:40"],
    "set": ["duration_s=2"],
    "goal": "path_distance_m",
    "minimize": False,
    "candidates": 2,
    "seeds": 1,
    "seed": 1,
}


@pytest.fixture(autouse=True, scope="module")
def instant_trials() -> Iterator[None]:
    """Replace the workers, so that every trial has a result at once: its propulsion plus 100 times its seed."""

    class InstantWorkers:
        def count_workers(self) -> int:
            return 2

        def run_trials(
            self, trials: Sequence[EvaluationTrial]
        ) -> Iterator[tuple[EvaluationTrial, TrialOutcome]]:
            for trial in trials:
                config = msgspec.json.decode(trial.config)
                propulsion_n = config["controllers"]["obstacle_triplet"]["propulsion_n"]
                value = propulsion_n + 100 * config["seed"]
                yield trial, TrialOutcome(metrics={"path_distance_m": value, "advance_m": value})

    @contextmanager
    def start_instant_workers(*_arguments: Any) -> Iterator[InstantWorkers]:
        yield InstantWorkers()

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(search, "start_workers", start_instant_workers)
        yield


@pytest.fixture(scope="module")
def first_storage(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of the first search."""
    storage = tmp_path_factory.mktemp("first") / "search.db"
    search_values(storage)
    return storage


def search_values(storage: Path, **changes: Any) -> None:
    """Run the first search with a file, with some values of its request changed."""
    request = SearchRequest(**{**FIRST_SEARCH, **changes, "storage": storage})
    assert run_optimization(request) == 0


def read_printed_lines(capsys: pytest.CaptureFixture[str]) -> list[str]:
    return capsys.readouterr().out.splitlines()


@pytest.mark.parametrize(
    "changes",
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
def test_another_search_is_refused_with_every_difference(
    first_storage: Path, changes: dict[str, Any]
) -> None:
    content_before = first_storage.read_bytes()
    with raises_error(
        ConfigError, code="evaluation/other-search", field=f"--storage {first_storage}"
    ):
        search_values(first_storage, **changes)
    assert first_storage.read_bytes() == content_before


def test_search_with_a_changed_scenario_file_is_refused(tmp_path: Path) -> None:
    scenario = tmp_path / "own.toml"
    text = read_text(resolve_file_path("triplet", "scenarios"))
    scenario.write_text(text)
    search_values(tmp_path / "search.db", scenario=str(scenario))
    assert "rate_hz = 100" in text
    scenario.write_text(text.replace("rate_hz = 100", "rate_hz = 50"))
    with raises_error(ConfigError, code="evaluation/other-search"):
        search_values(tmp_path / "search.db", scenario=str(scenario))


def test_search_file_without_its_command_stays_unchanged(tmp_path: Path) -> None:
    storage = tmp_path / "search.db"
    study = optuna.create_study(
        storage=f"sqlite:///{storage}", study_name="triplet path_distance_m"
    )
    study.add_trial(optuna.trial.create_trial(value=1.0))
    with raises_error(ConfigError, code="evaluation/other-search"):
        search_values(storage)
    assert len(study.get_trials()) == 1


@pytest.mark.parametrize("name", ["a?b 50%20.db", "{x}#&ä.db"])
def test_search_accepts_any_file_name(
    tmp_path: Path, name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    search_values(tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    read_printed_lines(capsys)
    search_values(tmp_path / name, candidates=3)
    assert "holds 2 candidates already" in read_printed_lines(capsys)[0]


@pytest.mark.parametrize("kind", ["text", "folder"])
def test_search_storage_that_is_no_database_is_refused(tmp_path: Path, kind: str) -> None:
    storage = tmp_path / "search.db"
    if kind == "folder":
        storage.mkdir()
    else:
        storage.write_text("mine\n" * 1000)
    with raises_error(ConfigError, code="file/not-writable", field="search.db"):
        search_values(storage)


def test_search_killed_numbers_candidates_without_gaps(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A killed search leaves a candidate without a result; the next search gives its number to another one."""
    storage = tmp_path / "search.db"
    search_values(storage)
    study = optuna.load_study(study_name=None, storage=f"sqlite:///{storage}")
    study.ask({PROPULSION: optuna.distributions.IntDistribution(5, 40)})
    search_values(storage, candidates=5)
    lines = read_printed_lines(capsys)
    numbers = [int(line.split()[1].strip(":")) for line in lines if line.startswith("candidate ")]
    assert numbers == list(range(1, 6))
    best = next(line for line in lines[::-1] if line.startswith("best "))
    value, _, number = best.removeprefix("best path_distance_m: ").partition(", candidate ")
    assert any(
        line.startswith(f"candidate {number}:") and line.endswith(f": {value}") for line in lines
    )


def test_search_printout_for_several_seeds_names_the_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    search_values(tmp_path / "search.db", seeds=3, seed=5)
    *_, best, explanation, command = read_printed_lines(capsys)
    words = shlex.split(command)
    propulsion_text = next(word for word in words if word.startswith(PROPULSION))
    propulsion_n = float(propulsion_text.partition("=")[2])
    assert best.startswith(f"best path_distance_m: {propulsion_n + 600:.4g}, candidate ")
    assert "seed=5" in words
    assert (
        explanation
        == f"  the mean of 3 trials; to repeat the first one, with {propulsion_n + 500:.4g}:"
    )
