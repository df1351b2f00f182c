"""Friction by direction, contact by contact: the set of forces, the force of sliding, and that it never drives."""

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

HU = (0.11, 0.14, 0.19)  # forward, backward, sideways
STIFFNESS, DAMPING, NORMAL_N = 5000.0, 30000.0, 3.0  # of a foot of 0.3 kg, with steps of 2 ms
UP = (0.0, 0.0, 1.0)


def hu(min_friction: float = 0.0) -> DirectionalCoefficients:
    return combine_coefficients(*HU, 0.0, 0.0, min_friction)


@pytest.mark.parametrize("angle_rad", np.linspace(0.0, 6.2, 9).tolist())
def test_sliding_force_is_that_of_hu_in_every_direction(angle_rad: float) -> None:
    velocity = np.array([math.cos(angle_rad), math.sin(angle_rad), 0.0])
    isotropic = -hu().largest * NORMAL_N * velocity
    x, y, z = isotropic.tolist()
    force = apply_directional_friction((x, y, z), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0), hu(), 0.0)
    along = HU[0] if velocity[0] > 0 else HU[1]
    assert force == pytest.approx(
        (-NORMAL_N * along * velocity[0], -NORMAL_N * HU[2] * velocity[1], 0.0)
    )
    assert np.dot(force, velocity) < 0.0


def test_equal_coefficients_are_not_directional() -> None:
    assert not combine_coefficients(0.3, 0.3, 0.3, 0.0, 0.0, 0.0).is_directional
    assert not combine_coefficients(0.0, 0.0, 0.0, 0.0, 0.0, 0.0).is_directional
    assert combine_coefficients(0.3, 0.3, 0.3, 0.0, 1.0, 0.0).is_directional
    assert hu().is_directional
    assert hu(min_friction=2.0) == (2.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0)


def test_without_an_axis_all_directions_are_sideways() -> None:
    force = apply_directional_friction(
        (-1.0, 2.0, 0.0),
        (0.0, 0.0, 0.0),
        NO_AXIS,
        DirectionalCoefficients(1.0, 0.2, 0.3, 0.5, 0, 0),
        0.0,
    )
    assert force == (-0.5, 1.0, 0.0)


def test_viscous_force_is_normal_force_times_coefficient_times_speed() -> None:
    step_s, speed = 0.002, np.array([0.3, -0.2, 0.0])
    x, y, z = (speed * step_s).tolist()
    coefficients = combine_coefficients(0.0, 0.0, 0.0, 0.5, 3.0, 0.0)
    force = apply_directional_friction(
        (0.0, 0.0, 0.0), (x, y, z), (0.0, 1.0, 0.0), coefficients, NORMAL_N / step_s
    )
    assert force == pytest.approx((-NORMAL_N * 3.0 * 0.3, NORMAL_N * 0.5 * 0.2, 0.0))


@pytest.mark.trials
@pytest.mark.parametrize("coefficients", [HU, (0.01, 0.01, 0.6), (0.5, 0.1, 0.1), (0.1, 0.3, 0.2)])
def test_friction_never_gives_more_energy_than_its_spring_has(
    coefficients: tuple[float, float, float],
) -> None:
    """A foot moves at random, jerks and reverses, and its link turns: the work that friction does is bounded."""
    random = np.random.default_rng(5)
    found = combine_coefficients(*coefficients, 0.0, 0.0, 0.0)
    limit_n = found.largest * NORMAL_N
    max_energy_j = 0.5 * limit_n**2 / STIFFNESS
    for turning in (0.0, 0.003):
        stretch, work_j, heading, highest_j, slid_m = np.zeros(2), 0.0, 0.0, 0.0, 0.0
        velocity = np.zeros(2)
        last_force = np.zeros(2)
        for _ in range(choose_trial_count(5_000)):
            velocity += 0.3 * (random.normal(0.0, 2e-5, 2) - velocity)
            slip = velocity * random.choice([0.1, 1.0, 1.0, 3.0])
            heading += turning * random.normal()
            stretch = stretch + slip
            size_n = STIFFNESS * np.hypot(*stretch)
            stretch *= min(1.0, limit_n / max(size_n, 1e-12))
            pull = -STIFFNESS * stretch - DAMPING * slip
            pull *= min(1.0, limit_n / max(np.hypot(*pull), 1e-12))
            axis = (math.cos(heading), math.sin(heading), 0.0)
            x, y, _ = apply_directional_friction(
                (pull[0], pull[1], 0.0), (slip[0], slip[1], 0.0), axis, found, 0.0
            )
            force = np.array([x, y])
            work_j += 0.5 * float((last_force + force) @ slip)
            last_force = force
            slid_m += float(np.hypot(*slip))
            highest_j = max(highest_j, work_j)
        assert highest_j < max_energy_j, "it drives the foot"
        assert work_j < -0.1 * min(coefficients) * NORMAL_N * slid_m, "it hardly brakes"


def test_underside_turns_from_link_to_link() -> None:
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


def test_sides_and_back_of_a_link_are_not_its_underside() -> None:
    config = make_config({"chain": {"modules": 3}})
    sim, data, physics = make_resting_body(config, SimSettings())
    underside = LinkUndersides(data, sim.first_link_body, config.robot.link_lengths_m)
    body = sim.first_link_body + 1
    faces = []
    for roll_rad in (0.0, 0.7, 0.9, math.pi):
        mujoco.mju_axisAngle2Quat(data.qpos[3:7], np.array([1.0, 0.0, 0.0]), roll_rad)
        physics.forward()
        faces.append(underside.faces(body, body, 0.0, UP))
    assert faces == [True, True, False, False]
