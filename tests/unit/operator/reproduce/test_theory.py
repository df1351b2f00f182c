"""The computations that explain differences: a body of endless length, and a chain in the plane."""

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

NO_DRY = DirectionalFriction(0.0, 0.0, 0.0)


@pytest.mark.parametrize("drag_ratio", [2.0, 10.0])
def test_the_formula_of_gray_and_hancock_is_the_balance_of_drag_for_small_bends(
    drag_ratio: float,
) -> None:
    angle_rad = 0.02
    endless = find_endless_motion(angle_rad, GroundFriction(NO_DRY, 1.0, drag_ratio)).speed
    published = find_published_ratio(angle_rad, drag_ratio)
    assert endless / find_axis_ratio(angle_rad) == pytest.approx(published, rel=0.005)


def test_a_body_that_cannot_slip_sideways_moves_one_wave_in_each_period() -> None:
    friction = GroundFriction(DirectionalFriction(0.001, 0.001, 5.0), 0.0, 0.0)
    motion = find_endless_motion(0.9, friction)
    assert motion.speed == pytest.approx(find_axis_ratio(0.9), rel=0.001)
    assert motion.cost == pytest.approx(1.0 / find_axis_ratio(0.9), rel=0.05)


def test_the_length_along_the_axis_is_a_bessel_function() -> None:
    """J0(0.9) by its power series."""
    series = sum((-1) ** k * (0.9 / 2) ** (2 * k) / math.factorial(k) ** 2 for k in range(10))
    assert find_axis_ratio(0.9) == pytest.approx(series, abs=1e-9)


def test_the_optimum_of_an_endless_body_approaches_the_power_of_a_quarter() -> None:
    ratios = (1e4, 1e5)
    optima: list[float] = []
    for ratio in ratios:
        friction = GroundFriction(DirectionalFriction(1.0 / ratio, 1.0 / ratio, 1.0), 0.0, 0.0)
        angles_rad = np.linspace(0.7, 1.3, 61) * (8.0 / ratio) ** 0.25
        costs = [find_endless_motion(angle_rad, friction).cost for angle_rad in angles_rad]
        optima.append(float(angles_rad[np.argmin(costs)]))
    assert fit_exponent(ratios, optima) == pytest.approx(-0.25, abs=0.005)
    assert optima[1] == pytest.approx((8.0 / ratios[1]) ** 0.25, rel=0.03)


def test_friction_opposes_sliding_by_its_direction() -> None:
    friction = GroundFriction(DirectionalFriction(0.11, 0.14, 0.19), 0.5, 3.0)
    slips = np.array([0.2 + 0.0j, -0.2 + 0.0j, 0.2j])
    forces = find_friction_per_load(slips, friction, 0.0)
    assert forces.tolist() == pytest.approx([-0.11 - 0.1, 0.14 + 0.1, -0.19j - 0.6j])


def test_feet_share_the_weight_and_the_directions_of_their_links() -> None:
    loads_n = find_foot_loads_n(np.array([1.0, 3.0]))
    assert loads_n == pytest.approx([0.5 * 9.81, 2.0 * 9.81, 1.5 * 9.81], rel=0.001)
    tangents = find_foot_tangents(np.array([2.0 + 0.0j, 0.0 + 3.0j]))
    assert tangents.tolist() == pytest.approx([1.0, (1.0 + 1.0j) / math.sqrt(2.0), 1.0j])


@pytest.mark.parametrize(("drag_ratio", "sign"), [(4.0, 1.0), (1.0, 0.0)])
def test_a_chain_travels_only_on_ground_that_rubs_more_sideways(
    drag_ratio: float, sign: float
) -> None:
    run = make_serpenoid_run(0.6, 1.0, 1.0, set_viscous(2.0, 2.0 * drag_ratio), module_count=6)
    motion = find_chain_motion(
        run.robot, JointWaves.from_serpenoid(run.robot, 0.6, 1.0, 1.0), run.friction, step_s=0.002
    )
    wave_m_s = run.robot.length_m
    assert motion.speed_m_s / wave_m_s == pytest.approx(0.15 * sign, abs=0.1 if sign else 0.01)
    assert motion.ground_power_w > 0.0


def test_a_chain_dissipates_what_dragging_costs_and_more() -> None:
    run = make_serpenoid_run(0.6, 0.8, 1.0, set_skin(0.1, 0.1, 1.0), module_count=8)
    motion = find_chain_motion(
        run.robot, JointWaves.from_serpenoid(run.robot, 0.6, 0.8, 1.0), run.friction
    )
    weight_n = 9.81 * sum(run.robot.link_masses_kg)
    assert motion.ground_power_w > 0.1 * weight_n * motion.speed_m_s > 0.0


def test_reasons_add_up_to_the_difference() -> None:
    reasons = explain_by_steps(
        [("", 1.0), ("a", 0.9), ("b", 0.95), ("", 0.97)], unit="m/s", rest="contacts"
    )
    assert [reason.cause for reason in reasons] == ["a", "b", "Unknown, possibly contacts."]
    assert [reason.effect for reason in reasons] == pytest.approx([-0.1, 0.05, 0.02])


def test_an_exponent_is_a_slope_of_logarithms() -> None:
    assert fit_exponent([1.0, 2.0, 5.0], [3.0, 12.0, 75.0]) == pytest.approx(2.0)
