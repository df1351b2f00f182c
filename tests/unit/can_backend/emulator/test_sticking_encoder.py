"""A physics model in which one encoder has a dead zone."""

import numpy as np
import pytest

from snakesim_drivers.emulation.inertia import InertiaModel, InertiaSettings
from snakesim_hal.physics.sticking_encoder import StickingEncoderModel
from snakesim_testing.can.driver_loop import make_can_config

DEAD_ZONE_RAD = 0.02


def test_measured_angle_sticks_in_dead_zone_then_jumps_to_shaft() -> None:
    run = make_can_config(3)
    shafts = InertiaModel(run, InertiaSettings(drag_nm=0.0))
    model = StickingEncoderModel(shafts, run.robot.joint_table, {"joint_2": DEAD_ZONE_RAD})
    measured_rad = [float(model.angle_rad[1])]
    errors_rad: list[float] = []
    for step in range(600):
        model.advance(np.full(3, 0.05 if (step // 150) % 4 in (0, 3) else -0.05))
        measured_rad.append(float(model.angle_rad[1]))
        errors_rad.append(float(shafts.angle_rad[1] - model.angle_rad[1]))
        assert model.angle_rad[[0, 2]] == pytest.approx(shafts.angle_rad[[0, 2]])
        assert model.velocity_rad_s == pytest.approx(shafts.velocity_rad_s)
    jumps_rad = np.abs(np.diff(measured_rad))
    jumps_rad = jumps_rad[jumps_rad > 0]
    assert len(jumps_rad) > 4
    assert np.min(jumps_rad) >= DEAD_ZONE_RAD
    assert DEAD_ZONE_RAD / 2 < np.max(np.abs(errors_rad)) < DEAD_ZONE_RAD
