"""The file of a search: an Optuna study in SQLite, and the command that it belongs to.

A search continues only with a file that the same command began. Candidates of another goal, direction, range, set
value, seed, configuration or version of the code are not comparable: the sampler and the printed result would mix them.
In Optuna, a candidate is called a trial.
"""

import hashlib
import shlex
import sqlite3
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec
import optuna
from optuna.exceptions import OptunaError
from optuna.storages import BaseStorage, RDBStorage
from optuna.study import Study
from optuna.trial import TrialState
from sqlalchemy import QueuePool
from sqlalchemy.exc import SQLAlchemyError

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.evaluate.trial import EvaluationTrial

# Attribute of the study: the `SearchCommand` as JSON types.
SEARCH_COMMAND_ATTRIBUTE = "snakesim_command"
# Attributes of a candidate: its number as it is printed, from 1; the metric of each of its trials; and whether its
# first trial was ended early because the robot did not advance.
CANDIDATE_NUMBER_ATTRIBUTE = "snakesim_number"
CANDIDATE_RESULTS_ATTRIBUTE = "snakesim_results"
IS_STALLED_ATTRIBUTE = "snakesim_stalled"

# What SQLite, SQLAlchemy and Optuna raise for a file of another kind, a folder, a full disk, another version.
STORAGE_ERRORS = (OSError, sqlite3.Error, SQLAlchemyError, OptunaError, RuntimeError)


class SearchCommand(msgspec.Struct, frozen=True, kw_only=True):
    """Everything on which the result of a candidate depends."""

    scenario: str
    conditions: list[int]  # of a suite, by number
    vary: dict[str, str]  # key -> LOW:HIGH
    set: dict[str, Any]  # the values, which are compared
    set_texts: list[str]  # KEY=VALUE as it was typed, for the command that continues the search
    goal: str
    direction: Literal["minimize", "maximize"]
    seeds: int  # number of seeds for each candidate
    seed: int  # the first of them
    # Hash of what scenario, robot and scene files give at the ends of the ranges.
    configurations: str
    code: str  # hash of the installed code

    def format_command_line(self, storage: Path) -> str:
        """Return the command that continues the search, as a user types it."""
        words = ["snakesim", "study", "optimize", self.scenario]
        if self.conditions:
            words += ["--conditions", ",".join(map(str, self.conditions))]
        for key, limits in self.vary.items():
            words += ["--vary", f"{key}={limits}"]
        for text in self.set_texts:
            words += ["--set", text]
        words += ["--goal", self.goal]
        if self.direction == "minimize":
            words.append("--minimize")
        words += ["--seeds", str(self.seeds), "--seed", str(self.seed), "--storage", str(storage)]
        return shlex.join(words)


def hash_configurations(trials: Sequence[EvaluationTrial]) -> str:
    """Return a hash of the whole configurations of these trials."""
    digest = hashlib.sha256()
    for trial in trials:
        digest.update(trial.config)
    return digest.hexdigest()[:16]


def open_study(path: Path, command: SearchCommand) -> Study:
    """Open the search that a file holds, or create a search in an empty or new file.

    Candidates that another process started and did not finish are queued again.

    Args:
        path: The SQLite file; its folder is made if it does not exist.
        command: The search; it must be the same as the search in the file.

    Returns:
        The Optuna study with the candidates so far.

    Raises:
        ConfigError: The file holds another search, or is not usable.
    """
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        storage = _open_storage(path)
        summaries = optuna.get_all_study_summaries(storage)
        started_searches = [
            summary
            for summary in summaries
            if summary.n_trials or SEARCH_COMMAND_ATTRIBUTE in summary.user_attrs
        ]
        if not started_searches:
            for summary in summaries:  # of a process that was killed before its first candidate
                optuna.delete_study(study_name=summary.study_name, storage=storage)
            return _create_study(storage, command)
        stored_summary = started_searches[0]
        _check_same_search(path, stored_summary.user_attrs.get(SEARCH_COMMAND_ATTRIBUTE), command)
        study = optuna.load_study(study_name=stored_summary.study_name, storage=storage)
    except STORAGE_ERRORS as error:
        message = getattr(error, "strerror", None) or str(error)
        reason = message.splitlines()[0][:200]
        raise ConfigError(
            f"--storage {path}: {reason}; choose another file", code="file/not-writable"
        ) from None
    _requeue_unfinished_candidates(study)
    return study


def generate_unused_candidate_numbers(study: Study) -> Iterator[int]:
    """Yield the numbers from 1 that no candidate with a result has, for further candidates; there is no end."""
    used_numbers = {
        candidate.user_attrs.get(CANDIDATE_NUMBER_ATTRIBUTE)
        for candidate in study.get_trials(states=(TrialState.COMPLETE,))
    }
    number = 0
    while True:
        number += 1
        if number not in used_numbers:
            yield number


def _open_storage(path: Path) -> RDBStorage:
    """Open the file by its name. In a URL SQLAlchemy and Optuna give `?`, `%`, `#` and braces a meaning."""
    engine_options = {
        "creator": lambda: sqlite3.connect(path, check_same_thread=False),
        "poolclass": QueuePool,  # as SQLAlchemy has it for a file; this URL has no file
    }
    return RDBStorage("sqlite://", engine_options)


def _create_study(storage: BaseStorage, command: SearchCommand) -> Study:
    study = optuna.create_study(
        storage=storage,
        study_name=f"{command.scenario} {command.goal}",
        direction=command.direction,
    )
    study.set_user_attr(SEARCH_COMMAND_ATTRIBUTE, msgspec.to_builtins(command))
    return study


def _requeue_unfinished_candidates(study: Study) -> None:
    """End the candidates of a process that was killed, and enqueue their values again."""
    for candidate in study.get_trials(states=(TrialState.RUNNING,)):
        study.tell(candidate.number, state=TrialState.FAIL)
        study.enqueue_trial(candidate.params)


def _check_same_search(path: Path, stored: Any, command: SearchCommand) -> None:
    """Check that the search in a file is the one that this command asks for.

    Otherwise the candidates of two searches would be mixed.

    Args:
        path: Path of the file, for the error message.
        stored: The command in the file as JSON values, which may have any form.
        command: The command that the user typed now.

    Raises:
        ConfigError: The searches differ; the error names each difference.
    """
    try:
        stored_command = msgspec.convert(stored, SearchCommand)
    except msgspec.ValidationError:
        raise ConfigError(
            f"--storage {path}: the file was written by an older version of SnakeSIM or by another program, and cannot "
            "be continued; choose another file",
            code="evaluation/other-search",
        ) from None
    this_command = msgspec.convert(msgspec.to_builtins(command), SearchCommand)
    differences = list(_describe_differences(stored_command, this_command))
    if not differences:
        return
    raise ConfigError(
        f"--storage {path}: the file holds another search, whose candidates are not comparable with this one's. "
        f"{'; '.join(differences)}. Continue that search with "
        f"`{stored_command.format_command_line(path)}`, or choose another file",
        code="evaluation/other-search",
    )


def _describe_differences(stored: SearchCommand, requested: SearchCommand) -> Iterator[str]:
    """Describe each difference between two searches by the options of the command line.

    Args:
        stored: The search whose candidates the file holds.
        requested: The search that the user asks for now.
    """
    if stored.scenario != requested.scenario:
        yield f"scenario: {stored.scenario} there, {requested.scenario} here"
    if stored.conditions != requested.conditions:
        yield f"--conditions: {_format_conditions(stored)} there, {_format_conditions(requested)} here"
    yield from _describe_differing_keys("--vary", stored.vary, requested.vary)
    yield from _describe_differing_keys("--set", stored.set, requested.set)
    if stored.goal != requested.goal:
        yield f"--goal: {stored.goal} there, {requested.goal} here"
    if stored.direction != requested.direction:
        is_set_text = {"minimize": "set", "maximize": "not set"}
        yield f"--minimize: {is_set_text[stored.direction]} there, {is_set_text[requested.direction]} here"
    if stored.seeds != requested.seeds:
        yield f"--seeds: {stored.seeds} there, {requested.seeds} here"
    if stored.seed != requested.seed:
        yield f"--seed: {stored.seed} there, {requested.seed} here"
    if stored.code != requested.code:
        yield "the installed SnakeSIM has changed since then"
    # Other configurations follow from another command. They are a difference only if the command is the same.
    command_with_same_files = msgspec.structs.replace(
        stored,
        configurations=requested.configurations,
        code=requested.code,
        set_texts=requested.set_texts,
    )
    if command_with_same_files == requested and stored.configurations != requested.configurations:
        yield "the same command gives another configuration: the files of scenario, robot, scene or suite have changed"


def _describe_differing_keys(
    option: str, stored: dict[str, Any], requested: dict[str, Any]
) -> Iterator[str]:
    for key in sorted(stored.keys() | requested.keys()):
        stored_value = stored.get(key, "not set")
        requested_value = requested.get(key, "not set")
        if stored_value != requested_value:
            yield f"{option} {key}: {stored_value} there, {requested_value} here"


def _format_conditions(command: SearchCommand) -> str:
    return ",".join(map(str, command.conditions)) or "all"
