"""`snakesim compare` on real runs: what it prints, the page that it leaves, and its exit code."""

import re
from pathlib import Path

import pytest

from tests.e2e.command import run_to_summary, snakesim

pytestmark = pytest.mark.e2e


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs")
    for name, more in (("a", []), ("again", []), ("slow", ["--set", "rate_hz=50"]), ("hold", ["--controller", "hold"])):
        ended, _ = run_to_summary(folder / name, "triplet", "--duration", "1.5", "--pace", "lockstep", *more)
        assert ended.code == 0, ended.out + ended.err
    return folder


def test_a_repeated_run_is_the_same(runs: Path) -> None:
    ended = snakesim("compare", "a", "again", "--within", "0", cwd=runs)
    assert ended.code == 0, ended.out + ended.err
    assert "no setting differs" in ended.out and "The runs are the same, joint by joint" in ended.out
    assert (runs / "again" / "compare.html").is_file()


def test_runs_that_differ_are_told_apart(runs: Path, tmp_path: Path) -> None:
    ended = snakesim("compare", "a", "slow", "--out", str(tmp_path / "new" / "page.html"), cwd=runs)
    assert ended.code == 0, ended.out + ended.err
    assert re.search(r"rate_hz +100.0 -> 50.0", ended.out)
    assert "A is interpolated at the ticks of B" in ended.out
    assert re.search(r"angle +0\.\d+ rad +[+-]0\.\d+ rad +joint_\d+ at", ended.out)
    assert not re.search(r"\bnan\b", ended.out)
    page = (tmp_path / "new" / "page.html").read_text(encoding="utf-8")
    for title in ("Advance of both runs", "s angle over time", "s torque over time", "Propulsion joints of both"):
        assert title in page
    assert "src=" not in page and "url(" not in page and len(page) < 1_500_000


def test_within_decides_the_exit_code(runs: Path) -> None:
    ended = snakesim("compare", "a", "hold", "--within", "20", cwd=runs)
    assert ended.code == 1 and re.search(r"not within 20 %: B 1?\d\d\.\d % less", ended.out), ended.out + ended.err


def test_wrong_input_is_refused_with_a_way_out(runs: Path, tmp_path: Path) -> None:
    ended = snakesim("compare", str(runs / "a"), "nowhere", cwd=tmp_path)
    assert ended.code == 2 and "nowhere: no such folder" in ended.err and "snakesim run --out" in ended.err
    other, _ = run_to_summary(tmp_path / "mamba", "clutter", "--duration", "0.1")
    assert other.code == 0, other.out + other.err
    ended = snakesim("compare", str(runs / "a"), "mamba", cwd=tmp_path)
    assert ended.code == 2 and "planar13 with 13 joints" in ended.err and "mamba with" in ended.err
