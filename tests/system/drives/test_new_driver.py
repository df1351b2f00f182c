"""`snakesim drive new` writes a package that passes the contract suite unchanged, and without an installation."""

import re
import sys
from pathlib import Path

import pytest

from snakesim_testing.harness.command import run_program, snakesim

SUITE_TIMEOUT_S = 300.0


@pytest.mark.heavy
@pytest.mark.timeout(400)
def test_new_driver_passes_the_contract_suite_as_generated(tmp_path: Path) -> None:
    written = snakesim("drive", "new", "acme_servo", cwd=tmp_path)
    assert written.code == 0, written.printed
    result = run_program(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"],
        tmp_path / "acme_servo",
        timeout_s=SUITE_TIMEOUT_S,
    )
    assert result.code == 0, result.printed
    passed = re.search(r"(\d+) passed", result.out)
    assert passed is not None, result.out
    assert int(passed[1]) > 100, result.out  # on two benches
    assert re.search(r"acme_servo +mounted\n", result.out), result.out
    assert "--snakesim-mute" not in result.out, result.out
    assert "--snakesim-drives" not in result.out, result.out


@pytest.mark.parametrize(
    "clock_mode",
    [
        pytest.param("lockstep", marks=pytest.mark.heavy),
        pytest.param("realtime", marks=pytest.mark.quiet),
    ],
)
def test_new_driver_completes_a_run_as_its_page_says(tmp_path: Path, clock_mode: str) -> None:
    """These are the commands of docs/hardware/write-a-driver.md."""
    assert snakesim("drive", "new", "acme_servo", cwd=tmp_path).code == 0
    backend = "./acme_servo_driver/driver.py:AcmeServoBackend"
    result = snakesim(
        *("run", "scales", "--backend", backend, "--duration", "3", "--clock-mode", clock_mode),
        cwd=tmp_path / "acme_servo",
    )
    assert result.code == 0, result.printed
    assert "no fault" in result.out


def test_new_driver_with_invalid_name_writes_nothing(tmp_path: Path) -> None:
    refused = snakesim("drive", "new", "Acme-Servo", cwd=tmp_path)
    assert refused.code == 2
    assert "config/invalid-value" in refused.printed
    assert not [*tmp_path.glob("[aA]cme*")]
