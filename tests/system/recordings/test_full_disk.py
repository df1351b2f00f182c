"""An export that does not fit on the disk is named and leaves no partial file; an earlier file stays unchanged."""

from collections.abc import Callable
from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.features.evaluate.store import write_tables
from snakesim_testing.harness.file_size import limited_file_size
from snakesim_testing.messages import raises_error
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim

MAX_FILE_BYTES = 2000  # less than any of these exports needs


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("full") / "run"
    result, _ = run_to_summary(out, "triplet", "--duration", "0.5")
    assert result.code == 0, result.err
    return out


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("command", "name"),
    [
        (["recording", "export", "--format", "csv"], "table.csv"),
        (["recording", "export", "--format", "parquet"], "table.parquet"),
        (["recording", "export", "--format", "npz"], "arrays.npz"),
        (["recording", "export", "--format", "lerobot"], "dataset"),
        (["recording", "export", "--format", "mcap"], "whole.mcap"),
        (["recording", "plot"], "plot.pdf"),
        (["recording", "plot"], "plot.svg"),
        (["recording", "video", "--width", "64", "--height", "48", "--fps", "10"], "film.gif"),
        (["recording", "video", "--width", "64", "--height", "48", "--fps", "10"], "film.mp4"),
        (["recording", "report"], "report.html"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_export_on_full_disk_is_named_and_leaves_nothing(
    run: Path, tmp_path: Path, command: list[str], name: str
) -> None:
    out = tmp_path / name
    with limited_file_size(MAX_FILE_BYTES):
        result = snakesim(*command[:2], str(run), *command[2:], "--out", str(out), cwd=tmp_path)
    assert result.code == 2 and f"{out}: cannot be written: " in result.err, result.out + result.err
    assert list(tmp_path.iterdir()) == []


def write_learning_curve(folder: Path) -> None:
    """Write the learning curve of a search."""
    # The import takes a second, and each test worker imports this file.
    from snakesim.training.curve import write_curve
    from snakesim.training.search import SearchGeneration

    write_curve(folder, [SearchGeneration(0, 10, 0.1, 0.2, None, None, None)] * 200)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("write", "name"),
    [
        (write_learning_curve, "curve.csv"),
        (lambda folder: write_tables(folder, [], {}), "results.parquet"),
    ],
    ids=["curve", "tables"],
)
def test_table_on_full_disk_is_named_and_keeps_earlier_file(
    tmp_path: Path, write: Callable[[Path], object], name: str
) -> None:
    (tmp_path / name).write_text("an earlier one")
    with (
        limited_file_size(MAX_FILE_BYTES),
        raises_error(ConfigError, code="file/not-writable", field=name),
    ):
        write(tmp_path)
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [
        (name, "an earlier one")
    ]
