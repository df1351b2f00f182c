"""Tests the frames, noise, rates and delays of simulated sensors."""

from typing import Any

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


def push_snake_at_peg(sensors=None):
    """Return the rig of a bent snake that an external force pushes at a peg."""
    robot = {"chain": {"modules": 6}, "sensors": sensors or {}}
    run = SimulatorRig(make_config(robot, CORNER))
    run.command([JointMode.POSITION] * 6, [0.1, -0.2, 0.3, 0.1, -0.2, 0.3])
    run.sim.data.xfrc_applied[run.sim.sim.model.body("link_2").id, 1] = 15.0
    return run


def sample_with_link_frames(run):
    """Return samples, and the origins and rotations of the links that follow from published pose and angles."""
    samples = run.sample()
    robot = run.config.robot
    pose = samples.by_key[keys.POSE]
    assert isinstance(pose, Pose)
    rotation = rotation_from_quaternion(pose.orientation_wxyz)
    origins_w, rotations = compute_link_frames(
        pose.position_w, rotation, samples.joints.angle_rad, robot.axes, robot.link_lengths_m
    )
    return samples, origins_w, rotations


@pytest.mark.parametrize("robot", ["planar13", "mamba"])
def test_sensor_pose_and_angles_give_the_frames_of_links(robot):
    run = SimulatorRig(make_config(base_robot=robot))
    joint_count = run.count
    run.command([JointMode.POSITION] * joint_count, [0.3 * np.sin(i) for i in range(joint_count)])
    run.advance(0.3)
    _, origins_w, rotations = sample_with_link_frames(run)
    data = run.sim.data
    mujoco.mj_kinematics(run.sim.sim.model, data)
    first_body = run.sim.sim.first_link_body
    assert np.abs(data.xpos[first_body:] - origins_w).max() < 1e-6
    assert np.abs(data.xmat[first_body:].reshape(-1, 3, 3) - rotations).max() < 1e-6


def test_sensor_contacts_in_link_frames_equal_the_true_contacts():
    run = push_snake_at_peg()
    run.advance(0.5)
    samples, origins_w, rotations = sample_with_link_frames(run)
    true_contacts = run.sim.true_state().contacts
    message = samples.by_key[keys.CONTACTS]
    assert isinstance(message, Contacts)
    assert message.contacts
    for measured, true in zip(message.contacts, true_contacts, strict=True):
        rotation = rotations[measured.link]
        assert (measured.link, measured.obstacle) == (true.link, true.obstacle) == (2, "post")
        # The contact is that at the beginning of the last physics step, in which the link slides and turns on.
        position_w = origins_w[measured.link] + rotation @ measured.position_l
        assert position_w == pytest.approx(true.position_w, abs=1e-3)
        assert rotation @ measured.normal_l == pytest.approx(true.normal_w, abs=5e-3)
        assert rotation @ measured.force_l == pytest.approx(true.force_w, abs=0.1)
        axes = np.array([measured.normal_l, measured.tangent_1_l, measured.tangent_2_l])
        assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-9)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        assert measured.tangent_1_l[0] > 0, "the first tangent points to the head"
        assert np.dot(measured.force_l, measured.normal_l) > 0, "an obstacle does not pull"
        # The position is on the skin.
        radius_m = np.hypot(measured.position_l[1], measured.position_l[2])
        assert radius_m == pytest.approx(0.04, abs=1e-3)


def test_sensor_contacts_below_threshold_are_not_published():
    run = push_snake_at_peg({"contacts": {"rate_hz": 1000.0, "threshold_n": 100.0}})
    run.advance(0.5)
    assert run.sim.true_state().contacts
    assert run.sample_only_sensor(Contacts).contacts == []


def test_imu_on_spinning_snake_measures_centripetal_acceleration():
    run = SimulatorRig(make_config(scene={"ground": {"friction": 0.0}}))
    spin_rad_s = 2.0
    middle_m = 13 * 0.11 / 2
    # The snake spins about its center.
    run.sim.data.qvel[5] = spin_rad_s
    run.sim.data.qvel[1] = -spin_rad_s * middle_m
    run.command(JointMode.POSITION)
    run.advance(0.02)
    imu = run.sample_only_sensor(Imu)
    lengths_m = np.array(run.config.robot.link_lengths_m)
    link_centers_m = np.cumsum(lengths_m) - lengths_m / 2
    expected_m_s2 = -(spin_rad_s**2) * (link_centers_m - middle_m)
    assert np.array(imu.angular_velocity_rad_s)[:, 2] == pytest.approx(spin_rad_s, rel=0.01)
    assert np.array(imu.acceleration_m_s2)[:, 0] == pytest.approx(expected_m_s2, abs=0.05)


def test_pose_velocity_is_the_derivative_of_pose():
    run = SimulatorRig(make_config(scene={"ground": {"friction": 0.0}}, rate_hz=1000))
    run.sim.data.qvel[:6] = [0.3, -0.2, 0.0, 0.0, 0.0, 1.5]
    run.advance(0.3)
    before = run.sample_only_sensor(Pose)
    run.advance()
    after = run.sample_only_sensor(Pose)
    period_s = 1e-3
    velocity_w = (np.array(after.position_w) - before.position_w) / period_s
    assert after.velocity_w == pytest.approx(velocity_w, abs=5e-3)
    rotation = (
        rotation_from_quaternion(after.orientation_wxyz)
        @ rotation_from_quaternion(before.orientation_wxyz).T
    )
    yaw_rate_rad_s = (rotation[1, 0] - rotation[0, 1]) / 2 / period_s
    assert after.angular_velocity_w[2] == pytest.approx(yaw_rate_rad_s, rel=1e-3)


def test_sensor_noise_has_the_deviations_of_the_robot_file():
    sensors = {
        "joints": {"angle_noise_rad": 0.01, "velocity_noise_rad_s": 0.2, "torque_noise_nm": 0.5},
        "imu": {"angular_velocity_noise_rad_s": 0.03, "acceleration_noise_m_s2": 0.4},
        "pose": {"position_noise_m": 0.002, "angle_noise_rad": 0.01},
        "contacts": {"position_noise_m": 0.003, "force_noise_n": 0.7},
    }
    exact_run = push_snake_at_peg()
    noisy_run = push_snake_at_peg(sensors)
    for run in (exact_run, noisy_run):
        run.advance(0.5)
    errors_by_name: dict[tuple[str, float], list[np.ndarray]] = {}
    exact: Any = exact_run.sample()
    exact_imu = exact.by_key[keys.IMU]
    exact_pose = exact.by_key[keys.POSE]
    exact_contact = exact.by_key[keys.CONTACTS].contacts[0]
    exact_rotation = rotation_from_quaternion(exact_pose.orientation_wxyz)
    for _ in range(1000):
        noisy: Any = noisy_run.sample()
        imu = noisy.by_key[keys.IMU]
        pose = noisy.by_key[keys.POSE]
        contact = noisy.by_key[keys.CONTACTS].contacts[0]
        rotation = rotation_from_quaternion(pose.orientation_wxyz) @ exact_rotation.T
        small_angles_rad = [rotation[2, 1], rotation[0, 2], rotation[1, 0]]
        for name, sigma, noisy_values, exact_values in (
            ("angle", 0.01, noisy.joints.angle_rad, exact.joints.angle_rad),
            ("velocity", 0.2, noisy.joints.velocity_rad_s, exact.joints.velocity_rad_s),
            ("torque", 0.5, noisy.joints.torque_nm, exact.joints.torque_nm),
            ("gyro", 0.03, imu.angular_velocity_rad_s, exact_imu.angular_velocity_rad_s),
            ("accelerometer", 0.4, imu.acceleration_m_s2, exact_imu.acceleration_m_s2),
            ("position", 0.002, pose.position_w, exact_pose.position_w),
            ("attitude", 0.01, small_angles_rad, [0.0, 0.0, 0.0]),
            ("contact position", 0.003, contact.position_l, exact_contact.position_l),
            ("contact force", 0.7, contact.force_l, exact_contact.force_l),
        ):
            error = (np.array(noisy_values) - np.array(exact_values)).ravel()
            errors_by_name.setdefault((name, sigma), []).append(error)
    for (name, sigma), errors in errors_by_name.items():
        assert np.array(errors).std() == pytest.approx(sigma, rel=0.06), name
        assert np.abs(np.array(errors).mean(axis=0)).max() < 0.2 * sigma, name


@pytest.mark.parametrize(
    ("tick_hz", "sensor_hz", "expected_ticks"),
    [
        (100, 100.0, [0, 1, 2, 3, 4]),
        (100, 50.0, [0, 2, 4, 6, 8]),
        (100, 30.0, [0, 4, 7, 10, 14]),
        (300, 300.0, [0, 1, 2, 3, 4]),
        (100, 1000.0, [0, 1, 2, 3, 4]),
    ],
)
def test_sensor_is_due_after_each_of_its_periods(tick_hz, sensor_hz, expected_ticks):
    robot = {"chain": {"modules": 1}, "sensors": {"pose": {"rate_hz": sensor_hz}}}
    run = SimulatorRig(make_config(robot, rate_hz=tick_hz))
    ticks = []
    for _ in range(expected_ticks[-1] + 1):
        if keys.POSE in run.sample().by_key:
            ticks.append(run.tick)
        run.advance()
    assert ticks == expected_ticks


def test_sampling_schedule_over_long_run_has_exact_sample_count():
    schedule = SamplingSchedule(70.0, 1000.0, 1_000_000)
    assert sum(schedule.is_due(tick * 1_000_000) for tick in range(1, 10_001)) == 700


PERIOD_NS = 10_000_000


def test_sensor_delayed_joint_states_are_those_of_earlier_ticks():
    delay_ticks = 2
    delayed = push_snake_at_peg({"joints": {"delay_s": 0.02}})
    prompt = push_snake_at_peg()
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


def test_sensor_delayed_pose_has_the_timestamp_of_its_tick():
    delay_ticks = 3
    delayed = push_snake_at_peg({"pose": {"delay_s": 0.03}})
    prompt = push_snake_at_peg()
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
