"""Tests the MuJoCo physics model behind emulated drives: its start, torques, contact forces, IMUs and errors.

It must start like the simulated robot, and obey the same physics.
"""

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
FOUR_MODULES = {"chain": {"modules": 4}}
MOTOR_WITH_FRICTION = {
    "armature_kg_m2": 0.01,
    "friction_nm": 0.05,
    "viscous_nm_s_per_rad": 0.02,
}
PEG = {"cylinder": [{"position_m": [0.22, 0.0905], "radius_m": 0.05}]}


def make_physics_model(config, **settings):
    return MujocoPhysicsModel(config, PhysicsModelSettings(**settings))


def apply_torques(physics_model, torque_nm: ArrayLike = 0.0, seconds=0.0):
    """Make at least one step under constant torques: one number for all joints, or one each."""
    torques_nm = np.broadcast_to(np.asarray(torque_nm, dtype=float), physics_model.angle_rad.shape)
    for _ in range(max(round(seconds / physics_model.step_s), 1)):
        physics_model.advance(torques_nm)


def read_contacts_w(physics_model):
    """Read the contacts of obstacles from MuJoCo.

    Returns:
        For each link in contact, the position and the force in the world frame of each of its contacts.
    """
    model = physics_model.sim.model
    data = physics_model.data
    friction_forces_w = physics_model.physics.contacts.friction_force_w
    contacts_by_link: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    wrench = np.zeros(6)
    for i in range(data.ncon):
        names = [model.geom(geom).name for geom in data.contact[i].geom]
        if not any(name.startswith("obstacle:") for name in names):
            continue
        mujoco.mj_contactForce(model, data, i, wrench)
        force_on_second_w = data.contact[i].frame.reshape(3, 3).T @ wrench[:3]
        (link_geom,) = (k for k in (0, 1) if names[k].startswith("link_"))
        link = int(names[link_geom].removeprefix("link_"))
        normal_force_w = force_on_second_w if link_geom == 1 else -force_on_second_w
        force_w = normal_force_w + friction_forces_w.get(i, 0.0)
        contacts_by_link.setdefault(link, []).append((data.contact[i].pos.copy(), force_w))
    return contacts_by_link


def compute_link_loads(physics_model):
    """Return the mean position and the total force of each link's contacts, in the frame of the link."""
    loads_by_link = {}
    for link, contacts in read_contacts_w(physics_model).items():
        body = physics_model.data.body(f"link_{link}")
        positions_w = [position_w for position_w, _ in contacts]
        forces_w = [force_w for _, force_w in contacts]
        weights = [np.linalg.norm(force_w) for force_w in forces_w]
        if sum(weights) == 0:
            continue
        link_from_world = body.xmat.reshape(3, 3).T
        position_w = np.average(positions_w, axis=0, weights=weights) - body.xpos
        force_w = np.sum(forces_w, axis=0)
        loads_by_link[link] = (link_from_world @ position_w, link_from_world @ force_w)
    return loads_by_link


def compute_joint_loads_nm(physics_model, torques_nm):
    """Compute the torque between the links of each joint from the motion of the outer links under these torques."""
    model = physics_model.sim.model
    data = mujoco.MjData(model)
    mujoco.mj_copyData(data, model, physics_model.data)
    data.qfrc_applied[6:] = torques_nm
    PhysicsStepper(physics_model.sim, data).forward()
    mujoco.mj_rnePostConstraint(model, data)
    internal_nm = [
        data.cdof[6 + i] @ data.cfrc_int[model.jnt_bodyid[1 + i]]
        for i in range(len(physics_model.angle_rad))
    ]
    ground_nm = (data.qfrc_passive - data.qfrc_damper)[6:]
    return np.array(internal_nm) - ground_nm


class Firmware:
    """The position loop of all joint modules as the robot file describes it, computed once a step."""

    def __init__(self, config, step_s):
        self._motor = config.robot.motor
        self._max_torque_nm = config.robot.limits.torque_nm
        self._gain = 1 - math.exp(-step_s / self._motor.response_time_s)
        self.torque_nm = np.zeros(config.robot.chain.modules)

    def drive(self, physics_model, target_rad):
        """Make a step of the physics model with the torques of the position loop."""
        error_rad = target_rad - physics_model.angle_rad
        demand_nm = (
            self._motor.stiffness_nm_per_rad * error_rad
            - self._motor.damping_nm_s_per_rad * physics_model.velocity_rad_s
        )
        self.torque_nm = self.torque_nm + self._gain * (demand_nm - self.torque_nm)
        physics_model.advance(np.clip(self.torque_nm, -self._max_torque_nm, self._max_torque_nm))


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
    physics_model = make_physics_model(config)
    state = SimulatorRig(config).sim.true_state()
    pose = physics_model.pose()
    assert physics_model.angle_rad == pytest.approx(state.angles_rad, abs=1e-4)
    assert pose.position_w == pytest.approx(state.base_position_w, abs=1e-4)
    assert pose.orientation_wxyz == pytest.approx(state.base_orientation_wxyz, abs=1e-4)
    assert not physics_model.velocity_rad_s.any()
    assert not any(pose.velocity_w + pose.angular_velocity_w)
    assert physics_model.data.time == 0.0


def test_physics_model_without_torque_stays_at_rest():
    physics_model: PhysicsModel = make_physics_model(load_scenario("triplet").config)
    angles_rad = physics_model.angle_rad.copy()
    before = physics_model.pose()
    apply_torques(physics_model, seconds=1.0)
    after = physics_model.pose()
    assert before is not None
    assert after is not None
    assert physics_model.angle_rad == pytest.approx(angles_rad, abs=1e-4)
    assert after.position_w == pytest.approx(before.position_w, abs=1e-4)
    assert np.abs(physics_model.velocity_rad_s).max() < 1e-4
    assert before.tick == 0
    assert before.timestamp_ns == 0
    assert after.tick == 0
    assert after.timestamp_ns == 10**9


# --- torques ------------------------------------------------------------------------------------------------------


def test_free_joint_accelerates_by_inertia_and_gauge_measures_links():
    """Two equal free bars turn about their joint without pushing each other: the inertia is half of one bar's."""
    rotor_kg_m2 = 0.004
    torque_nm = 0.03
    config = make_config({"chain": {"modules": 1}, "motor": {"armature_kg_m2": rotor_kg_m2}}, ICE)
    physics_model = make_physics_model(config)
    bar_kg_m2 = physics_model.sim.model.body("link_1").inertia.max()  # about an axis across it
    apply_torques(physics_model, torque_nm)
    expected_rad_s2 = torque_nm / (bar_kg_m2 / 2 + rotor_kg_m2)
    acceleration_rad_s2 = physics_model.velocity_rad_s[0] / physics_model.step_s
    assert acceleration_rad_s2 == pytest.approx(expected_rad_s2, rel=1e-3)
    shaft_nm = torque_nm - rotor_kg_m2 * expected_rad_s2
    assert physics_model.shaft_torque_nm()[0] == pytest.approx(shaft_nm, rel=1e-3)


def test_joint_at_its_limit_stops_and_gauge_measures_motor():
    physics_model = make_physics_model(
        make_config({**FOUR_MODULES, "limits": {"angle_rad": 0.3}}, ICE)
    )
    apply_torques(physics_model, [0.0, 0.4, 0.0, 0.0], seconds=2.0)
    assert physics_model.angle_rad[1] == pytest.approx(0.3, abs=5e-3)
    assert abs(physics_model.velocity_rad_s[1]) < 1e-3
    assert physics_model.shaft_torque_nm()[1] == pytest.approx(0.4, rel=1e-2)


def test_shaft_at_rest_has_motor_torque_minus_dry_friction():
    """First the friction of the ground holds the links, then dry friction in the joints."""
    torques_nm = [0.02, -0.01, 0.03, 0.0]
    on_rough_ground = make_physics_model(make_config(FOUR_MODULES, {"ground": {"friction": 1.0}}))
    # A straight body rocks on its round underside for a while.
    apply_torques(on_rough_ground, torques_nm, seconds=2.5)
    assert np.abs(on_rough_ground.velocity_rad_s).max() < 0.01
    assert on_rough_ground.shaft_torque_nm() == pytest.approx(torques_nm, abs=1e-3)

    with_dry_friction = make_physics_model(
        make_config({**FOUR_MODULES, "motor": {"friction_nm": 0.1}}, ICE)
    )
    apply_torques(with_dry_friction, torques_nm, seconds=0.5)
    assert np.abs(with_dry_friction.velocity_rad_s).max() < 0.01
    assert with_dry_friction.shaft_torque_nm() == pytest.approx([0.0] * 4, abs=1e-3)


@pytest.mark.parametrize("motor", [{}, MOTOR_WITH_FRICTION], ids=["no friction", "friction"])
def test_shafts_in_motion_carry_the_loads_of_outer_links(motor):
    """The body moves among pegs, with inertia, gravity, friction and contacts."""
    pegs = {
        "cylinder": [
            {"position_m": [0.22 + 0.2 * k, 0.0905], "radius_m": 0.05, "friction": 0.3}
            for k in range(3)
        ]
    }
    # No joint reaches its end stop, whose torque acts between the links and not on the shaft.
    robot = {"motor": motor, "limits": {"angle_rad": 3.1}}
    physics_model = make_physics_model(make_config(robot, {"ground": {"friction": 0.2}, **pegs}))
    # The default tolerance of the solver allows errors of 1e-3 N·m.
    physics_model.sim.model.opt.tolerance = 1e-14
    load_count = 0
    for k in range(1500):
        torques_nm = np.array([0.5 * np.sin(0.01 * k + 0.9 * i) for i in range(13)])
        if k % 20 != 0:
            physics_model.advance(torques_nm)
            continue
        expected_nm = compute_joint_loads_nm(physics_model, torques_nm)
        physics_model.advance(torques_nm)
        assert physics_model.shaft_torque_nm() == pytest.approx(expected_nm, abs=1e-5)
        load_count += len(physics_model.loads())
    assert load_count > 5
    assert np.ptp(physics_model.angle_rad) > 0.3


def test_position_loop_once_a_step_equals_simulator_motors():
    """The angles differ by at most 0.1 % of the largest angle, and the torques by 3 % of the largest torque."""
    config = make_config({"chain": {"modules": 6}}, rate_hz=1000)
    physics_model = make_physics_model(config)
    run = SimulatorRig(config, timestep_s=0.001)
    firmware = Firmware(config, physics_model.step_s)
    max_error_rad = 0.0
    max_error_nm = 0.0
    max_angle_rad = 0.0
    max_torque_nm = 0.0
    for k in range(1000):
        target_rad = np.array(
            [0.1 * np.sin(0.0063 * k - 0.8 * i) - 0.1 * np.sin(-0.8 * i) for i in range(6)]
        )
        run.command(JointMode.POSITION, target_rad.tolist())
        run.advance()
        firmware.drive(physics_model, target_rad)
        state = run.sim.true_state()
        error_rad = np.abs(physics_model.angle_rad - state.angles_rad).max()
        error_nm = np.abs(firmware.torque_nm - state.torques_nm).max()
        max_error_rad = max(max_error_rad, error_rad)
        max_error_nm = max(max_error_nm, error_nm)
        max_angle_rad = max(max_angle_rad, np.abs(state.angles_rad).max())
        max_torque_nm = max(max_torque_nm, np.abs(state.torques_nm).max())
    assert max_angle_rad > 0.1
    assert max_error_rad < 1e-3 * max_angle_rad
    assert max_error_nm < 0.03 * max_torque_nm
    assert physics_model.pose().position_w == pytest.approx(
        run.sim.true_state().base_position_w, abs=1e-4
    )


# --- measurements -------------------------------------------------------------------------------------------------


def test_contact_forces_without_contact_or_imus_are_zero():
    physics_model = make_physics_model(make_config({"sensors!": {"joints": {}}}))
    assert physics_model.loads() == []
    apply_torques(physics_model)
    assert physics_model.loads() == []
    assert physics_model.imu() is None


def test_motor_between_three_pegs_measures_their_moment():
    """One peg is on the left of the middle, and one on the right of each end: a body that bends right is jammed."""
    places_m = [(0.03, -0.0905), (0.24, 0.0905), (0.62, -0.0905)]
    pegs = {"cylinder": [{"position_m": list(place), "radius_m": 0.05} for place in places_m]}
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
    # The pegs squeeze the body slowly forward.
    assert np.abs(physics_model.velocity_rad_s).max() < 0.02
    joint_w = physics_model.data.body("link_3").xpos
    head_link = physics_model.data.body("link_6")
    rotation = head_link.xmat.reshape(3, 3)
    lever_w = head_link.xpos + rotation @ head.position_l - joint_w
    moment_nm = np.cross(lever_w, rotation @ head.force_l)[2]
    assert physics_model.shaft_torque_nm()[2] == pytest.approx(-moment_nm, rel=0.01)
    assert physics_model.shaft_torque_nm() == pytest.approx(firmware.torque_nm, abs=0.01)


@pytest.mark.parametrize("friction", [pytest.param(0.0, marks=pytest.mark.slow), 0.4])
def test_loads_are_the_sums_of_the_true_contacts(friction):
    """The body is jammed between walls and pegs, so that some links have several contacts at once."""
    walls = [{"from_m": [-1, y], "to_m": [3, y], "friction": friction} for y in (0.09, -0.09)]
    pegs = [
        {"position_m": [0.4 + 0.3 * k, 0.06], "radius_m": 0.02, "friction": friction}
        for k in range(3)
    ]
    config = make_config(scene={"wall": walls, "cylinder": pegs})
    physics_model = make_physics_model(config)
    firmware = Firmware(config, physics_model.step_s)
    links_in_contact: set[int] = set()
    max_contacts_of_link = 0
    for k in range(600):
        firmware.drive(physics_model, np.array([0.5 * np.sin(0.01 * k + i) for i in range(13)]))
        loads = physics_model.loads()
        expected_loads = compute_link_loads(physics_model)
        assert [load.link for load in loads] == sorted(expected_loads)
        for load in loads:
            position_l, force_l = expected_loads[load.link]
            assert load.force_l == pytest.approx(force_l, abs=1e-9)
            assert load.position_l == pytest.approx(position_l, abs=1e-9)
        links_in_contact |= set(expected_loads)
        contact_counts = [len(contacts) for contacts in read_contacts_w(physics_model).values()]
        max_contacts_of_link = max([max_contacts_of_link, *contact_counts])
    assert len(links_in_contact) > 5
    assert max_contacts_of_link > 1


def test_imu_samples_equal_those_computed_every_step():
    physics_model = make_physics_model(make_config(scene=PEG))
    model = physics_model.sim.model
    data_with_sensors = mujoco.MjData(model)
    for k in range(300):
        torques_nm = np.array([0.5 * np.sin(0.02 * k + i) for i in range(13)])
        if k == 299:
            # Make the last step with MuJoCo's own sensors, too.
            mujoco.mj_copyData(data_with_sensors, model, physics_model.data)
            model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
            data_with_sensors.qfrc_applied[6:] = torques_nm
            PhysicsStepper(physics_model.sim, data_with_sensors).step(1)
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        physics_model.advance(torques_nm)
    imu = physics_model.imu()
    assert imu is not None
    assert imu == physics_model.imu()
    assert imu.link == list(range(14))
    assert np.ravel(imu.angular_velocity_rad_s + imu.acceleration_m_s2) == pytest.approx(
        data_with_sensors.sensordata, abs=1e-12
    )
    assert np.abs(imu.angular_velocity_rad_s).max() > 0.1


def test_imus_at_the_start_measure_only_gravity():
    config = make_config()
    imu = make_physics_model(config).imu()
    assert imu is not None
    assert imu == SimulatorRig(config).sample().by_key["sensor/imu"]
    for angular_velocity, acceleration in zip(
        imu.angular_velocity_rad_s, imu.acceleration_m_s2, strict=True
    ):
        assert angular_velocity == pytest.approx((0, 0, 0), abs=1e-6)
        assert acceleration == pytest.approx((0, 0, G), abs=0.05)


def test_physics_model_pose_is_the_true_present_pose():
    physics_model = make_physics_model(make_config(start={"yaw_rad": 0.7}))
    # The body also rolls about its own axis.
    physics_model.data.qvel[:6] = [0.3, -0.2, 0.0, 1.0, 0.0, 0.5]
    apply_torques(physics_model, 0.05, seconds=0.1)
    pose = physics_model.pose()
    assert pose.position_w == pytest.approx(physics_model.data.qpos[:3], abs=0)
    assert pose.velocity_w == pytest.approx(physics_model.data.qvel[:3], abs=0)
    mujoco.mj_kinematics(physics_model.sim.model, physics_model.data)
    rotation = physics_model.data.body("link_0").xmat.reshape(3, 3)
    assert rotation_from_quaternion(pose.orientation_wxyz) == pytest.approx(rotation, abs=1e-12)
    assert pose.angular_velocity_w == pytest.approx(
        rotation @ physics_model.data.qvel[3:6], abs=1e-12
    )


# --- tether and errors --------------------------------------------------------------------------------------------


def test_physics_model_is_towed_by_a_tether():
    physics_model = make_physics_model(
        make_config(FOUR_MODULES),
        tether=TetherSettings(link=4, direction_w=(1.0, 0.0), reel_in_m_s=0.1),
    )
    apply_torques(physics_model, seconds=1.0)
    friction_n = 0.3 * 4 * 0.3 * G
    expected_m_s = 0.1 - friction_n / WINCH_N_S_PER_M
    assert physics_model.pose().velocity_w[0] == pytest.approx(expected_m_s, rel=0.02)


@pytest.mark.parametrize("torque", [math.nan, math.inf, 1e12])
def test_diverging_physics_is_reported_at_once_and_permanently(torque):
    config = make_config()
    physics_model = make_physics_model(config)
    apply_torques(physics_model, seconds=0.01)
    torques_nm = np.zeros(13)
    torques_nm[4] = torque
    with raises_error(BackendError, code="simulator/diverged"):
        physics_model.advance(torques_nm)
    assert physics_model.angle_rad == pytest.approx(compute_start_pose(config).angles_rad, abs=1e-3)
    assert np.isfinite(physics_model.shaft_torque_nm()).all()
    imu = physics_model.imu()
    assert imu is not None
    assert imu.acceleration_m_s2[7] == pytest.approx((0, 0, G), abs=0.05)
    angles_rad = physics_model.angle_rad.copy()
    with raises_error(BackendError, code="simulator/diverged"):
        physics_model.advance(torques_nm)
    assert np.array_equal(physics_model.angle_rad, angles_rad)


def test_oscillating_firmware_is_detected_and_joint_named():
    """The rotor is light, the loop has no lag, and its damping is too strong for the step."""
    physics_model = make_physics_model(make_config({"motor": {"armature_kg_m2": 1e-6}}, ICE))
    with raises_error(BackendError, code="simulator/diverged"):
        for _ in range(5000):
            physics_model.advance(-20.0 * physics_model.velocity_rad_s + 1e-3)
            assert np.isfinite(physics_model.angle_rad).all()


def test_physics_model_failure_of_mujoco_is_a_backend_error():
    physics_model = make_physics_model(make_config({"motor": MOTOR_WITH_FRICTION}))
    apply_torques(physics_model, seconds=0.01)
    physics_model.sim.model.opt.solver = 99
    with raises_error(BackendError, code="simulator/diverged"):
        physics_model.advance(np.zeros(13))
