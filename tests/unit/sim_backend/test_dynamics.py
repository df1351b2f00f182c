"""Conservation laws, friction and contact forces: the physics itself."""

import itertools

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.sim.simulator_rig import G, SimulatorRig, make_config

ICE = {"ground": {"friction": 0.0}}


def loads_n(run: SimulatorRig) -> NDArray[np.float64]:
    """On every foot."""
    forces_n = run.sim.physics.laws.foot_forces_n
    assert forces_n is not None
    return forces_n


def kinetic_energy(run):
    data, model = run.sim.data, run.sim.sim.model
    mujoco.mj_forward(model, data)
    mujoco.mj_energyVel(model, data)
    return data.energy[1]


def momentum(run):
    """Linear and angular momentum, the latter about the world's origin, z component."""
    data, model = run.sim.data, run.sim.sim.model
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    snake = model.body("link_0").id
    linear = model.body_subtreemass[snake] * data.subtree_linvel[snake]
    return np.array(
        [*linear[:2], (data.subtree_angmom[snake] + np.cross(data.subtree_com[snake], linear))[2]]
    )


def mass_kg(config):
    return config.robot.chain.modules * config.robot.module.mass_kg


def test_a_writhing_snake_on_ice_keeps_its_momentum():
    run = SimulatorRig(make_config(scene=ICE), timestep_s=0.0002)
    run.sim.data.qvel[:2] = 0.3, -0.1
    start = momentum(run)
    run.command([JointMode.POSITION] * 13, [0.4 * np.sin(0.9 * i) for i in range(13)])
    run.advance(1.0)
    assert np.ptp(run.sim.true_state().angles_rad) > 0.5
    assert momentum(run) == pytest.approx(start, abs=2e-3 * mass_kg(run.config) * 0.3)


def test_passive_joints_on_ice_keep_their_energy():
    run = SimulatorRig(make_config(scene=ICE), timestep_s=0.0005)
    run.sim.data.qvel[6:] = [0.5 * np.cos(i) for i in range(13)]
    start = kinetic_energy(run)
    run.advance(0.5)
    assert kinetic_energy(run) == pytest.approx(start, rel=0.01)


def test_motors_give_the_energy_that_the_snake_has():
    run = SimulatorRig(make_config({"chain": {"modules": 3}}, ICE, rate_hz=1000))
    work = 0.0
    run.command(JointMode.TORQUE, [0.02, -0.03, 0.01])
    for _ in range(300):
        before = run.sim.true_state().velocities_rad_s
        run.advance()
        state = run.sim.true_state()
        work += float(state.torques_nm @ (before + state.velocities_rad_s)) / 2 * 1e-3
    assert kinetic_energy(run) == pytest.approx(work, rel=0.01)


CURLED = [0.5] * 8  # a straight, round body would roll


@pytest.mark.parametrize("yaw", [0.0, 0.8, 1.6])
@pytest.mark.parametrize("friction", [0.1, 0.5])
def test_towing_drags_with_friction_times_weight_in_every_direction(yaw, friction):
    config = make_config(
        {"chain": {"modules": 4}},
        {"ground": {"friction": friction}},
        start={"yaw_rad": yaw},
        rate_hz=500,
    )
    run = SimulatorRig(
        config,
        tether={
            "link": 4,
            "direction_w": [float(np.cos(yaw)), float(np.sin(yaw))],
            "reel_in_m_s": 0.1,
        },
    )
    run.command(JointMode.POSITION)
    run.advance(1.0)
    tensions = []
    for _ in range(500):
        run.advance()
        tensions.append(run.sim.tether_tension_n)
    assert np.mean(tensions) == pytest.approx(friction * mass_kg(config) * G, rel=0.02)


def test_a_snake_that_slides_does_not_hop():
    config = make_config(scene={"ground": {"friction": 0.1}})
    run = SimulatorRig(
        config, tether={"link": 13, "point_m": 0.055, "direction_w": [1.0, 0.0], "reel_in_m_s": 0.2}
    )
    run.command(JointMode.POSITION)
    run.advance(1.0)
    heights, tensions = [], []
    for _ in range(50):
        run.advance()
        heights.append(run.sim.true_state().base_velocity_w[2])
        tensions.append(run.sim.tether_tension_n)
        assert loads_n(run).min() > 0.0  # every joint and both ends are on the ground
    assert np.std(heights) < 1e-3
    assert tensions == pytest.approx([0.1 * mass_kg(config) * G] * 50, rel=0.03)


@pytest.mark.parametrize("along", [(1.0, 0.0), (0.0, 1.0), (0.7, -0.7)])
@pytest.mark.parametrize(("tilt", "slides"), [(0.9, False), (1.1, True)])
def test_snake_on_slope_slides_only_beyond_friction_angle(along, tilt, slides):
    friction = 0.3
    run = SimulatorRig(make_config({"chain": {"modules": 8}}, {"ground": {"friction": friction}}))
    run.command([JointMode.POSITION] * 8, CURLED)
    run.advance(0.5)
    before = run.sim.true_state().base_position_w
    slope = np.arctan(friction) * tilt
    downhill = np.array(along) / np.hypot(*along)
    run.sim.sim.model.opt.gravity[:] = [*(G * np.sin(slope) * downhill), -G * np.cos(slope)]
    run.advance(1.0)
    moved = (run.sim.true_state().base_position_w - before)[:2] @ downhill
    if slides:
        acted = (np.sin(slope) - 2 * moved / G) / np.cos(slope)
        assert acted == pytest.approx(friction, rel=0.03)
    else:
        assert abs(moved) < 3e-3


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
def test_sliding_along_an_obstacle_rubs_with_the_obstacle_s_friction(obstacle):
    friction = next(iter(obstacle.values()))[0]["friction"]
    run = SimulatorRig(make_config({"chain": {"modules": 4}}, {**ICE, **obstacle}))
    run.command(JointMode.POSITION)
    data, model = run.sim.data, run.sim.sim.model
    body = model.body("link_2").id
    data.xfrc_applied[body, 1] = 8.0
    data.qvel[0] = 0.5
    ratios = []
    for _ in range(10):
        run.advance()
        contacts = run.sim.true_state().contacts
        if not contacts:
            continue
        force = np.sum([c.force_w for c in contacts], axis=0)
        normal = np.array(contacts[0].normal_w)
        push = force @ normal
        ratios.append(np.linalg.norm(force - push * normal) / push)
        assert force[0] <= 1e-6
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


def test_the_ground_carries_the_weight():
    config = make_config()
    run = SimulatorRig(config)
    run.advance(0.1)
    masses = config.robot.link_masses_kg
    shares = [0.5 * (before + after) for before, after in itertools.pairwise([0.0, *masses, 0.0])]
    assert loads_n(run) == pytest.approx(G * np.array(shares), rel=1e-3)
