"""Tests that the C version of the laws computes the same bits as the Python version, which is its specification.

Both get many random states. In these the snake is bent, lifted, pressed into the ground and into obstacles, and moves.
There are springs under its feet, contacts with friction, and obstacles that have moved.
"""

from typing import Any

import mujoco
import numpy as np
import pytest
from mujoco import batch

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scenario import RunConfig
from snakesim_native.libraries import LAWS_LIBRARY
from snakesim_native.load import load_shared_library
from snakesim_sim_backend.laws.version import LawsVersion
from snakesim_sim_backend.model.build import FREE_DOFS, FREE_QPOS, SimModel, build_sim_model
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.hypothesis_profiles import choose_trial_count
from snakesim_testing.sim.simulator_rig import make_config

STATES = choose_trial_count(100)  # in each scene
MANY_STATES = 2000  # in each scene: ten thousand together
BATCH_SIZE = 9
BATCH_STEPS = 20
STEPS_PER_STATE = 2  # the second begins with the memory that the first has left

PEGS = [
    {
        "name": f"peg{i}",
        "position_m": [0.25 * i - 0.2, 0.12 * (-1) ** i],
        "radius_m": 0.05,
        "friction": 0.4,
    }
    for i in range(6)
]
MOVING_BOXES = [
    {
        "name": "post",
        "position_m": [0.3, 0.1],
        "size_m": [0.1, 0.1, 0.2],
        "friction": 0.3,
        "stiffness_n_per_m": 300.0,
    },
    {
        "name": "block",
        "position_m": [0.6, -0.1],
        "size_m": [0.2, 0.1, 0.2],
        "friction": 0.5,
        "mass_kg": 0.4,
    },
    {
        "name": "both",
        "position_m": [0.9, 0.1],
        "size_m": [0.1, 0.1, 0.2],
        "friction": 0.2,
        "mass_kg": 0.3,
        "stiffness_n_per_m": 200.0,
    },
]
SCENES: dict[str, dict[str, Any]] = {
    "flat ground": {"ground": {"friction": 0.2}},
    "pegs": {"ground": {"friction": 0.1}, "cylinder": PEGS},
    "one obstacle that moves": {"ground": {"friction": 0.3}, "box": MOVING_BOXES[:1]},
    "obstacles that move": {"ground": {"friction": 0.3}, "box": MOVING_BOXES, "cylinder": PEGS[:2]},
    "hills": {
        "ground": {
            "friction": 0.3,
            "heightfield": {"height_m": 0.1, "wavelength_m": 0.8, "area_m": 6.0},
        }
    },
    "slope": {
        "gravity_m_s2": 3.7,
        "ground": {"friction": 0.3, "slope_rad": 0.2, "slope_towards_rad": 2.5},
        "box": MOVING_BOXES,
        "cylinder": PEGS[:2],
    },
    "pipes and stairs": {
        "ground": {"friction": 0.1},
        "pipe": [
            {
                "position_m": [1.0, 0.0],
                "length_m": 6.0,
                "radius_m": 0.12,
                "inner_radius_m": 0.1,
                "friction": 0.4,
            },
            {
                "position_m": [0.5, 0.0],
                "length_m": 2.0,
                "radius_m": 0.2,
                "axis_height_m": -0.18,
                "yaw_rad": 1.5,
            },
        ],
        "stairs": [
            {"position_m": [1.2, 0.0], "count": 3, "rise_m": 0.01, "run_m": 0.1, "width_m": 3.0}
        ],
    },
    "water": {
        "ground": {"friction": 0.2},
        "fluid": {"density_kg_m3": 1000.0, "buoyancy": 0.5},
        "cylinder": PEGS[:2],
    },
    "cloth": {"ground": {"friction": 0.19, "backward_friction": 0.14}},
    "mud": {"ground": {"friction": 0.1, "viscous": {"along_s_per_m": 0.5, "across_s_per_m": 4.0}}},
    "turning wheels": {
        "ground": {"friction": 0.1, "viscous": {"along_s_per_m": 0.5, "across_s_per_m": 4.0}},
        "step": [{"position_m": [0.5, 0.0], "size_m": [0.5, 2.0], "height_m": 0.002}],
        "cylinder": PEGS[:2],
    },
    "turning wheels on hills": {
        "ground": {
            "friction": 0.3,
            "heightfield": {"height_m": 0.1, "wavelength_m": 0.8, "area_m": 6.0},
        },
        "box": MOVING_BOXES[:1],
    },
    "rough hills": {
        "ground": {
            "friction": 0.3,
            "forward_friction": 0.1,
            "viscous": {"along_s_per_m": 2.0, "across_s_per_m": 1.0},
            "heightfield": {"height_m": 0.1, "wavelength_m": 0.8, "area_m": 6.0},
        }
    },
    "steps": {
        "ground": {"friction": 0.1, "forward_friction": 0.3},
        "step": [
            {
                "position_m": [0.5, 0.0],
                "size_m": [0.5, 2.0],
                "height_m": 0.002,
                "forward_friction": 0.1,
            }
        ],
        "box": [
            {
                "position_m": [1.68, 0.0],
                "size_m": [0.4, 2.0, 0.001],
                "backward_friction": 0.1,
                "mass_kg": 0.5,
            }
        ],
        "cylinder": PEGS[:2],
    },
}
ROBOT_WITH_SCALES = {
    "skin": {
        "forward": 0.11,
        "backward": 0.14,
        "sideways": 0.19,
        "links": {"link_3": {"forward": 0.3}, "link_13": {"sideways": 0.05}},
    }
}
ROBOT_WITH_WHEELS = {
    "wheels": {
        "radius_m": 0.03,
        "bearing_radius_m": 0.004,
        "bearing_friction": 0.1,
        "tire_friction": 0.6,
    }
}
ROBOT_WITH_SEPARATE_WHEEL_LIMITS = {
    "wheels": {**ROBOT_WITH_WHEELS["wheels"], "separate_limits": True}
}
ROBOTS: dict[str, dict[str, Any]] = {
    "cloth": ROBOT_WITH_SCALES,
    "mud": ROBOT_WITH_WHEELS,
    "rough hills": ROBOT_WITH_SCALES,
    "steps": ROBOT_WITH_SCALES,
    "turning wheels": ROBOT_WITH_SEPARATE_WHEEL_LIMITS,
    "turning wheels on hills": ROBOT_WITH_SEPARATE_WHEEL_LIMITS,
}
# Scenes in which some robots lie on their sides and backs.
SCENES_WITH_ROLLED_ROBOTS = (
    "cloth",
    "mud",
    "rough hills",
    "steps",
    "turning wheels",
    "turning wheels on hills",
)


class Simulation:
    """One version of the laws in a scene."""

    def __init__(self, config: RunConfig, laws: LawsVersion) -> None:
        self.sim: SimModel = build_sim_model(config, SimSettings(), laws=laws, measures_force=True)
        self.model = self.sim.model
        self.data = mujoco.MjData(self.model)
        self.physics = PhysicsStepper(self.sim, self.data)
        self.measured_force = self.physics.start_force_measurement()

    def run(self, state: "State", min_friction: float) -> list[Floats]:
        """Start at a state, make steps, and return everything that the laws compute."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = state.positions
        self.data.qvel[:] = state.velocities
        self.physics.set_min_friction(min_friction)
        self.physics.reset()
        self.measured_force = self.physics.start_force_measurement()
        results = self._list_results()
        for _ in range(STEPS_PER_STATE):
            self.data.qfrc_applied[:] = state.forces
            self.physics.step(1)
            results += self._list_results()
        return results

    def _list_results(self) -> list[Floats]:
        contacts = self.physics.contacts
        forces_w = contacts.friction_force_w
        foot_forces_n = self.physics.laws.foot_forces_n
        return [
            self.data.qfrc_passive.copy(),
            self.data.qpos.copy(),
            self.data.qvel.copy(),
            np.array(contacts.normal_force_n),
            np.array([[number, *forces_w[number]] for number in sorted(forces_w)]),
            np.zeros(0) if foot_forces_n is None else foot_forces_n.copy(),
            np.array([self.measured_force.max_n]),
        ]


class State:
    """A random state of a model."""

    def __init__(
        self, model: mujoco.MjModel, random: np.random.Generator, *, rolls: bool = False
    ) -> None:
        speed = 10.0 ** random.uniform(-3, 0.7)
        self.positions = model.qpos0.copy()
        self.positions[FREE_QPOS:] = random.normal(0.0, 0.3, model.nq - FREE_QPOS)
        # Obstacles, whose three coordinates come last, move by centimeters.
        joints = model.nq - FREE_QPOS - count_obstacle_dofs(model)
        self.positions[FREE_QPOS + joints :] *= 0.1
        self.positions[:2] += random.normal(0.0, 0.1, 2)
        self.positions[2] += random.uniform(-0.002, 0.001)
        tilt = random.normal(0.0, 0.02, 4)
        self.positions[3:FREE_QPOS] = np.array([1.0, 0.0, 0.0, 0.0]) + tilt
        if rolls:
            self.positions[4] += random.choice([0.0, 0.0, 0.3, 0.4, 10.0])
        self.positions[3:FREE_QPOS] /= np.linalg.norm(self.positions[3:FREE_QPOS])
        self.velocities = random.normal(0.0, speed, model.nv)
        self.forces = random.normal(0.0, 0.5, model.nv)
        self.forces[:FREE_DOFS] = 0.0


def count_obstacle_dofs(model: mujoco.MjModel) -> int:
    """Return how many degrees of freedom the obstacles have."""
    slides = (model.jnt_type == int(mujoco.mjtJoint.mjJNT_SLIDE)).sum()
    return int(slides) // 2 * 3


@pytest.fixture(autouse=True)
def require_laws_library() -> None:
    """Skip the test where there is no C version."""
    loaded = load_shared_library(LAWS_LIBRARY)
    if loaded.library is None:
        pytest.skip(loaded.problem)


@pytest.mark.trials
@pytest.mark.parametrize("scene", list(SCENES))
def test_laws_in_c_compute_the_bits_of_python(scene: str) -> None:
    compare_laws(scene, STATES)


@pytest.mark.slow  # a hundred states: the test before this one
@pytest.mark.parametrize("scene", list(SCENES))
def test_laws_in_c_compute_the_same_bits_in_many_states(scene: str) -> None:
    compare_laws(scene, MANY_STATES)


def compare_laws(scene: str, states: int) -> None:
    """Give random states to both versions, and compare all that they compute."""
    config = make_config(ROBOTS.get(scene), SCENES[scene])
    specification = Simulation(config, "python")
    plugin = Simulation(config, "c")
    random = np.random.default_rng(7)
    friction_contact_count = 0
    states_with_contact = 0
    for number in range(states):
        state = State(specification.model, random, rolls=scene in SCENES_WITH_ROLLED_ROBOTS)
        min_friction = float(random.choice([0.0, 0.0, 2.0]))
        expected = specification.run(state, min_friction)
        computed = plugin.run(state, min_friction)
        friction_contact_count += len(specification.physics.contacts.friction_force_w)
        states_with_contact += specification.measured_force.max_n > 0.0
        for expected_array, array in zip(expected, computed, strict=True):
            difference = expected_array - array
            assert expected_array.tobytes() == array.tobytes(), f"state {number}: {difference}"
    if scene not in ("flat ground", "cloth", "mud"):
        assert friction_contact_count > states / 10, "too few states have contacts with friction"
    if "pegs" in scene or "obstacle" in scene:
        assert states_with_contact > states / 10, "too few states have contacts with obstacles"


def test_laws_computed_repeatedly_do_not_change_the_next_step() -> None:
    config = make_config(scene=SCENES["obstacles that move"])
    recomputed = Simulation(config, "c")
    undisturbed = Simulation(config, "c")
    state = State(recomputed.model, np.random.default_rng(3))
    for simulation in (recomputed, undisturbed):
        simulation.run(state, 0.0)
    for _ in range(3):
        mujoco.mj_forward(recomputed.model, recomputed.data)
    for simulation in (recomputed, undisturbed):
        simulation.physics.step(5)
    assert recomputed.data.qpos.tobytes() == undisturbed.data.qpos.tobytes()


def test_laws_in_plain_mujoco_start_with_feet_that_stick() -> None:
    simulation = Simulation(make_config(scene=SCENES["flat ground"]), "c")
    simulation.data.qpos[:2] = 3.0, -2.0
    simulation.data.qpos[2] = 0.99 * simulation.data.qpos[2]
    mujoco.mj_step(simulation.model, simulation.data)
    assert np.abs(simulation.data.qvel[:2]).max() < 1e-6


@pytest.mark.parametrize("threads", [1, 2, 4])
def test_batch_computes_bits_of_single_simulations_with_any_threads(
    threads: int,
) -> None:
    config = make_config(scene=SCENES["obstacles that move"])
    single = Simulation(config, "c")
    simulations = batch.Batch(single.model, nsim=BATCH_SIZE, nthread=threads)
    random = np.random.default_rng(11)
    state_kind = mujoco.mjtState.mjSTATE_INTEGRATION
    state = np.empty(mujoco.mj_stateSize(single.model, state_kind))
    expected: list[bytes] = []
    for row in range(BATCH_SIZE):
        single.run(State(single.model, random), 0.0)
        mujoco.mj_getState(single.model, single.data, state, state_kind)
        simulations.state[row] = state
        single.physics.step(BATCH_STEPS)
        mujoco.mj_getState(single.model, single.data, state, state_kind)
        expected.append(state.tobytes())
    simulations.step(nstep=BATCH_STEPS // 2)
    simulations.step(nstep=BATCH_STEPS - BATCH_STEPS // 2)
    assert [row.tobytes() for row in simulations.state] == expected
