"""Compares the compiled model with the robot file and scene file that it is built from."""

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config, open_sim

FRICTION_NM = 0.12
VISCOUS_NM_S_PER_RAD = 0.03


@pytest.fixture(params=["planar13", "mamba"])
def robot_and_model(request):
    """Return a robot file and the model that is compiled from it."""
    motor = {"friction_nm": FRICTION_NM, "viscous_nm_s_per_rad": VISCOUS_NM_S_PER_RAD}
    config = make_config({"motor": motor}, base_robot=request.param)
    return config.robot, open_sim(config).sim.model


def test_model_links_have_masses_of_robot_file(robot_and_model):
    robot, model = robot_and_model
    masses_kg = [float(model.body(f"link_{i}").mass[0]) for i in range(robot.chain.modules + 1)]
    assert masses_kg == pytest.approx(list(robot.link_masses_kg))
    assert sum(masses_kg) == pytest.approx(robot.chain.modules * robot.module.mass_kg)


def test_model_links_are_capsules_with_mass_center_in_their_middle(robot_and_model):
    robot, model = robot_and_model
    for i, length_m in enumerate(robot.link_lengths_m):
        radius_m, half_length_m, _ = model.geom(f"link_{i}").size
        assert radius_m == robot.module.radius_m
        assert 2 * half_length_m == pytest.approx(length_m)
        assert model.body(f"link_{i}").ipos == pytest.approx([length_m / 2, 0, 0])


def test_model_joints_have_axes_limits_and_places_of_robot_file(robot_and_model):
    robot, model = robot_and_model
    for i, axis in enumerate(robot.axes):
        joint = model.joint(f"joint_{i + 1}")
        assert joint.axis == pytest.approx([0, 0, 1] if axis == "yaw" else [0, 1, 0])
        assert joint.range == pytest.approx([-robot.limits.angle_rad, robot.limits.angle_rad])
        assert model.body_pos[joint.bodyid[0]] == pytest.approx([robot.link_lengths_m[i], 0, 0])


def test_model_motors_have_values_of_robot_file(robot_and_model):
    robot, model = robot_and_model
    base_dofs = 6  # of the free joint
    assert (
        model.dof_armature[base_dofs:].tolist()
        == [robot.motor.armature_kg_m2] * robot.chain.modules
    )
    assert model.dof_frictionloss[base_dofs:] == pytest.approx(FRICTION_NM)
    assert model.dof_damping[base_dofs:] == pytest.approx(VISCOUS_NM_S_PER_RAD)
    assert model.actuator_forcerange[:, 1] == pytest.approx(robot.limits.torque_nm)
    motor_names = [model.actuator(i).name for i in range(robot.chain.modules)]
    assert motor_names == [f"motor_joint_{i + 1}" for i in range(robot.chain.modules)]


def test_model_link_inertia_is_that_of_a_capsule():
    config = make_config()
    model = open_sim(config).sim.model
    r = config.robot.module.radius_m
    length = config.robot.module.length_m
    mass = config.robot.module.mass_kg
    # A capsule is a cylinder and two halves of a sphere.
    cylinder_m3 = np.pi * r**2 * length
    sphere_m3 = 4 / 3 * np.pi * r**3
    cylinder_kg, sphere_kg = mass * np.array([cylinder_m3, sphere_m3]) / (cylinder_m3 + sphere_m3)
    about_axis = cylinder_kg * r**2 / 2 + sphere_kg * 2 / 5 * r**2
    across = cylinder_kg * (r**2 / 4 + length**2 / 12) + sphere_kg * (
        2 / 5 * r**2 + length**2 / 4 + 3 / 8 * length * r
    )
    assert sorted(model.body("link_5").inertia) == pytest.approx(
        sorted([about_axis, across, across]), rel=1e-6
    )


@pytest.mark.parametrize(
    ("rate_hz", "timestep_s", "steps"),
    [(100, 0.001, 10), (100, 0.003, 4), (1000, 0.004, 1), (300, 0.001, 4)],
)
def test_model_period_is_a_whole_number_of_steps(rate_hz, timestep_s, steps):
    config = make_config(rate_hz=rate_hz)
    sim = open_sim(config, timestep_s=timestep_s, contact_time_s=0.01).sim
    assert sim.steps_per_tick == steps
    assert sim.model.opt.timestep * steps == pytest.approx(config.period_ns * 1e-9, rel=1e-12)


def test_model_contacts_too_stiff_for_the_step_are_refused():
    with raises_error(ConfigError, code="config/out-of-range"):
        open_sim(make_config(), timestep_s=0.005, contact_time_s=0.002)


def test_model_only_links_that_are_not_neighbors_collide():
    config = make_config({"chain": {"modules": 8}, "limits": {"angle_rad": 1.5}})
    run = SimulatorRig(config)
    data = run.sim.data
    assert not any(data.contact.geom.min(axis=1) > 0)
    # The snake is rolled up by more than a revolution.
    data.qpos[7:] = 1.0
    mujoco.mj_forward(run.sim.sim.model, data)
    pairs = {tuple(sorted(pair)) for pair in data.contact.geom.tolist() if min(pair) > 0}
    assert pairs
    assert all(second - first > 1 for first, second in pairs)
