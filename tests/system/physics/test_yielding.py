"""Obstacles that yield do so as their numbers say: springs, dry friction on the ground, no direction of their own."""

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

AT = [3.0, 1.0]
PEG: dict[str, Any] = {"position_m": AT, "radius_m": 0.05, "name": "it"}
BOX: dict[str, Any] = {"position_m": AT, "size_m": [0.3, 0.1, 0.2], "name": "it"}
MASS_KG, FOOT = 2.0, 0.5
BLOCK = BOX | {"mass_kg": MASS_KG, "base_friction": FOOT}
HOLDS_N = FOOT * MASS_KG * G
DIRECTIONS = np.linspace(0.0, math.pi, 5)


class Pushed:
    """One obstacle far from the snake, pushed by a constant force and moment."""

    def __init__(self, kind: str, obstacle: dict[str, Any], step_s: float = 0.002) -> None:
        config = make_config(scene={kind: [obstacle]})
        sim, self._data, self._physics = make_resting_body(config, SimSettings(timestep_s=step_s))
        self._body, self._step_s = sim.model.body("obstacle:it").id, sim.model.opt.timestep

    def for_s(
        self, time_s: float, force_w: tuple[float, float] = (0.0, 0.0), moment_nm: float = 0.0
    ) -> Floats:
        """How far it is from where it stood: x, y in m and a turn in rad, (3,)."""
        self._data.xfrc_applied[self._body] = (*force_w, 0.0, 0.0, 0.0, moment_nm)
        self._physics.step(round(time_s / self._step_s))
        return self._data.qpos[-3:].copy()

    @property
    def speed(self) -> Floats:
        return self._data.qvel[-3:].copy()


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_spring_post_yields_by_force_over_stiffness_and_returns(direction: float) -> None:
    post = Pushed("cylinder", PEG | {"stiffness_n_per_m": 500.0})
    towards = np.array([math.cos(direction), math.sin(direction)])
    moved = post.for_s(3.0, tuple(20.0 * towards))
    assert moved == pytest.approx([*(20.0 / 500.0 * towards), 0.0], abs=1e-6)
    assert post.for_s(3.0) == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


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
    block = Pushed("box", BLOCK, step_s)
    held = block.for_s(1.0, tuple(0.9 * HOLDS_N * towards))
    assert np.linalg.norm(held) < 2e-4
    # It does not creep.
    assert block.for_s(5.0, tuple(0.9 * HOLDS_N * towards)) == pytest.approx(held, abs=1e-9)
    block.for_s(1.0)
    block.for_s(0.1, tuple(2.0 * HOLDS_N * towards))
    before = block.speed
    block.for_s(0.5, tuple(2.0 * HOLDS_N * towards))
    gained = block.speed - before
    assert gained == pytest.approx([*(0.5 * HOLDS_N / MASS_KG * towards), 0.0], rel=1e-3, abs=1e-3)
    block.for_s(2.0)
    assert np.linalg.norm(block.speed) < 1e-6


def test_a_block_turns_above_the_moment_of_its_foot() -> None:
    lengths = np.stack(np.meshgrid(np.linspace(-0.15, 0.15, 601), np.linspace(-0.05, 0.05, 201)))
    holds_nm = HOLDS_N * float(np.hypot(*lengths).mean())
    for share, turns in ((0.97, False), (1.03, True)):
        x, y, turn = Pushed("box", BLOCK).for_s(3.0, moment_nm=share * holds_nm)
        assert (abs(turn) > 0.05) == turns
        assert math.hypot(x, y) < 1e-9


def test_a_block_that_turns_is_moved_sideways_by_any_force() -> None:
    """Dry friction opposes the whole motion: a foot that slips already holds nothing across its slip."""
    gentle = (0.3 * HOLDS_N, 0.0)
    turned, alone = (
        Pushed("box", BLOCK).for_s(1.0, gentle, moment_nm=2.0),
        Pushed("box", BLOCK).for_s(1.0, gentle),
    )
    assert turned[0] > 0.01 > 1e-4 > alone[0]


def test_spring_too_stiff_for_time_step_is_refused_with_advice() -> None:
    with raises_error(ConfigError, code="scene/invalid", field="it", value=100000):
        Pushed("cylinder", PEG | {"stiffness_n_per_m": 1e5})
    Pushed("cylinder", PEG | {"stiffness_n_per_m": 1e5, "mass_kg": 1.0})


def test_yielding_obstacles_under_emulated_modules_are_no_joints() -> None:
    loose = {
        "cylinder": [PEG | {"position_m": [0.5, 0.1], "mass_kg": 1.0, "stiffness_n_per_m": 5e5}]
    }
    physics_model = MujocoPhysicsModel(
        make_config(scene=loose), PhysicsModelSettings(timestep_s=0.0005)
    )
    bent = np.full(13, 3.0)
    for _ in range(400):
        physics_model.advance(bent)
    assert (
        physics_model.angle_rad.shape
        == physics_model.velocity_rad_s.shape
        == physics_model.shaft_torque_nm().shape
        == (13,)
    )
    assert np.abs(physics_model.data.qpos[-3:-1]).max() > 1e-3  # it was pushed away
    assert [load.link for load in physics_model.loads()] == sorted(
        {load.link for load in physics_model.loads()}
    )


def test_leaning_peg_has_its_foot_position_and_angle() -> None:
    config = make_config(scene={"cylinder": [PEG | {"lean_rad": 0.3, "lean_towards_rad": 2.0}]})
    sim = build_sim_model(config, SimSettings(), motors=False)
    data, found = mujoco.MjData(sim.model), np.zeros(1, dtype=np.int32)
    mujoco.mj_kinematics(sim.model, data)
    towards, across = (
        np.array([math.cos(2.0), math.sin(2.0)]),
        np.array([-math.sin(2.0), math.cos(2.0)]),
    )
    for height_m in (0.001, 0.04, 0.12):
        middle = np.array(AT) + height_m * math.tan(0.3) * towards
        for aim, radius_m in ((across, 0.05), (towards, 0.05 / math.cos(0.3))):
            start = np.array([*(middle - 0.5 * aim), height_m])
            way_m = mujoco.mj_ray(sim.model, data, start, np.array([*aim, 0.0]), None, 1, -1, found)
            assert way_m == pytest.approx(0.5 - radius_m, abs=1e-6)


@pytest.mark.slow  # posts and blocks alone stand above
def test_snake_advances_at_fixed_obstacles_and_displaces_loose_ones() -> None:
    peg = "scene.pegs_along_route.0."
    fixed, held, pushed = (
        run_controller(
            load_run_config("peg_row", *(peg + text for text in made)), duration_s=6.0
        ).advance_m
        for made in ((), ("mass_kg=20", "base_friction=1.0"), ("mass_kg=0.5",))
    )
    assert held == pytest.approx(fixed, rel=0.1)
    assert fixed > 0.8
    assert pushed < 0.05
