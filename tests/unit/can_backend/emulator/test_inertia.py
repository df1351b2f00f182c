"""The physics model without a world."""

from typing import Any

import numpy as np
import pytest

from snakesim_drivers.emulation.inertia import InertiaModel, InertiaSettings
from snakesim_testing.can.driver_loop import make_can_config

INERTIA = 0.005 + 0.2 * 0.1**2 / 12  # of the middle joints of the test robot


def physics_model(**settings: Any) -> InertiaModel:
    return InertiaModel(make_can_config(3), InertiaSettings(**{"drag_nm": 0.0, **settings}))


def push(made: InertiaModel, torque_nm: float, seconds: float) -> None:
    for _ in range(round(seconds / made.step_s)):
        made.advance(np.full(3, torque_nm))


def test_a_torque_speeds_up_an_inertia():
    made = physics_model()
    push(made, 0.1, 0.1)
    assert made.velocity_rad_s[0] == pytest.approx(0.1 * 0.1 / INERTIA)
    assert made.angle_rad[0] == pytest.approx(0.5 * 0.1 / INERTIA * 0.1**2, rel=0.02)


def test_released_joint_comes_to_rest_without_reversing():
    made = physics_model(drag_nm=0.1)
    push(made, 0.5, 0.02)
    speeds = []
    for _ in range(200):
        made.advance(np.zeros(3))
        speeds.append(made.velocity_rad_s[0])
    assert min(speeds) == 0.0
    assert speeds[-1] == 0.0


def test_an_end_stop_takes_all_motion():
    made = physics_model()
    push(made, 4.0, 0.5)
    assert made.angle_rad == pytest.approx([1.5] * 3)
    assert made.velocity_rad_s == pytest.approx([0.0] * 3)
    push(made, -4.0, 0.005)
    assert (made.velocity_rad_s < 0).all()


def test_a_whole_number_of_steps_makes_a_period():
    run = make_can_config(3, rate_hz=300)
    steps = run.period_ns * 1e-9 / InertiaModel(run, InertiaSettings()).step_s
    assert steps == pytest.approx(4.0)


def test_inertia_emulator_has_no_world():
    made = physics_model()
    assert made.loads() == []
    assert made.imu() is None
    assert made.pose() is None
