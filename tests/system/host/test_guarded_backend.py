"""Every error of a backend stops the robot, and the host records its cause."""

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


@pytest.mark.parametrize("method", ["sample", "enact", "advance", "faults"])
@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (BackendError("diverged"), "diverged"),  # The host keeps the text of a BackendError.
        (OSError(19, "No such device"), "LagBackend.{} failed: OSError: [Errno 19] No such device"),
    ],
)
def test_backend_error_is_latched_and_stops_the_joints(
    method: str, error: Exception, cause: str
) -> None:
    with running_commanded_host(make_run_config()) as (run, _):
        run.backend.fails_in = method
        run.backend.fails_with = error
        wait_until(run.has_ended, "the end of the host")
        assert run.host.ending_status == "failed"
        assert run.host.authority.state == "fault"
        causes = {fault.what: fault.cause for fault in run.host.authority.faults_since_start.faults}
        assert causes["backend_failed"] == cause.format(method)
        if method != "enact":
            assert run.backend.enacted[-1].mode == [JointMode.VELOCITY] * 3


class InvalidSampleBackend(LagBackend):
    """A backend that publishes invalid samples after a test has set them."""

    invalid_samples: Mapping[str, Any] = {}  # by key

    def sample(self, tick: int, timestamp_ns: int) -> Samples:
        valid = super().sample(tick, timestamp_ns)
        invalid_by_key = dict(self.invalid_samples)
        invalid_joint_fields = invalid_by_key.pop(keys.JOINTS, {})
        joints = msgspec.structs.replace(valid.joints, **invalid_joint_fields)
        return Samples(joints, {**valid.by_key, **invalid_by_key})


@pytest.mark.parametrize(
    "clock_mode", [pytest.param("realtime", marks=pytest.mark.quiet), "lockstep"]
)
@pytest.mark.parametrize(
    ("key", "sample", "problem"),
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
def test_backend_with_invalid_sample_is_a_latched_fault(
    clock_mode: ClockMode, key: str, sample: Any, problem: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("snakesim_testing.hal.local_network.LagBackend", InvalidSampleBackend)
    with running_commanded_host(make_run_config(clock_mode=clock_mode)) as (run, _):
        backend: Any = run.backend
        backend.invalid_samples = {key: sample}
        wait_until(run.has_ended, "the end of the host")
        assert run.host.ending_status == "failed"
        assert run.host.authority.state == "fault"
        cause = next(
            fault.cause
            for fault in run.host.authority.faults_since_start.faults
            if fault.what == "backend_failed"
        )
        assert cause.startswith(
            f"InvalidSampleBackend.sample: {key} cannot be published: {problem}"
        ), cause
