"""`snakesim reproduce` runs one experiment in its quick form, and lists all experiments."""

import json
from importlib.util import find_spec
from pathlib import Path

import pytest

from snakesim_testing.harness.command import snakesim

pytestmark = pytest.mark.skipif(find_spec("matplotlib") is None, reason="needs the extra `report`")
PNG = b"\x89PNG\r\n"


@pytest.mark.heavy
def test_reproduce_prints_both_numbers_and_reasons_of_the_difference(tmp_path: Path) -> None:
    options = ("--quick", "--json", "--workers", "1", "--out", "pictures")
    completed = snakesim("reproduce", "gray-hancock", *options, cwd=tmp_path)
    assert completed.code == 0, completed.err
    (record,) = json.loads(completed.out)
    (comparison,) = record["comparisons"]
    assert comparison["published"] == pytest.approx(0.0437, abs=0.0001)
    assert comparison["ours"] == pytest.approx(comparison["published"], rel=0.2)
    effects = [reason["effect"] for reason in record["reasons"]]
    assert sum(effects) == pytest.approx(comparison["difference"])
    assert abs(effects[-1]) < 0.01 * comparison["published"], "the unexplained part is large"
    assert (tmp_path / "pictures" / "gray-hancock.png").read_bytes().startswith(PNG)


@pytest.mark.heavy
def test_reproduce_list_is_printed_as_text_and_json(tmp_path: Path) -> None:
    listed = snakesim("reproduce", "--list", cwd=tmp_path)
    assert listed.code == 0, listed.err
    entries = json.loads(snakesim("reproduce", "--list", "--json", cwd=tmp_path).out)
    assert [line.split()[0] for line in listed.out.splitlines()] == [
        entry["name"] for entry in entries
    ]
    assert "Alben" in listed.out
