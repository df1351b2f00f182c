"""One case of an evaluation: a configuration to run, and the numbers of its summary. Runs in a worker process."""

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

Number = bool | int | float | str | None
# They differ from run to run.
WALL_CLOCK_FIELDS = {"wall_s", "real_time_factor", "overruns", "answered_fraction"}
GAVE_UP_FIELD = "gave_up"  # the number that is true if a run was ended because it was stuck
_run_lock = threading.Lock()


@dataclass(frozen=True)
class EvaluationCase:
    """One run of an evaluation."""

    id: str
    row: int  # from 1, as in the table
    setting: str
    controller: str
    field: int
    config: bytes  # the whole configuration as JSON
    stall_timeout_s: float  # robot time without an advance after which a run is ended
    timeout_s: float  # wall time after which it is stopped, whatever it does
    value: float | None = None  # of the setting, where that is one number

    @property
    def identifying_columns(self) -> dict[str, Number]:
        """The columns that identify this case in the table of results, by name."""
        return {
            "row": self.row,
            "setting": self.setting,
            "controller": self.controller,
            "field": self.field,
        }


class CaseOutcome(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a case."""

    numbers: dict[str, Number] = {}  # the plain fields of the run's summary
    error: str | None = None  # why there was no run


class TimeLimitError(BaseException):
    """Raised in a run whose wall time is over. It is no `Exception`, because a controller's guard must not catch it."""


@cache
def compute_code_digest() -> str:
    """Return a digest of the installed code, so that results of other code are not mixed with these."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[3].glob("snakesim_*/**/*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def make_case_id(config: RunConfig, stall_timeout_s: float) -> str:
    """Return an id that is equal for equal configurations and equal code."""
    return f"{compute_config_hash(config)}-{compute_code_digest()}-{stall_timeout_s:g}"


def run_case(
    config_json: bytes, expected_code: str, stall_timeout_s: float, timeout_s: float
) -> CaseOutcome:
    """Run one case of an evaluation in this process, and return its metrics or its error.

    Exceptions that are no SnakesimError, such as those of a controller, are not caught.

    Args:
        config_json: The whole configuration of the run as JSON.
        expected_code: Digest of the code of SnakeSIM that the case is for, as `compute_code_digest` returns it.
        stall_timeout_s: Simulated time without progress after which the run is ended.
        timeout_s: Wall time after which the run is stopped.

    Returns:
        The outcome; a case that cannot run, or takes too long, has an error instead of metrics.
    """
    if expected_code != compute_code_digest():
        return CaseOutcome(
            error="the worker has another version of SnakeSIM; install the same, and continue with --resume"
        )
    with _run_lock:  # a process makes one run at a time, because a run captures what is printed
        try:
            return _simulate_case(
                msgspec.json.decode(config_json, type=RunConfig), stall_timeout_s, timeout_s
            )
        except TimeLimitError:
            return make_timeout_outcome(timeout_s)
        except SnakesimError as error:
            return CaseOutcome(error=str(error))


def _simulate_case(config: RunConfig, stall_timeout_s: float, timeout_s: float) -> CaseOutcome:
    validate_start_pose(config)
    with closing(StepWatchdog(timeout_s, error_type=TimeLimitError)) as limit, limit:
        result = simulate(
            config, until_goal=True, stall_timeout_s=stall_timeout_s, turn_limit_s=timeout_s
        )
    numbers = collect_reproducible_metrics(result.summary)
    numbers[GAVE_UP_FIELD] = result.has_stalled and not result.summary.reached_goal
    return CaseOutcome(numbers=numbers)


def make_timeout_outcome(timeout_s: float) -> CaseOutcome:
    """Return the outcome of a case that was stopped at its limit of wall time."""
    return CaseOutcome(
        error=f"stopped after {timeout_s:g} s of wall time; the suite's `limit_s` allows no more"
    )


def collect_reproducible_metrics(summary: RunSummary) -> dict[str, Number]:
    """Return every plain field of a summary that depends only on configuration and code."""
    fields = {
        name: getattr(summary, name)
        for name in summary.__struct_fields__
        if name not in WALL_CLOCK_FIELDS
    }
    return {name: value for name, value in fields.items() if isinstance(value, Number)}
