"""Tests simulated pipes: their inside is round and closed, and a body rests and slides at their bottom."""

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_sim_backend.laws.version import LawsVersion
from snakesim_sim_backend.model.build import SimModel, build_sim_model
from snakesim_sim_backend.model.pipes import STAVES
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.sim.simulator_rig import G, SimulatorRig, make_config

FRICTION = 0.3
# Radius of the polygon's corners, divided by that of its sides.
CORNER_RATIO = 1.0 / math.cos(math.pi / STAVES)
PIPE: dict[str, Any] = {
    "position_m": [1.0, 0.5],
    "length_m": 8.0,
    "radius_m": 0.12,
    "inner_radius_m": 0.1,
    "friction": FRICTION,
    "yaw_rad": 0.7,
}
VERSIONS: list[LawsVersion] = ["c", "python"]


def make_pipe_config(**change: Any) -> RunConfig:
    """Return the run of a robot that lies in the pipe, along its axis."""
    start = {"on_route": False, "position_m": PIPE["position_m"], "yaw_rad": PIPE["yaw_rad"]}
    return make_config(scene={"pipe": [{**PIPE, **change}]}, start=start)


def measure_distances_m(sim: SimModel, angles_rad: Floats) -> list[float]:
    """Return how far from the middle of the pipe's axis a surface is, in directions about the axis. 0: to the left."""
    data = mujoco.MjData(sim.model)
    data.qpos[2] = 50.0  # the robot is elsewhere
    mujoco.mj_forward(sim.model, data)
    left_w = np.array([-math.sin(PIPE["yaw_rad"]), math.cos(PIPE["yaw_rad"]), 0.0])
    hit_geom = np.zeros(1, dtype=np.int32)
    distances_m: list[float] = []
    for angle_rad in angles_rad:
        ray_w = math.cos(angle_rad) * left_w + np.array([0.0, 0.0, math.sin(angle_rad)])
        axis_w = np.array([*PIPE["position_m"], PIPE["radius_m"]])
        distances_m.append(mujoco.mj_ray(sim.model, data, axis_w, ray_w, None, 1, -1, hit_geom))
    return distances_m


def test_pipe_inside_is_closed_and_round() -> None:
    sim = build_sim_model(make_pipe_config(), SimSettings())
    distances_m = measure_distances_m(sim, np.linspace(0.0, 2 * math.pi, 500))
    assert min(distances_m) == pytest.approx(PIPE["inner_radius_m"], rel=1e-4)
    assert max(distances_m) <= PIPE["inner_radius_m"] * CORNER_RATIO * 1.0001


def test_half_pipe_is_open_at_its_top() -> None:
    sim = build_sim_model(make_pipe_config(open_top=True), SimSettings())
    above = measure_distances_m(sim, np.linspace(0.02, math.pi - 0.02, 100))
    below = measure_distances_m(sim, -np.linspace(0.02, math.pi - 0.02, 100))
    assert set(above) == {-1.0}
    assert max(below) <= PIPE["inner_radius_m"] * CORNER_RATIO * 1.0001


@pytest.mark.parametrize("open_top", [False, True])
def test_robot_in_pipe_starts_at_rest_at_its_bottom(open_top: bool) -> None:
    run = SimulatorRig(make_pipe_config(open_top=open_top))
    state = run.sim.true_state()
    bottom_m = PIPE["radius_m"] - CORNER_RATIO * (
        PIPE["inner_radius_m"] - run.config.robot.module.radius_m
    )
    assert state.base_position_w[:2] == pytest.approx(PIPE["position_m"], abs=1e-3)
    assert state.base_position_w[2] == pytest.approx(bottom_m, abs=1e-3)
    before_w = np.array(state.base_position_w)
    run.advance(1.0)
    assert np.linalg.norm(run.sim.true_state().base_position_w - before_w) < 1e-3


@pytest.mark.parametrize("laws", VERSIONS)
def test_body_sliding_in_pipe_decelerates_by_its_friction(laws: LawsVersion) -> None:
    """The body lies in a corner of the polygon, on both staves, so N is a little more than its weight."""
    config = make_pipe_config()
    run = SimulatorRig(config)
    sim = build_sim_model(config, SimSettings(), motors=False, laws=laws)
    data = mujoco.MjData(sim.model)
    data.qpos[:] = run.sim.data.qpos
    physics = PhysicsStepper(sim, data)
    physics.reset()
    direction_w = np.array([math.cos(PIPE["yaw_rad"]), math.sin(PIPE["yaw_rad"])])
    data.qvel[:2] = 1.2 * direction_w
    physics.step(50)
    before_m_s = data.qvel[:2] @ direction_w
    physics.step(100)
    step_s = sim.model.opt.timestep
    speed_loss_m_s = before_m_s - data.qvel[:2] @ direction_w
    assert speed_loss_m_s == pytest.approx(FRICTION * G * CORNER_RATIO * 100 * step_s, rel=0.01)


def test_robot_on_solid_pipe_starts_at_rest_and_stays() -> None:
    """The pipe is below the middle of the robot, and across."""
    pipe = {
        "position_m": [0.75, 0.0],
        "length_m": 4.0,
        "radius_m": 0.1,
        "yaw_rad": math.pi / 2,
        "friction": 0.5,
    }
    run = SimulatorRig(make_config(scene={"pipe": [{**pipe, "axis_height_m": 0.0}]}))
    assert run.sim.data.body("link_0").xpos[2] == pytest.approx(
        run.config.robot.module.radius_m, abs=1e-3
    )
    assert run.sim.data.body("link_13").xpos[2] > 0.2  # it leans on the pipe, like a plank
    before_w = run.sim.true_state().base_position_w
    run.advance(1.0)
    assert np.linalg.norm(run.sim.true_state().base_position_w - before_w) < 2e-3
