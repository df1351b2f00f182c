"""What a person tells a robot: arm, disarm, reset, estop; and that a stop outlives the host."""

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

LONG = (
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
    with running_armed_snakesim(tmp_path_factory.mktemp("operator") / "run", *LONG) as started:
        yield started
        assert started.interrupt() == 130, started.printed()


def until_armed(run: RunningCommand) -> None:
    """As a person does it: until the answer is yes."""
    wait_until(
        lambda: run_command_for_robot(run, "robot", "arm", "planar13", "sim").code == 0,
        "armed",
        30.0,
    )


def test_arming_is_for_what_is_named(run: RunningCommand) -> None:
    assert run_command_for_robot(run, "robot", "disarm").code == 0
    for robot, backend, word in (
        ("mamba", "sim", "'planar13', not 'mamba'"),
        ("planar13", "can", "'sim', not 'can'"),
    ):
        ended = run_command_for_robot(run, "robot", "arm", robot, backend)
        assert ended.code == 1
        assert word in ended.err
        assert "snakesim robot arm planar13 sim" in ended.err
    until_armed(run)
    assert "planar13: armed" in run_command_for_robot(run, "status").out
    again = run_command_for_robot(run, "robot", "arm", "planar13", "sim")
    assert again.code == 1
    assert "must be disarmed" in again.err
    assert run_command_for_robot(run, "robot", "reset").code == 1


def test_a_stop_is_latched_and_outlives_the_host(run: RunningCommand) -> None:
    until_armed(run) if "planar13: armed" not in run_command_for_robot(run, "status").out else None
    stopped = run_command_for_robot(run, "estop")
    assert stopped.code == 0
    assert "planar13: stopped" in stopped.out
    kept = run.out.parent / "snakesim" / "robots" / "planar13-sim" / ESTOP
    assert kept.is_file()
    first = run.part("host")
    os.kill(first, signal.SIGKILL)
    wait_until(
        lambda: "planar13: estop" in run_command_for_robot(run, "status").out,
        "a new host in estop",
        30.0,
    )
    assert run.part("host") != first
    status = run_command_for_robot(run, "status").out
    assert "before this host" in status
    assert "`snakesim robot reset" in status
    assert "then `snakesim robot arm planar13 sim" in status
    refused = run_command_for_robot(run, "robot", "arm", "planar13", "sim")
    assert refused.code == 1
    assert "state is estop" in refused.err
    assert run_command_for_robot(run, "robot", "reset").code == 0
    assert not kept.exists()
    until_armed(run)
    assert run.printed().count("; restart in") == 1


@pytest.mark.slow
def test_nobody_there(tmp_path: Path) -> None:
    for arguments in (
        ["estop"],
        ["robot", "reset"],
        ["robot", "arm", "planar13", "sim"],
        ["fault", "inject", "mute", "joint_1"],
        ["status"],
    ):
        ended = snakesim(*arguments, "--endpoint", "tcp/127.0.0.1:9", cwd=tmp_path)
        words = "no robot answers" if arguments == ["status"] else "no robot on tcp/127.0.0.1:9"
        assert ended.code == 1
        assert words in ended.err + ended.out
