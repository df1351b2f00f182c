"""Obstacles apply dry friction: mu times the normal force against the motion, without pushing the body away."""

from typing import Any

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.settings import SimSettings
from snakesim_sim_backend.state.contacts import ObstacleContactReader
from snakesim_testing.sim.simulator_rig import G, make_config, make_resting_body

WALL_FRICTION = 0.3
LINK_FORCE_N = 2.0  # presses each link to the wall
BLOCK_MASS_KG = 5.0
FULL_STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class SnakeAtWall:
    """A straight snake on ground without friction, pressed to a long wall beside it."""

    def __init__(self, *, step_s: float = 0.002, **wall_keys: Any) -> None:
        wall = {
            "position_m": [1.0, -0.09],
            "size_m": [8.0, 0.1, 0.2],
            "friction": WALL_FRICTION,
            "name": "it",
        } | wall_keys
        config = make_config(scene={"ground": {"friction": 0.0}, "box": [wall]})
        self.sim, self.data, self.physics = make_resting_body(
            config, SimSettings(timestep_s=step_s)
        )
        self.model = self.sim.model
        self._contacts = ObstacleContactReader(self.sim, self.data, self.physics.contacts)
        link_count = len(self.sim.link_geoms)
        first_link = self.sim.first_link_body
        links = slice(first_link, first_link + link_count)
        self.normal_force_n = LINK_FORCE_N * link_count
        self.forces_w = self.data.xfrc_applied[links]
        self.mass_kg = float(self.model.body_mass[links].sum())
        self.forces_w[:, 1] = -LINK_FORCE_N
        self.run_for(0.5)

    def run_for(self, time_s: float) -> None:
        """Simulate this time."""
        self.physics.step(round(time_s / self.model.opt.timestep))

    @property
    def speed_m_s(self) -> float:
        """The speed along the wall."""
        return float(self.data.qvel[0])

    def measure_wall_force_w(self) -> Floats:
        """Return the force of the wall on the body."""
        return np.sum([contact.force_w for contact in self._contacts.read()], axis=0)


@pytest.mark.parametrize("step_s", [0.002, 0.0005])
def test_wall_friction_brakes_body_by_mu_times_normal_force(step_s: float) -> None:
    body = SnakeAtWall(step_s=step_s)
    body.data.qvel[0] = 1.0
    body.run_for(0.1)
    initial_speed_m_s = body.speed_m_s
    forces_w = []
    for _ in range(100):
        body.run_for(0.002)
        forces_w.append(body.measure_wall_force_w())
    friction_n = np.array(forces_w)[:, 0]
    normal_n = np.array(forces_w)[:, 1]
    expected_friction_n = WALL_FRICTION * body.normal_force_n
    assert initial_speed_m_s - body.speed_m_s == pytest.approx(
        0.2 * expected_friction_n / body.mass_kg, rel=0.01
    )
    assert normal_n == pytest.approx(body.normal_force_n, rel=0.02), (
        "the body does not stay at the wall"
    )
    assert friction_n == pytest.approx(-expected_friction_n, rel=0.02), (
        "the contact reader measures another friction"
    )


def test_body_at_wall_slides_only_above_friction_limit() -> None:
    body = SnakeAtWall()
    body.forces_w[:, 0] = 0.9 * WALL_FRICTION * LINK_FORCE_N
    body.run_for(1.0)
    position_m = float(body.data.qpos[0])
    body.run_for(2.0)
    assert body.data.qpos[0] == pytest.approx(position_m, abs=1e-6)
    body.forces_w[:, 0] = 1.1 * WALL_FRICTION * LINK_FORCE_N
    body.run_for(1.0)
    excess_force_n = 0.1 * WALL_FRICTION * body.normal_force_n
    assert body.speed_m_s == pytest.approx(excess_force_n / body.mass_kg, rel=0.05)


def test_wall_friction_drags_a_block_by_same_force() -> None:
    body = SnakeAtWall(mass_kg=BLOCK_MASS_KG, base_friction=0.0)
    body.forces_w[:] = 0.0
    body.data.qvel[:] = 0.0
    body.data.qvel[:2] = 0.5, -0.2
    initial_momentum = body.mass_kg * body.data.qvel[:2]
    body.run_for(0.5)
    body_momentum = body.mass_kg * body.data.qvel[:2]
    block_momentum = BLOCK_MASS_KG * body.data.qvel[-3:-1]
    assert block_momentum[0] > 0.05
    assert body_momentum + block_momentum == pytest.approx(initial_momentum, abs=0.01)


def test_friction_state_restored_continues_unchanged() -> None:
    body = SnakeAtWall()
    body.data.qvel[0] = 0.5
    body.forces_w[:, 0] = 0.5 * WALL_FRICTION * LINK_FORCE_N
    body.run_for(0.1)
    saved = np.empty(mujoco.mj_stateSize(body.model, FULL_STATE))
    mujoco.mj_getState(body.model, body.data, saved, FULL_STATE)
    body.run_for(1.0)
    restored = mujoco.MjData(body.model)
    mujoco.mj_setState(body.model, restored, saved, FULL_STATE)
    PhysicsStepper(body.sim, restored).step(500)
    assert restored.qpos.tolist() == body.data.qpos.tolist()


def test_friction_of_body_moved_after_restore_is_zero() -> None:
    body = SnakeAtWall()
    body.data.qvel[0] = 0.5
    body.run_for(0.1)
    moved = mujoco.MjData(body.model)
    mujoco.mj_copyData(moved, body.model, body.data)
    moved.xfrc_applied[:] = 0.0
    moved.qpos[1] += 0.01  # away from the wall
    physics = PhysicsStepper(body.sim, moved)
    physics.step(2)
    speed_m_s = float(moved.qvel[0])
    physics.step(50)
    assert len(moved.contact) == 0
    assert moved.qvel[0] == pytest.approx(speed_m_s, abs=1e-3)


@pytest.mark.parametrize("friction", [0.3, 1.0])
def test_coiled_snake_with_self_friction_comes_to_rest(friction: float) -> None:
    config = make_config(
        {"chain": {"modules": 8}, "limits": {"angle_rad": 1.5}}, {"ground": {"friction": 0.0}}
    )
    _, data, physics = make_resting_body(config, SimSettings(self_friction=friction), 0.75)
    data.qfrc_applied[6:] = 1.0
    physics.step(3000)
    assert len(data.contact) > 0
    assert np.abs(data.qvel[6:]).max() < 1e-3


@pytest.mark.parametrize(("slope", "expected_m_s2"), [(0.35, 0.0), (0.45, 0.05 * G)])
def test_slope_body_slides_only_above_ground_friction(slope: float, expected_m_s2: float) -> None:
    """The heightfield is level within 10 um; a horizontal component of gravity replaces the slope."""
    heightfield = {"height_m": 1e-5, "wavelength_m": 0.8, "area_m": 6.0}
    config = make_config(scene={"ground": {"friction": 0.4, "heightfield": heightfield}})
    sim, data, physics = make_resting_body(config, SimSettings())
    physics.step(250)
    sim.model.opt.gravity[0] = slope * G
    physics.step(250)
    speed_m_s = data.qvel[0]
    physics.step(250)
    acceleration_m_s2 = (data.qvel[0] - speed_m_s) / 0.5
    assert acceleration_m_s2 == pytest.approx(expected_m_s2, abs=0.01 * 0.4 * G)
