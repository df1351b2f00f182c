"""The folder of an evaluation: what it keeps, and which folders are refused."""

from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.evaluate.store import FORMER_TRIALS_FILENAME, open_store
from snakesim_operator.features.evaluate.trial import EvaluationTrial, TrialOutcome
from snakesim_testing.messages import raises_error

TRIAL = EvaluationTrial(
    id="mine",
    condition_number=1,
    condition_name="as it is",
    controller="hold",
    seed=1,
    config=b"{}",
    stall_timeout_s=12.0,
    wall_timeout_s=60.0,
)


def test_store_resumed_keeps_outcomes_of_finished_trials(tmp_path: Path) -> None:
    outcome = TrialOutcome(metrics={"advance_m": 0.5, "reached_goal": None})
    with open_store(tmp_path, resume=False) as store:
        store.append(TRIAL, outcome)
    with open_store(tmp_path, resume=True) as store:
        assert store.outcome_by_id == {TRIAL.id: outcome}
    with (
        raises_error(ConfigError, code="file/already-exists"),
        open_store(tmp_path, resume=False),
    ):
        pass


def test_store_of_an_older_version_is_refused(tmp_path: Path) -> None:
    (tmp_path / FORMER_TRIALS_FILENAME).write_text("{}\n")
    with raises_error(ConfigError, code="file/already-exists"), open_store(tmp_path, resume=True):
        pass
    assert [path.name for path in tmp_path.iterdir()] == [FORMER_TRIALS_FILENAME]
