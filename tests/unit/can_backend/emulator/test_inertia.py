"""The physics model of separate inertias: each joint accelerates alone, without contacts."""

from typing import Any

import numpy as np
import pytest

from snakesim_drivers.emulation.inertia import InertiaModel, InertiaSettings
from snakesim_testing.can.driver_loop import make_can_config

INERTIA_KG_M2 = 0.005 + 0.2 * 0.1**2 / 12  # kg·m², of the middle joints of the test robot


def make_model(**settings: Any) -> InertiaModel:
    return InertiaModel(make_can_config(3), InertiaSettings(**{"drag_nm": 0.0, **settings}))


def apply_torque(model: InertiaModel, torque_nm: float, seconds: float) -> None:
    """Apply a torque to every joint for some time."""
    for _ in range(round(seconds / model.step_s)):
        model.advance(np.full(3, torque_nm))


def test_torque_accelerates_an_inertia():
    model = make_model()
    apply_torque(model, 0.1, 0.1)
    assert model.velocity_rad_s[0] == pytest.approx(0.1 * 0.1 / INERTIA_KG_M2)
    assert model.angle_rad[0] == pytest.approx(0.5 * 0.1 / INERTIA_KG_M2 * 0.1**2, rel=0.02)


def test_released_joint_comes_to_rest_without_reversing():
    model = make_model(drag_nm=0.1)
    apply_torque(model, 0.5, 0.02)
    speeds = []
    for _ in range(200):
        model.advance(np.zeros(3))
        speeds.append(model.velocity_rad_s[0])
    assert min(speeds) == 0.0
    assert speeds[-1] == 0.0


def test_joint_at_its_end_stop_stops_completely():
    model = make_model()
    apply_torque(model, 4.0, 0.5)
    assert model.angle_rad == pytest.approx([1.5] * 3)
    assert model.velocity_rad_s == pytest.approx([0.0] * 3)
    apply_torque(model, -4.0, 0.005)
    assert (model.velocity_rad_s < 0).all()


def test_control_period_is_a_whole_number_of_steps():
    run = make_can_config(3, rate_hz=300)
    steps = run.period_ns * 1e-9 / InertiaModel(run, InertiaSettings()).step_s
    assert steps == pytest.approx(4.0)


def test_inertia_model_has_no_contacts_imu_or_pose():
    model = make_model()
    assert model.loads() == []
    assert model.imu() is None
    assert model.pose() is None
