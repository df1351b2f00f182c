"""`simulate` and `snakesim run --in-process` write the files of a run, and end safely (refusals: refusals.toml)."""

import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from snakesim_hal.model.scenario import KeyOverride, load_scenario, parse_set_option
from snakesim_hal.programs.single_process import InProcessRun
from snakesim_hal.run_log.host_record import BLACK_BOX, DESCRIPTION, HOST_RECORD
from snakesim_operator.recording.message import RECORDING_FILENAME
from snakesim_operator.results.run_reader import CONFIG_FILENAME, REPORT_FILENAME, SUMMARY_FILENAME
from snakesim_operator.run.conclusion import write_and_print_results
from snakesim_operator.run.in_process import LOG_FILE, run_in_process, simulate
from snakesim_testing.harness.command import SNAKESIM_COMMAND, make_environment
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.in_process_command import snakesim

RUN_FILES = {
    BLACK_BOX,
    CONFIG_FILENAME,
    DESCRIPTION,
    HOST_RECORD,
    RECORDING_FILENAME,
    REPORT_FILENAME,
    SUMMARY_FILENAME,
}


def test_in_process_command_writes_the_files_of_a_run(tmp_path: Path) -> None:
    out = tmp_path / "run"
    result = snakesim(
        "run", "triplet", "--in-process", "--duration", "1", "--out", str(out), cwd=tmp_path
    )
    assert result.code == 0, result.out + result.err
    assert {path.name for path in out.iterdir()} == RUN_FILES | {LOG_FILE}
    assert "in one process" in result.out
    assert str(out / REPORT_FILENAME) in result.out
    assert not result.err


@pytest.mark.parametrize("backend", ["odrive", "dynamixel", "feetech"])
def test_in_process_robot_of_emulated_drives_arms_without_torque_sensors(
    backend: str,
) -> None:
    """Feetech servos do not measure their torque, although the robot file lists it."""
    options = [
        f"backend={backend}",
        f"backends.{backend}.physics_model=inertia",
        "controller=hold",
        "robot.chain.modules=3",
        "duration_s=0.3",
    ]
    config = load_scenario("joint_check", [parse_set_option(text) for text in options]).config
    with InProcessRun(config) as run:
        for _ in run.iterate_ticks():
            pass
        assert run.host.authority.arm_session, run.host.build_status().reason
        measures_torque = ["torque" in joint.measures for joint in run.host.description.joints]
    assert measures_torque == [backend != "feetech"] * 3
    configured = ["torque" in joint.drive.measures for joint in run.config.robot.joint_table]
    assert configured == measures_torque


FAILING_CODE = """
from snakesim_gnc.control.hold import HoldPose


class Failing(HoldPose):
    def update(self, observation):
        if observation.tick == 20:
            raise ValueError("no idea")
        return super().update(observation)
"""


def test_in_process_controller_error_ends_in_safe_stop(tmp_path: Path) -> None:
    (tmp_path / "failing.py").write_text(FAILING_CODE)
    result = simulate(
        load_scenario(
            "triplet", [KeyOverride("controller", f"{tmp_path}/failing.py:Failing", "the test")]
        ).config
    )
    assert "control ended: controller" in result.summary.ended
    assert "no idea" in result.summary.ended
    assert [fault.what for fault in result.summary.faults] == ["service_lost", "lease_expired"]
    assert result.record.host.lifecycle == "fault"


ENDLESS_CODE = """
import os
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from snakesim_gnc.control.hold import HoldPose


class Endless(HoldPose):
    def update(self, observation):
        while observation.tick > 20:
            Path("begun").touch()
        return super().update(observation)


class Compiled(HoldPose):
    def update(self, observation):
        if observation.tick > 20:
            Path("begun").touch()
            sum(iter(int, 1))
        return super().update(observation)
"""


@pytest.mark.heavy
def test_in_process_controller_that_hangs_ends_in_safe_stop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("snakesim_hal.programs.single_process.TURN_TIMEOUT_S", 2.0)
    (tmp_path / "endless.py").write_text(ENDLESS_CODE)
    changes = [
        KeyOverride("controller", "./endless.py:Endless", "the test"),
        parse_set_option("start_limit_s=1"),
    ]
    result = simulate(load_scenario("triplet", changes).config)
    assert "control ended: " in result.summary.ended, result.summary.ended
    assert (
        "took longer than 2 s in one tick; if it needs so long, allow it with --set"
        in result.summary.ended
    )
    assert result.record.host.lifecycle == "fault"


@pytest.mark.heavy
@pytest.mark.parametrize(
    "controller", ["Endless", pytest.param("Compiled", marks=pytest.mark.slow)]
)
def test_in_process_run_with_hanging_controller_ends_on_ctrl_c(
    controller: str, tmp_path: Path
) -> None:
    (tmp_path / "endless.py").write_text(ENDLESS_CODE)
    arguments = [
        *SNAKESIM_COMMAND,
        "run",
        "triplet",
        "--in-process",
        "--controller",
        f"./endless.py:{controller}",
        "--out",
        "run",
    ]
    with subprocess.Popen(
        arguments,
        cwd=tmp_path,
        env=make_environment(tmp_path),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        try:
            wait_until((tmp_path / "begun").exists, "a tick that does not end", 60)
            start_s = time.monotonic()
            process.send_signal(signal.SIGINT)
            printed, _ = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 130, printed
    assert time.monotonic() - start_s < 30
    if controller == "Endless":
        assert "The run ended early: interrupted." in printed
        assert (tmp_path / "run" / REPORT_FILENAME).is_file()
    else:
        assert (
            "had not returned 3 s after it received the signal to stop; its process was killed"
            in printed
        )


def test_in_process_ctrl_c_after_last_tick_keeps_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def conclude_interrupted(*arguments: Any) -> int:
        os.kill(os.getpid(), signal.SIGINT)
        return write_and_print_results(*arguments)

    monkeypatch.setattr(
        "snakesim_operator.run.in_process.write_and_print_results", conclude_interrupted
    )
    config = load_scenario(
        "triplet", [parse_set_option("duration_s=0.1"), parse_set_option("clock_mode=lockstep")]
    ).config
    assert run_in_process(config, tmp_path / "run") == 0
    assert (tmp_path / "run" / REPORT_FILENAME).is_file()


@pytest.mark.heavy
def test_in_process_run_with_fault_is_repeatable() -> None:
    config = load_scenario(
        "peg_row",
        [parse_set_option("duration_s=3"), parse_set_option('faults=["mute:joint_3@0.5"]')],
    ).config
    first, second = (simulate(config).summary for _ in range(2))
    assert "joint_3" in first.ended
    assert first.ticks == second.ticks
    assert first.command_digest == second.command_digest
