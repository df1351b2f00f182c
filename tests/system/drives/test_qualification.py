"""`snakesim drive qualify` on emulated drives: real host, real bus, and a drive in a process of its own."""

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
# What no program can find out about a drive of this type.
UNKNOWN_STEPS = {
    "moteus": ["identity"],  # it reports no version of its firmware
    "dynamixel": ["identity"],
    "feetech": ["identity", "torque"],  # it measures no torque
}
REFUTED_STEPS = {"dynamixel": ["watchdog"]}  # packets of the second program feed its watchdog


def options(tmp_path: Path, *only: str, mutant: str = "") -> Options:
    module = (MUTANT_PROGRAM, mutant) if mutant else ("snakesim_operator",)
    return Options(
        operator="test", key=tmp_path / "key.pem", yes=True, only=only, emulator_module=module
    )


def list_steps(record: Record, verdict: str) -> list[str]:
    return [step.key for step in record.steps if step.verdict == verdict]


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
def test_whole_qualification_completes_on_an_emulated_drive(driver_type: str, tmp_path: Path):
    folder = tmp_path / "out"
    ran = snakesim(
        *("drive", "qualify", driver_type, "--yes", "--json", "--out", "out", "--key", "key.pem"),
        cwd=tmp_path,
        timeout_s=250,
    )
    result = json.loads(ran.out.splitlines()[-1])
    assert (folder / RECORD).exists(), ran.printed
    record = read_record(folder / RECORD)
    assert record.subject.emulated
    assert result["emulated"]
    assert len(record.steps) == 13
    unexplained = [step.problem for step in record.steps if step.problem]
    assert not unexplained, ran.err
    assert list_steps(record, "unknown") == UNKNOWN_STEPS.get(driver_type, []), ran.err
    assert list_steps(record, "refuted") == REFUTED_STEPS.get(driver_type, []), ran.err
    assert not [claim.id for claim in record.claims if claim.verdict == "refuted"]
    assert "EMULATED" in (folder / SUMMARY).read_text()
    verified = snakesim("drive", "verify", f"out/{RECORD}", cwd=tmp_path)
    assert "the signature is valid" in verified.out
    assert "EMULATED" in verified.out
    again = snakesim("drive", "qualify", driver_type, "--yes", "--out", "out", cwd=tmp_path)
    assert again.code == 2
    assert "finished" in again.err


def test_drive_without_watchdog_is_refuted(tmp_path: Path):
    record = qualify_drive(
        Request("moteus", tmp_path),
        options(tmp_path, "watchdog", mutant="no_watchdog"),
        discard_line,
    )
    assert list_steps(record, "refuted") == ["watchdog"]
    assert {claim.id for claim in record.claims if claim.verdict == "refuted"} == {
        "stops-without-host"
    }


def test_drive_that_enables_itself_again_is_refuted(tmp_path: Path):
    record = qualify_drive(
        Request("moteus", tmp_path),
        options(tmp_path, "freeze", mutant="enables_again"),
        discard_line,
    )
    assert list_steps(record, "refuted") == ["freeze"]
    assert "stays-off" in {claim.id for claim in record.claims if claim.verdict == "refuted"}


def test_drive_that_turns_the_other_way_is_refuted(tmp_path: Path):
    request = Request("moteus", tmp_path, emulator_sets=["backend.mounted.joint_1.sign=-1"])
    record = qualify_drive(request, options(tmp_path, "motion"), discard_line)
    assert list_steps(record, "refuted") == ["motion"]
    assert {claim.id for claim in record.claims if claim.verdict == "refuted"} == {"si-units"}


def test_interrupted_qualification_leaves_the_motor_off_and_continues(tmp_path: Path):
    folder = tmp_path / "out"
    words = ("drive", "qualify", "odrive", "--yes", "--out", "out", "--key", "key.pem")
    with run_in_background(tmp_path, *words) as process:
        wait_until(
            lambda: (folder / PROGRESS).exists() and b"motion" in (folder / PROGRESS).read_bytes(),
            "steps",
            90,
        )
        time.sleep(0.5)
        os.kill(process.pid, signal.SIGINT)
        assert process.wait(30) == 130
    last = json.loads((folder / "drive.log").read_text().splitlines()[-1])
    assert last["enabled"] == [False]
    before = read_record(folder / PROGRESS)
    record = qualify_drive(
        Request("odrive", folder),
        options(tmp_path, *(step.key for step in before.steps), "torque"),
        discard_line,
    )
    assert record.steps[: len(before.steps)] == before.steps
    assert list_steps(record, "confirmed")[-1] == "torque"


def test_qualification_is_refused_without_terminal_without_limits_and_for_several_joints(
    tmp_path: Path,
):
    asked = snakesim("drive", "qualify", "odrive", cwd=tmp_path)
    assert asked.code == 2
    assert "stdin is no terminal" in asked.err
    for setting, word in (
        ("robot.limits.torque_nm=7", "at most 2 N·m"),
        ("robot.limits.angle_rad=1", "at most 0.35"),
    ):
        ran = snakesim("drive", "qualify", "odrive", "--yes", "--set", setting, cwd=tmp_path)
        assert ran.code == 2
        assert word in ran.err
    simulator = snakesim("drive", "qualify", "sim", "--yes", cwd=tmp_path)
    assert "no drives on a bus" in simulator.err
