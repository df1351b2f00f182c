"""`snakesim study compare RUN_A RUN_B`: reads two runs, prints a table of their differences, and writes a page."""

from pathlib import Path

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_json, print_line
from snakesim_hal.model.textfiles import write_text
from snakesim_operator.results.compare.difference import compute_difference
from snakesim_operator.results.compare.page import render_comparison_page
from snakesim_operator.results.compare.table import format_comparison, make_json_values
from snakesim_operator.results.compare.verdict import check_tolerance
from snakesim_operator.results.missing_data import report_missing_data
from snakesim_operator.results.run_log import RunRecord

PAGE_FILENAME = "compare.html"


def compare_runs(
    run_a: Path,
    run_b: Path,
    page_path: Path | None = None,
    within_percent: float | None = None,
    *,
    as_json: bool = False,
) -> int:
    """Compare two runs, print the differences, and write the page.

    Args:
        run_a: Folder or recording of the first run, to which percentages refer.
        run_b: Folder or recording of the second run.
        page_path: Path of the page; None for a file in the folder of the second run.
        within_percent: Maximum difference of the distances in percent; None for no check.
        as_json: Whether to print JSON instead of a table.

    Returns:
        The exit code: 1 if the distances differ by more than `within_percent`, 3 if a record is incomplete, else 0.

    Raises:
        ConfigError: A run cannot be read, the runs cannot be compared, or the page cannot be written.
    """
    if within_percent is not None and not 0 <= within_percent < float("inf"):
        raise ConfigError(
            f"--within {within_percent:g}: give a percentage that is not negative, such as --within 10",
            code="command/invalid-option",
        )
    difference = compute_difference(
        RunRecord.load(run_a.resolve()), RunRecord.load(run_b.resolve())
    )
    check = None
    if within_percent is not None:
        check = check_tolerance(difference, within_percent)
        if check is None:
            raise ConfigError(
                f"--within {within_percent:g}: {run_a} and {run_b} have no common measure of the distance moved; "
                "give the robot a pose sensor, or leave --within away",
                code="recording/not-comparable",
            )
    path = page_path or _choose_default_page_path(run_b)
    try:
        write_text(path, render_comparison_page(difference, check))
    except ConfigError as error:
        raise ConfigError(
            f"{error}; name another file with --out FILE.html", code="file/not-writable"
        ) from None
    if as_json:
        print_json({**make_json_values(difference), "page": str(path), "within": check})
    else:
        for line in format_comparison(difference):
            print_line(line)
        print_line(f"page: {path}")
        if check is not None:
            print_line(check.words)
    code = 0 if check is None or check.holds else 1
    code_a = report_missing_data(run_a, difference.a.missing, code)
    code_b = report_missing_data(run_b, difference.b.missing, code)
    return max(code_a, code_b)


def _choose_default_page_path(run: Path) -> Path:
    """Return the path of the page in the folder of a run, or beside a recording."""
    folder = run if run.is_dir() else run.parent
    return folder / PAGE_FILENAME
