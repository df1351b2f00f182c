"""`snakesim compare RUN_A RUN_B`: read two run folders, print the table, write the page."""

from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import say, say_json
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.results.compare.difference import differ
from snakesim_operator.results.compare.page import page
from snakesim_operator.results.compare.table import for_scripts, table
from snakesim_operator.results.compare.verdict import within
from snakesim_operator.results.missing_data import exit_code
from snakesim_operator.results.record import RunRecord

PAGE = "compare.html"


def compare(
    run_a: Path, run_b: Path, out: Path | None = None, within_percent: float | None = None, *, as_json: bool = False
) -> int:
    """Returns 0; 1 when the distances differ by more than `within_percent`; else 3 when a record lacks something.

    Raises ConfigError on wrong input.
    """
    if within_percent is not None and not 0 <= within_percent < float("inf"):
        raise ConfigError(f"--within {within_percent:g}: give a percentage that is not negative, such as --within 10")
    difference = differ(RunRecord.load(run_a.resolve()), RunRecord.load(run_b.resolve()))
    asked = within(difference, within_percent) if within_percent is not None else None
    if within_percent is not None and asked is None:
        raise ConfigError(
            f"--within {within_percent:g}: {run_a} and {run_b} have no common measure of the distance moved; "
            "give the robot a pose sensor, or leave --within away"
        )
    path = out or (run_b if run_b.is_dir() else run_b.parent) / PAGE
    try:
        write_text(path, page(difference, asked))
    except ConfigError as error:
        raise ConfigError(f"{error}; name another file with --out FILE.html") from None
    if as_json:
        say_json({**for_scripts(difference), "page": str(path), "within": asked})
    else:
        for line in [*table(difference), f"page: {path}", *([asked.words] if asked is not None else [])]:
            say(line)
    code = 0 if asked is None or asked.holds else 1
    return max(exit_code(given, record.lacks, code) for given, record in ((run_a, difference.a), (run_b, difference.b)))
