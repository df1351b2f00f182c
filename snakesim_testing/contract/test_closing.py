"""Closing, reopening, and repeatability."""

import contextlib

import numpy as np
import pytest

from snakesim_hal.backend import Samples
from snakesim_hal.base.errors import BackendError
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import JointMode, JointState
from snakesim_testing.contract import tolerances
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.rig import BackendRig, skip_limiter
from snakesim_testing.contract.test_lifecycle import MOVE_JOINT_0


def use_closed_backend(rig: BackendRig) -> list[JointState]:
    """Call every method of a closed backend for some periods, and return the joint states that it still reports.

    A closed backend may raise BackendError, and nothing else.
    """
    joint_states: list[JointState] = []
    for tick in range(rig.tick + 1, rig.tick + 1 + tolerances.CLOSING_PERIODS):
        with contextlib.suppress(BackendError):
            rig.backend.enact(skip_limiter(rig.make_setpoints(MOVE_JOINT_0)), "armed")
        with contextlib.suppress(BackendError):
            rig.backend.advance()
        with contextlib.suppress(BackendError):
            rig.backend.faults()
        with contextlib.suppress(BackendError):
            joint_states.append(rig.backend.sample(tick, tick * rig.period_ns).joints)
    return joint_states


def test_a_closed_backend_drives_nothing(bench: Bench, rig: BackendRig) -> None:
    """A backend that was closed while a joint moved does not drive any joint, even if it gets setpoints."""
    rig.arm_and_move_joint()
    start_angle_rad = rig.newest_joints.angle_rad[0]
    rig.close()
    moved_rad = max(
        (abs(joints.angle_rad[0] - start_angle_rad) for joints in use_closed_backend(rig)),
        default=0.0,
    )
    max_coasting_rad = (
        0.5 * tolerances.MOTION_SPEED_RAD_S * tolerances.CLOSING_PERIODS * rig.period_ns * 1e-9
    )
    assert moved_rad < max_coasting_rad, (
        f"a joint moved by {moved_rad:.3f} rad after the backend was closed; at most {max_coasting_rad:.3f} rad"
    )


def test_closing_twice_does_no_harm(bench: Bench) -> None:
    """A backend can be closed twice, also right after opening, because the host closes it after errors of any kind."""
    backend = bench.open()
    backend.close()
    backend.close()


def test_a_backend_opens_again_after_it_was_closed(bench: Bench) -> None:
    """A backend that was closed opens again in the same process: disarmed, at rest, and able to move once armed."""
    if not bench.was_opened:
        bench.open().close()
    rig = bench.open_rig()
    assert np.abs(rig.newest_joints.velocity_rad_s).max() < tolerances.STANDSTILL_RAD_S
    rig.arm_and_move_joint()


def test_in_lockstep_same_seed_and_commands_give_same_samples(bench: Bench) -> None:
    """Two runs in lockstep with the same seed and the same commands have bit-identical samples."""
    if bench.clock_mode != "lockstep":
        pytest.skip("this backend supports real time only, which is not exactly repeatable")

    def run_once() -> list[Samples]:
        rig = bench.open_rig()
        rig.arm_and_move_joint()
        rig.command_joints(
            {
                0: (JointMode.TORQUE, -0.1),
                1: (JointMode.POSITION, rig.home_rad[1] + tolerances.STEP_RAD),
            },
            rig.count_periods(tolerances.MOTION_DURATION_S),
        )
        rig.trigger_estop()
        rig.wait_periods(tolerances.ARMING_PERIODS)
        return rig.record_since(1).samples

    first_run = run_once()
    second_run = run_once()
    for a, b in zip(first_run, second_run, strict=True):
        assert a.joints == b.joints, f"the joint states of tick {a.joints.tick} differ"
        assert encode(dict(a.by_key)) == encode(dict(b.by_key)), (
            f"the samples of other sensors differ in tick {a.joints.tick}"
        )
