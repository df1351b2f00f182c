"""Links slide more easily along the body than across it, and the laws of dry friction hold on every surface."""

from typing import Any

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import load_scenario, parse_set_option
from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_operator.run.in_process import simulate
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.sim.gliding import SURFACES, GlidingSnake, glide_without_mujoco
from snakesim_testing.sim.simulator_rig import G, make_config, make_resting_body
from snakesim_testing.sim.waves import JointWave, integrate_momentum_balance, simulate_wave

SCALES_FRICTION = DirectionalFriction(0.11, 0.14, 0.19)
SCALES = {"skin": {"forward": 0.11, "backward": 0.14, "sideways": 0.19}}
TURNED_SCALES = {"skin": {"forward": 0.14, "backward": 0.11, "sideways": 0.19}}
WHEELS = {
    "wheels": {
        "radius_m": 0.03,
        "bearing_radius_m": 0.003,
        "bearing_friction": 0.1,
        "tire_friction": 0.6,
    }
}
CLOTH = {"friction": 0.19}
MUD = {"friction": 0.0, "viscous": {"along_s_per_m": 0.5, "across_s_per_m": 3.0}}
FULL_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
WAVE = JointWave(0.3, 0.7, 4.0)
MAX_SPURIOUS_DRIFT_MM_S = 1.0
# Relative to the drag. On hills MuJoCo distributes the weight among contacts that appear and disappear.
DRAG_TOLERANCE = {
    "flat ground": 0.01,
    "level hills": 0.015,
    "step": 0.01,
    "top of an obstacle": 0.01,
}
# In one second. On hills the contacts of MuJoCo appear and disappear, whatever the friction is.
MAX_CREEP_M = {"flat ground": 1e-6, "level hills": 1e-4, "step": 1e-6, "top of an obstacle": 1e-6}


@pytest.mark.parametrize("surface", list(SURFACES))
@pytest.mark.parametrize(
    ("direction", "expected_coefficients"),
    [
        ((1.0, 0.0), (0.11, 0.0)),
        ((-1.0, 0.0), (0.14, 0.0)),
        ((0.0, 1.0), (0.0, 0.19)),
        ((0.6, -0.8), (0.066, 0.152)),
    ],
)
def test_dragged_body_measures_friction_coefficient_of_direction(
    surface: str, direction: tuple[float, float], expected_coefficients: tuple[float, float]
) -> None:
    """The coefficients agree within 1 %, and on hills within 1.5 %."""
    glider = GlidingSnake(surface, SCALES)
    force_n = glider.drag(0.2 * np.array(direction), 0.6)
    coefficients = np.abs(force_n) / (glider.mass_kg * G)
    tolerance = DRAG_TOLERANCE[surface] * max(expected_coefficients)
    assert coefficients == pytest.approx(expected_coefficients, abs=tolerance)


@pytest.mark.parametrize("surface", list(SURFACES))
@pytest.mark.parametrize("angle_rad", [0.0, np.pi, 0.9, 4.0])
def test_pushed_body_slides_only_beyond_the_friction_ellipse(
    surface: str, angle_rad: float
) -> None:
    direction = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    along = SCALES_FRICTION.forward if direction[0] > 0 else SCALES_FRICTION.backward
    limit = 1.0 / np.hypot(direction[0] / along, direction[1] / SCALES_FRICTION.sideways)
    glider = GlidingSnake(surface, SCALES)
    glider.push(0.95 * limit * direction)
    glider.go(0.5)
    position_w = glider.position_w
    glider.go(1.0)
    assert glider.position_w == pytest.approx(position_w, abs=MAX_CREEP_M[surface]), (
        "the body creeps"
    )
    glider.push(1.1 * limit * direction)
    glider.go(0.5)
    assert np.linalg.norm(glider.position_w - position_w) > 1e-3


@pytest.mark.heavy
@pytest.mark.parametrize("surface", list(SURFACES))
@pytest.mark.parametrize("velocity", [(1.0, 0.6), (-0.8, 0.8)])
def test_gliding_body_stops_where_independent_integrator_computes(
    surface: str, velocity: tuple[float, float]
) -> None:
    glider = GlidingSnake(surface, SCALES)
    glider.throw(np.array(velocity))
    start_w = glider.position_w
    glider.go(1.5)
    distance_m = glider.position_w - start_w
    expected_m = glide_without_mujoco(np.array(velocity), SCALES_FRICTION, 1.5)
    print(f"{surface}: {distance_m} m, without MuJoCo {expected_m} m")
    tolerance_m = 0.01 * float(np.linalg.norm(expected_m))
    assert distance_m == pytest.approx(expected_m, abs=tolerance_m)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("robot", "ground", "coefficients", "viscous"),
    [
        (SCALES, CLOTH, SCALES_FRICTION, 0j),
        pytest.param(
            WHEELS, CLOTH, DirectionalFriction(0.01, 0.01, 0.6), 0j, marks=pytest.mark.slow
        ),
        pytest.param(
            {}, MUD, DirectionalFriction(0.0, 0.0, 0.0), 0.5 + 3.0j, marks=pytest.mark.slow
        ),
    ],
    ids=["scales", "wheels", "mud"],
)
def test_wave_drifts_as_momentum_balance_computes(
    robot: dict[str, Any],
    ground: dict[str, Any],
    coefficients: DirectionalFriction,
    viscous: complex,
) -> None:
    drift_mm_s = simulate_wave(WAVE, ground, robot).drift_mm_s
    expected_mm_s = integrate_momentum_balance(WAVE, coefficients, viscous).drift_mm_s
    print(f"{drift_mm_s:+.2f} mm/s, momentum balance {expected_mm_s:+.2f} mm/s")
    assert drift_mm_s == pytest.approx(expected_mm_s, abs=MAX_SPURIOUS_DRIFT_MM_S)
    assert abs(drift_mm_s) > 5.0


def test_mirrored_snake_moves_mirrored() -> None:
    wave = JointWave(0.3, 0.7, 4.0, bend=0.04)
    mirrored_wave = JointWave(-0.3, 0.7, 4.0, bend=-0.04)
    center = simulate_wave(wave, CLOTH, SCALES).center[-1]
    mirrored_center = simulate_wave(mirrored_wave, CLOTH, SCALES).center[-1]
    assert np.linalg.norm(center) > 0.02
    assert mirrored_center == pytest.approx(center * [1.0, -1.0], abs=1e-6)


def test_reversed_wave_of_turned_scales_reverses_the_drift() -> None:
    drift_mm_s = simulate_wave(WAVE, CLOTH, SCALES).drift_mm_s
    reversed_drift_mm_s = simulate_wave(WAVE.reversed, CLOTH, TURNED_SCALES).drift_mm_s
    assert abs(drift_mm_s + reversed_drift_mm_s) < MAX_SPURIOUS_DRIFT_MM_S
    assert drift_mm_s > 5.0


@pytest.mark.parametrize(("robot", "ground"), [(SCALES, CLOTH), (WHEELS, CLOTH), ({}, MUD)])
def test_energy_loss_of_moving_snake_equals_work_of_friction(
    robot: dict[str, Any], ground: dict[str, Any]
) -> None:
    """The work of friction, computed from the velocities of the feet, is the body's energy loss within 3 %."""
    config = make_config(robot, {"ground": ground})
    sim, data, physics = make_resting_body(config, SimSettings(timestep_s=0.0005), 0.05)
    model = sim.model
    model.dof_damping[:] = 0.0
    model.dof_frictionloss[:] = 0.0
    physics.step(500)
    data.qvel[:2] = 0.8, 0.5
    data.qvel[6:] = [0.8 * np.cos(i) for i in range(13)]
    feet = [model.geom(f"foot_{i}").id for i in range(15)]
    physics.step(1)
    start_j = compute_kinetic_energy_j(model, data)
    friction_work_j = 0.0
    min_energy_j = start_j
    energy_j = start_j
    feet_w = data.geom_xpos[feet, :2].copy()
    for _ in range(400):
        physics.step(1)
        new_feet_w = data.geom_xpos[feet, :2].copy()
        slip_w = new_feet_w - feet_w
        friction_work_j += compute_friction_work_j(
            slip_w, feet_w, robot, ground, physics, model.opt.timestep
        )
        feet_w = new_feet_w
        energy_j = compute_kinetic_energy_j(model, data)
        assert energy_j < min_energy_j + 1e-4 * start_j, "the ground drives the body"
        min_energy_j = min(energy_j, min_energy_j)
    assert start_j - energy_j > 0.1 * start_j
    assert start_j - energy_j == pytest.approx(friction_work_j, rel=0.03)


def compute_friction_work_j(
    slip_w: Floats,
    feet_w: Floats,
    robot: dict[str, Any],
    ground: dict[str, Any],
    physics: PhysicsStepper,
    step_s: float,
) -> float:
    """Return the energy that feet lose in a step, by the law of sliding."""
    links = np.diff(feet_w, axis=0)
    links /= np.linalg.norm(links, axis=1)[:, None]
    tangents = np.vstack([links, [0.0, 0.0]]) + np.vstack([[0.0, 0.0], links])
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    along = np.sum(slip_w * tangents, axis=1)
    across = slip_w[:, 1] * tangents[:, 0] - slip_w[:, 0] * tangents[:, 1]
    coefficients = SCALES_FRICTION
    viscous = (0.0, 0.0)
    if robot == WHEELS:
        coefficients = DirectionalFriction(0.01, 0.01, 0.6)
    if ground == MUD:
        coefficients = DirectionalFriction(0.0, 0.0, 0.0)
        viscous = (0.5 / step_s, 3.0 / step_s)
    coefficient_along = np.where(along > 0, coefficients.forward, coefficients.backward)
    slip_m = np.maximum(np.hypot(along, across), 1e-15)
    dry_work_per_n = (coefficient_along * along**2 + coefficients.sideways * across**2) / slip_m
    viscous_work_per_n = viscous[0] * along**2 + viscous[1] * across**2
    normal_n = physics.laws.foot_forces_n
    assert normal_n is not None
    return float(normal_n @ (dry_work_per_n + viscous_work_per_n))


def compute_kinetic_energy_j(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    momentum = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, momentum, data.qvel)
    return 0.5 * float(momentum @ data.qvel)


@pytest.mark.parametrize("surface", list(SURFACES))
def test_restored_state_of_gliding_snake_continues_bit_identically(surface: str) -> None:
    glider = GlidingSnake(surface, SCALES)
    glider.throw(np.array([0.5, 0.3]))
    glider.go(0.1)
    saved = np.empty(mujoco.mj_stateSize(glider.model, FULL_STATE))
    mujoco.mj_getState(glider.model, glider.data, saved, FULL_STATE)
    restored = mujoco.MjData(glider.model)
    mujoco.mj_setState(glider.model, restored, saved, FULL_STATE)
    glider.physics.step(200)
    PhysicsStepper(glider.sim, restored).step(200)
    assert restored.qpos.tobytes() == glider.data.qpos.tobytes()


def test_wall_friction_of_scaled_link_is_equal_in_both_directions() -> None:
    wall = {
        "position_m": [1.0, -0.09],
        "size_m": [8.0, 0.1, 0.2],
        "friction": 0.3,
        "backward_friction": 0.9,
    }
    config = make_config(SCALES, {"ground": {"friction": 0.0}, "box": [wall]})
    for speed_m_s in (1.0, -1.0):
        sim, data, physics = make_resting_body(config, SimSettings())
        first_link = sim.first_link_body
        link_count = len(sim.link_geoms)
        links = slice(first_link, first_link + link_count)
        data.xfrc_applied[links, 1] = -2.0
        physics.step(250)
        data.qvel[0] = speed_m_s
        physics.step(50)
        initial_speed_m_s = abs(float(data.qvel[0]))
        physics.step(100)
        final_speed_m_s = abs(float(data.qvel[0]))
        deceleration_m_s2 = (initial_speed_m_s - final_speed_m_s) / 0.2
        expected_m_s2 = 0.3 * 2.0 * link_count / float(sim.model.body_mass[links].sum())
        assert deceleration_m_s2 == pytest.approx(expected_m_s2, rel=0.02)


@pytest.mark.heavy
def test_undulation_moves_forward_on_scales_without_obstacles() -> None:
    """The example of the documentation moves along the initial heading of its body."""
    duration = parse_set_option("duration_s=5")
    robot_without_scales = parse_set_option("robot=planar13")
    with_scales = simulate(load_scenario("scales", [duration]).config).summary
    without_scales = simulate(
        load_scenario("scales", [duration, robot_without_scales]).config
    ).summary
    advance_m = with_scales.heading_advance_m or 0.0
    assert advance_m > 0.25
    assert advance_m > 2.0 * (without_scales.heading_advance_m or 0.0)
