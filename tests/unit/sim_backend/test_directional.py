"""Tests directional friction of single contacts: its sliding and viscous forces, its axis, and its energy."""

import math

import mujoco
import numpy as np
import pytest

from snakesim_sim_backend.laws.directional import (
    NO_AXIS,
    DirectionalCoefficients,
    LinkUndersides,
    apply_directional_friction,
    combine_coefficients,
)
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.hypothesis_profiles import choose_trial_count
from snakesim_testing.sim.simulator_rig import make_config, make_resting_body

HU = (0.11, 0.14, 0.19)  # coefficients of Hu et al.: forward, backward, sideways
# Values of a foot of 0.3 kg, with steps of 2 ms.
STIFFNESS_N_PER_M = 5000.0
DAMPING_N_PER_M = 30000.0
NORMAL_N = 3.0
UP = (0.0, 0.0, 1.0)


def make_hu_coefficients(min_friction: float = 0.0) -> DirectionalCoefficients:
    return combine_coefficients(*HU, 0.0, 0.0, min_friction)


@pytest.mark.parametrize("angle_rad", np.linspace(0.0, 6.2, 9).tolist())
def test_directional_friction_of_sliding_foot_equals_hu_formula(angle_rad: float) -> None:
    velocity = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
    isotropic = -make_hu_coefficients().largest * NORMAL_N * velocity
    x, y, z = isotropic.tolist()
    force = apply_directional_friction(
        (x, y, z), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), make_hu_coefficients(), 0.0
    )
    along = HU[0] if velocity[0] > 0 else HU[1]
    assert force == pytest.approx(
        (-NORMAL_N * along * velocity[0], -NORMAL_N * HU[2] * velocity[1], 0.0)
    )
    assert np.dot(force, velocity) < 0.0


def test_directional_coefficients_that_are_equal_are_isotropic() -> None:
    assert not combine_coefficients(0.3, 0.3, 0.3, 0.0, 0.0, 0.0).is_directional
    assert not combine_coefficients(0.0, 0.0, 0.0, 0.0, 0.0, 0.0).is_directional
    assert combine_coefficients(0.3, 0.3, 0.3, 0.0, 1.0, 0.0).is_directional
    assert make_hu_coefficients().is_directional
    assert make_hu_coefficients(min_friction=2.0) == (2.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)


def test_directional_friction_without_axis_is_sideways_everywhere() -> None:
    force = apply_directional_friction(
        (-1.0, 2.0, 0.0),
        (0.0, 0.0, 0.0),
        NO_AXIS,
        DirectionalCoefficients(1.0, 0.2, 0.3, 0.5, 0, 0),
        0.0,
    )
    assert force == (-0.5, 1.0, 0.0)


def test_viscous_friction_is_normal_force_times_coefficient_times_speed() -> None:
    step_s = 0.002
    velocity_m_s = np.array([0.3, -0.2, 0.0])
    x, y, z = (velocity_m_s * step_s).tolist()
    coefficients = combine_coefficients(0.0, 0.0, 0.0, 0.5, 3.0, 0.0)
    force = apply_directional_friction(
        (0.0, 0.0, 0.0), (x, y, z), (0.0, 1.0, 0.0), coefficients, NORMAL_N / step_s
    )
    assert force == pytest.approx((-NORMAL_N * 3.0 * 0.3, NORMAL_N * 0.5 * 0.2, 0.0))


@pytest.mark.trials
@pytest.mark.parametrize("coefficients", [HU, (0.01, 0.01, 0.6), (0.5, 0.1, 0.1), (0.1, 0.3, 0.2)])
def test_directional_friction_never_gives_more_than_spring_energy(
    coefficients: tuple[float, float, float],
) -> None:
    """A foot moves at random, jerks and reverses, and its link turns: the work that friction does is bounded."""
    random = np.random.default_rng(5)
    combined = combine_coefficients(*coefficients, 0.0, 0.0, 0.0)
    limit_n = combined.largest * NORMAL_N
    max_energy_j = 0.5 * limit_n**2 / STIFFNESS_N_PER_M
    for turn_per_step_rad in (0.0, 0.003):
        stretch_m = np.zeros(2)
        smooth_slip_m = np.zeros(2)
        last_force_n = np.zeros(2)
        heading_rad = 0.0
        work_j = 0.0
        max_work_j = 0.0
        slid_m = 0.0
        for _ in range(choose_trial_count(5_000)):
            smooth_slip_m += 0.3 * (random.normal(0.0, 2e-5, 2) - smooth_slip_m)
            slip_m = smooth_slip_m * random.choice([0.1, 1.0, 1.0, 3.0])
            heading_rad += turn_per_step_rad * random.normal()
            # The isotropic force of a spring and a damper is limited by friction.
            stretch_m = stretch_m + slip_m
            spring_n = STIFFNESS_N_PER_M * np.hypot(*stretch_m)
            stretch_m *= min(1.0, limit_n / max(spring_n, 1e-12))
            isotropic_n = -STIFFNESS_N_PER_M * stretch_m - DAMPING_N_PER_M * slip_m
            isotropic_n *= min(1.0, limit_n / max(np.hypot(*isotropic_n), 1e-12))
            axis = (math.cos(heading_rad), math.sin(heading_rad), 0.0)
            x, y, _ = apply_directional_friction(
                (isotropic_n[0], isotropic_n[1], 0.0),
                (slip_m[0], slip_m[1], 0.0),
                axis,
                combined,
                0.0,
            )
            force_n = np.array([x, y])
            work_j += 0.5 * float((last_force_n + force_n) @ slip_m)
            last_force_n = force_n
            slid_m += float(np.hypot(*slip_m))
            max_work_j = max(max_work_j, work_j)
        assert max_work_j < max_energy_j, "friction drives the foot"
        assert work_j < -0.1 * min(coefficients) * NORMAL_N * slid_m, "friction hardly brakes"


def test_underside_axis_turns_from_link_to_link() -> None:
    config = make_config({"chain": {"modules": 3}})
    sim, data, _ = make_resting_body(config, SimSettings(), 0.4)
    lengths_m = config.robot.link_lengths_m
    underside = LinkUndersides(data, sim.first_link_body, lengths_m)
    first = sim.first_link_body

    def heading_rad(link: int, along_m: float) -> float:
        neighbor, weight = underside.find_neighbor(first + link, along_m)
        x, y, _ = underside.find_axis(first + link, neighbor, weight, UP)
        return math.atan2(y, x)

    assert heading_rad(0, 0.0) == pytest.approx(0.0)
    assert heading_rad(1, lengths_m[1] / 2) == pytest.approx(0.4)
    assert heading_rad(0, lengths_m[0]) == pytest.approx(0.2)
    assert heading_rad(1, 0.0) == pytest.approx(0.2), (
        "both links of a joint have the same direction there"
    )
    assert heading_rad(1, lengths_m[1]) == pytest.approx(0.6)
    assert heading_rad(3, lengths_m[3]) == pytest.approx(1.2)


def test_underside_excludes_sides_and_back_of_a_link() -> None:
    config = make_config({"chain": {"modules": 3}})
    sim, data, physics = make_resting_body(config, SimSettings())
    underside = LinkUndersides(data, sim.first_link_body, config.robot.link_lengths_m)
    body = sim.first_link_body + 1
    faces_ground = []
    for roll_rad in (0.0, 0.7, 0.9, math.pi):
        mujoco.mju_axisAngle2Quat(data.qpos[3:7], np.array([1.0, 0.0, 0.0]), roll_rad)
        physics.forward()
        faces_ground.append(underside.faces(body, body, 0.0, UP))
    assert faces_ground == [True, True, False, False]
