"""Control beside the driver: the same commands as from a process of its own, and what a bad controller can do there."""

from pathlib import Path

import pytest

from snakesim_testing.harness.bad_plugins import BAD
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs import in_process_command as command
from snakesim_testing.runs.command import run_to_summary, running_snakesim

pytestmark = pytest.mark.e2e

BESIDE = ("--set", "services.control.process=host")
# 50 Hz has the longest lease, 100 ms: a busy test machine may well forget a process for 50 ms.
REALTIME = (
    "triplet",
    "--clock-mode",
    "realtime",
    "--set",
    "rate_hz=50",
    "--duration",
    "60",
    *BESIDE,
)


@pytest.mark.slow
def test_it_drives_the_motors_alike(tmp_path: Path) -> None:
    """As in a process of its own, and as in the one of all: test_in_process.py."""
    arguments = ("triplet", "--duration", "2", "--clock-mode", "lockstep")
    _, apart = command.run_to_summary(tmp_path / "apart", *arguments)
    ended, beside = run_to_summary(tmp_path / "beside", *arguments, *BESIDE)
    assert ended.code == 0
    assert beside.command_digest == apart.command_digest


@pytest.mark.slow  # tests/unit/gnc/control/service/test_guarded.py, and a stop while it hangs below
@pytest.mark.parametrize(
    ("backend", "deed", "words"),
    [
        pytest.param("sim", "raises", "update() raised ZeroDivisionError", marks=pytest.mark.slow),
        pytest.param(
            "can", "hangs", "lease of control expired", marks=pytest.mark.slow
        ),  # below, with --stay
        pytest.param("sim", "spins", "lease of control expired", marks=pytest.mark.slow),
        ("can", "dies", "host ended with exit code 0"),
    ],
)
def test_a_bad_controller_stops_its_robot(
    tmp_path: Path, backend: str, deed: str, words: str
) -> None:
    (tmp_path / "bad.py").write_text(BAD.replace("%s", deed))
    given = (*REALTIME, "--controller", "./bad.py:Controller", "--backend", backend)
    ended, summary = run_to_summary(tmp_path / "out", *given)
    assert ended.code == 1 and words in ended.out + summary.ended and summary.duration_s < 60, (
        ended.out
    )


def test_a_stop_is_answered_while_it_hangs(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(BAD.replace("%s", "hangs"))
    with running_snakesim(
        tmp_path / "out", *REALTIME, "--controller", "./bad.py:Controller", "--stay"
    ) as run:
        run.wait_for("lease of control expired")
        stopped = command.run_command_for_robot(run, "estop")
        assert stopped.code == 0 and "planar13: stopped" in stopped.out, stopped.out + stopped.err
        assert "estop" in command.run_command_for_robot(run, "status", "--json").out


@pytest.mark.slow
def test_failed_service_is_restarted_and_waits_for_arming(tmp_path: Path) -> None:
    (tmp_path / "bad.py").write_text(BAD.replace("%s", "raises"))
    with running_snakesim(
        tmp_path / "out", *REALTIME, "--controller", "./bad.py:Controller", "--stay"
    ) as run:
        run.wait_for("fault: ")

        def armed() -> bool:
            asked = (("robot", "reset"), ("robot", "arm", "planar13", "sim"))
            return [command.run_command_for_robot(run, *one).code for one in asked][-1] == 0

        wait_until(armed, "a robot that is armed again")
