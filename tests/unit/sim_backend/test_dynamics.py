"""Tests conservation laws, friction and contact forces of the simulated physics."""

import itertools

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.sim.simulator_rig import G, SimulatorRig, make_config

ICE = {"ground": {"friction": 0.0}}


def read_foot_forces_n(run: SimulatorRig) -> NDArray[np.float64]:
    """Return the force of the ground on each foot."""
    forces_n = run.sim.physics.laws.foot_forces_n
    assert forces_n is not None
    return forces_n


def compute_kinetic_energy_j(run):
    data = run.sim.data
    model = run.sim.sim.model
    mujoco.mj_forward(model, data)
    mujoco.mj_energyVel(model, data)
    return data.energy[1]


def compute_momentum(run):
    """Return x and y of the linear momentum, and z of the angular momentum about the world's origin."""
    data = run.sim.data
    model = run.sim.sim.model
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    snake = model.body("link_0").id
    linear = model.body_subtreemass[snake] * data.subtree_linvel[snake]
    angular = data.subtree_angmom[snake] + np.cross(data.subtree_com[snake], linear)
    return np.array([*linear[:2], angular[2]])


def compute_mass_kg(config):
    return config.robot.chain.modules * config.robot.module.mass_kg


def test_snake_that_moves_joints_on_ice_keeps_its_momentum():
    run = SimulatorRig(make_config(scene=ICE), timestep_s=0.0002)
    run.sim.data.qvel[:2] = 0.3, -0.1
    start_momentum = compute_momentum(run)
    run.command([JointMode.POSITION] * 13, [0.4 * np.sin(0.9 * i) for i in range(13)])
    run.advance(1.0)
    assert np.ptp(run.sim.true_state().angles_rad) > 0.5
    assert compute_momentum(run) == pytest.approx(
        start_momentum, abs=2e-3 * compute_mass_kg(run.config) * 0.3
    )


def test_snake_with_passive_joints_on_ice_keeps_its_energy():
    run = SimulatorRig(make_config(scene=ICE), timestep_s=0.0005)
    run.sim.data.qvel[6:] = [0.5 * np.cos(i) for i in range(13)]
    start_energy_j = compute_kinetic_energy_j(run)
    run.advance(0.5)
    assert compute_kinetic_energy_j(run) == pytest.approx(start_energy_j, rel=0.01)


def test_motor_work_on_ice_equals_the_kinetic_energy():
    run = SimulatorRig(make_config({"chain": {"modules": 3}}, ICE, rate_hz=1000))
    period_s = 1e-3
    work_j = 0.0
    run.command(JointMode.TORQUE, [0.02, -0.03, 0.01])
    for _ in range(300):
        velocities_before_rad_s = run.sim.true_state().velocities_rad_s
        run.advance()
        state = run.sim.true_state()
        velocity_sums_rad_s = velocities_before_rad_s + state.velocities_rad_s
        work_j += float(state.torques_nm @ velocity_sums_rad_s) / 2 * period_s
    assert compute_kinetic_energy_j(run) == pytest.approx(work_j, rel=0.01)


CURLED_RAD = [0.5] * 8  # a straight, round body would roll


@pytest.mark.parametrize("yaw_rad", [0.0, 0.8, 1.6])
@pytest.mark.parametrize("friction", [0.1, 0.5])
def test_towed_snake_resists_with_friction_in_every_direction(yaw_rad, friction):
    config = make_config(
        {"chain": {"modules": 4}},
        {"ground": {"friction": friction}},
        start={"yaw_rad": yaw_rad},
        rate_hz=500,
    )
    direction_w = [float(np.cos(yaw_rad)), float(np.sin(yaw_rad))]
    tether = {"link": 4, "direction_w": direction_w, "reel_in_m_s": 0.1}
    run = SimulatorRig(config, tether=tether)
    run.command(JointMode.POSITION)
    run.advance(1.0)
    tensions_n = []
    for _ in range(500):
        run.advance()
        tensions_n.append(run.sim.tether_tension_n)
    assert np.mean(tensions_n) == pytest.approx(friction * compute_mass_kg(config) * G, rel=0.02)


def test_sliding_snake_keeps_all_feet_on_the_ground():
    friction = 0.1
    config = make_config(scene={"ground": {"friction": friction}})
    tether = {"link": 13, "point_m": 0.055, "direction_w": [1.0, 0.0], "reel_in_m_s": 0.2}
    run = SimulatorRig(config, tether=tether)
    run.command(JointMode.POSITION)
    run.advance(1.0)
    vertical_speeds_m_s = []
    tensions_n = []
    for _ in range(50):
        run.advance()
        vertical_speeds_m_s.append(run.sim.true_state().base_velocity_w[2])
        tensions_n.append(run.sim.tether_tension_n)
        # All joints and both ends are on the ground.
        assert read_foot_forces_n(run).min() > 0.0
    assert np.std(vertical_speeds_m_s) < 1e-3
    assert tensions_n == pytest.approx([friction * compute_mass_kg(config) * G] * 50, rel=0.03)


@pytest.mark.parametrize("downhill_direction", [(1.0, 0.0), (0.0, 1.0), (0.7, -0.7)])
@pytest.mark.parametrize(("angle_ratio", "slides"), [(0.9, False), (1.1, True)])
def test_snake_on_slope_slides_only_beyond_friction_angle(downhill_direction, angle_ratio, slides):
    friction = 0.3
    run = SimulatorRig(make_config({"chain": {"modules": 8}}, {"ground": {"friction": friction}}))
    run.command([JointMode.POSITION] * 8, CURLED_RAD)
    run.advance(0.5)
    before_w = run.sim.true_state().base_position_w
    slope_rad = np.arctan(friction) * angle_ratio
    downhill_w = np.array(downhill_direction) / np.hypot(*downhill_direction)
    run.sim.sim.model.opt.gravity[:] = [
        *(G * np.sin(slope_rad) * downhill_w),
        -G * np.cos(slope_rad),
    ]
    run.advance(1.0)
    moved_m = (run.sim.true_state().base_position_w - before_w)[:2] @ downhill_w
    if slides:
        # The acceleration during the second is twice the displacement.
        measured_friction = (np.sin(slope_rad) - 2 * moved_m / G) / np.cos(slope_rad)
        assert measured_friction == pytest.approx(friction, rel=0.03)
    else:
        assert abs(moved_m) < 3e-3


@pytest.mark.parametrize(
    "obstacle",
    [
        {"wall": [{"from_m": [-1, 0.07], "to_m": [2, 0.07], "friction": 0.4}]},
        {"wall": [{"from_m": [-1, 0.07], "to_m": [2, 0.07], "friction": 0.0}]},
        {"cylinder": [{"position_m": [0.22, 0.0905], "radius_m": 0.05, "friction": 0.25}]},
        {
            "cylinder": [
                {"position_m": [0.22, 0.0905], "radius_m": 0.05, "height_m": 0.1, "friction": 0.25}
            ]
        },
    ],
)
def test_sliding_along_an_obstacle_has_the_friction_of_obstacle(obstacle):
    friction = next(iter(obstacle.values()))[0]["friction"]
    run = SimulatorRig(make_config({"chain": {"modules": 4}}, {**ICE, **obstacle}))
    run.command(JointMode.POSITION)
    data = run.sim.data
    body = run.sim.sim.model.body("link_2").id
    data.xfrc_applied[body, 1] = 8.0
    data.qvel[0] = 0.5
    ratios = []
    for _ in range(10):
        run.advance()
        contacts = run.sim.true_state().contacts
        if not contacts:
            continue
        force_w = np.sum([contact.force_w for contact in contacts], axis=0)
        normal_w = np.array(contacts[0].normal_w)
        normal_force_n = force_w @ normal_w
        friction_force_n = np.linalg.norm(force_w - normal_force_n * normal_w)
        ratios.append(friction_force_n / normal_force_n)
        assert force_w[0] <= 1e-6, "friction does not drive the snake"
    assert np.median(ratios) == pytest.approx(friction, rel=0.02, abs=1e-6)


def test_contact_force_of_snake_pushed_at_peg_equals_push():
    peg = {"cylinder": [{"position_m": [0.22, 0.0905], "radius_m": 0.05, "name": "post"}]}
    run = SimulatorRig(make_config({"chain": {"modules": 4}}, {**ICE, **peg}))
    run.command(JointMode.POSITION)
    body = run.sim.sim.model.body("link_2").id
    run.sim.data.xfrc_applied[body, 1] = 20.0
    run.advance(0.3)
    (contact,) = run.sim.true_state().contacts
    assert contact.obstacle == "post"
    assert contact.link == 2
    assert contact.force_w == pytest.approx([0.0, -20.0, 0.0], abs=0.2)
    assert contact.normal_w == pytest.approx([0.0, -1.0, 0.0], abs=1e-2)
    assert contact.position_w == pytest.approx([0.22, 0.0405, 0.04], abs=3e-3)


def test_ground_carries_the_weight_of_the_links():
    config = make_config()
    run = SimulatorRig(config)
    run.advance(0.1)
    # Each foot carries half of both links that it joins.
    masses_kg = [0.0, *config.robot.link_masses_kg, 0.0]
    carried_kg = [0.5 * (behind + ahead) for behind, ahead in itertools.pairwise(masses_kg)]
    assert read_foot_forces_n(run) == pytest.approx(G * np.array(carried_kg), rel=1e-3)
