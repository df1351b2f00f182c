"""A physics model whose drives reach their links through backlash."""

import numpy as np
import pytest

from snakesim_drivers.emulation.inertia import InertiaModel, InertiaSettings
from snakesim_hal.physics.backlash import BacklashModel, move_rotor_inertia_to_motor_side
from snakesim_testing.can.driver_loop import config

BACKLASH_RAD = 0.03


def test_backlash_drive_turns_through_gap_before_its_link_moves() -> None:
    run = config(3)
    joints = run.robot.joint_table
    backlash_rad = {"joint_2": BACKLASH_RAD}
    links = InertiaModel(
        move_rotor_inertia_to_motor_side(run, joints, backlash_rad), InertiaSettings(drag_nm=0.02)
    )
    physics_model = BacklashModel(links, joints, backlash_rad, seed=1)
    sound = InertiaModel(run, InertiaSettings(drag_nm=0.02))
    apart: list[float] = []
    for step in range(600):
        torque_nm = np.full(3, 0.1 if (step // 150) % 2 == 0 else -0.1)
        physics_model.advance(torque_nm)
        sound.advance(torque_nm)
        apart.append(float(physics_model.angle_rad[1] - links.angle_rad[1]))
    assert np.ptp(apart) == pytest.approx(BACKLASH_RAD, abs=0.003)
    assert physics_model.angle_rad[[0, 2]] == pytest.approx(sound.angle_rad[[0, 2]])
    assert np.ptp(apart[:3]) < 0.01  # a rotor has mass
