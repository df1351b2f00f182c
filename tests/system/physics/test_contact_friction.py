"""Rough obstacles rub as dry friction does: by mu N against the motion, without throwing off what slides along them."""

from typing import Any

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.settings import SimSettings
from snakesim_sim_backend.state.contacts import ObstacleContactReader
from snakesim_testing.sim.simulator_rig import G, make_config, make_resting_body

MU, PRESS_N = 0.3, 2.0  # of the wall; on each link
WHOLE = mujoco.mjtState.mjSTATE_INTEGRATION


class Pressed:
    """A straight snake on ground without friction, pressed at a long wall beside it."""

    def __init__(self, *, step_s: float = 0.002, **wall: Any) -> None:
        wall = {
            "position_m": [1.0, -0.09],
            "size_m": [8.0, 0.1, 0.2],
            "friction": MU,
            "name": "it",
        } | wall
        config = make_config(scene={"ground": {"friction": 0.0}, "box": [wall]})
        self.sim, self.data, self.physics = make_resting_body(
            config, SimSettings(timestep_s=step_s)
        )
        self.model = self.sim.model
        self._touches = ObstacleContactReader(self.sim, self.data, self.physics.contacts)
        self.links = len(self.sim.link_geoms)
        first = self.sim.first_link_body
        self.forces_w = self.data.xfrc_applied[first : first + self.links]
        self.mass_kg = float(self.model.body_mass[first : first + self.links].sum())
        self.forces_w[:, 1] = -PRESS_N
        self.for_s(0.5)

    def for_s(self, time_s: float) -> None:
        self.physics.step(round(time_s / self.model.opt.timestep))

    @property
    def speed_m_s(self) -> float:
        return float(self.data.qvel[0])

    @property
    def measured_w(self) -> Floats:
        """The wall's force on the body."""
        return np.sum([touch.force_w for touch in self._touches.read()], axis=0)


@pytest.mark.parametrize("step_s", [0.002, 0.0005])
def test_wall_friction_brakes_body_by_mu_times_normal_force(step_s: float) -> None:
    body = Pressed(step_s=step_s)
    body.data.qvel[0] = 1.0
    body.for_s(0.1)
    before, pushes = body.speed_m_s, []
    for _ in range(100):
        body.for_s(0.002)
        pushes.append(body.measured_w)
    normal, rub = np.array(pushes)[:, 1], np.array(pushes)[:, 0]
    pressed_n = PRESS_N * body.links
    assert before - body.speed_m_s == pytest.approx(0.2 * MU * pressed_n / body.mass_kg, rel=0.01)
    assert normal == pytest.approx(pressed_n, rel=0.02), "it leaves the wall and comes back"
    assert rub == pytest.approx(-MU * pressed_n, rel=0.02), "its sensor feels another friction"


def test_it_stands_below_mu_and_slides_above() -> None:
    body = Pressed()
    body.forces_w[:, 0] = 0.9 * MU * PRESS_N
    body.for_s(1.0)
    at = float(body.data.qpos[0])
    body.for_s(2.0)
    assert body.data.qpos[0] == pytest.approx(at, abs=1e-6)
    body.forces_w[:, 0] = 1.1 * MU * PRESS_N
    body.for_s(1.0)
    assert body.speed_m_s == pytest.approx(0.1 * MU * PRESS_N * body.links / body.mass_kg, rel=0.05)


def test_wall_friction_drags_a_block_by_same_force() -> None:
    body = Pressed(mass_kg=5.0, base_friction=0.0)
    body.forces_w[:] = 0.0
    body.data.qvel[:] = 0.0
    body.data.qvel[:2] = 0.5, -0.2
    before = body.mass_kg * body.data.qvel[:2]
    body.for_s(0.5)
    block = 5.0 * body.data.qvel[-3:-1]
    assert block[0] > 0.05
    assert body.mass_kg * body.data.qvel[:2] + block == pytest.approx(before, abs=0.01)


def test_friction_state_restored_continues_unchanged() -> None:
    body = Pressed()
    body.data.qvel[0] = 0.5
    body.forces_w[:, 0] = 0.5 * MU * PRESS_N
    body.for_s(0.1)
    saved = np.empty(mujoco.mj_stateSize(body.model, WHOLE))
    mujoco.mj_getState(body.model, body.data, saved, WHOLE)
    body.for_s(1.0)
    other = mujoco.MjData(body.model)
    mujoco.mj_setState(body.model, other, saved, WHOLE)
    PhysicsStepper(body.sim, other).step(500)
    assert other.qpos.tolist() == body.data.qpos.tolist()


def test_friction_of_body_moved_after_restore_is_zero() -> None:
    body = Pressed()
    body.data.qvel[0] = 0.5
    body.for_s(0.1)
    other = mujoco.MjData(body.model)
    mujoco.mj_copyData(other, body.model, body.data)
    other.xfrc_applied[:] = 0.0
    other.qpos[1] += 0.01
    physics = PhysicsStepper(body.sim, other)
    physics.step(2)
    before = float(other.qvel[0])
    physics.step(50)
    assert len(other.contact) == 0
    assert other.qvel[0] == pytest.approx(before, abs=1e-3)


@pytest.mark.parametrize("friction", [0.3, 1.0])
def test_rolled_up_a_snake_whose_links_rub_comes_to_rest(friction: float) -> None:
    config = make_config(
        {"chain": {"modules": 8}, "limits": {"angle_rad": 1.5}}, {"ground": {"friction": 0.0}}
    )
    _, data, physics = make_resting_body(config, SimSettings(self_friction=friction), 0.75)
    data.qfrc_applied[6:] = 1.0
    physics.step(3000)
    assert len(data.contact) > 0
    assert np.abs(data.qvel[6:]).max() < 1e-3


@pytest.mark.parametrize(("slope", "slides_m_s2"), [(0.35, 0.0), (0.45, 0.05 * G)])
def test_slope_body_slides_only_above_ground_friction(slope: float, slides_m_s2: float) -> None:
    """The ground is level but for 10 um, and gravity is turned."""
    uneven = {"height_m": 1e-5, "wavelength_m": 0.8, "area_m": 6.0}
    config = make_config(scene={"ground": {"friction": 0.4, "heightfield": uneven}})
    sim, data, physics = make_resting_body(config, SimSettings())
    physics.step(250)
    sim.model.opt.gravity[0] = slope * G
    physics.step(250)
    before = data.qvel[0]
    physics.step(250)
    assert (data.qvel[0] - before) / 0.5 == pytest.approx(slides_m_s2, abs=0.01 * 0.4 * G)
