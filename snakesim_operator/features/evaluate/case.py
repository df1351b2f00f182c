"""One case: a configuration to run, and the numbers that come of it. Runs in a worker process."""

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
OF_THE_CLOCK = {"wall_s", "real_time_factor", "overruns", "answered_fraction"}  # differ from run to run
GAVE_UP = "gave_up"  # the number that says that a run was ended because it was stuck
_turn = threading.Lock()  # a run takes what is printed: one at a time in a process


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
        """What names it in the results."""
        return {"row": self.row, "setting": self.setting, "controller": self.controller, "field": self.field}


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """What came of a case."""

    numbers: dict[str, Number] = {}  # the plain fields of the run's summary
    error: str | None = None  # why there was no run


class TimeLimitError(BaseException):
    """Raised in a run whose wall time is over. No `Exception`: a controller's guard must not catch it."""


@cache
def code_digest() -> str:
    """Names the code that is installed here: results of other code are not mixed with these."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parents[3].glob("snakesim_*/**/*.py")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def case_id(config: RunConfig, give_up_s: float) -> str:
    """Equal for equal configurations and equal code."""
    return f"{config_hash(config)}-{code_digest()}-{give_up_s:g}"


def run_case(config: bytes, code: str, give_up_s: float, limit_s: float) -> Outcome:
    """Run it, and return the numbers. Anything but a SnakesimError is raised: a fault of this worker, perhaps."""
    if code != code_digest():
        return Outcome(error="the worker has another version of SnakeSIM; install the same, and go on with --resume")
    with _turn:
        try:
            asked = msgspec.json.decode(config, type=RunConfig)
            check(asked)
            with closing(StepLimit(limit_s, error=TimeLimitError)) as limit, limit:
                result = simulate(asked, until_goal=True, give_up_s=give_up_s, turn_limit_s=limit_s)
            return Outcome(
                numbers={**plain_numbers(result.summary), GAVE_UP: result.gave_up and not result.summary.crossed}
            )
        except TimeLimitError:
            return took_too_long(limit_s)
        except SnakesimError as error:
            return Outcome(error=str(error))


def took_too_long(limit_s: float) -> Outcome:
    """Return the outcome of a case that was stopped at its limit of wall time."""
    return Outcome(error=f"stopped after {limit_s:g} s of wall time; the suite's `limit_s` allows no more")


def plain_numbers(summary: RunSummary) -> dict[str, Number]:
    """Every plain field that depends on nothing but configuration and code."""
    fields = {name: getattr(summary, name) for name in summary.__struct_fields__ if name not in OF_THE_CLOCK}
    return {name: value for name, value in fields.items() if isinstance(value, Number)}
