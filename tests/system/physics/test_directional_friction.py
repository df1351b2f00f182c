"""Links that slide more easily along than across: the guarantees of dry friction hold, on every kind of ground."""

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

HU = DirectionalFriction(0.11, 0.14, 0.19)
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
WHOLE = mujoco.mjtState.mjSTATE_INTEGRATION
WAVE = JointWave(0.3, 0.7, 4.0)
GHOST_MM_S = 1.0
# Of the drag. On hills MuJoCo shares the weight among contacts that come and go.
DRAG_TOLERANCE = {
    "flat ground": 0.01,
    "level hills": 0.015,
    "step": 0.01,
    "top of an obstacle": 0.01,
}
# In a second. On hills the contacts of MuJoCo come and go, with friction of any kind.
CREEP_M = {"flat ground": 1e-6, "level hills": 1e-4, "step": 1e-6, "top of an obstacle": 1e-6}


@pytest.mark.parametrize("surface", list(SURFACES))
@pytest.mark.parametrize(
    ("direction", "expected"),
    [
        ((1.0, 0.0), (0.11, 0.0)),
        ((-1.0, 0.0), (0.14, 0.0)),
        ((0.0, 1.0), (0.0, 0.19)),
        ((0.6, -0.8), (0.066, 0.152)),
    ],
)
def test_dragging_takes_the_coefficient_of_the_direction(
    surface: str, direction: tuple[float, float], expected: tuple[float, float]
) -> None:
    """Within 1 %, and on hills within 1.5 %."""
    glider = GlidingSnake(surface, SCALES)
    force_n = glider.drag(0.2 * np.array(direction), 0.6)
    assert np.abs(force_n) / (glider.mass_kg * G) == pytest.approx(
        expected, abs=DRAG_TOLERANCE[surface] * max(expected)
    )


@pytest.mark.parametrize("surface", list(SURFACES))
@pytest.mark.parametrize("angle_rad", [0.0, np.pi, 0.9, 4.0])
def test_it_stands_within_the_half_ellipses_and_slides_beyond(
    surface: str, angle_rad: float
) -> None:
    direction = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    along = HU.forward if direction[0] > 0 else HU.backward
    limit = 1.0 / np.hypot(direction[0] / along, direction[1] / HU.sideways)
    glider = GlidingSnake(surface, SCALES)
    glider.push(0.95 * limit * direction)
    glider.go(0.5)
    at = glider.position_w
    glider.go(1.0)
    assert glider.position_w == pytest.approx(at, abs=CREEP_M[surface]), "it creeps"
    glider.push(1.1 * limit * direction)
    glider.go(0.5)
    assert np.linalg.norm(glider.position_w - at) > 1e-3


@pytest.mark.parametrize("surface", list(SURFACES))
@pytest.mark.parametrize("velocity", [(1.0, 0.6), (-0.8, 0.8)])
def test_gliding_body_comes_to_rest_where_an_independent_integrator_says(
    surface: str, velocity: tuple[float, float]
) -> None:
    glider = GlidingSnake(surface, SCALES)
    glider.throw(np.array(velocity))
    start = glider.position_w
    glider.go(1.5)
    expected_m = glide_without_mujoco(np.array(velocity), HU, 1.5)
    print(f"{surface}: {glider.position_w - start} m, without MuJoCo {expected_m} m")
    assert glider.position_w - start == pytest.approx(
        expected_m, abs=0.01 * float(np.linalg.norm(expected_m))
    )


@pytest.mark.parametrize(
    ("robot", "ground", "coefficients", "viscous"),
    [
        (SCALES, CLOTH, HU, 0j),
        pytest.param(
            WHEELS, CLOTH, DirectionalFriction(0.01, 0.01, 0.6), 0j, marks=pytest.mark.slow
        ),
        pytest.param(
            {}, MUD, DirectionalFriction(0.0, 0.0, 0.0), 0.5 + 3.0j, marks=pytest.mark.slow
        ),
    ],
    ids=["scales", "wheels", "mud"],
)
def test_wave_drifts_as_a_momentum_balance_says(
    robot: dict[str, Any],
    ground: dict[str, Any],
    coefficients: DirectionalFriction,
    viscous: complex,
) -> None:
    ours = simulate_wave(WAVE, ground, robot).drift_mm_s
    balance = integrate_momentum_balance(WAVE, coefficients, viscous).drift_mm_s
    print(f"{ours:+.2f} mm/s, momentum balance {balance:+.2f} mm/s")
    assert ours == pytest.approx(balance, abs=GHOST_MM_S)
    assert abs(ours) > 5.0


def test_mirrored_snake_moves_mirrored() -> None:
    wave = JointWave(0.3, 0.7, 4.0, bend=0.04)
    mirrored = JointWave(-0.3, 0.7, 4.0, bend=-0.04)
    plain = simulate_wave(wave, CLOTH, SCALES).center[-1]
    assert np.linalg.norm(plain) > 0.02
    assert simulate_wave(mirrored, CLOTH, SCALES).center[-1] == pytest.approx(
        plain * [1.0, -1.0], abs=1e-6
    )


def test_reversed_wave_of_turned_scales_drifts_the_other_way_by_as_much() -> None:
    there = simulate_wave(WAVE, CLOTH, SCALES).drift_mm_s
    back = simulate_wave(WAVE.reversed, CLOTH, TURNED_SCALES).drift_mm_s
    assert abs(there + back) < GHOST_MM_S
    assert there > 5.0


@pytest.mark.parametrize(("robot", "ground"), [(SCALES, CLOTH), (WHEELS, CLOTH), ({}, MUD)])
def test_ground_takes_all_the_energy_that_a_writhing_snake_loses(
    robot: dict[str, Any], ground: dict[str, Any]
) -> None:
    """What the feet lose by the law of sliding, from their velocities, is what the body loses, within 3 %."""
    config = make_config(robot, {"ground": ground})
    sim, data, physics = make_resting_body(config, SimSettings(timestep_s=0.0005), 0.05)
    model = sim.model
    model.dof_damping[:], model.dof_frictionloss[:] = 0.0, 0.0
    physics.step(500)
    data.qvel[:2] = 0.8, 0.5
    data.qvel[6:] = [0.8 * np.cos(i) for i in range(13)]
    feet = [model.geom(f"foot_{i}").id for i in range(15)]
    physics.step(1)
    start_j = kinetic_energy_j(model, data)
    lost_j, lowest_j, energy_j = 0.0, start_j, start_j
    before = data.geom_xpos[feet, :2].copy()
    for _ in range(400):
        physics.step(1)
        now = data.geom_xpos[feet, :2].copy()
        lost_j += loss_j(now - before, before, robot, ground, physics, model.opt.timestep)
        before = now
        energy_j = kinetic_energy_j(model, data)
        assert energy_j < lowest_j + 1e-4 * start_j, "the ground drives the body"
        lowest_j = min(energy_j, lowest_j)
    assert start_j - energy_j > 0.1 * start_j
    assert start_j - energy_j == pytest.approx(lost_j, rel=0.03)


def loss_j(
    slip: Floats,
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
    along = np.sum(slip * tangents, axis=1)
    across = slip[:, 1] * tangents[:, 0] - slip[:, 0] * tangents[:, 1]
    coefficients = HU
    viscous = (0.0, 0.0)
    if robot == WHEELS:
        coefficients = DirectionalFriction(0.01, 0.01, 0.6)
    if ground == MUD:
        coefficients = DirectionalFriction(0.0, 0.0, 0.0)
        viscous = (0.5 / step_s, 3.0 / step_s)
    of_along = np.where(along > 0, coefficients.forward, coefficients.backward)
    dry = (of_along * along**2 + coefficients.sideways * across**2) / np.maximum(
        np.hypot(along, across), 1e-15
    )
    normal_n = physics.laws.foot_forces_n
    assert normal_n is not None
    return float(normal_n @ (dry + viscous[0] * along**2 + viscous[1] * across**2))


def kinetic_energy_j(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    momentum = np.zeros(model.nv)
    mujoco.mj_mulM(model, data, momentum, data.qvel)
    return 0.5 * float(momentum @ data.qvel)


@pytest.mark.parametrize("surface", list(SURFACES))
def test_restored_state_continues_to_the_bit(surface: str) -> None:
    glider = GlidingSnake(surface, SCALES)
    glider.throw(np.array([0.5, 0.3]))
    glider.go(0.1)
    saved = np.empty(mujoco.mj_stateSize(glider.model, WHOLE))
    mujoco.mj_getState(glider.model, glider.data, saved, WHOLE)
    other = mujoco.MjData(glider.model)
    mujoco.mj_setState(glider.model, other, saved, WHOLE)
    glider.physics.step(200)
    PhysicsStepper(glider.sim, other).step(200)
    assert other.qpos.tobytes() == glider.data.qpos.tobytes()


def test_side_of_a_link_rubs_on_a_wall_equally_in_both_directions() -> None:
    wall = {
        "position_m": [1.0, -0.09],
        "size_m": [8.0, 0.1, 0.2],
        "friction": 0.3,
        "backward_friction": 0.9,
    }
    config = make_config(SCALES, {"ground": {"friction": 0.0}, "box": [wall]})
    decelerations = []
    for speed_m_s in (1.0, -1.0):
        sim, data, physics = make_resting_body(config, SimSettings())
        first = sim.first_link_body
        links = len(sim.link_geoms)
        data.xfrc_applied[first : first + links, 1] = -2.0
        physics.step(250)
        data.qvel[0] = speed_m_s
        physics.step(50)
        before = float(data.qvel[0])
        physics.step(100)
        decelerations.append((abs(before) - abs(float(data.qvel[0]))) / 0.2)
        expected = 0.3 * 2.0 * links / float(sim.model.body_mass[first : first + links].sum())
        assert decelerations[-1] == pytest.approx(expected, rel=0.02)


def test_undulation_moves_forward_on_scales_without_obstacles() -> None:
    """The example of the documentation moves forward, along the first heading of its body."""
    with_scales = simulate(
        load_scenario("scales", [parse_set_option("duration_s=5")]).config
    ).summary
    equal = simulate(
        load_scenario(
            "scales", [parse_set_option("duration_s=5"), parse_set_option("robot=planar13")]
        ).config
    ).summary
    assert (with_scales.heading_advance_m or 0.0) > 0.25
    assert (with_scales.heading_advance_m or 0.0) > 2.0 * (equal.heading_advance_m or 0.0)
