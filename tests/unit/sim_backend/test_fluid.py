"""Compares the forces of a fluid on the links with the formulas of MuJoCo's documentation, and tests its buoyancy."""

from typing import Any

import numpy as np
import pytest
from mujoco import MjData

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import ConfigTable, decode_table
from snakesim_hal.model.scene_file.scene import SceneFile
from snakesim_hal.wire.messages import Imu
from snakesim_sim_backend.laws.version import LawsVersion
from snakesim_sim_backend.model.build import build_sim_model
from snakesim_sim_backend.model.mjcf import export_mjcf
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.hal.small_robots import SCENE
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import G, SimulatorRig, make_config
from snakesim_testing.sim.swimming import HONEY, WATER, Swimmer

UNUSUAL = {**WATER, "blunt_drag": 0.9, "slender_drag": 0.1, "kutta_lift": 0.4}
FLOATING = {"on_route": False, "height_m": 1.0}
VERSIONS: list[LawsVersion] = ["c", "python"]


@pytest.mark.parametrize("fluid", [WATER, HONEY, UNUSUAL])
@pytest.mark.parametrize(
    "velocity", [(1.0, 0.0, 0.0), (0.0, -0.5, 0.0), (0.6, 0.3, 0.0), (-0.4, 0.2, 0.5)]
)
def test_fluid_force_on_moving_links_equals_the_documented_formula(
    fluid: dict[str, Any], velocity: tuple[float, float, float]
) -> None:
    swimmer = Swimmer(fluid)
    velocity_m_s = np.array(velocity)
    expected_n = swimmer.compute_force_n(velocity_m_s)
    assert swimmer.measure_force_n(velocity_m_s) == pytest.approx(expected_n, rel=1e-9, abs=1e-9)
    assert expected_n @ velocity_m_s < 0.0  # it brakes


def test_fluid_added_inertia_equals_that_of_potential_flow() -> None:
    swimmer = Swimmer(WATER)
    for i, geom in enumerate(swimmer.sim.link_geoms):
        added_kg = swimmer.ellipsoids.added_kg[i] / WATER["density_kg_m3"]
        added_kg_m2 = swimmer.ellipsoids.added_kg_m2[i] / WATER["density_kg_m3"]
        # The long axis of MuJoCo's capsule is z.
        expected = [*added_kg[[1, 2, 0]], *added_kg_m2[[1, 2, 0]]]
        assert swimmer.model.geom_fluid[geom][6:] == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("fluid", [WATER, HONEY])
@pytest.mark.parametrize("velocity", [(1.0, 0.0, 0.0), (0.0, 0.5, 0.0), (0.6, 0.3, 0.0)])
def test_fluid_gliding_body_moves_as_an_independent_integrator_computes(
    fluid: dict[str, Any], velocity: tuple[float, float, float]
) -> None:
    swimmer = Swimmer(fluid, step_s=0.0005)
    expected_m = swimmer.glide_without_mujoco(np.array(velocity), 0.3)
    moved_m = swimmer.glide(np.array(velocity), 0.3)
    assert moved_m == pytest.approx(expected_m, abs=0.01 * float(np.linalg.norm(expected_m)))


def test_fluid_neutral_robot_neither_sinks_nor_rises() -> None:
    run = SimulatorRig(make_config(scene={"fluid": WATER}, start=FLOATING))
    before_w = run.sim.true_state().base_position_w
    assert before_w[2] == pytest.approx(1.0 + run.config.robot.module.radius_m, abs=1e-9)
    run.advance(1.0)
    assert np.linalg.norm(run.sim.true_state().base_position_w - before_w) < 1e-6
    for acceleration in run.sample_only_sensor(Imu).acceleration_m_s2:
        assert acceleration == pytest.approx((0.0, 0.0, G), abs=1e-6)


def test_fluid_drag_balances_the_weight_of_a_sinking_robot() -> None:
    swimmer = Swimmer({**WATER, "buoyancy": 0.9})
    swimmer.physics.step(1000)
    speed_m_s = -swimmer.data.qvel[2]
    assert swimmer.compute_force_n(np.array([0.0, 0.0, -speed_m_s]))[2] == pytest.approx(
        0.1 * swimmer.mass_kg * G, rel=0.01
    )


@pytest.mark.parametrize("buoyancy", [0.0, 0.5])
def test_fluid_buoyancy_leaves_the_rest_of_weight_to_ground(buoyancy: float) -> None:
    config = make_config(scene={"fluid": {**WATER, "buoyancy": buoyancy}})
    sim = build_sim_model(config, SimSettings(), motors=False)
    data = MjData(sim.model)
    data.qpos[2] = config.robot.module.radius_m
    physics = PhysicsStepper(sim, data)
    physics.reset()
    physics.step(1000)
    weight_n = sum(config.robot.link_masses_kg) * G
    forces_n = physics.laws.foot_forces_n
    assert forces_n is not None
    assert forces_n.sum() == pytest.approx((1.0 - buoyancy) * weight_n, rel=1e-3)


def test_robot_without_fluid_settles_on_the_ground_before_start() -> None:
    run = SimulatorRig(make_config(start={**FLOATING, "height_m": 0.05}))
    assert run.sim.true_state().base_position_w[2] == pytest.approx(
        run.config.robot.module.radius_m, abs=1e-3
    )


def test_laws_in_fluid_compute_the_same_bits_on_the_bottom() -> None:
    config = make_config(scene={"fluid": {**WATER, "buoyancy": 0.2}})
    states: list[np.ndarray] = []
    for laws in VERSIONS:
        sim = build_sim_model(config, SimSettings(), motors=False, laws=laws)
        data = MjData(sim.model)
        data.qpos[2] = config.robot.module.radius_m
        physics = PhysicsStepper(sim, data)
        physics.reset()
        data.qvel[:] = np.linspace(-0.5, 0.5, sim.model.nv)
        physics.step(200)
        states.append(np.concatenate((data.qpos, data.qvel)))
    assert np.array_equal(states[0], states[1])


def test_model_of_scene_without_fluid_has_no_fluid() -> None:
    model = build_sim_model(make_config(), SimSettings()).model
    assert model.opt.density == model.opt.viscosity == 0.0
    assert not model.body_gravcomp.any()
    assert not model.geom_fluid.any()


def test_exported_model_has_the_fluid_of_the_scene_file() -> None:
    mjcf = export_mjcf(make_config(scene={"fluid": WATER}), SimSettings())
    assert 'density="1000" viscosity="0.001"' in mjcf
    assert 'fluidshape="ellipsoid"' in mjcf
    assert 'gravcomp="1"' in mjcf


@pytest.mark.parametrize(
    "change",
    [{"density_kg_m3": -1}, {"viscosity_pa_s": 101}, {"buoyancy": 1.1}, {"blunt_drag": 11}],
)
def test_fluid_values_out_of_range_are_refused(change: dict[str, Any]) -> None:
    with raises_error(ConfigError, code="config/out-of-range"):
        decode_table(ConfigTable({**SCENE, "fluid": {**WATER, **change}}, "water.toml"), SceneFile)
