"""Tests the computations that explain differences: a body of endless length, and a chain in the plane."""

import math

import numpy as np
import pytest

from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_operator.features.reproduce.endless_curve import find_axis_ratio, find_endless_motion
from snakesim_operator.features.reproduce.experiment import explain_by_steps, fit_exponent
from snakesim_operator.features.reproduce.experiments.gray_hancock import find_published_ratio
from snakesim_operator.features.reproduce.gait_motion import (
    GroundFriction,
    find_foot_loads_n,
    find_foot_tangents,
    find_friction_per_load,
)
from snakesim_operator.features.reproduce.planar_chain import JointWaves, find_chain_motion
from snakesim_operator.features.reproduce.trials import make_serpenoid_run, set_skin, set_viscous

NO_DRY_FRICTION = DirectionalFriction(0.0, 0.0, 0.0)
GRAVITY_M_S2 = 9.81
WAVE_ANGLE_RAD = 0.9
FORWARD_FRICTION = 0.1


@pytest.mark.parametrize("drag_ratio", [2.0, 10.0])
def test_endless_motion_with_small_bends_equals_gray_hancock_formula(drag_ratio: float) -> None:
    angle_rad = 0.02
    motion = find_endless_motion(angle_rad, GroundFriction(NO_DRY_FRICTION, 1.0, drag_ratio))
    published = find_published_ratio(angle_rad, drag_ratio)
    assert motion.speed / find_axis_ratio(angle_rad) == pytest.approx(published, rel=0.005)


def test_endless_motion_without_side_slip_follows_the_wave() -> None:
    friction = GroundFriction(DirectionalFriction(0.001, 0.001, 5.0), 0.0, 0.0)
    motion = find_endless_motion(WAVE_ANGLE_RAD, friction)
    axis_ratio = find_axis_ratio(WAVE_ANGLE_RAD)
    assert motion.speed == pytest.approx(axis_ratio, rel=0.001)
    assert motion.cost == pytest.approx(1.0 / axis_ratio, rel=0.05)


def test_axis_ratio_equals_bessel_function() -> None:
    """The ratio is the Bessel function J0 of the angle, here computed by its power series."""
    series = sum(
        (-1) ** k * (WAVE_ANGLE_RAD / 2) ** (2 * k) / math.factorial(k) ** 2 for k in range(10)
    )
    assert find_axis_ratio(WAVE_ANGLE_RAD) == pytest.approx(series, abs=1e-9)


def test_endless_motion_optimum_approaches_power_of_a_quarter() -> None:
    friction_ratios = (1e4, 1e5)
    optimal_angles_rad: list[float] = []
    for ratio in friction_ratios:
        friction = GroundFriction(DirectionalFriction(1.0 / ratio, 1.0 / ratio, 1.0), 0.0, 0.0)
        angles_rad = np.linspace(0.7, 1.3, 61) * (8.0 / ratio) ** 0.25
        costs = [find_endless_motion(angle_rad, friction).cost for angle_rad in angles_rad]
        optimal_angles_rad.append(float(angles_rad[np.argmin(costs)]))
    assert fit_exponent(friction_ratios, optimal_angles_rad) == pytest.approx(-0.25, abs=0.005)
    expected_rad = (8.0 / friction_ratios[1]) ** 0.25
    assert optimal_angles_rad[1] == pytest.approx(expected_rad, rel=0.03)


def test_friction_opposes_sliding_in_each_direction() -> None:
    friction = GroundFriction(DirectionalFriction(0.11, 0.14, 0.19), 0.5, 3.0)
    # Velocities and forces are complex: real part along the body, imaginary part across it.
    slip_m_s = np.array([0.2 + 0.0j, -0.2 + 0.0j, 0.2j])
    forces_per_load = find_friction_per_load(slip_m_s, friction, 0.0)
    assert forces_per_load.tolist() == pytest.approx([-0.11 - 0.1, 0.14 + 0.1, -0.19j - 0.6j])


def test_feet_share_weight_and_directions_of_their_links() -> None:
    loads_n = find_foot_loads_n(np.array([1.0, 3.0]))
    assert loads_n == pytest.approx(
        [0.5 * GRAVITY_M_S2, 2.0 * GRAVITY_M_S2, 1.5 * GRAVITY_M_S2], rel=0.001
    )
    tangents = find_foot_tangents(np.array([2.0 + 0.0j, 0.0 + 3.0j]))
    assert tangents.tolist() == pytest.approx([1.0, (1.0 + 1.0j) / math.sqrt(2.0), 1.0j])


@pytest.mark.parametrize(("drag_ratio", "direction"), [(4.0, 1.0), (1.0, 0.0)])
def test_chain_travels_only_with_more_sideways_friction(
    drag_ratio: float, direction: float
) -> None:
    run = make_serpenoid_run(0.6, 1.0, 1.0, set_viscous(2.0, 2.0 * drag_ratio), module_count=6)
    waves = JointWaves.from_serpenoid(run.robot, 0.6, 1.0, 1.0)
    motion = find_chain_motion(run.robot, waves, run.friction, step_s=0.002)
    wave_speed_m_s = run.robot.length_m
    tolerance = 0.1 if direction else 0.01
    assert motion.speed_m_s / wave_speed_m_s == pytest.approx(0.15 * direction, abs=tolerance)
    assert motion.ground_power_w > 0.0


def test_chain_dissipates_more_power_than_dragging() -> None:
    run = make_serpenoid_run(0.6, 0.8, 1.0, set_skin(FORWARD_FRICTION, 0.1, 1.0), module_count=8)
    waves = JointWaves.from_serpenoid(run.robot, 0.6, 0.8, 1.0)
    motion = find_chain_motion(run.robot, waves, run.friction)
    weight_n = GRAVITY_M_S2 * sum(run.robot.link_masses_kg)
    dragging_power_w = FORWARD_FRICTION * weight_n * motion.speed_m_s
    assert motion.ground_power_w > dragging_power_w > 0.0


def test_explanation_reasons_add_up_to_the_difference() -> None:
    reasons = explain_by_steps(
        [("", 1.0), ("a", 0.9), ("b", 0.95), ("", 0.97)], unit="m/s", rest="contacts"
    )
    assert [reason.cause for reason in reasons] == ["a", "b", "Unknown, possibly contacts."]
    assert [reason.effect for reason in reasons] == pytest.approx([-0.1, 0.05, 0.02])


def test_fitted_exponent_equals_slope_of_logarithms() -> None:
    assert fit_exponent([1.0, 2.0, 5.0], [3.0, 12.0, 75.0]) == pytest.approx(2.0)
