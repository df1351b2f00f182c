"""`snakesim study compare RUN_A RUN_B`: read two run folders, print the table, write the page."""

from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.results.compare.difference import differ
from snakesim_operator.results.compare.page import page
from snakesim_operator.results.compare.table import for_scripts, table
from snakesim_operator.results.compare.verdict import within
from snakesim_operator.results.missing_data import exit_code
from snakesim_operator.results.run_log import RunRecord

PAGE = "compare.html"


def compare(
    run_a: Path, run_b: Path, out: Path | None = None, within_percent: float | None = None, *, as_json: bool = False
) -> int:
    """Compare two runs, print the differences, and write the page.

    Args:
        run_a: Folder or recording of the first run, to which percentages refer.
        run_b: Folder or recording of the second run.
        out: The page; None: in the second run's folder.
        within_percent: Largest allowed difference of the distances.
        as_json: Print JSON instead of a table.

    Returns:
        The exit code. 1: the distances differ by more than `within_percent`; 3: a record is incomplete; else 0.

    Raises:
        ConfigError: A run cannot be read, the runs cannot be compared, or the page cannot be written.
    """
    if within_percent is not None and not 0 <= within_percent < float("inf"):
        raise ConfigError(
            f"--within {within_percent:g}: give a percentage that is not negative, such as --within 10",
            code="command/invalid-option",
        )
    difference = differ(RunRecord.load(run_a.resolve()), RunRecord.load(run_b.resolve()))
    check = None
    if within_percent is not None:
        check = within(difference, within_percent)
        if check is None:
            raise ConfigError(
                f"--within {within_percent:g}: {run_a} and {run_b} have no common measure of the distance moved; "
                "give the robot a pose sensor, or leave --within away",
                code="recording/not-comparable",
            )
    path = out or _default_path(run_b)
    try:
        write_text(path, page(difference, check))
    except ConfigError as error:
        raise ConfigError(f"{error}; name another file with --out FILE.html", code="file/not-writable") from None
    if as_json:
        print_json({**for_scripts(difference), "page": str(path), "within": check})
    else:
        for line in table(difference):
            print_line(line)
        print_line(f"page: {path}")
        if check is not None:
            print_line(check.words)
    code = 0 if check is None or check.holds else 1
    code_a = exit_code(run_a, difference.a.missing, code)
    code_b = exit_code(run_b, difference.b.missing, code)
    return max(code_a, code_b)


def _default_path(run: Path) -> Path:
    folder = run if run.is_dir() else run.parent
    return folder / PAGE
