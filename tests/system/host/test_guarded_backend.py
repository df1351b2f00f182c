"""Whatever a backend raises stops the robot, with a record of what it was."""

import math
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
import pytest

from snakesim_hal.backend import Samples
from snakesim_hal.base.errors import BackendError
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import ClockMode, JointMode
from snakesim_testing.hal.local_network import LagBackend, running_commanded_host
from snakesim_testing.hal.small_robots import make_pose, make_power, make_run_config
from snakesim_testing.harness.wait import wait_until


@pytest.mark.parametrize("where", ["sample", "enact", "advance", "faults"])
@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (BackendError("diverged"), "diverged"),  # our own errors stay as they are
        (OSError(19, "No such device"), "LagBackend.{} failed: OSError: [Errno 19] No such device"),
    ],
)
def test_backend_error_is_latched_and_joints_are_made_safe(
    where: str, error: Exception, cause: str
) -> None:
    with running_commanded_host(make_run_config()) as (run, _):
        run.backend.fails_in, run.backend.fails_with = where, error
        wait_until(run.has_ended, "the end of the host")
        assert run.host.ending_status == "failed"
        assert run.host.authority.state == "fault"
        causes = {fault.what: fault.cause for fault in run.host.authority.faults_since_start.faults}
        assert causes["backend_failed"] == cause.format(where)
        if where != "enact":
            assert run.backend.enacted[-1].mode == [JointMode.VELOCITY] * 3


class Wrong(LagBackend):
    """Has a wrong sample in it from some tick on."""

    wrong: Mapping[str, Any] = {}

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        right = super().sample(tick, timestamp_ns)
        joints = msgspec.structs.replace(right.joints, **self.wrong.get(keys.JOINTS, {}))
        return Samples(
            joints,
            {**right.by_key, **{key: one for key, one in self.wrong.items() if key != keys.JOINTS}},
        )


@pytest.mark.parametrize(
    "clock_mode", [pytest.param("realtime", marks=pytest.mark.quiet), "lockstep"]
)
@pytest.mark.parametrize(
    ("key", "sample", "why"),
    [
        (
            keys.POSE,
            make_pose(position_w=np.zeros(3)),
            "Pose.position_w is array([0., 0., 0.]), must be plain Python",
        ),
        (
            keys.POSE,
            make_pose(position_w=[0.0, math.nan, 0.0]),
            "Pose.position_w[1] is nan, must be `float` >= -",
        ),
        (keys.POSE, {"position_w": [0.0, 0.0, 0.0]}, "a dict, must be a Pose"),
        (keys.POSE, make_power(), "a Power, must be a Pose"),
        (
            keys.POWER,
            make_power(),
            f"not a sensor of its description, which has {keys.JOINTS}, {keys.POSE}",
        ),
        (
            "sensor/pose2",
            make_pose(),
            f"not a sensor of its description, which has {keys.JOINTS}, {keys.POSE}",
        ),
        (
            keys.JOINTS,
            {"angle_rad": np.zeros(3)},
            "JointState.angle_rad is array([0., 0., 0.]), must be plain Python",
        ),
    ],
)
def test_backend_sample_out_of_bounds_is_a_named_latched_fault(
    clock_mode: ClockMode, key: str, sample: Any, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("snakesim_testing.hal.local_network.LagBackend", Wrong)
    with running_commanded_host(make_run_config(clock_mode=clock_mode)) as (run, _):
        backend: Any = run.backend
        backend.wrong = {key: sample}
        wait_until(run.has_ended, "the end of the host")
        assert run.host.ending_status == "failed"
        assert run.host.authority.state == "fault"
        cause = next(
            fault.cause
            for fault in run.host.authority.faults_since_start.faults
            if fault.what == "backend_failed"
        )
        assert cause.startswith(f"Wrong.sample: {key} cannot be published: {why}"), cause
