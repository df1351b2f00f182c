"""One trial of an evaluation: a run of one controller, in one condition, with one seed. It runs in a worker process."""

import hashlib
import threading
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.base.step_limit import StepWatchdog
from snakesim_hal.model.scenario import RunConfig, compute_config_hash, validate_start_pose
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.in_process import simulate

MetricValue = bool | int | float | str | None
# Metrics that depend on the wall clock: they differ when a trial is repeated.
WALL_CLOCK_METRICS = {"wall_s", "real_time_factor", "overruns", "answered_fraction"}
# Name of the metric that is true if a run was ended early because the robot did not advance.
ENDED_BY_STALL_METRIC = "ended_by_stall"
_run_lock = threading.Lock()


@dataclass(frozen=True)
class EvaluationTrial:
    """One run of an evaluation."""

    id: str  # equal for equal configurations and equal code

    # The condition, the controller and the seed identify a trial.
    condition_number: int  # from 1, in the order of the suite
    condition_name: str
    controller: str
    seed: int  # of the run, and of every random part of its scene

    # The run.
    config: bytes  # the whole configuration as JSON
    stall_timeout_s: float  # robot time without an advance after which the run is ended
    wall_timeout_s: float  # wall time after which the run is stopped
    varied_number: float | None = None  # of the condition, if it varies a single number

    @property
    def identifying_columns(self) -> dict[str, MetricValue]:
        """The columns that identify this trial in the table of results, by name."""
        return {
            "condition_number": self.condition_number,
            "condition_name": self.condition_name,
            "controller": self.controller,
            "seed": self.seed,
        }


class TrialOutcome(msgspec.Struct, frozen=True, kw_only=True):
    """The metrics of a trial, or the error of a trial that could not run."""

    metrics: dict[str, MetricValue] = {}  # the plain values of the run's summary, by name
    error: str | None = None


class TimeLimitError(BaseException):
    """Raised in a run whose wall time is over. It is no `Exception`, because a controller's guard must not catch it."""


@cache
def compute_code_digest() -> str:
    """Return a digest of the installed code, so that results of other code are not mixed with these."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[3].glob("snakesim_*/**/*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def make_trial_id(config: RunConfig, stall_timeout_s: float) -> str:
    """Return an id that is equal for equal configurations and equal code."""
    return f"{compute_config_hash(config)}-{compute_code_digest()}-{stall_timeout_s:g}"


def run_trial(
    config_json: bytes, expected_code: str, stall_timeout_s: float, wall_timeout_s: float
) -> TrialOutcome:
    """Run one trial in this process, and return its metrics or its error.

    Exceptions that are no SnakesimError, such as those of a controller, are not caught.

    Args:
        config_json: The whole configuration of the run as JSON.
        expected_code: Digest of the code of SnakeSIM that the trial is for, as `compute_code_digest` returns it.
        stall_timeout_s: Robot time without an advance after which the run is ended.
        wall_timeout_s: Wall time after which the run is stopped.

    Returns:
        The outcome. A trial that cannot run, or takes too long, has an error instead of metrics.
    """
    if expected_code != compute_code_digest():
        return TrialOutcome(
            error="the worker has another version of SnakeSIM; install the same, and continue with --resume"
        )
    with _run_lock:  # a process makes one run at a time, because a run captures what is printed
        try:
            config = msgspec.json.decode(config_json, type=RunConfig)
            return _simulate_trial(config, stall_timeout_s, wall_timeout_s)
        except TimeLimitError:
            return make_timeout_outcome(wall_timeout_s)
        except SnakesimError as error:
            return TrialOutcome(error=str(error))


def _simulate_trial(
    config: RunConfig, stall_timeout_s: float, wall_timeout_s: float
) -> TrialOutcome:
    validate_start_pose(config)
    with closing(StepWatchdog(wall_timeout_s, error_type=TimeLimitError)) as watchdog, watchdog:
        result = simulate(
            config, until_goal=True, stall_timeout_s=stall_timeout_s, turn_limit_s=wall_timeout_s
        )
    metrics = collect_reproducible_metrics(result.summary)
    metrics[ENDED_BY_STALL_METRIC] = result.has_stalled and not result.summary.reached_goal
    return TrialOutcome(metrics=metrics)


def make_timeout_outcome(wall_timeout_s: float) -> TrialOutcome:
    """Return the outcome of a trial that was stopped at its limit of wall time."""
    return TrialOutcome(
        error=f"stopped after {wall_timeout_s:g} s of wall time; the suite's `wall_timeout_s` allows no more"
    )


def collect_reproducible_metrics(summary: RunSummary) -> dict[str, MetricValue]:
    """Return every plain value of a summary that depends only on configuration and code, by name."""
    metrics: dict[str, MetricValue] = {}
    for name in summary.__struct_fields__:
        value = getattr(summary, name)
        if name not in WALL_CLOCK_METRICS and isinstance(value, MetricValue):
            metrics[name] = value
    return metrics
