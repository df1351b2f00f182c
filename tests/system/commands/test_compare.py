"""`snakesim study compare` compares real runs: its output, its page, its exit code, and damaged records."""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.results.compare.command import compare_runs
from snakesim_operator.results.missing_data import EXIT_INCOMPLETE
from snakesim_operator.results.page.html import LIBRARY
from snakesim_testing.runs.in_process_command import run_to_summary, snakesim


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder with four runs: two equal ones, a slower rate, and another controller."""
    folder = tmp_path_factory.mktemp("runs")
    for name, options in (
        ("a", []),
        ("again", []),
        ("slow", ["--set", "rate_hz=50"]),
        ("hold", ["--controller", "hold"]),
    ):
        completed, _ = run_to_summary(folder / name, "triplet", "--duration", "1.5", *options)
        assert completed.code == 0, completed.out + completed.err
    return folder


@pytest.mark.slow  # tests/system/runs/test_golden.py compares the digests of such runs
def test_compare_of_repeated_run_reports_no_difference(runs: Path) -> None:
    completed = snakesim("study", "compare", "a", "again", "--within", "0", cwd=runs)
    assert completed.code == 0, completed.out + completed.err
    assert "no setting differs" in completed.out
    assert "The runs are the same, joint by joint" in completed.out
    assert (runs / "again" / "compare.html").is_file()


@pytest.mark.heavy
def test_compare_of_different_runs_reports_and_draws_differences(
    runs: Path, tmp_path: Path
) -> None:
    completed = snakesim(
        "study", "compare", "a", "slow", "--out", str(tmp_path / "new" / "page.html"), cwd=runs
    )
    assert completed.code == 0, completed.out + completed.err
    assert re.search(r"rate_hz +100.0 -> 50.0", completed.out)
    assert "A is interpolated at the ticks of B" in completed.out
    assert re.search(r"angle +0\.\d+ rad +[+-]0\.\d+ rad +joint_\d+ at", completed.out)
    assert not re.search(r"\bnan\b", completed.out)
    page = (tmp_path / "new" / "page.html").read_text(encoding="utf-8")
    for title in (
        "Advance of both runs",
        "s angle over time",
        "s torque over time",
        "Propulsion joints of both",
    ):
        assert title in page
    page_without_library = page.replace(LIBRARY.read_text(encoding="utf-8"), "")
    assert "src=" not in page_without_library
    assert "url(" not in page_without_library
    assert len(page) < MAX_PAGE_CHARACTERS


def test_compare_beyond_allowed_difference_has_exit_code_1(runs: Path) -> None:
    completed = snakesim("study", "compare", "a", "hold", "--within", "20", cwd=runs)
    assert completed.code == 1, completed.out + completed.err
    assert re.search(r"not within 20 %: B 1?\d\d\.\d % less", completed.out), completed.out


MAX_PAGE_CHARACTERS = 3_000_000
DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "noise": lambda path: path.write_bytes(os.urandom(5000)),
    "deep": lambda path: path.write_text("[" * 100_000),
    "deep JSON": lambda path: path.write_text('{"a":' * 100_000),
    "nothing in it": lambda path: path.write_text("{}"),
    "NUL": lambda path: path.write_bytes(b"\0" * 100),
    "pipe": os.mkfifo,
    "endless": lambda path: path.symlink_to("/dev/zero"),
    "folder": Path.mkdir,
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_compare_with_damaged_record_is_one_clear_line(
    runs: Path, tmp_path: Path, damage: str
) -> None:
    """Any file of the record can be damaged, without knowledge of how the record is read."""
    file_names = [
        path.name for path in (runs / "a").iterdir() if not path.name.endswith((".log", ".html"))
    ]
    assert {"config.json", "host.json"} < set(file_names)
    for name in file_names:
        folder = tmp_path / name
        shutil.copytree(runs / "a", folder)
        (folder / name).unlink()
        DAMAGES[damage](folder / name)
        try:
            # The comparison succeeds if it does not need the file.
            exit_code = compare_runs(folder, folder, tmp_path / "page.html")
            assert exit_code == (EXIT_INCOMPLETE if name == RECORDING_FILENAME else 0)
        except ConfigError as error:
            assert len(error.lines) == 1, error
            assert len(str(error)) < 1000, error


def test_compare_writes_pages_only_to_files(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("precious")
    (tmp_path / "link.html").symlink_to(tmp_path / "elsewhere")
    os.mkfifo(tmp_path / "pipe.html")
    for name, expected_text in (("link.html", "is a symbolic link"), ("pipe.html", "is a pipe")):
        completed = snakesim(
            "study", "compare", str(runs / "a"), str(runs / "a"), "--out", name, cwd=tmp_path
        )
        assert completed.code == 2, completed.err
        assert expected_text in completed.err, completed.err
        assert completed.err.count("\n") == 1, completed.err
    assert (tmp_path / "elsewhere").read_text() == "precious"
    for name in ("pipe.html", "/dev/zero", "nowhere"):
        completed = snakesim("study", "compare", str(runs / "a"), name, cwd=tmp_path)
        assert completed.code == 2, completed.err
        assert "folder" in completed.err, completed.err
        assert completed.err.count("\n") == 1, completed.err


def test_compare_of_different_robots_is_refused(runs: Path, tmp_path: Path) -> None:
    mamba_run, _ = run_to_summary(tmp_path / "mamba", "mamba_hills", "--duration", "0.1")
    assert mamba_run.code == 0, mamba_run.out + mamba_run.err
    completed = snakesim("study", "compare", str(runs / "a"), "mamba", cwd=tmp_path)
    assert completed.code == 2
    assert "planar13 with 13 joints" in completed.err
    assert "mamba with" in completed.err
