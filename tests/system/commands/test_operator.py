"""An operator arms, disarms, resets and stops a robot, and a stop outlives the host."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from snakesim_hal.host.latch import ESTOP
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import RunningCommand, running_armed_snakesim
from snakesim_testing.runs.in_process_command import run_command_for_robot, snakesim

pytestmark = pytest.mark.e2e

RUN_ARGUMENTS = (
    "triplet",
    "--controller",
    "hold",
    "--duration",
    "600",
    "--clock-mode",
    "realtime",
    "--set",
    "rate_hz=50",
    "--stay",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningCommand]:
    """Run an armed robot for all tests of this file."""
    with running_armed_snakesim(
        tmp_path_factory.mktemp("operator") / "run", *RUN_ARGUMENTS
    ) as started:
        yield started
        assert started.interrupt() == 130, started.printed()


def arm_robot(run: RunningCommand) -> None:
    """Repeat `snakesim robot arm` until it succeeds."""
    wait_until(
        lambda: run_command_for_robot(run, "robot", "arm", "planar13", "sim").code == 0,
        "an armed robot",
        30.0,
    )


def test_operator_arms_only_the_named_robot_and_backend(run: RunningCommand) -> None:
    assert run_command_for_robot(run, "robot", "disarm").code == 0
    for robot, backend, expected_text in (
        ("mamba", "sim", "'planar13', not 'mamba'"),
        ("planar13", "can", "'sim', not 'can'"),
    ):
        completed = run_command_for_robot(run, "robot", "arm", robot, backend)
        assert completed.code == 1
        assert expected_text in completed.err
        assert "snakesim robot arm planar13 sim" in completed.err
    arm_robot(run)
    assert "planar13: armed" in run_command_for_robot(run, "status").out
    refused = run_command_for_robot(run, "robot", "arm", "planar13", "sim")
    assert refused.code == 1
    assert "must be disarmed" in refused.err
    assert run_command_for_robot(run, "robot", "reset").code == 1


def test_operator_stop_is_latched_and_outlives_the_host(run: RunningCommand) -> None:
    if "planar13: armed" not in run_command_for_robot(run, "status").out:
        arm_robot(run)
    stopped = run_command_for_robot(run, "estop")
    assert stopped.code == 0
    assert "planar13: stopped" in stopped.out
    latch_file = run.out.parent / "snakesim" / "robots" / "planar13-sim" / ESTOP
    assert latch_file.is_file()
    first_host_pid = run.part("host")
    os.kill(first_host_pid, signal.SIGKILL)
    wait_until(
        lambda: "planar13: estop" in run_command_for_robot(run, "status").out,
        "a new host in estop",
        30.0,
    )
    assert run.part("host") != first_host_pid
    status = run_command_for_robot(run, "status").out
    assert "before this host" in status
    assert "`snakesim robot reset" in status
    assert "then `snakesim robot arm planar13 sim" in status
    refused = run_command_for_robot(run, "robot", "arm", "planar13", "sim")
    assert refused.code == 1
    assert "state is estop" in refused.err
    assert run_command_for_robot(run, "robot", "reset").code == 0
    assert not latch_file.exists()
    arm_robot(run)
    assert run.printed().count("; restart in") == 1


@pytest.mark.slow
def test_operator_command_without_robot_fails(tmp_path: Path) -> None:
    for arguments in (
        ["estop"],
        ["robot", "reset"],
        ["robot", "arm", "planar13", "sim"],
        ["fault", "inject", "mute", "joint_1"],
        ["status"],
    ):
        completed = snakesim(*arguments, "--endpoint", "tcp/127.0.0.1:9", cwd=tmp_path)
        is_status = arguments == ["status"]
        expected_text = "no robot answers" if is_status else "no robot on tcp/127.0.0.1:9"
        assert completed.code == 1
        assert expected_text in completed.err + completed.out
