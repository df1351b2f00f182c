"""A controller that dies, answers wrongly or is too slow stops the robot, and the run names it as the cause."""

import os
import re
import signal
from pathlib import Path

import numpy as np
import pytest

from snakesim_hal.network.session import ConnectionSettings, open_session
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointMode, RobotStatus
from snakesim_operator.results.run_log import RunRecord
from snakesim_testing.harness.wait import wait_until
from snakesim_testing.runs.command import (
    read_summary,
    run_to_summary,
    running_armed_snakesim,
    snakesim,
)

pytestmark = pytest.mark.e2e

LONG_RUN = ["triplet", "--controller", "hold", "--duration", "600"]


@pytest.mark.parametrize(
    "clock_mode", [pytest.param("lockstep", marks=pytest.mark.slow), "realtime"]
)
def test_killed_controller_leads_to_damped_joints_and_failed_run(
    tmp_path: Path, clock_mode: str
) -> None:
    with running_armed_snakesim(tmp_path / "run", *LONG_RUN, "--clock-mode", clock_mode) as run:
        with open_session(ConnectionSettings(run.endpoint, "planar13")) as session:
            statuses = session.declare_reader(keys.STATUS, RobotStatus)
            wait_until(lambda: bool(statuses.drain()), "a status")
            os.kill(run.part("control"), signal.SIGKILL)
            wait_until(
                lambda: any(
                    "lease of control expired" in status.reason for status in statuses.drain()
                ),
                "the reason in the status",
            )
        assert run.end() == 1
    # On a busy computer either fault may be the first.
    faults = {fault.what: fault for fault in read_summary(run.out).faults}
    assert set(faults) == {"service_lost", "lease_expired"}
    lost = faults["service_lost"]
    expired = faults["lease_expired"]
    record = RunRecord.load(tmp_path / "run")
    lease_ticks = round(record.description.lease_ns / record.config.period_ns)
    assert expired.tick - lost.tick <= lease_ticks + 2
    last_commanded = int(np.flatnonzero((record.mode == JointMode.POSITION).any(axis=1))[-1])
    modes_after = record.mode[last_commanded + 1 :]
    targets_after = record.target[last_commanded + 1 :]
    assert len(modes_after) > 50
    # The joints are damped.
    assert (modes_after == JointMode.VELOCITY).all()
    assert (targets_after == 0).all()
    status = snakesim("status", "--endpoint", run.endpoint, cwd=tmp_path)
    assert status.code == 1
    assert "lease of control expired" in status.out


@pytest.mark.slow  # tests/unit/gnc/control/service/test_guarded.py has each wrong answer
@pytest.mark.parametrize(
    "clock_mode", ["realtime", pytest.param("lockstep", marks=pytest.mark.slow)]
)
def test_controller_with_invalid_command_is_named_at_once(tmp_path: Path, clock_mode: str) -> None:
    """Other invalid commands: tests/unit/gnc/control/service/test_guarded.py."""
    (tmp_path / "wave.py").write_text(
        "from snakesim_hal.controller import ControllerCommand, RequestedSetpoints\n"
        "from snakesim_gnc.control.hold import HoldPose\n"
        "from snakesim_hal.wire.messages import JointMode\n\n\n"
        "class Wave(HoldPose):\n"
        "    def update(self, observation):\n"
        "        if observation.time_s < 0.5:\n"
        "            return super().update(observation)\n"
        "        angles = list(observation.joints.angle_rad)[:-1]\n"
        "        return ControllerCommand(RequestedSetpoints([JointMode.POSITION] * len(angles), angles, [7.0] * 13))\n"
    )
    flags = ["--controller", "./wave.py:Wave", "--clock-mode", clock_mode, "--duration", "60"]
    result, summary = run_to_summary(tmp_path / "run", "triplet", *flags)
    message = (
        "controller ./wave.py:Wave (class Wave): RequestedSetpoints.mode has 12 values, must have 13: one a joint, "
        "joint_1 to joint_13"
    )
    assert result.code == 1
    assert summary.duration_s < 5.0  # the run does not wait as long as for a stalled service
    assert summary.ended.startswith(f"control ended with exit code 1: {message}")
    assert f"fault: control ended with exit code 1: {message}" in result.out
    assert summary.last_reason is not None
    assert summary.last_reason.startswith(message)
    assert (
        (tmp_path / "run" / "control.log")
        .read_text()
        .splitlines()[-1]
        .startswith(f"snakesim control: {message}")
    )


@pytest.mark.quiet  # a quicker test: tests/system/host/test_control_service.py
def test_slow_controller_is_named_as_cause_of_stop(tmp_path: Path) -> None:
    (tmp_path / "slow.py").write_text(
        "import time\n\n"
        "from snakesim_gnc.control.hold import HoldPose\n\n\n"
        "class Slow(HoldPose):\n"
        "    def update(self, observation):\n"
        "        time.sleep(0.1)\n"
        "        return super().update(observation)\n"
    )
    flags = ["--controller", "./slow.py:Slow", "--clock-mode", "realtime", "--duration", "10"]
    result, summary = run_to_summary(tmp_path / "run", "triplet", *flags)
    assert result.code == 1
    assert re.match(
        r"control: update\(\) took \d\d\d ms of 10 ms; lease of control expired", summary.ended
    )
