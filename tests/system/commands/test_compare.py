"""`snakesim study compare` on real runs: what it prints, the page that it leaves, and its exit code."""

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
    folder = tmp_path_factory.mktemp("runs")
    for name, more in (
        ("a", []),
        ("again", []),
        ("slow", ["--set", "rate_hz=50"]),
        ("hold", ["--controller", "hold"]),
    ):
        ended, _ = run_to_summary(folder / name, "triplet", "--duration", "1.5", *more)
        assert ended.code == 0, ended.out + ended.err
    return folder


@pytest.mark.slow  # the digests: tests/system/runs/test_golden.py
def test_a_repeated_run_is_the_same(runs: Path) -> None:
    ended = snakesim("study", "compare", "a", "again", "--within", "0", cwd=runs)
    assert ended.code == 0, ended.out + ended.err
    assert "no setting differs" in ended.out
    assert "The runs are the same, joint by joint" in ended.out
    assert (runs / "again" / "compare.html").is_file()


def test_runs_that_differ_are_told_apart(runs: Path, tmp_path: Path) -> None:
    ended = snakesim(
        "study", "compare", "a", "slow", "--out", str(tmp_path / "new" / "page.html"), cwd=runs
    )
    assert ended.code == 0, ended.out + ended.err
    assert re.search(r"rate_hz +100.0 -> 50.0", ended.out)
    assert "A is interpolated at the ticks of B" in ended.out
    assert re.search(r"angle +0\.\d+ rad +[+-]0\.\d+ rad +joint_\d+ at", ended.out)
    assert not re.search(r"\bnan\b", ended.out)
    page = (tmp_path / "new" / "page.html").read_text(encoding="utf-8")
    for title in (
        "Advance of both runs",
        "s angle over time",
        "s torque over time",
        "Propulsion joints of both",
    ):
        assert title in page
    ours = page.replace(LIBRARY.read_text(encoding="utf-8"), "")
    assert "src=" not in ours
    assert "url(" not in ours
    assert len(page) < 3_000_000


def test_within_decides_the_exit_code(runs: Path) -> None:
    ended = snakesim("study", "compare", "a", "hold", "--within", "20", cwd=runs)
    assert ended.code == 1 and re.search(r"not within 20 %: B 1?\d\d\.\d % less", ended.out), (
        ended.out + ended.err
    )


ODD: dict[str, Callable[[Path], object]] = {
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


@pytest.mark.parametrize("odd", ODD)
def test_an_odd_record_is_one_clear_line(runs: Path, tmp_path: Path, odd: str) -> None:
    """Whatever stands in the place of one of its files; the record's own reader is not known here."""
    every = [
        path.name for path in (runs / "a").iterdir() if not path.name.endswith((".log", ".html"))
    ]
    assert {"config.json", "host.json"} < set(every)
    for name in every:
        folder = tmp_path / name
        shutil.copytree(runs / "a", folder)
        (folder / name).unlink()
        ODD[odd](folder / name)
        try:
            # Without a file that no comparison needs.
            done = compare_runs(folder, folder, tmp_path / "page.html")
            assert done == (EXIT_INCOMPLETE if name == RECORDING_FILENAME else 0)
        except ConfigError as error:
            assert len(error.lines) == 1 and len(str(error)) < 1000, error


def test_pages_are_written_to_files_only(runs: Path, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").write_text("precious")
    (tmp_path / "link.html").symlink_to(tmp_path / "elsewhere")
    os.mkfifo(tmp_path / "pipe.html")
    for name, words in (("link.html", "is a symbolic link"), ("pipe.html", "is a pipe")):
        ended = snakesim(
            "study", "compare", str(runs / "a"), str(runs / "a"), "--out", name, cwd=tmp_path
        )
        assert ended.code == 2 and words in ended.err and ended.err.count("\n") == 1, ended.err
    assert (tmp_path / "elsewhere").read_text() == "precious"
    for name in ("pipe.html", "/dev/zero", "nowhere"):
        ended = snakesim("study", "compare", str(runs / "a"), name, cwd=tmp_path)
        assert ended.code == 2 and "folder" in ended.err and ended.err.count("\n") == 1, ended.err


def test_wrong_input_is_refused_with_a_way_out(runs: Path, tmp_path: Path) -> None:
    other, _ = run_to_summary(tmp_path / "mamba", "mamba_hills", "--duration", "0.1")
    assert other.code == 0, other.out + other.err
    ended = snakesim("study", "compare", str(runs / "a"), "mamba", cwd=tmp_path)
    assert ended.code == 2
    assert "planar13 with 13 joints" in ended.err
    assert "mamba with" in ended.err
