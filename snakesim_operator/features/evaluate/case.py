"""One case of an evaluation: a configuration to run, and the numbers of its summary. Runs in a worker process."""

import hashlib
import threading
from contextlib import closing
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import SnakesimError
from snakesim_hal.base.step_limit import StepLimit
from snakesim_hal.model.scenario import RunConfig, check, config_hash
from snakesim_operator.results.summary import RunSummary
from snakesim_operator.run.in_process import simulate

Number = bool | int | float | str | None
WALL_CLOCK_NUMBERS = {"wall_s", "real_time_factor", "overruns", "answered_fraction"}  # they differ from run to run
GAVE_UP = "gave_up"  # the number that is true if a run was ended because it was stuck
_one_run_lock = threading.Lock()  # a run captures what is printed, so a process makes one run at a time


@dataclass(frozen=True)
class Case:
    """One run of an evaluation."""

    id: str
    row: int  # from 1, as in the table
    setting: str
    controller: str
    field: int
    config: bytes  # the whole configuration as JSON
    give_up_s: float  # robot time without an advance after which a run is ended
    limit_s: float  # wall time after which it is stopped, whatever it does
    value: float | None = None  # of the setting, where that is one number

    @property
    def columns(self) -> dict[str, Number]:
        """The columns that identify this case in the results."""
        return {"row": self.row, "setting": self.setting, "controller": self.controller, "field": self.field}


class CaseOutcome(msgspec.Struct, frozen=True, kw_only=True):
    """The result of a case."""

    numbers: dict[str, Number] = {}  # the plain fields of the run's summary
    error: str | None = None  # why there was no run


class TimeLimitError(BaseException):
    """Raised in a run whose wall time is over. It is no `Exception`, because a controller's guard must not catch it."""


@cache
def code_digest() -> str:
    """Return a digest of the installed code, so that results of other code are not mixed with these."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[3].glob("snakesim_*/**/*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def case_id(config: RunConfig, give_up_s: float) -> str:
    """Return an id that is equal for equal configurations and equal code."""
    return f"{config_hash(config)}-{code_digest()}-{give_up_s:g}"


def run_case(config: bytes, code: str, give_up_s: float, limit_s: float) -> CaseOutcome:
    """Run one case of an evaluation in this process, and return its numbers or its error.

    Args:
        config: the whole configuration as JSON.
        code: digest of the code of SnakeSIM that the case is for.
        give_up_s: robot time without an advance after which the run is ended.
        limit_s: wall time after which it is stopped.

    Returns:
        The outcome; a case that cannot run, or takes too long, has an error instead of numbers.

    Raises:
        Exception: any error other than SnakesimError, such as a fault of this worker or of a controller.
    """
    if code != code_digest():
        return CaseOutcome(
            error="the worker has another version of SnakeSIM; install the same, and continue with --resume"
        )
    with _one_run_lock:
        try:
            return _simulate_case(msgspec.json.decode(config, type=RunConfig), give_up_s, limit_s)
        except TimeLimitError:
            return took_too_long(limit_s)
        except SnakesimError as error:
            return CaseOutcome(error=str(error))


def _simulate_case(config: RunConfig, give_up_s: float, limit_s: float) -> CaseOutcome:
    check(config)
    with closing(StepLimit(limit_s, error=TimeLimitError)) as limit, limit:
        result = simulate(config, until_goal=True, give_up_s=give_up_s, turn_limit_s=limit_s)
    numbers = plain_numbers(result.summary)
    numbers[GAVE_UP] = result.gave_up and not result.summary.crossed
    return CaseOutcome(numbers=numbers)


def took_too_long(limit_s: float) -> CaseOutcome:
    """Return the outcome of a case that was stopped at its limit of wall time."""
    return CaseOutcome(error=f"stopped after {limit_s:g} s of wall time; the suite's `limit_s` allows no more")


def plain_numbers(summary: RunSummary) -> dict[str, Number]:
    """Return every plain field of a summary that depends only on configuration and code."""
    fields = {name: getattr(summary, name) for name in summary.__struct_fields__ if name not in WALL_CLOCK_NUMBERS}
    return {name: value for name, value in fields.items() if isinstance(value, Number)}
