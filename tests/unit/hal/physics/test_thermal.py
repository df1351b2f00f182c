"""The thermal model heats windings, and reduces torque before the robot stops."""

from typing import Any

import numpy as np
import pytest

from snakesim_hal.physics.thermal import HeatLimits, ThermalModel
from snakesim_testing.hal.small_robots import make_robot_file

LIMITS = HeatLimits(derate_from_c=80.0, stop_at_c=105.0)


def make_thermal_model(count: int = 1, **exceptions: Any) -> ThermalModel:
    """Return the model of some motors of 4 N·m, with exceptions for joint_1."""
    robot = make_robot_file(
        chain__modules=count, limits__torque_nm=4.0, joints={"joint_1": exceptions}
    )
    return ThermalModel(robot.joint_table)


@pytest.mark.parametrize(
    ("winding_c", "fraction"), [(20.0, 1.0), (80.0, 1.0), (90.0, 0.6), (100.0, 0.2), (150.0, 0.2)]
)
def test_thermal_torque_fraction_falls_from_one_to_a_fifth(winding_c: float, fraction: float):
    limits = HeatLimits(derate_from_c=80.0, stop_at_c=100.0)
    assert limits.compute_remaining_fraction(winding_c) == pytest.approx(fraction)


def test_thermal_half_rated_torque_settles_at_80_degrees() -> None:
    heat = make_thermal_model()
    heat.advance_temperatures(3600.0, np.array([2.0**2]))
    assert heat.winding_temperature_c[0] == pytest.approx(80.0)
    assert heat.compute_remaining_fractions() is None


def test_thermal_model_is_exact_for_any_step() -> None:
    fine = make_thermal_model()
    coarse = make_thermal_model()
    for _ in range(1000):
        fine.advance_temperatures(0.01, np.array([9.0]))
    coarse.advance_temperatures(10.0, np.array([9.0]))
    assert fine.winding_temperature_c == pytest.approx(coarse.winding_temperature_c)
    assert coarse.winding_temperature_c[0] == pytest.approx(
        20 + 240 * 9 / 16 * (1 - np.exp(-10 / 60))
    )


def test_thermal_fraction_is_reported_while_hot_and_after_cooling() -> None:
    heat = make_thermal_model(2)
    for celsius, is_reported in (
        (80.0, False),
        (80.1, True),
        (100.0, True),
        (79.0, True),
        (79.0, False),
    ):
        heat.winding_temperature_c[1] = celsius
        fractions = heat.compute_remaining_fractions()
        assert (fractions is not None) is is_reported
        assert fractions is None or fractions.tolist() == pytest.approx(
            [1.0, LIMITS.compute_remaining_fraction(celsius)]
        )


def test_thermal_stalled_motor_loses_torque_and_never_overheats() -> None:
    heat = make_thermal_model()
    fractions: list[float] = []
    for _ in range(60_000):
        fractions.append(LIMITS.compute_remaining_fraction(float(heat.winding_temperature_c[0])))
        heat.advance_temperatures(0.01, np.array([(4.0 * fractions[-1]) ** 2]))
    assert np.abs(np.diff(fractions)).max() < 0.01
    assert heat.winding_temperature_c[0] < LIMITS.stop_at_c - 5
    assert fractions[-1] < 0.8


def test_thermal_injected_heat_remains_only_while_held() -> None:
    heat = make_thermal_model(2)
    heat.inject_heat(0, heat=True, hold=False)
    heat.inject_heat(1, heat=True, hold=True)
    assert heat.winding_temperature_c.tolist() == [110.0, 110.0], "5 K above the stop temperature"
    heat.advance_temperatures(30.0, np.zeros(2))
    assert heat.winding_temperature_c[0] < 80
    assert heat.winding_temperature_c[1] == 110.0
    heat.inject_heat(1, heat=False, hold=False)
    assert heat.winding_temperature_c[1] == 110.0, "it begins to cool from this temperature"
    heat.advance_temperatures(30.0, np.zeros(2))
    assert heat.winding_temperature_c[1] < 80


def test_thermal_moving_warm_module_needs_more_power() -> None:
    heat = make_thermal_model(4)
    heat.winding_temperature_c[1] = 80.0
    assert heat.compute_board_temperatures_c() == pytest.approx([20.0, 38.0, 20.0, 20.0])
    power_w = heat.compute_power_w(np.array([0.0, 4.0, 2.0, -2.0]), np.array([5.0, 0.0, 3.0, 3.0]))
    assert power_w == pytest.approx([0.0, 48.0, 18.0, 6.0])


def test_thermal_motor_with_exceptions_heats_by_its_own_data() -> None:
    heat = make_thermal_model(
        2,
        rated_nm=2.0,
        rise_at_rated_k=100.0,
        time_constant_s=30.0,
        derate_from_c=50.0,
        board_fraction=0.5,
    )
    heat.advance_temperatures(30.0, np.array([4.0, 4.0]))
    assert heat.winding_temperature_c == pytest.approx(
        [20 + 100 * (1 - np.exp(-1)), 20 + 60 * (1 - np.exp(-0.5))]
    )
    fractions = heat.compute_remaining_fractions()
    assert fractions is not None
    assert fractions[0] < 1.0
    assert fractions[1] == 1.0, "each motor has its own limits"
    assert (heat.compute_board_temperatures_c() - 20) / (
        heat.winding_temperature_c - 20
    ) == pytest.approx([0.5, 0.3])
    assert heat.compute_power_w(np.array([2.0, 2.0]), np.zeros(2)) == pytest.approx([48.0, 12.0])
