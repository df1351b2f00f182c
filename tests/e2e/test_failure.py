"""What happens when a part dies, a person presses Ctrl-C, or the supervisor itself is killed."""

import os
import signal
from pathlib import Path

import msgspec
import numpy as np
import pytest

from snakesim_hal.messages import Mode
from snakesim_operator.record import SUMMARY, RunRecord
from snakesim_operator.summary import RunSummary
from tests.e2e.command import nothing_left, running, snakesim

pytestmark = pytest.mark.e2e

LONG = ["triplet", "--controller", "hold", "--duration", "600"]


@pytest.mark.parametrize("pace", ["lockstep", "realtime"])
def test_killed_controller_means_safe_joints_a_reason_and_a_failed_run(tmp_path: Path, pace: str) -> None:
    with running(tmp_path / "run", *LONG, "--pace", pace) as run:
        run.wait_for("network:")
        run.wait_for(" s  ")  # the first line of progress: armed
        os.kill(run.part("control"), signal.SIGKILL)
        words = ""
        while "lease of control expired" not in words:
            assert run.process.poll() is None, "the run ended before the status could be asked: " + words
            words = snakesim("status", "--endpoint", run.endpoint, cwd=tmp_path).out
        assert "fault" in words and "control is gone" in words
        assert run.end() == 1
    nothing_left(tmp_path / "run")
    summary = msgspec.json.decode((tmp_path / "run" / SUMMARY).read_bytes(), type=RunSummary)
    assert [fault.what for fault in summary.faults] == ["service_lost", "lease_expired"]
    lost, expired = summary.faults
    record = RunRecord.load(tmp_path / "run")
    lease_ticks = round(record.description.lease_ns / record.config.period_ns)
    assert expired.tick - lost.tick <= lease_ticks + 2
    last_commanded = int(np.flatnonzero((record.mode == Mode.POSITION).any(axis=1))[-1])
    after = record.mode[last_commanded + 1 :]
    assert len(after) > 50
    assert (after == Mode.VELOCITY).all() and (record.target[last_commanded + 1 :] == 0).all()  # damped
    told_later = snakesim("status", "--endpoint", run.endpoint, cwd=tmp_path)
    assert told_later.code == 1 and "lease of control expired" in told_later.out


def test_killed_host_is_a_failed_run(tmp_path: Path) -> None:
    with running(tmp_path / "run", *LONG) as run:
        run.wait_for(" s  ")
        os.kill(run.part("host"), signal.SIGKILL)
        assert run.end() == 1
        assert "host was ended by SIGKILL" in run.said()
    nothing_left(tmp_path / "run")


def test_ctrl_c_ends_in_order_and_leaves_the_record(tmp_path: Path) -> None:
    with running(tmp_path / "run", *LONG) as run:
        run.wait_for(" s  ")
        os.kill(run.process.pid, signal.SIGINT)
        assert run.end() == 130
        assert "report:" in run.said()
    nothing_left(tmp_path / "run")
    summary = msgspec.json.decode((tmp_path / "run" / SUMMARY).read_bytes(), type=RunSummary)
    assert summary.ended == "interrupted" and summary.faults == [] and summary.ticks > 0


def test_killed_supervisor_leaves_nothing_running(tmp_path: Path) -> None:
    with running(tmp_path / "run", *LONG) as run:
        run.wait_for(" s  ")
        assert run.part("host") and run.part("guidance") and run.part("navigation") and run.part("control")
        os.kill(run.process.pid, signal.SIGKILL)
        run.end()
        nothing_left(tmp_path / "run")


def test_a_controller_that_raises_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text(
        "from snakesim_gnc.control.hold import Hold\n\n\n"
        "class Broken(Hold):\n"
        "    def update(self, view):\n"
        "        if view.tick > 20:\n"
        "            raise ZeroDivisionError('as planned')\n"
        "        return super().update(view)\n"
    )
    ended = snakesim("run", "triplet", "--controller", "./broken.py:Broken", "--out", "run", cwd=tmp_path)
    assert ended.code == 1
    assert "ZeroDivisionError: as planned" in ended.out
    assert "control ended with exit code 1" in ended.out
    nothing_left(tmp_path / "run")
