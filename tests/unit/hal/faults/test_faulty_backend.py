"""The host injects faults into samples of backends that cannot do this, and forwards or refuses other faults."""

import math
import time
from typing import Any

import msgspec
import pytest

from snakesim_hal.backend import Backend, SafeSetpoints
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.faults.faulty_backend import FaultyBackend
from snakesim_hal.model.fault_kinds import FaultInjection, parse_injection
from snakesim_hal.wire.messages import JointMode, JointState, RobotDescription
from snakesim_testing.hal.local_network import LagBackend
from snakesim_testing.hal.small_robots import PERIOD_NS, make_run_config
from snakesim_testing.messages import raises_error


class EmulatedLagBackend(LagBackend):
    """A backend that declares itself as emulated."""

    def describe(self) -> RobotDescription:
        return msgspec.structs.replace(super().describe(), emulated=True)


class LeakyBackend(EmulatedLagBackend):
    """A backend that can inject one kind of fault by itself."""

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self.injected: list[tuple[str, bool]] = []

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        if injection.kind != "leak":
            return False
        self.injected.append((str(injection), begins))
        return True


class FaultyRig:
    """A backend with fault injection whose joints all move with constant velocity."""

    def __init__(self, inner: Backend) -> None:
        self.backend = FaultyBackend(inner)
        self.tick = 0

    def read_joints(self) -> JointState:
        """Move all joints for a tick, and return their state."""
        self.backend.enact(SafeSetpoints([JointMode.VELOCITY] * 3, [1.0] * 3, [4.0] * 3), "armed")
        self.backend.advance()
        self.tick += 1
        return self.backend.sample(self.tick, self.tick * PERIOD_NS).joints

    def inject(self, text: str, *, begins: bool = True) -> None:
        self.backend.inject(parse_injection(f"{text}@0"), begins=begins)


@pytest.fixture
def rig() -> FaultyRig:
    faulty_robot = FaultyRig(EmulatedLagBackend(make_run_config(rate_hz=100)))
    faulty_robot.read_joints()
    return faulty_robot


def test_faulty_backend_without_fault_changes_nothing(rig: FaultyRig) -> None:
    assert rig.read_joints().angle_rad == [0.02] * 3
    assert rig.backend.describe().backend == "lag"
    assert rig.backend.faults() == []


def test_faulty_backend_mute_joint_is_invalid_and_ages(rig: FaultyRig) -> None:
    rig.inject("mute:joint_2")
    joint_states = [rig.read_joints() for _ in range(3)]
    assert [state.angle_rad[1] for state in joint_states] == [0.01] * 3
    assert [state.valid for state in joint_states] == [[True, False, True]] * 3
    assert [state.age_ns[1] for state in joint_states] == [PERIOD_NS, 2 * PERIOD_NS, 3 * PERIOD_NS]
    assert joint_states[-1].angle_rad[0] == pytest.approx(0.04)
    assert joint_states[-1].age_ns[0] == 0
    rig.inject("mute:joint_2", begins=False)
    state_after_end = rig.read_joints()
    assert state_after_end.valid == [True] * 3
    assert state_after_end.age_ns == [0] * 3
    assert state_after_end.angle_rad[1] == pytest.approx(0.05)


def test_faulty_backend_frozen_joint_repeats_its_state_and_ages(rig: FaultyRig) -> None:
    rig.inject("freeze:joint_1")
    joint_states = [rig.read_joints() for _ in range(3)]
    assert [state.angle_rad[0] for state in joint_states] == [0.01] * 3
    assert all(state.valid[0] for state in joint_states)
    assert joint_states[-1].age_ns == [3 * PERIOD_NS, 0, 0]


def test_faulty_backend_angle_can_be_wrong_or_nan(rig: FaultyRig) -> None:
    rig.inject("wrong:joint_3")
    rig.inject("nan:joint_1")
    joint_state = rig.read_joints()
    assert math.isnan(joint_state.angle_rad[0])
    assert joint_state.angle_rad[1:] == [pytest.approx(0.02), pytest.approx(0.52)]
    rig.inject("wrong:joint_3", begins=False)
    rig.inject("nan:joint_1", begins=False)
    assert rig.read_joints().angle_rad == [pytest.approx(0.03)] * 3


def test_slow_simulator_sample_takes_the_amount(
    rig: FaultyRig, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept_s: list[float] = []
    monkeypatch.setattr(time, "sleep", slept_s.append)
    rig.backend.inject(parse_injection("slow:simulator@0=0.2"), begins=True)
    rig.read_joints()
    rig.inject("slow:simulator", begins=False)
    rig.read_joints()
    assert [seconds > 0.0 for seconds in slept_s] == [True, *[False] * (len(slept_s) - 1)]
    assert slept_s[0] <= 0.05


def test_injection_is_offered_to_backend_first_else_refused(rig: FaultyRig) -> None:
    leaky_backend = LeakyBackend(make_run_config())
    injecting_rig = FaultyRig(leaky_backend)
    injecting_rig.inject("leak:joint_1")
    injecting_rig.inject("leak:joint_1", begins=False)
    assert leaky_backend.injected == [("leak:joint_1@0", True), ("leak:joint_1@0", False)]
    injecting_rig.inject("mute:joint_1")
    assert injecting_rig.read_joints().valid == [False, True, True]
    for tested_rig in (injecting_rig, rig):
        with raises_error(ConfigError, code="injection/not-supported", field="lag"):
            tested_rig.inject("reboot:joint_1")
    with raises_error(ConfigError, code="injection/unknown-target", field="joint_4"):
        rig.inject("mute:joint_4")
    with raises_error(ConfigError, code="injection/not-supported"):
        FaultyRig(LagBackend(make_run_config())).inject("slow:simulator")
