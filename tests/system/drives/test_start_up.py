"""Drives that need some seconds to home delay arming, in real time and with real processes."""

from pathlib import Path

from snakesim_testing.benches import homing_drives
from snakesim_testing.harness.command import RunningCommand, running_snakesim
from snakesim_testing.harness.wait import wait_until

BACKEND = f"{homing_drives.__file__}:HomingBackend"
REALTIME_OPTIONS = ("--clock-mode", "realtime", "--duration", "0.5")


def test_status_of_homing_drives_names_start_up_step(tmp_path: Path) -> None:
    homing_options = ("--set", "backend.homing_s=20", "--set", "backend.watchdog_s=0.5")
    with running_snakesim(
        tmp_path / "run", "triplet", "--backend", BACKEND, *homing_options, *REALTIME_OPTIONS
    ) as run:
        answer = wait_until(lambda: find_step(run), "status names the step")
        assert "joint_1 (drive 1): homing, " in answer
        assert " of 21.6 s" in answer
        assert "armed by" not in answer
        run.interrupt()


def find_step(run: RunningCommand) -> str:
    """Return the status if it names the step, or nothing: a busy host may not answer in time."""
    status = run.run_tool("status").out
    return status if "): homing, " in status else ""
