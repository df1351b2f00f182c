"""Closing, reopening, and repeatability."""

import contextlib

import numpy as np
import pytest

from snakesim_hal.backend import Samples
from snakesim_hal.base.errors import BackendError
from snakesim_hal.wire.codec import encode
from snakesim_hal.wire.messages import JointState, Mode
from snakesim_testing.contract import tolerances as t
from snakesim_testing.contract.bench import Bench
from snakesim_testing.contract.rig import Rig, unlimited
from snakesim_testing.contract.test_lifecycle import GO


def keep_using(rig: Rig) -> list[JointState]:
    """Go on as if nothing had happened. A closed backend may raise BackendError, and nothing else."""
    seen: list[JointState] = []
    for tick in range(rig.tick + 1, rig.tick + 1 + t.CLOSING_PERIODS):
        with contextlib.suppress(BackendError):
            rig.backend.enact(unlimited(rig.make_setpoints(GO)), "armed")
        with contextlib.suppress(BackendError):
            rig.backend.advance()
        with contextlib.suppress(BackendError):
            rig.backend.faults()
        with contextlib.suppress(BackendError):
            seen.append(rig.backend.sample(tick, tick * rig.period_ns).joints)
    return seen


def test_a_closed_backend_drives_nothing(bench: Bench, rig: Rig) -> None:
    """Closed while a joint moves, and handed setpoints afterwards: nothing is driven any more."""
    rig.cruise()
    before = rig.newest_joints.angle_rad[0]
    rig.close()
    went = max((abs(joints.angle_rad[0] - before) for joints in keep_using(rig)), default=0.0)
    coasting = 0.5 * t.CRUISE_RAD_S * t.CLOSING_PERIODS * rig.period_ns * 1e-9
    assert went < coasting, f"it went on by {went:.3f} rad"


def test_closing_twice_does_no_harm(bench: Bench) -> None:
    """Also right after opening, before anything was sampled; the host closes after errors of every kind."""
    backend = bench.open()
    backend.close()
    backend.close()


def test_a_backend_opens_again_after_it_was_closed(bench: Bench) -> None:
    """In the same process, as after the first opening: disarmed, at rest, and it moves when it is armed."""
    if not bench.was_opened:
        bench.open().close()
    again = bench.open_rig()
    assert np.abs(again.newest_joints.velocity_rad_s).max() < t.STILL_RAD_S
    again.cruise()


def test_in_lockstep_same_seed_and_commands_give_same_samples(bench: Bench) -> None:
    """Two runs in lockstep with the same seed and the same commands have bit-identical samples."""
    if bench.clock_mode != "lockstep":
        pytest.skip("this backend supports real time only, which is not exactly repeatable")

    def once() -> list[Samples]:
        rig = bench.open_rig()
        rig.cruise()
        rig.drive(
            {0: (Mode.TORQUE, -0.1), 1: (Mode.POSITION, rig.home_rad[1] + t.STEP_RAD)}, rig.count_periods(t.CRUISE_S)
        )
        rig.estop()
        rig.idle(t.ARMING_PERIODS)
        return rig.record_since(1).samples

    first, second = once(), once()
    for a, b in zip(first, second, strict=True):
        assert a.joints == b.joints, f"tick {a.joints.tick}"
        assert encode(dict(a.others)) == encode(dict(b.others)), f"tick {a.joints.tick}"
