"""`snakesim drive new` writes a package that passes the contract suite as it is, without being installed."""

import re
import sys
from pathlib import Path

import pytest

from snakesim_testing.harness.command import run_program, snakesim

SUITE_LIMIT_S = 300.0


@pytest.mark.timeout(400)
def test_new_driver_passes_the_contract_suite_as_generated(tmp_path: Path) -> None:
    written = snakesim("drive", "new", "acme_servo", cwd=tmp_path)
    assert written.code == 0, written.printed
    ended = run_program(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"],
        tmp_path / "acme_servo",
        timeout_s=SUITE_LIMIT_S,
    )
    assert ended.code == 0, ended.printed
    passed = re.search(r"(\d+) passed", ended.out)
    assert passed is not None and int(passed[1]) > 50, ended.out
    assert "--snakesim-mute" not in ended.out and "--snakesim-drives" not in ended.out, ended.out


def test_new_driver_of_a_bad_name_writes_nothing(tmp_path: Path) -> None:
    refused = snakesim("drive", "new", "Acme-Servo", cwd=tmp_path)
    assert refused.code == 2
    assert "config/invalid-value" in refused.printed
    assert not [*tmp_path.glob("[aA]cme*")]
