"""A physics model whose drives move their links through backlash, or through a coupling that slips."""

import numpy as np
import pytest

from snakesim_drivers.emulation.inertia import InertiaModel, InertiaSettings
from snakesim_hal.physics.loose_gear import (
    LooseGearModel,
    Looseness,
    move_rotor_inertia_to_motor_side,
)
from snakesim_testing.can.driver_loop import make_can_config

BACKLASH_RAD = 0.03
SLIP_NM = 0.2


def test_backlash_drive_turns_through_gap_before_its_link_moves() -> None:
    run = make_can_config(3)
    joints = run.robot.joint_table
    looseness = {"joint_2": Looseness(backlash_rad=BACKLASH_RAD)}
    links = InertiaModel(
        move_rotor_inertia_to_motor_side(run, joints, looseness), InertiaSettings(drag_nm=0.02)
    )
    physics_model = LooseGearModel(links, joints, looseness, seed=1)
    rigid_model = InertiaModel(run, InertiaSettings(drag_nm=0.02))
    gaps_rad: list[float] = []
    for step in range(600):
        torque_nm = np.full(3, 0.1 if (step // 150) % 2 == 0 else -0.1)
        physics_model.advance(torque_nm)
        rigid_model.advance(torque_nm)
        gaps_rad.append(float(physics_model.angle_rad[1] - links.angle_rad[1]))
    assert np.ptp(gaps_rad) == pytest.approx(BACKLASH_RAD, abs=0.003)
    assert physics_model.angle_rad[[0, 2]] == pytest.approx(rigid_model.angle_rad[[0, 2]])
    assert np.ptp(gaps_rad[:3]) < 0.01  # a rotor has inertia, and cannot cross the gap at once


def test_link_behind_slipping_coupling_gets_at_most_the_slip_torque() -> None:
    run = make_can_config(3)
    joints = run.robot.joint_table
    looseness = {"joint_2": Looseness(slip_torque_nm=SLIP_NM)}
    links = InertiaModel(
        move_rotor_inertia_to_motor_side(run, joints, looseness),
        InertiaSettings(drag_nm=2 * SLIP_NM),  # so that the link never moves
    )
    physics_model = LooseGearModel(links, joints, looseness, seed=1)
    start_rad = links.angle_rad.copy()
    shaft_torque_nm: list[float] = []
    drive_rad: list[float] = []
    for step in range(400):
        motor_nm = 1.5 * SLIP_NM if step < 200 else -1.5 * SLIP_NM
        physics_model.advance(np.full(3, motor_nm))
        shaft_torque_nm.append(float(physics_model.shaft_torque_nm()[1]))
        drive_rad.append(float(physics_model.angle_rad[1]))
    assert np.max(np.abs(shaft_torque_nm)) == pytest.approx(SLIP_NM)
    assert shaft_torque_nm[190] == -shaft_torque_nm[-1] == pytest.approx(SLIP_NM)
    assert max(drive_rad) - start_rad[1] > 0.1, "the drive continues to rotate"
    assert links.angle_rad == pytest.approx(start_rad, abs=1e-9)


def test_link_below_slip_torque_follows_its_drive() -> None:
    run = make_can_config(3)
    joints = run.robot.joint_table
    looseness = {"joint_2": Looseness(slip_torque_nm=5.0)}
    links = InertiaModel(
        move_rotor_inertia_to_motor_side(run, joints, looseness), InertiaSettings(drag_nm=0.02)
    )
    physics_model = LooseGearModel(links, joints, looseness, seed=1)
    for step in range(600):
        physics_model.advance(np.full(3, 0.1 if (step // 150) % 2 == 0 else -0.1))
        # A torque of 0.1 N·m bends the spring of the teeth by a third of a milliradian.
        assert abs(physics_model.angle_rad[1] - links.angle_rad[1]) < 1e-3
