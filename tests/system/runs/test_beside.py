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


def write_failing_controller(folder: Path, failure: str) -> str:
    """Write a controller that fails in its 30th tick, such as "raises" or "hangs", and return its plugin name."""
    (folder / "bad.py").write_text(BAD.replace("%s", failure))
    return "./bad.py:Controller"


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
    controller = write_failing_controller(tmp_path, failure)
    arguments = (*REALTIME, "--controller", controller, "--backend", backend)
    result, summary = run_to_summary(tmp_path / "out", *arguments)
    assert result.code == 1, result.out
    assert message in result.out + summary.ended, result.out
    assert summary.duration_s < 60, result.out


@pytest.mark.heavy
def test_host_obeys_estop_while_its_controller_hangs(tmp_path: Path) -> None:
    controller = write_failing_controller(tmp_path, "hangs")
    with running_snakesim(tmp_path / "out", *REALTIME, "--controller", controller, "--stay") as run:
        run.wait_for("lease of control expired")
        stopped = command.run_command_for_robot(run, "estop")
        assert stopped.code == 0, stopped.out + stopped.err
        assert "planar13: stopped" in stopped.out
        assert "estop" in command.run_command_for_robot(run, "status", "--json").out


@pytest.mark.slow
def test_failed_service_is_restarted_and_can_be_armed(tmp_path: Path) -> None:
    """The host refuses to arm a robot without a control service, so arming succeeds only after its restart."""
    controller_that_raises = write_failing_controller(tmp_path, "raises")
    with running_snakesim(
        tmp_path / "out", *REALTIME, "--controller", controller_that_raises, "--stay"
    ) as run:
        run.wait_for("fault: ")  # the exception has ended the control service

        def reset_and_arm() -> bool:
            command.run_command_for_robot(run, "robot", "reset")  # clears the fault
            armed = command.run_command_for_robot(run, "robot", "arm", "planar13", "sim")
            return armed.code == 0

        wait_until(reset_and_arm, "control has restarted and the robot is armed again")
