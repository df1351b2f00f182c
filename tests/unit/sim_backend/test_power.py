"""Tests the temperatures of simulated windings, the power sensor, and injected overheating."""

from math import inf

import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.fault_kinds import FaultInjection
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import JointMode, Power, SensorDescription
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config

WITH_POWER_SENSOR = {"sensors!": {"joints": {}, "power": {"rate_hz": 5.0}}}
WITHOUT_POWER_SENSOR = {"sensors!": {"joints": {}}}


def make_overheating(end_s: float = inf) -> FaultInjection:
    """Return an injection that overheats joint_3 until a time."""
    return FaultInjection("overheat", "joint_3", 0.0, end_s)


def test_power_sample_keeps_its_rate_and_starts_at_ambient():
    run = SimulatorRig(make_config(WITH_POWER_SENSOR))
    sensor = SensorDescription(key=keys.POWER, rate_hz=5.0, delay_s=0.0)
    assert sensor in run.sim.describe().sensors
    power = run.sample_only_sensor(Power)
    assert power.motor_c == power.board_c == [20.0] * run.count
    assert power.voltage_v == [24.0] * run.count
    assert power.current_a == pytest.approx([0.05] * run.count)
    assert power.valid == [True] * run.count
    assert power.leak == [False] * run.count
    sample_ticks: list[int] = []
    for _ in range(40):
        run.advance()
        if keys.POWER in run.sample().by_key:
            sample_ticks.append(run.tick)
    assert sample_ticks == [20, 40]


def test_motor_under_load_gets_warm_and_takes_current():
    run = SimulatorRig(make_config(WITH_POWER_SENSOR))
    run.sample()
    run.command(JointMode.TORQUE, [3.5, *[0.0] * (run.count - 1)])
    run.advance(6.0)
    power = run.sample_only_sensor(Power)
    # The joint turns to its stop and pushes; 3.5 of 7 N·m settle at 80 °C, by a time constant of a minute.
    assert power.motor_c[0] == pytest.approx(20 + 60 * (1 - 2.718 ** (-6 / 60)), abs=0.6)
    assert power.motor_c[-1] < 20.5
    assert power.current_a[0] > 0.4 > power.current_a[-1]


def test_injected_overheating_persists_or_cools_down_after_its_end():
    run = SimulatorRig(make_config(WITH_POWER_SENSOR))
    for end_s, expected_c in ((inf, 109.0), (5.0, 110.0)):
        assert run.sim.inject(make_overheating(end_s), begins=True)
        run.advance(1.0)
        assert run.sample_only_sensor(Power).motor_c[2] == pytest.approx(expected_c, abs=1.0)
    assert run.sample_only_sensor(Power).motor_c[1] == pytest.approx(20.0, abs=0.1)
    assert run.sim.inject(make_overheating(5.0), begins=False)
    run.advance(10.0)
    assert run.sample_only_sensor(Power).motor_c[2] < 98.0


def test_injected_overheating_without_power_sensor_is_refused():
    faults = ["overheat:joint_1@1"]
    with raises_error(ConfigError, code="injection/not-supported"):
        SimBackend.check(make_config(WITHOUT_POWER_SENSOR, faults=faults), SimSettings())
    run = SimulatorRig(make_config(WITHOUT_POWER_SENSOR))
    assert not run.sim.inject(make_overheating(), begins=True)
    assert SimBackend.check(make_config(WITH_POWER_SENSOR, faults=faults), SimSettings())
