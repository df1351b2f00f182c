"""Tests scenes with other gravity and with sloping flat ground: where bodies stay and slide, and what IMUs measure."""

import math
from typing import Any

import numpy as np
import pytest
from mujoco import MjData

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import ConfigTable, decode_table
from snakesim_hal.model.scene_file.scene import SceneFile, compute_gravity_w
from snakesim_hal.wire.messages import Imu
from snakesim_sim_backend.laws.version import LawsVersion
from snakesim_sim_backend.model.build import build_sim_model
from snakesim_sim_backend.model.mjcf import export_mjcf
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.physics_model import MujocoPhysicsModel
from snakesim_sim_backend.settings import PhysicsModelSettings, SimSettings
from snakesim_testing.hal.small_robots import SCENE
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import G, SimulatorRig, make_config

FRICTION = 0.3
FRICTION_ANGLE_RAD = math.atan(FRICTION)
VERSIONS: list[LawsVersion] = ["c", "python"]


class Sled:
    """A straight body without motors, whose length is along x, at rest on a slope."""

    def __init__(self, laws: LawsVersion, ground: dict[str, Any], gravity_m_s2: float = G) -> None:
        config = make_config(
            scene={"ground": {"friction": FRICTION, **ground}, "gravity_m_s2": gravity_m_s2}
        )
        sim = build_sim_model(config, SimSettings(), motors=False, laws=laws)
        self.data = MjData(sim.model)
        self.data.qpos[2] = config.robot.module.radius_m
        self._step_s = sim.model.opt.timestep
        self._physics = PhysicsStepper(sim, self.data)
        self._physics.reset()

    def advance(self, seconds: float) -> None:
        self._physics.step(round(seconds / self._step_s))


@pytest.mark.parametrize("laws", VERSIONS)
@pytest.mark.parametrize("gravity_m_s2", [1.62, G])
@pytest.mark.parametrize("towards_rad", [0.0, math.pi])
def test_slope_below_the_friction_angle_holds_the_body(
    laws: LawsVersion, gravity_m_s2: float, towards_rad: float
) -> None:
    ground = {"slope_rad": 0.9 * FRICTION_ANGLE_RAD, "slope_towards_rad": towards_rad}
    sled = Sled(laws, ground, gravity_m_s2)
    sled.advance(0.5)
    before_m = sled.data.qpos[:2].copy()
    sled.advance(2.0)
    assert np.abs(before_m).max() < 1e-3
    assert np.abs(sled.data.qpos[:2] - before_m).max() < 1e-6


@pytest.mark.parametrize("laws", VERSIONS)
@pytest.mark.parametrize("gravity_m_s2", [1.62, G])
@pytest.mark.parametrize("towards_rad", [0.0, math.pi])
def test_slope_above_friction_angle_accelerates_body_by_remaining_gravity(
    laws: LawsVersion, gravity_m_s2: float, towards_rad: float
) -> None:
    slope_rad = 1.5 * FRICTION_ANGLE_RAD
    sled = Sled(laws, {"slope_rad": slope_rad, "slope_towards_rad": towards_rad}, gravity_m_s2)
    sled.advance(0.2)
    before_m_s = sled.data.qvel[0]
    sled.advance(0.5)
    acceleration_m_s2 = (sled.data.qvel[0] - before_m_s) / 0.5 * math.cos(towards_rad)
    expected_m_s2 = gravity_m_s2 * (math.sin(slope_rad) - FRICTION * math.cos(slope_rad))
    assert acceleration_m_s2 == pytest.approx(expected_m_s2, rel=0.01)


@pytest.mark.parametrize("laws", VERSIONS)
def test_slope_of_viscous_ground_leads_to_terminal_speed(laws: LawsVersion) -> None:
    along_s_per_m = 2.0
    viscous = {"along_s_per_m": along_s_per_m, "across_s_per_m": 4.0}
    sled = Sled(laws, {"friction": 0.0, "slope_rad": 0.2, "viscous": viscous})
    sled.advance(1.0)
    assert sled.data.qvel[0] == pytest.approx(math.tan(0.2) / along_s_per_m, rel=0.01)


@pytest.mark.parametrize("slope_rad", [0.2, 0.6])
def test_slope_gives_same_bits_with_both_laws(slope_rad: float) -> None:
    ground = {"slope_rad": slope_rad, "slope_towards_rad": 0.4}
    one, other = (Sled(laws, ground, 3.7) for laws in VERSIONS)
    for _ in range(20):
        for name in ("qacc", "qpos", "qvel"):
            assert np.array_equal(getattr(one.data, name), getattr(other.data, name))
        one.advance(0.01)
        other.advance(0.01)


@pytest.mark.parametrize("gravity_m_s2", [1.62, G])
def test_slope_imus_at_rest_measure_the_gravity_vector(gravity_m_s2: float) -> None:
    ground = {"friction": 0.6, "slope_rad": 0.3, "slope_towards_rad": math.pi}
    config = make_config(scene={"ground": ground, "gravity_m_s2": gravity_m_s2})
    expected = (gravity_m_s2 * math.sin(0.3), 0.0, gravity_m_s2 * math.cos(0.3))
    run = SimulatorRig(config)
    first = run.sample_only_sensor(Imu)
    assert np.mean(first.acceleration_m_s2, axis=0) == pytest.approx(expected, rel=0.02, abs=1e-6)
    run.advance(1.0)
    for acceleration in run.sample_only_sensor(Imu).acceleration_m_s2:
        assert acceleration == pytest.approx(expected, rel=1e-3, abs=1e-3)

    model = MujocoPhysicsModel(config, PhysicsModelSettings())
    for _ in range(round(1.0 / model.step_s)):
        model.advance(np.zeros(config.robot.chain.modules))
    imu = model.imu()
    assert imu is not None
    assert np.mean(imu.acceleration_m_s2, axis=0) == pytest.approx(expected, rel=1e-3, abs=1e-3)


def test_slope_that_does_not_hold_robot_keeps_its_start() -> None:
    """The robot lies across the slope, where it would roll down while it comes to rest."""
    ground = {"slope_rad": 0.7, "slope_towards_rad": math.pi / 2}
    run = SimulatorRig(make_config(scene={"ground": {"friction": FRICTION, **ground}}))
    position_m = run.sim.true_state().base_position_w
    assert np.abs(position_m[:2]).max() < 1e-6
    run.advance(0.5)
    assert run.sim.true_state().base_position_w[1] > 0.5


def make_loose_block(base_friction: float) -> dict[str, Any]:
    return {
        "name": "crate",
        "position_m": [0.5, 1.0],
        "size_m": [0.2] * 3,
        "mass_kg": 2,
        "base_friction": base_friction,
    }


def test_slope_holds_a_loose_obstacle_with_enough_friction() -> None:
    ground = {"friction": FRICTION, "slope_rad": 0.2, "slope_towards_rad": 0.0}
    run = SimulatorRig(make_config(scene={"ground": ground, "box": [make_loose_block(0.25)]}))
    run.advance(1.0)
    assert np.abs(run.sim.data.qpos[-3:]).max() < 1e-3
    config = make_config(scene={"ground": ground, "box": [make_loose_block(0.15)]})
    with raises_error(ConfigError, code="scene/invalid"):
        SimulatorRig(config)


def test_level_ground_has_exactly_the_gravity_of_mujoco() -> None:
    for towards_rad in (0.0, 2.0, math.pi):
        scene = decode_scene(ground={"friction": 0.1, "slope_towards_rad": towards_rad})
        assert repr(compute_gravity_w(scene)) == "(0.0, 0.0, -9.81)"


def test_exported_model_has_the_gravity_of_the_scene() -> None:
    config = make_config(scene={"ground": {"friction": 0.1, "slope_rad": 0.5}, "gravity_m_s2": 2.0})
    assert 'gravity="0.958851 0 -1.75517"' in export_mjcf(config, SimSettings())


@pytest.mark.parametrize(
    "sections",
    [
        {"gravity_m_s2": 0},
        {"gravity_m_s2": 31},
        {"ground": {"friction": 0.1, "slope_rad": 0.8}},
        {"ground": {"friction": 0.1, "slope_rad": -0.1}},
        {"ground": {"friction": 0.1, "slope_towards_rad": 7}},
    ],
)
def test_slope_and_gravity_out_of_range_are_refused(sections: dict[str, Any]) -> None:
    with raises_error(ConfigError, code="config/out-of-range"):
        decode_scene(**sections)


def decode_scene(**sections: Any) -> SceneFile:
    return decode_table(ConfigTable({**SCENE, **sections}, "tilted.toml"), SceneFile)
