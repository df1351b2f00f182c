"""What the host makes of samples where the backend itself knows no faults, and what it passes on or refuses."""

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


class Emulated(LagBackend):
    """Says that nothing real moves."""

    def describe(self) -> RobotDescription:
        return msgspec.structs.replace(super().describe(), emulated=True)


class Leaky(Emulated):
    """Knows one fault by itself."""

    def __init__(self, config: Any) -> None:
        super().__init__(config)
        self.injected: list[tuple[str, bool]] = []

    def inject(self, injection: FaultInjection, *, begins: bool) -> bool:
        if injection.kind != "leak":
            return False
        self.injected.append((str(injection), begins))
        return True


class Bench:
    """A backend whose joints all move, tick by tick."""

    def __init__(self, inner: Backend) -> None:
        self.backend = FaultyBackend(inner)
        self.tick = 0

    def sample(self) -> JointState:
        self.backend.enact(SafeSetpoints([JointMode.VELOCITY] * 3, [1.0] * 3, [4.0] * 3), "armed")
        self.backend.advance()
        self.tick += 1
        return self.backend.sample(self.tick, self.tick * PERIOD_NS).joints

    def inject(self, text: str, *, begins: bool = True) -> None:
        self.backend.inject(parse_injection(f"{text}@0"), begins=begins)


@pytest.fixture
def bench() -> Bench:
    made = Bench(Emulated(make_run_config(rate_hz=100)))
    made.sample()
    return made


def test_without_a_fault_everything_is_the_backends(bench: Bench) -> None:
    assert bench.sample().angle_rad == [0.02] * 3
    assert bench.backend.describe().backend == "lag"
    assert bench.backend.faults() == []


def test_a_mute_joint_says_nothing_and_its_age_grows(bench: Bench) -> None:
    bench.inject("mute:joint_2")
    reported = [bench.sample() for _ in range(3)]
    assert [joints.angle_rad[1] for joints in reported] == [0.01] * 3
    assert [joints.valid for joints in reported] == [[True, False, True]] * 3
    assert [joints.age_ns[1] for joints in reported] == [PERIOD_NS, 2 * PERIOD_NS, 3 * PERIOD_NS]
    assert reported[-1].angle_rad[0] == pytest.approx(0.04)
    assert reported[-1].age_ns[0] == 0
    bench.inject("mute:joint_2", begins=False)
    back = bench.sample()
    assert back.valid == [True] * 3
    assert back.age_ns == [0] * 3
    assert back.angle_rad[1] == pytest.approx(0.05)


def test_a_frozen_joint_repeats_itself_and_grows_old(bench: Bench) -> None:
    bench.inject("freeze:joint_1")
    reported = [bench.sample() for _ in range(3)]
    assert [joints.angle_rad[0] for joints in reported] == [0.01] * 3
    assert all(joints.valid[0] for joints in reported)
    assert reported[-1].age_ns == [3 * PERIOD_NS, 0, 0]


def test_an_angle_can_be_off_and_can_be_no_number(bench: Bench) -> None:
    bench.inject("wrong:joint_3")
    bench.inject("nan:joint_1")
    reported = bench.sample()
    assert math.isnan(reported.angle_rad[0])
    assert reported.angle_rad[1:] == [pytest.approx(0.02), pytest.approx(0.52)]
    bench.inject("wrong:joint_3", begins=False)
    bench.inject("nan:joint_1", begins=False)
    assert bench.sample().angle_rad == [pytest.approx(0.03)] * 3


def test_slow_simulator_sample_takes_the_amount(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    slept_s: list[float] = []
    monkeypatch.setattr(time, "sleep", slept_s.append)
    bench.backend.inject(parse_injection("slow:simulator@0=0.2"), begins=True)
    bench.sample()
    bench.inject("slow:simulator", begins=False)
    bench.sample()
    assert [seconds > 0.0 for seconds in slept_s] == [True, *[False] * (len(slept_s) - 1)]
    assert slept_s[0] <= 0.05


def test_injection_is_offered_to_backend_first_else_refused(bench: Bench) -> None:
    leaky = Leaky(make_run_config())
    able = Bench(leaky)
    able.inject("leak:joint_1")
    able.inject("leak:joint_1", begins=False)
    assert leaky.injected == [("leak:joint_1@0", True), ("leak:joint_1@0", False)]
    able.inject("mute:joint_1")
    assert able.sample().valid == [False, True, True]
    for backend in (able, bench):
        with raises_error(ConfigError, code="injection/not-supported", field="lag"):
            backend.inject("reboot:joint_1")
    with raises_error(ConfigError, code="injection/unknown-target", field="joint_4"):
        bench.inject("mute:joint_4")
    with raises_error(ConfigError, code="injection/not-supported"):
        Bench(LagBackend(make_run_config())).inject("slow:simulator")
