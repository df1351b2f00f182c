"""Obstacles yield as their parameters specify: by springs, and by dry friction on the ground in every direction."""

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_sim_backend.model.build import build_sim_model
from snakesim_sim_backend.physics_model import MujocoPhysicsModel
from snakesim_sim_backend.settings import PhysicsModelSettings, SimSettings
from snakesim_testing.messages import raises_error
from snakesim_testing.runs.whole_run import load_run_config, run_controller
from snakesim_testing.sim.simulator_rig import G, make_config, make_resting_body

POSITION_M = [3.0, 1.0]
PEG: dict[str, Any] = {"position_m": POSITION_M, "radius_m": 0.05, "name": "it"}
BOX: dict[str, Any] = {"position_m": POSITION_M, "size_m": [0.3, 0.1, 0.2], "name": "it"}
BLOCK_MASS_KG = 2.0
BASE_FRICTION = 0.5
BLOCK = BOX | {"mass_kg": BLOCK_MASS_KG, "base_friction": BASE_FRICTION}
MAX_FRICTION_N = BASE_FRICTION * BLOCK_MASS_KG * G
DIRECTIONS = np.linspace(0.0, math.pi, 5)


class PushedObstacle:
    """One obstacle far from the snake, pushed by a constant force and moment."""

    def __init__(self, kind: str, obstacle: dict[str, Any], step_s: float = 0.002) -> None:
        config = make_config(scene={kind: [obstacle]})
        sim, self._data, self._physics = make_resting_body(config, SimSettings(timestep_s=step_s))
        self._body = sim.model.body("obstacle:it").id
        self._step_s = sim.model.opt.timestep

    def push_for(
        self, time_s: float, force_w: tuple[float, float] = (0.0, 0.0), moment_nm: float = 0.0
    ) -> Floats:
        """Push the obstacle; return its displacement from the start: x and y in m and yaw in rad, (3,)."""
        self._data.xfrc_applied[self._body] = (*force_w, 0.0, 0.0, 0.0, moment_nm)
        self._physics.step(round(time_s / self._step_s))
        return self._data.qpos[-3:].copy()

    @property
    def velocity(self) -> Floats:
        """The velocity in m/s along x and y, and the yaw rate in rad/s, (3,)."""
        return self._data.qvel[-3:].copy()


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_spring_post_yields_by_force_over_stiffness_and_returns(direction: float) -> None:
    post = PushedObstacle("cylinder", PEG | {"stiffness_n_per_m": 500.0})
    towards = np.array([math.cos(direction), math.sin(direction)])
    displacement = post.push_for(3.0, tuple(20.0 * towards))
    assert displacement == pytest.approx([*(20.0 / 500.0 * towards), 0.0], abs=1e-6)
    assert post.push_for(3.0) == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


@pytest.mark.parametrize(
    ("direction", "step_s"),
    [
        *((direction, 0.002) for direction in DIRECTIONS),
        (DIRECTIONS[1], 0.0005),
        *(
            pytest.param(direction, 0.0005, marks=pytest.mark.slow)
            for direction in (DIRECTIONS[0], *DIRECTIONS[2:])
        ),
    ],
)
def test_block_slides_only_above_friction_of_its_foot(direction: float, step_s: float) -> None:
    towards = np.array([math.cos(direction), math.sin(direction)])
    block = PushedObstacle("box", BLOCK, step_s)
    small_force_w = tuple(0.9 * MAX_FRICTION_N * towards)
    large_force_w = tuple(2.0 * MAX_FRICTION_N * towards)
    displacement = block.push_for(1.0, small_force_w)
    assert np.linalg.norm(displacement) < 2e-4
    # The block does not creep.
    assert block.push_for(5.0, small_force_w) == pytest.approx(displacement, abs=1e-9)
    block.push_for(1.0)
    block.push_for(0.1, large_force_w)
    initial_velocity = block.velocity
    block.push_for(0.5, large_force_w)
    velocity_change = block.velocity - initial_velocity
    expected_change_m_s = 0.5 * MAX_FRICTION_N / BLOCK_MASS_KG * towards
    assert velocity_change == pytest.approx([*expected_change_m_s, 0.0], rel=1e-3, abs=1e-3)
    block.push_for(2.0)
    assert np.linalg.norm(block.velocity) < 1e-6


def test_block_turns_only_above_friction_moment_of_its_base() -> None:
    points = np.stack(np.meshgrid(np.linspace(-0.15, 0.15, 601), np.linspace(-0.05, 0.05, 201)))
    max_friction_nm = MAX_FRICTION_N * float(np.hypot(*points).mean())
    for moment_ratio, turns in ((0.97, False), (1.03, True)):
        block = PushedObstacle("box", BLOCK)
        x_m, y_m, yaw_rad = block.push_for(3.0, moment_nm=moment_ratio * max_friction_nm)
        assert (abs(yaw_rad) > 0.05) == turns
        assert math.hypot(x_m, y_m) < 1e-9


def test_turning_block_is_moved_sideways_by_small_force() -> None:
    """Dry friction opposes the whole motion: a base that slips resists no force across its slip."""
    small_force_w = (0.3 * MAX_FRICTION_N, 0.0)
    turning = PushedObstacle("box", BLOCK).push_for(1.0, small_force_w, moment_nm=2.0)
    not_turning = PushedObstacle("box", BLOCK).push_for(1.0, small_force_w)
    assert turning[0] > 0.01
    assert not_turning[0] < 1e-4


def test_spring_too_stiff_for_time_step_is_refused_with_advice() -> None:
    with raises_error(ConfigError, code="scene/invalid", field="it", value=100000):
        PushedObstacle("cylinder", PEG | {"stiffness_n_per_m": 1e5})
    # A heavier post with the same spring is slow enough for the time step.
    PushedObstacle("cylinder", PEG | {"stiffness_n_per_m": 1e5, "mass_kg": 1.0})


def test_yielding_obstacles_in_physics_model_add_no_joints() -> None:
    spring_post = PEG | {"position_m": [0.5, 0.1], "mass_kg": 1.0, "stiffness_n_per_m": 5e5}
    physics_model = MujocoPhysicsModel(
        make_config(scene={"cylinder": [spring_post]}), PhysicsModelSettings(timestep_s=0.0005)
    )
    torque_nm = np.full(13, 3.0)
    for _ in range(400):
        physics_model.advance(torque_nm)
    assert physics_model.angle_rad.shape == (13,)
    assert physics_model.velocity_rad_s.shape == (13,)
    assert physics_model.shaft_torque_nm().shape == (13,)
    assert np.abs(physics_model.data.qpos[-3:-1]).max() > 1e-3  # the snake pushed the post away
    loaded_links = [load.link for load in physics_model.loads()]
    assert loaded_links == sorted(set(loaded_links))


def test_leaning_peg_has_its_foot_position_and_angle() -> None:
    """Rays at several heights, across and along the lean, hit the surface of the leaning cylinder."""
    lean_rad = 0.3
    lean_towards_rad = 2.0
    radius_m = 0.05
    ray_length_m = 0.5  # from the start of a ray to the axis of the peg
    peg = PEG | {"lean_rad": lean_rad, "lean_towards_rad": lean_towards_rad}
    sim = build_sim_model(make_config(scene={"cylinder": [peg]}), SimSettings(), motors=False)
    data = mujoco.MjData(sim.model)
    geom_id = np.zeros(1, dtype=np.int32)
    mujoco.mj_kinematics(sim.model, data)
    towards = np.array([math.cos(lean_towards_rad), math.sin(lean_towards_rad)])
    across = np.array([-math.sin(lean_towards_rad), math.cos(lean_towards_rad)])
    for height_m in (0.001, 0.04, 0.12):
        center = np.array(POSITION_M) + height_m * math.tan(lean_rad) * towards
        for direction, half_width_m in (
            (across, radius_m),
            (towards, radius_m / math.cos(lean_rad)),
        ):
            start = np.array([*(center - ray_length_m * direction), height_m])
            distance_m = mujoco.mj_ray(
                sim.model, data, start, np.array([*direction, 0.0]), None, 1, -1, geom_id
            )
            assert distance_m == pytest.approx(ray_length_m - half_width_m, abs=1e-6)


def measure_advance_with_pegs_m(*peg_keys: str) -> float:
    """Return how far the snake advances in `peg_row` if its pegs have these keys."""
    options = [f"scene.pegs_along_route.0.{key}" for key in peg_keys]
    return run_controller(load_run_config("peg_row", *options), duration_s=6.0).advance_m


@pytest.mark.slow  # the tests above check single posts and blocks
def test_snake_advances_at_fixed_obstacles_and_displaces_loose_ones() -> None:
    fixed_m = measure_advance_with_pegs_m()
    heavy_m = measure_advance_with_pegs_m("mass_kg=20", "base_friction=1.0")
    light_m = measure_advance_with_pegs_m("mass_kg=0.5")
    assert heavy_m == pytest.approx(fixed_m, rel=0.1)
    assert fixed_m > 0.8
    assert light_m < 0.05
