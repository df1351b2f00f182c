"""The body under emulated modules: it starts as the simulated robot does, obeys the same physics, and feels it."""

import math

import mujoco
import numpy as np
import pytest
from numpy.typing import ArrayLike

from snakesim_hal.base.errors import BackendError
from snakesim_hal.model.geometry.kinematics import rotation_from_quaternion
from snakesim_hal.model.scenario import compute_start_pose, load_scenario
from snakesim_hal.physics.physics_model import PhysicsModel
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.model.tether import WINCH_N_S_PER_M
from snakesim_sim_backend.physics import PhysicsStepper
from snakesim_sim_backend.physics_model import MujocoPhysicsModel
from snakesim_sim_backend.settings import PhysicsModelSettings, TetherSettings
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.hilly_start import CURVE, HILLS
from snakesim_testing.sim.simulator_rig import G, SimulatorRig, make_config

ICE = {"ground": {"friction": 0.0}}
FOUR = {"chain": {"modules": 4}}
RUBBING = {"armature_kg_m2": 0.01, "friction_nm": 0.05, "viscous_nm_s_per_rad": 0.02}
PEG = {"cylinder": [{"position_m": [0.22, 0.0905], "radius_m": 0.05}]}


def make_physics_model(config, **settings):
    return MujocoPhysicsModel(config, PhysicsModelSettings(**settings))


def pass_time(physics_model, torque_nm: ArrayLike = 0.0, seconds=0.0):
    """At least one step under constant torques: one number for all joints, or one each."""
    torques = np.broadcast_to(np.asarray(torque_nm, dtype=float), physics_model.angle_rad.shape)
    for _ in range(max(round(seconds / physics_model.step_s), 1)):
        physics_model.advance(torques)


def touches_of(physics_model):
    """Link -> (position, force) in the world's frame of every touch by an obstacle, pushed as MuJoCo says."""
    model, data, rub_w = (
        physics_model.sim.model,
        physics_model.data,
        physics_model.physics.contacts.friction_force_w,
    )
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    wrench = np.zeros(6)
    for i in range(data.ncon):
        names = [model.geom(g).name for g in data.contact[i].geom]
        if not any(name.startswith("obstacle:") for name in names):
            continue
        mujoco.mj_contactForce(model, data, i, wrench)
        force = data.contact[i].frame.reshape(3, 3).T @ wrench[:3]  # on the second geom
        (which,) = (k for k in (0, 1) if names[k].startswith("link_"))
        link = int(names[which].removeprefix("link_"))
        force = (force if which else -force) + rub_w.get(i, 0.0)
        found.setdefault(link, []).append((data.contact[i].pos.copy(), force))
    return found


def true_loads(physics_model):
    """Link -> (position, force) in the link's frame."""
    result = {}
    for link, touches in touches_of(physics_model).items():
        body = physics_model.data.body(f"link_{link}")
        weights = [np.linalg.norm(force) for _, force in touches]
        if sum(weights) == 0:
            continue
        link_from_world = body.xmat.reshape(3, 3).T
        position = np.average([p for p, _ in touches], axis=0, weights=weights) - body.xpos
        result[link] = (
            link_from_world @ position,
            link_from_world @ np.sum([f for _, f in touches], axis=0),
        )
    return result


def through_joints_nm(physics_model, torques):
    """Torque about every joint's axis between its two links, from what the outer links will do under these torques."""
    model, data = physics_model.sim.model, mujoco.MjData(physics_model.sim.model)
    mujoco.mj_copyData(data, model, physics_model.data)
    data.qfrc_applied[6:] = torques
    PhysicsStepper(physics_model.sim, data).forward()
    mujoco.mj_rnePostConstraint(model, data)
    through = [
        data.cdof[6 + i] @ data.cfrc_int[model.jnt_bodyid[1 + i]]
        for i in range(len(physics_model.angle_rad))
    ]
    of_the_ground = data.qfrc_passive - data.qfrc_damper
    return np.array(through) - of_the_ground[6:]


class Firmware:
    """A module's position loop as the robot file describes it, computed once a step."""

    def __init__(self, config, step_s):
        self._motor, self._most_nm = config.robot.motor, config.robot.limits.torque_nm
        self._gain = 1 - math.exp(-step_s / self._motor.response_time_s)
        self.torque_nm = np.zeros(config.robot.chain.modules)

    def drive(self, physics_model, target_rad):
        error, speed = target_rad - physics_model.angle_rad, physics_model.velocity_rad_s
        demand = self._motor.stiffness_nm_per_rad * error - self._motor.damping_nm_s_per_rad * speed
        self.torque_nm = self.torque_nm + self._gain * (demand - self.torque_nm)
        physics_model.advance(np.clip(self.torque_nm, -self._most_nm, self._most_nm))


# --- start --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "config",
    [
        make_config(),
        load_scenario("triplet").config,
        make_config(scene={**HILLS, **CURVE}, base_robot="mamba", start={"on_route": True}),
    ],
    ids=["flat", "triplet", "hills_mamba"],
)
def test_physics_model_starts_like_the_simulator(config):
    physics_model, state = make_physics_model(config), SimulatorRig(config).sim.true_state()
    pose = physics_model.pose()
    assert physics_model.angle_rad == pytest.approx(state.angles_rad, abs=1e-4)
    assert pose.position_w == pytest.approx(state.base_position_w, abs=1e-4)
    assert pose.orientation_wxyz == pytest.approx(state.base_orientation_wxyz, abs=1e-4)
    assert not physics_model.velocity_rad_s.any()
    assert not any(pose.velocity_w + pose.angular_velocity_w)
    assert physics_model.data.time == 0.0


def test_physics_model_without_torque_stays_at_rest():
    physics_model: PhysicsModel = make_physics_model(load_scenario("triplet").config)
    angles, before = physics_model.angle_rad.copy(), physics_model.pose()
    pass_time(physics_model, seconds=1.0)
    after = physics_model.pose()
    assert before is not None
    assert after is not None
    assert physics_model.angle_rad == pytest.approx(angles, abs=1e-4)
    assert after.position_w == pytest.approx(before.position_w, abs=1e-4)
    assert np.abs(physics_model.velocity_rad_s).max() < 1e-4
    assert before.tick == 0
    assert before.timestamp_ns == 0
    assert after.tick == 0
    assert after.timestamp_ns == 10**9


# --- torques ------------------------------------------------------------------------------------------------------


def test_free_joint_accelerates_by_inertia_and_gauge_measures_links():
    """Two equal bars, straight and free, open about their joint without pushing each other: inertia is half a bar's."""
    rotor, torque = 0.004, 0.03
    config = make_config({"chain": {"modules": 1}, "motor": {"armature_kg_m2": rotor}}, ICE)
    physics_model = make_physics_model(config)
    links = physics_model.sim.model.body("link_1").inertia.max() / 2  # about an axis across the bar
    pass_time(physics_model, torque)
    expected = torque / (links + rotor)
    assert physics_model.velocity_rad_s[0] / physics_model.step_s == pytest.approx(
        expected, rel=1e-3
    )
    assert physics_model.shaft_torque_nm()[0] == pytest.approx(torque - rotor * expected, rel=1e-3)


def test_joint_at_its_limit_stops_and_gauge_measures_motor():
    physics_model = make_physics_model(make_config({**FOUR, "limits": {"angle_rad": 0.3}}, ICE))
    pass_time(physics_model, [0.0, 0.4, 0.0, 0.0], seconds=2.0)
    assert physics_model.angle_rad[1] == pytest.approx(0.3, abs=5e-3)
    assert abs(physics_model.velocity_rad_s[1]) < 1e-3
    assert physics_model.shaft_torque_nm()[1] == pytest.approx(0.4, rel=1e-2)


def test_shaft_at_rest_has_motor_torque_minus_dry_friction():
    """Friction of the ground holds the links, so nothing moves: first without, then with dry friction in the joints."""
    grippy = {"ground": {"friction": 1.0}}
    held = [0.02, -0.01, 0.03, 0.0]
    physics_model = make_physics_model(make_config(FOUR, grippy))
    pass_time(physics_model, held, seconds=2.5)  # a straight body rocks on its round belly
    assert np.abs(physics_model.velocity_rad_s).max() < 0.01
    assert physics_model.shaft_torque_nm() == pytest.approx(held, abs=1e-3)
    dry = make_physics_model(make_config({**FOUR, "motor": {"friction_nm": 0.1}}, ICE))
    pass_time(dry, held, seconds=0.5)
    assert np.abs(dry.velocity_rad_s).max() < 0.01
    assert dry.shaft_torque_nm() == pytest.approx([0.0] * 4, abs=1e-3)


@pytest.mark.parametrize("motor", [{}, RUBBING], ids=["smooth", "rubbing"])
def test_in_motion_the_shafts_carry_what_the_outer_links_need(motor):
    """Among pegs, with inertia, gravity, friction and touches: against the forces between the links."""
    peg = {
        "cylinder": [
            {"position_m": [0.22 + 0.2 * k, 0.0905], "radius_m": 0.05, "friction": 0.3}
            for k in range(3)
        ]
    }
    # No end stops: they are not felt, but between the links.
    robot = {"motor": motor, "limits": {"angle_rad": 3.1}}
    physics_model = make_physics_model(make_config(robot, {"ground": {"friction": 0.2}, **peg}))
    # Of the solver, whose default leaves 1e-3 N·m open.
    physics_model.sim.model.opt.tolerance = 1e-14
    touched = 0
    for k in range(1500):
        torques = np.array([0.5 * np.sin(0.01 * k + 0.9 * i) for i in range(13)])
        needed = through_joints_nm(physics_model, torques) if k % 20 == 0 else None
        physics_model.advance(torques)
        if needed is not None:
            assert physics_model.shaft_torque_nm() == pytest.approx(needed, abs=1e-5)
            touched += len(physics_model.loads())
    assert touched > 5
    assert np.ptp(physics_model.angle_rad) > 0.3


def test_position_loop_once_a_step_equals_simulator_motors():
    """All the way within a thousandth of the motion, and the torques within 3 % of the greatest."""
    config = make_config({"chain": {"modules": 6}}, rate_hz=1000)
    physics_model, run = make_physics_model(config), SimulatorRig(config, timestep_s=0.001)
    firmware = Firmware(config, physics_model.step_s)
    worst_rad, worst_nm, max_rad, max_nm = 0.0, 0.0, 0.0, 0.0
    for k in range(1000):
        target = np.array(
            [0.1 * np.sin(0.0063 * k - 0.8 * i) - 0.1 * np.sin(-0.8 * i) for i in range(6)]
        )
        run.command(JointMode.POSITION, target.tolist())
        run.advance()
        firmware.drive(physics_model, target)
        state = run.sim.true_state()
        worst_rad = max(worst_rad, np.abs(physics_model.angle_rad - state.angles_rad).max())
        worst_nm = max(worst_nm, np.abs(firmware.torque_nm - state.torques_nm).max())
        max_rad = max(max_rad, np.abs(state.angles_rad).max())
        max_nm = max(max_nm, np.abs(state.torques_nm).max())
    assert max_rad > 0.1
    assert worst_rad < 1e-3 * max_rad
    assert worst_nm < 0.03 * max_nm
    assert physics_model.pose().position_w == pytest.approx(
        run.sim.true_state().base_position_w, abs=1e-4
    )


# --- what is felt -------------------------------------------------------------------------------------------------


def test_contact_forces_without_contact_or_imus_are_zero():
    physics_model = make_physics_model(make_config({"sensors!": {"joints": {}}}))
    assert physics_model.loads() == []
    pass_time(physics_model)
    assert physics_model.loads() == []
    assert physics_model.imu() is None


def test_motor_between_three_pegs_measures_their_moment():
    """A peg on the left of its middle and one on the right of each end: bent to the right, it is jammed."""
    places = [(0.03, -0.0905), (0.24, 0.0905), (0.62, -0.0905)]
    pegs = {"cylinder": [{"position_m": list(place), "radius_m": 0.05} for place in places]}
    config = make_config({"chain": {"modules": 6}}, {**ICE, **pegs})
    physics_model = make_physics_model(config)
    firmware = Firmware(config, physics_model.step_s)
    for k in range(500):
        firmware.drive(physics_model, np.array([0.0, 0.0, -min(k * 1e-4, 0.03), 0.0, 0.0, 0.0]))
    tail, middle, head = physics_model.loads()
    assert tail.link == 0
    assert middle.link == 2
    assert head.link == 6
    assert middle.force_l[1] < -1.0 < 1.0 < min(tail.force_l[1], head.force_l[1])
    assert tail.position_l[1] < 0.0 < middle.position_l[1]
    # It is being squeezed out forwards, slowly.
    assert np.abs(physics_model.velocity_rad_s).max() < 0.02
    joint, body = physics_model.data.body("link_3").xpos, physics_model.data.body("link_6")
    rotation = body.xmat.reshape(3, 3)
    arm = body.xpos + rotation @ head.position_l - joint
    moment = np.cross(arm, rotation @ head.force_l)[2]
    assert physics_model.shaft_torque_nm()[2] == pytest.approx(-moment, rel=0.01)
    assert physics_model.shaft_torque_nm() == pytest.approx(firmware.torque_nm, abs=0.01)


@pytest.mark.parametrize("friction", [pytest.param(0.0, marks=pytest.mark.slow), 0.4])
def test_loads_are_the_sums_of_the_true_touches(friction):
    """Jammed between walls and pegs, links are touched at several places at once."""
    walls = [{"from_m": [-1, y], "to_m": [3, y], "friction": friction} for y in (0.09, -0.09)]
    pegs = [
        {"position_m": [0.4 + 0.3 * k, 0.06], "radius_m": 0.02, "friction": friction}
        for k in range(3)
    ]
    config = make_config(scene={"wall": walls, "cylinder": pegs})
    physics_model = make_physics_model(config)
    firmware = Firmware(config, physics_model.step_s)
    links, most_on_one = set(), 0
    for k in range(600):
        firmware.drive(physics_model, np.array([0.5 * np.sin(0.01 * k + i) for i in range(13)]))
        felt, true = physics_model.loads(), true_loads(physics_model)
        assert [one.link for one in felt] == sorted(true)
        for one in felt:
            position, force = true[one.link]
            assert one.force_l == pytest.approx(force, abs=1e-9)
            assert one.position_l == pytest.approx(position, abs=1e-9)
        links |= set(true)
        most_on_one = max([most_on_one, *map(len, touches_of(physics_model).values())])
    assert len(links) > 5
    assert most_on_one > 1


def test_imu_samples_equal_those_computed_every_step():
    physics_model = make_physics_model(make_config(scene=PEG))
    model, other = physics_model.sim.model, mujoco.MjData(physics_model.sim.model)
    for k in range(300):
        torques = np.array([0.5 * np.sin(0.02 * k + i) for i in range(13)])
        if k == 299:
            mujoco.mj_copyData(other, model, physics_model.data)
            model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
            other.qfrc_applied[6:] = torques
            PhysicsStepper(physics_model.sim, other).step(1)
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        physics_model.advance(torques)
    imu = physics_model.imu()
    assert imu is not None
    assert imu == physics_model.imu()
    assert imu.link == list(range(14))
    assert np.ravel(imu.angular_velocity_rad_s + imu.acceleration_m_s2) == pytest.approx(
        other.sensordata, abs=1e-12
    )
    assert np.abs(imu.angular_velocity_rad_s).max() > 0.1


def test_at_the_start_imus_feel_gravity_alone():
    config = make_config()
    imu = make_physics_model(config).imu()
    assert imu is not None
    assert imu == SimulatorRig(config).sample().by_key["sensor/imu"]
    for turning, force in zip(imu.angular_velocity_rad_s, imu.acceleration_m_s2, strict=True):
        assert turning == pytest.approx((0, 0, 0), abs=1e-6)
        assert force == pytest.approx((0, 0, G), abs=0.05)


def test_the_pose_is_true_and_of_now():
    physics_model = make_physics_model(make_config(start={"yaw_rad": 0.7}))
    # It rolls about its own axis, too.
    physics_model.data.qvel[:6] = [0.3, -0.2, 0.0, 1.0, 0.0, 0.5]
    pass_time(physics_model, 0.05, seconds=0.1)
    pose = physics_model.pose()
    assert pose.position_w == pytest.approx(physics_model.data.qpos[:3], abs=0)
    assert pose.velocity_w == pytest.approx(physics_model.data.qvel[:3], abs=0)
    mujoco.mj_kinematics(physics_model.sim.model, physics_model.data)
    rotation = physics_model.data.body("link_0").xmat.reshape(3, 3)
    assert rotation_from_quaternion(pose.orientation_wxyz) == pytest.approx(rotation, abs=1e-12)
    assert pose.angular_velocity_w == pytest.approx(
        rotation @ physics_model.data.qvel[3:6], abs=1e-12
    )


# --- the rest -----------------------------------------------------------------------------------------------------


def test_physics_model_is_towed_by_a_tether():
    physics_model = make_physics_model(
        make_config(FOUR), tether=TetherSettings(link=4, direction_w=(1.0, 0.0), reel_in_m_s=0.1)
    )
    pass_time(physics_model, seconds=1.0)
    friction = 0.3 * 4 * 0.3 * G
    assert physics_model.pose().velocity_w[0] == pytest.approx(
        0.1 - friction / WINCH_N_S_PER_M, rel=0.02
    )


@pytest.mark.parametrize("torque", [math.nan, math.inf, 1e12])
def test_diverging_physics_is_reported_at_once_and_permanently(torque):
    config = make_config()
    physics_model = make_physics_model(config)
    pass_time(physics_model, seconds=0.01)
    bad = np.zeros(13)
    bad[4] = torque
    with raises_error(BackendError, code="simulator/diverged"):
        physics_model.advance(bad)
    assert physics_model.angle_rad == pytest.approx(compute_start_pose(config).angles_rad, abs=1e-3)
    assert np.isfinite(physics_model.shaft_torque_nm()).all()
    imu = physics_model.imu()
    assert imu is not None
    assert imu.acceleration_m_s2[7] == pytest.approx((0, 0, G), abs=0.05)
    good = physics_model.angle_rad.copy()
    with raises_error(BackendError, code="simulator/diverged"):
        physics_model.advance(bad)
    assert np.array_equal(physics_model.angle_rad, good)


def test_oscillating_firmware_is_detected_and_joint_named():
    """A stiff loop, with a light rotor and no lag, whose damping acts too strongly for the step."""
    physics_model = make_physics_model(make_config({"motor": {"armature_kg_m2": 1e-6}}, ICE))
    with raises_error(BackendError, code="simulator/diverged"):
        for _ in range(5000):
            physics_model.advance(-20.0 * physics_model.velocity_rad_s + 1e-3)
            assert np.isfinite(physics_model.angle_rad).all()


def test_what_mujoco_cannot_do_is_an_error_of_the_backend():
    physics_model = make_physics_model(make_config({"motor": RUBBING}))
    pass_time(physics_model, seconds=0.01)
    physics_model.sim.model.opt.solver = 99
    with raises_error(BackendError, code="simulator/diverged"):
        physics_model.advance(np.zeros(13))
