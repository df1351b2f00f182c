"""Compares the contact forces of obstacles that the C library writes into the state with those that Python reads."""

from typing import Any

import mujoco
import numpy as np
import pytest

from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.model.measured_force import MeasuredForce
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.batch.placed import create_settled_robot
from snakesim_sim_backend.laws.version import LawsVersion, choose_laws
from snakesim_sim_backend.settings import SimSettings
from snakesim_sim_backend.state.contacts import ObstacleContactReader
from snakesim_testing.sim.simulator_rig import make_config

STEPS = 300
PEGS = [
    {
        "name": f"peg{i}",
        "position_m": [0.25 * i - 0.1, 0.1 * (-1) ** i],
        "radius_m": 0.05,
        "friction": 0.2 * (i % 2),
    }
    for i in range(4)
]
POST = {
    "name": "post",
    "position_m": [0.5, 0.095],
    "size_m": [0.1, 0.1, 0.2],
    "stiffness_n_per_m": 300.0,
}
SCENES: dict[str, dict[str, Any]] = {
    "rough and smooth pegs": {"ground": {"friction": 0.1}, "cylinder": PEGS},
    "an obstacle that yields": {"ground": {"friction": 0.1}, "cylinder": PEGS[:2], "box": [POST]},
}


needs_c = pytest.mark.skipif(
    choose_laws() == "python", reason="there is no C version of the laws here"
)


@needs_c
@pytest.mark.parametrize("name", SCENES)
def test_obstacle_contacts_in_the_state_equal_those_of_python(name: str) -> None:
    placed = create_settled_robot(make_config(scene={"name": "test", **SCENES[name]}))
    random = np.random.default_rng(1)
    joints = placed.motors.count
    limits_nm = [joint.limits.torque_nm for joint in placed.config.robot.joint_table]
    contact_count = 0
    for step in range(STEPS):
        if step % 30 == 0:
            placed.motors.set_inputs(
                [JointMode.POSITION] * joints, random.uniform(-1.2, 1.2, joints).tolist(), limits_nm
            )
        placed.physics.step(1)
        expected = [[contact.link, *contact.force_w] for contact in placed.contact_reader.read()]
        assert placed.read_obstacle_contacts() == expected
        contact_count += len(expected)
    assert contact_count > 20


class MeasuringRobot:
    """A simulated robot whose joints move at random among obstacles."""

    def __init__(self, scene: dict[str, Any], step_s: float, laws: LawsVersion) -> None:
        config = make_config(scene={"name": "test", **scene})
        self.backend = SimBackend(config, SimSettings(timestep_s=step_s), laws=laws)
        self.step_s: float = self.backend.sim.model.opt.timestep
        self.contact_reader = ObstacleContactReader(
            self.backend.sim, self.backend.data, self.backend.physics.contacts
        )
        self.measured_force = self.backend.physics.start_force_measurement()
        self._modes = [JointMode.POSITION] * config.robot.chain.modules
        self._limits_nm = [joint.limits.torque_nm for joint in config.robot.joint_table]
        self._random = np.random.default_rng(1)

    def step(self, number: int) -> None:
        """Make a physics step. Every thirtieth begins with other setpoints."""
        if number % 30 == 0:
            targets_rad = self._random.uniform(-1.2, 1.2, len(self._modes)).tolist()
            self.backend.enact(SafeSetpoints(self._modes, targets_rad, self._limits_nm), "armed")
        self.backend.physics.step(1)


@needs_c
@pytest.mark.parametrize("step_s", [0.002, 0.001])
@pytest.mark.parametrize("name", SCENES)
def test_measured_force_in_c_equals_that_in_python(name: str, step_s: float) -> None:
    robot = MeasuringRobot(SCENES[name], step_s, "c")
    specification = MeasuredForce(robot.step_s)
    pair_counts: set[int] = set()
    for number in range(3 * STEPS):
        robot.step(number)
        forces_n = robot.contact_reader.sum_forces_n()
        specification.add_sample(forces_n)
        assert robot.measured_force.max_n == specification.max_n, f"step {number}"
        pair_counts.add(len(forces_n))
    assert {0, 1, 2} <= pair_counts


@needs_c
def test_measured_force_is_the_same_with_both_laws() -> None:
    scene = SCENES["rough and smooth pegs"]
    native = MeasuringRobot(scene, 0.002, "c")
    python = MeasuringRobot(scene, 0.002, "python")
    max_force_n = 0.0
    for number in range(STEPS):
        for robot in (native, python):
            robot.step(number)
        assert native.measured_force.max_n == python.measured_force.max_n
        max_force_n = max(max_force_n, native.measured_force.max_n)
    assert max_force_n > 1.0


@pytest.mark.parametrize("laws", ["python", pytest.param("c", marks=needs_c)])
def test_measured_force_ignores_repeated_computation_of_forces(laws: LawsVersion) -> None:
    robot = MeasuringRobot(SCENES["rough and smooth pegs"], 0.002, laws)
    number = 0
    while robot.measured_force.max_n == 0.0:
        robot.step(number)
        number += 1
        assert number < STEPS
    before_n = robot.measured_force.max_n
    robot.backend.physics.forward()
    mujoco.mj_forward(robot.backend.sim.model, robot.backend.data)
    assert robot.measured_force.max_n == before_n


@needs_c
def test_measured_force_without_its_plugin_is_an_error() -> None:
    placed = create_settled_robot(
        make_config(scene={"name": "test", **SCENES["rough and smooth pegs"]})
    )
    with pytest.raises(ValueError, match="measured_force"):
        placed.physics.start_force_measurement()
