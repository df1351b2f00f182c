"""`snakesim drive qualify` examines emulated drives with a real host, a real bus, and a separate drive process."""

import json
import os
import signal
import time
from pathlib import Path

import pytest

from snakesim_hal.base.terminal import discard_line
from snakesim_operator.features.qualification.protocol.record import (
    PROGRESS,
    RECORD,
    SUMMARY,
    Record,
    read_record,
)
from snakesim_operator.features.qualification.runner import Options, qualify_drive
from snakesim_operator.features.qualification.setup import Request
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import run_in_background, snakesim

pytestmark = pytest.mark.e2e

MUTANT_PROGRAM = "snakesim_testing.drivers.mutant_drive_program"
# The steps that no program can decide for a drive of this type.
UNKNOWN_STEPS = {
    "moteus": ["identity"],  # it reports no version of its firmware
    "dynamixel": ["identity"],
    "feetech": ["identity", "torque"],  # it measures no torque
}
REFUTED_STEPS = {"dynamixel": ["watchdog"]}  # packets of the second program feed its watchdog


def make_options(tmp_path: Path, *only: str, mutant: str = "") -> Options:
    """Make options for some of the steps, on a correct drive or on one with a defect."""
    module = (MUTANT_PROGRAM, mutant) if mutant else ("snakesim_operator",)
    return Options(
        operator="test", key=tmp_path / "key.pem", yes=True, only=only, emulator_module=module
    )


def list_steps(record: Record, verdict: str) -> list[str]:
    """Return the steps with this verdict."""
    return [step.key for step in record.steps if step.verdict == verdict]


@pytest.mark.heavy
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "driver_type",
    [
        "odrive",
        # Each takes 20 s of CPU time, and the steps themselves are the same for every type.
        pytest.param("moteus", marks=pytest.mark.slow),
        pytest.param("dynamixel", marks=pytest.mark.slow),
        pytest.param("can", marks=pytest.mark.slow),
        pytest.param("cia402", marks=pytest.mark.slow),
        pytest.param("feetech", marks=pytest.mark.slow),
    ],
)
def test_qualification_completes_on_an_emulated_drive(driver_type: str, tmp_path: Path):
    folder = tmp_path / "out"
    result = snakesim(
        *("drive", "qualify", driver_type, "--yes", "--json", "--out", "out", "--key", "key.pem"),
        cwd=tmp_path,
        timeout_s=250,
    )
    printed_result = json.loads(result.out.splitlines()[-1])
    assert (folder / RECORD).exists(), result.printed
    record = read_record(folder / RECORD)
    assert record.subject.emulated
    assert printed_result["emulated"]
    assert len(record.steps) == 13
    unexplained = [step.problem for step in record.steps if step.problem]
    assert not unexplained, result.err
    assert list_steps(record, "unknown") == UNKNOWN_STEPS.get(driver_type, []), result.err
    assert list_steps(record, "refuted") == REFUTED_STEPS.get(driver_type, []), result.err
    assert not [claim.id for claim in record.claims if claim.verdict == "refuted"]
    assert "EMULATED" in (folder / SUMMARY).read_text()
    verified = snakesim("drive", "verify", f"out/{RECORD}", cwd=tmp_path)
    assert "the signature is valid" in verified.out
    assert "EMULATED" in verified.out
    repeated = snakesim("drive", "qualify", driver_type, "--yes", "--out", "out", cwd=tmp_path)
    assert repeated.code == 2
    assert "finished" in repeated.err


@pytest.mark.heavy
def test_qualification_refutes_drive_without_watchdog(tmp_path: Path):
    record = qualify_drive(
        Request("moteus", tmp_path),
        make_options(tmp_path, "watchdog", mutant="no_watchdog"),
        discard_line,
    )
    assert list_steps(record, "refuted") == ["watchdog"]
    assert {claim.id for claim in record.claims if claim.verdict == "refuted"} == {
        "stops-without-host"
    }


@pytest.mark.heavy
def test_qualification_refutes_drive_that_enables_itself_again(tmp_path: Path):
    record = qualify_drive(
        Request("moteus", tmp_path),
        make_options(tmp_path, "freeze", mutant="enables_again"),
        discard_line,
    )
    assert list_steps(record, "refuted") == ["freeze"]
    assert "stays-off" in {claim.id for claim in record.claims if claim.verdict == "refuted"}


@pytest.mark.heavy
def test_qualification_refutes_drive_that_turns_the_other_way(tmp_path: Path):
    request = Request("moteus", tmp_path, emulator_sets=["backend.mounted.joint_1.sign=-1"])
    record = qualify_drive(request, make_options(tmp_path, "motion"), discard_line)
    assert list_steps(record, "refuted") == ["motion"]
    assert {claim.id for claim in record.claims if claim.verdict == "refuted"} == {"si-units"}


@pytest.mark.heavy
def test_interrupted_qualification_leaves_motor_off_and_continues(tmp_path: Path):
    folder = tmp_path / "out"
    arguments = ("drive", "qualify", "odrive", "--yes", "--out", "out", "--key", "key.pem")
    with run_in_background(tmp_path, *arguments) as process:
        wait_until(
            lambda: (folder / PROGRESS).exists() and b"motion" in (folder / PROGRESS).read_bytes(),
            "the step `motion`",
            90,
        )
        time.sleep(0.5)
        os.kill(process.pid, signal.SIGINT)
        assert process.wait(30) == 130
    last_state = json.loads((folder / "drive.log").read_text().splitlines()[-1])
    assert last_state["enabled"] == [False]
    interrupted = read_record(folder / PROGRESS)
    record = qualify_drive(
        Request("odrive", folder),
        make_options(tmp_path, *(step.key for step in interrupted.steps), "torque"),
        discard_line,
    )
    assert record.steps[: len(interrupted.steps)] == interrupted.steps
    assert list_steps(record, "confirmed")[-1] == "torque"


def test_qualification_is_refused_without_terminal_limits_or_bus(
    tmp_path: Path,
):
    without_terminal = snakesim("drive", "qualify", "odrive", cwd=tmp_path)
    assert without_terminal.code == 2
    assert "stdin is no terminal" in without_terminal.err
    for setting, reason in (
        ("robot.limits.torque_nm=7", "at most 2 N·m"),
        ("robot.limits.angle_rad=1", "at most 0.35"),
    ):
        result = snakesim("drive", "qualify", "odrive", "--yes", "--set", setting, cwd=tmp_path)
        assert result.code == 2
        assert reason in result.err
    simulator = snakesim("drive", "qualify", "sim", "--yes", cwd=tmp_path)
    assert "no drives on a bus" in simulator.err
