"""Control in the host's process sends the same commands as in its own process; a bad controller stops its robot."""

from pathlib import Path

import pytest

from snakesim_testing.harness.bad_plugins import BAD
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as command
from snakesim_testing.runs.command import run_to_summary, running_snakesim

pytestmark = pytest.mark.e2e

CONTROL_IN_HOST = ("--set", "services.control.process=host")
# 50 Hz has the longest lease, 100 ms: a busy test machine may pause a process for 50 ms.
REALTIME = (
    "triplet",
    "--clock-mode",
    "realtime",
    "--set",
    "rate_hz=50",
    "--duration",
    "60",
    *CONTROL_IN_HOST,
)


@pytest.mark.slow
def test_control_in_host_process_sends_the_same_commands(tmp_path: Path) -> None:
    arguments = ("triplet", "--duration", "2", "--clock-mode", "lockstep")
    _, in_process = command.run_to_summary(tmp_path / "apart", *arguments)
    result, in_host = run_to_summary(tmp_path / "beside", *arguments, *CONTROL_IN_HOST)
    assert result.code == 0
    assert in_host.command_digest == in_process.command_digest


@pytest.mark.slow  # quicker tests: tests/unit/gnc/control/service/test_guarded.py
@pytest.mark.parametrize(
    ("backend", "failure", "message"),
    [
        pytest.param("sim", "raises", "update() raised ZeroDivisionError", marks=pytest.mark.slow),
        pytest.param("can", "hangs", "lease of control expired", marks=pytest.mark.slow),
        pytest.param("sim", "spins", "lease of control expired", marks=pytest.mark.slow),
        ("can", "dies", "host ended with exit code 0"),
    ],
)
def test_control_in_host_with_failing_controller_ends_run(
    tmp_path: Path, backend: str, failure: str, message: str
) -> None:
    (tmp_path / "bad.py").write_text(BAD.replace("%s", failure))
    arguments = (*REALTIME, "--controller", "./bad.py:Controller", "--backend", backend)
    result, summary = run_to_summary(tmp_path / "out", *arguments)
    assert result.code == 1, result.out
    assert message in result.out + summary.ended, result.out
    assert summary.duration_s < 60, result.out


@pytest.mark.heavy
def test_host_obeys_estop_while_its_controller_hangs(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(BAD.replace("%s", "hangs"))
    with running_snakesim(
        tmp_path / "out", *REALTIME, "--controller", "./bad.py:Controller", "--stay"
    ) as run:
        run.wait_for("lease of control expired")
        stopped = command.run_command_for_robot(run, "estop")
        assert stopped.code == 0, stopped.out + stopped.err
        assert "planar13: stopped" in stopped.out
        assert "estop" in command.run_command_for_robot(run, "status", "--json").out


@pytest.mark.slow
def test_failed_service_is_restarted_and_waits_for_arming(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(BAD.replace("%s", "raises"))
    with running_snakesim(
        tmp_path / "out", *REALTIME, "--controller", "./bad.py:Controller", "--stay"
    ) as run:
        run.wait_for("fault: ")

        def reset_and_arm() -> bool:
            command.run_command_for_robot(run, "robot", "reset")
            return command.run_command_for_robot(run, "robot", "arm", "planar13", "sim").code == 0

        wait_until(reset_and_arm, "the robot is armed again")
