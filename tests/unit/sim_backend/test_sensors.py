"""Sensors: frames, noise, rate, delay, and that the same seed gives the same bytes."""

import mujoco
import numpy as np
import pytest

from snakesim_hal.model.geometry.kinematics import compute_link_frames, rotation_from_quaternion
from snakesim_hal.wire import keys
from snakesim_hal.wire.messages import Contacts, Imu, JointMode, Pose
from snakesim_sim_backend.sensors.timing import SamplingSchedule
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config

CORNER = {
    "ground": {"friction": 0.0},
    "cylinder": [{"position_m": [0.22, 0.0905], "radius_m": 0.05, "friction": 0.3, "name": "post"}],
}


def pushed(sensors=None, **top):
    """A bent snake that is pushed at a peg."""
    robot = {"chain": {"modules": 6}, "sensors": sensors or {}}
    run = SimulatorRig(make_config(robot, CORNER, **top))
    run.command([JointMode.POSITION] * 6, [0.1, -0.2, 0.3, 0.1, -0.2, 0.3])
    run.sim.data.xfrc_applied[run.sim.sim.model.body("link_2").id, 1] = 15.0
    return run


def frames_of(run):
    """Origins and rotations of the links, from what the robot itself publishes."""
    samples, robot = run.sample(), run.config.robot
    pose = samples.by_key[keys.POSE]
    assert isinstance(pose, Pose)
    rotation = rotation_from_quaternion(pose.orientation_wxyz)
    return samples, *compute_link_frames(
        pose.position_w, rotation, samples.joints.angle_rad, robot.axes, robot.link_lengths_m
    )


@pytest.mark.parametrize("robot", ["planar13", "mamba"])
def test_links_are_where_the_published_pose_and_angles_say(robot):
    run = SimulatorRig(make_config(base_robot=robot))
    n = run.count
    run.command([JointMode.POSITION] * n, [0.3 * np.sin(i) for i in range(n)])
    run.advance(0.3)
    _, origins, rotations = frames_of(run)
    data, model = run.sim.data, run.sim.sim.model
    mujoco.mj_kinematics(model, data)
    first = run.sim.sim.first_link_body
    assert np.abs(data.xpos[first:] - origins).max() < 1e-6
    assert np.abs(data.xmat[first:].reshape(-1, 3, 3) - rotations).max() < 1e-6


def test_contacts_in_link_frames_are_the_true_contacts():
    run = pushed()
    run.advance(0.5)
    samples, origins, rotations = frames_of(run)
    truth = run.sim.true_state().contacts
    message = samples.by_key[keys.CONTACTS]
    assert isinstance(message, Contacts)
    assert message.contacts
    for felt, true in zip(message.contacts, truth, strict=True):
        rotation = rotations[felt.link]
        assert (felt.link, felt.obstacle) == (true.link, true.obstacle) == (2, "post")
        # The contact is that at the beginning of the last physics step, in which the link slides and turns on.
        assert origins[felt.link] + rotation @ felt.position_l == pytest.approx(
            true.position_w, abs=1e-3
        )
        assert rotation @ felt.normal_l == pytest.approx(true.normal_w, abs=5e-3)
        assert rotation @ felt.force_l == pytest.approx(true.force_w, abs=0.1)
        axes = np.array([felt.normal_l, felt.tangent_1_l, felt.tangent_2_l])
        assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert felt.tangent_1_l[0] > 0  # towards the head
        assert np.dot(felt.force_l, felt.normal_l) > 0  # an obstacle pushes, it does not pull
        # On the skin.
        assert np.hypot(felt.position_l[1], felt.position_l[2]) == pytest.approx(0.04, abs=1e-3)


def test_weak_touches_go_unfelt():
    run = pushed({"contacts": {"rate_hz": 1000.0, "threshold_n": 100.0}})
    run.advance(0.5)
    assert run.sim.true_state().contacts
    assert run.sample_only_sensor(Contacts).contacts == []


def test_imu_on_spinning_snake_measures_centripetal_acceleration():
    run = SimulatorRig(make_config(scene={"ground": {"friction": 0.0}}))
    spin, middle = 2.0, 13 * 0.11 / 2
    run.sim.data.qvel[5] = spin
    run.sim.data.qvel[1] = -spin * middle  # about its center
    run.command(JointMode.POSITION)
    run.advance(0.02)
    imu = run.sample_only_sensor(Imu)
    lengths = np.array(run.config.robot.link_lengths_m)
    centers = np.cumsum(lengths) - lengths / 2
    assert np.array(imu.angular_velocity_rad_s)[:, 2] == pytest.approx(spin, rel=0.01)
    assert np.array(imu.acceleration_m_s2)[:, 0] == pytest.approx(
        -(spin**2) * (centers - middle), abs=0.05
    )


def test_pose_velocity_is_the_derivative_of_pose():
    run = SimulatorRig(make_config(scene={"ground": {"friction": 0.0}}, rate_hz=1000))
    run.sim.data.qvel[:6] = [0.3, -0.2, 0.0, 0.0, 0.0, 1.5]
    run.advance(0.3)
    before = run.sample_only_sensor(Pose)
    run.advance()
    after = run.sample_only_sensor(Pose)
    change = (np.array(after.position_w) - before.position_w) / 1e-3
    assert after.velocity_w == pytest.approx(change, abs=5e-3)
    turned = (
        rotation_from_quaternion(after.orientation_wxyz)
        @ rotation_from_quaternion(before.orientation_wxyz).T
    )
    assert after.angular_velocity_w[2] == pytest.approx(
        (turned[1, 0] - turned[0, 1]) / 2 / 1e-3, rel=1e-3
    )


def test_noise_has_the_deviations_of_the_robot_file():
    sensors = {
        "joints": {"angle_noise_rad": 0.01, "velocity_noise_rad_s": 0.2, "torque_noise_nm": 0.5},
        "imu": {"angular_velocity_noise_rad_s": 0.03, "acceleration_noise_m_s2": 0.4},
        "pose": {"position_noise_m": 0.002, "angle_noise_rad": 0.01},
        "contacts": {"position_noise_m": 0.003, "force_noise_n": 0.7},
    }
    quiet, noisy = pushed(), pushed(sensors)
    for run in (quiet, noisy):
        run.advance(0.5)
    errors: dict[tuple[str, float], list[np.ndarray]] = {}
    plain = quiet.sample()
    plain_imu = plain.by_key[keys.IMU]
    contact = plain.by_key[keys.CONTACTS].contacts[0]  # pyright: ignore[reportAttributeAccessIssue]
    orientation = rotation_from_quaternion(plain.by_key[keys.POSE].orientation_wxyz)  # pyright: ignore[reportAttributeAccessIssue]
    for _ in range(1000):
        sample = noisy.sample()
        imu, pose, touches = (sample.by_key[key] for key in (keys.IMU, keys.POSE, keys.CONTACTS))
        turn = rotation_from_quaternion(pose.orientation_wxyz) @ orientation.T  # pyright: ignore[reportAttributeAccessIssue]
        felt = touches.contacts[0]  # pyright: ignore[reportAttributeAccessIssue]
        for name, sigma, got, true in (
            ("angle", 0.01, sample.joints.angle_rad, plain.joints.angle_rad),
            ("velocity", 0.2, sample.joints.velocity_rad_s, plain.joints.velocity_rad_s),
            ("torque", 0.5, sample.joints.torque_nm, plain.joints.torque_nm),
            ("gyro", 0.03, imu.angular_velocity_rad_s, plain_imu.angular_velocity_rad_s),  # pyright: ignore[reportAttributeAccessIssue]
            ("accelerometer", 0.4, imu.acceleration_m_s2, plain_imu.acceleration_m_s2),  # pyright: ignore[reportAttributeAccessIssue]
            ("position", 0.002, pose.position_w, plain.by_key[keys.POSE].position_w),  # pyright: ignore[reportAttributeAccessIssue]
            ("attitude", 0.01, [turn[2, 1], turn[0, 2], turn[1, 0]], [0.0, 0.0, 0.0]),
            ("contact position", 0.003, felt.position_l, contact.position_l),
            ("contact force", 0.7, felt.force_l, contact.force_l),
        ):
            errors.setdefault((name, sigma), []).append((np.array(got) - np.array(true)).ravel())
    for (name, sigma), found in errors.items():
        error = np.array(found)
        assert error.std() == pytest.approx(sigma, rel=0.06), name
        assert np.abs(error.mean(axis=0)).max() < 0.2 * sigma, name


@pytest.mark.parametrize(
    ("tick_hz", "sensor_hz", "due"),
    [
        (100, 100.0, [0, 1, 2, 3, 4]),
        (100, 50.0, [0, 2, 4, 6, 8]),
        (100, 30.0, [0, 4, 7, 10, 14]),
        (300, 300.0, [0, 1, 2, 3, 4]),
        (100, 1000.0, [0, 1, 2, 3, 4]),
    ],
)
def test_sensor_is_due_after_each_of_its_periods(tick_hz, sensor_hz, due):
    run = SimulatorRig(
        make_config(
            {"chain": {"modules": 1}, "sensors": {"pose": {"rate_hz": sensor_hz}}}, rate_hz=tick_hz
        )
    )
    ticks = []
    for _ in range(due[-1] + 1):
        if keys.POSE in run.sample().by_key:
            ticks.append(run.tick)
        run.advance()
    assert ticks == due


def test_over_a_long_run_the_number_of_samples_is_exact():
    schedule = SamplingSchedule(70.0, 1000.0, 1_000_000)
    assert sum(schedule.is_due(tick * 1_000_000) for tick in range(1, 10_001)) == 700


PERIOD_NS = 10_000_000


def test_sensor_delayed_joint_states_are_those_of_earlier_ticks():
    delay_ticks = 2
    delayed = pushed({"joints": {"delay_s": 0.02}})
    prompt = pushed()
    history = []
    for tick in range(12):
        joints = delayed.sample().joints
        history.append(prompt.sample().joints)
        captured_tick = max(tick - delay_ticks, 0)
        assert joints.tick == tick
        assert joints.timestamp_ns == tick * PERIOD_NS
        assert joints.age_ns == [(tick - captured_tick) * PERIOD_NS] * 6
        assert joints.angle_rad == history[captured_tick].angle_rad
        delayed.advance()
        prompt.advance()


def test_sensor_delayed_pose_is_that_of_earlier_tick_with_its_timestamp():
    delay_ticks = 3
    delayed = pushed({"pose": {"delay_s": 0.03}})
    prompt = pushed()
    history = []
    for tick in range(12):
        pose = delayed.sample().by_key.get(keys.POSE)
        history.append(prompt.sample().by_key[keys.POSE])
        captured_tick = tick - delay_ticks
        if captured_tick < 0:
            assert pose is None
        else:
            captured = history[captured_tick]
            assert isinstance(pose, Pose)
            assert isinstance(captured, Pose)
            assert pose.tick == tick
            assert pose.timestamp_ns == captured_tick * PERIOD_NS
            assert pose.position_w == captured.position_w
        delayed.advance()
        prompt.advance()
