"""Tests the simulated motors: their four modes, their limits, and changes between the modes."""

import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.model.build import build_sim_model
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config

RESPONSE_S = 0.01  # time constant with which the torque of a motor follows its demand
ZERO_TOLERANCE_NM = 1e-12
STEP_S = 0.001  # of the physics, and between two samples
RISE_S = 0.1  # ten response times: the torque has reached its demand
JOINT_SPEED_INDEX = 6  # of the first joint in MuJoCo's qvel, after the six speeds of the free body
TWO_LINKS = {
    "chain": {"modules": 1},
    "limits": {"angle_rad": 3.0},
    "motor": {"response_time_s": RESPONSE_S},
}
# This joint hardly moves.
HEAVY_ROTOR = {**TWO_LINKS, "motor": {"response_time_s": RESPONSE_S, "armature_kg_m2": 10.0}}
ICE = {"ground": {"friction": 0.0}}


def open_rig(robot=None, **settings):
    """Return the rig of one joint on ice, sampled at every physics step of 1 ms."""
    return SimulatorRig(make_config(robot or TWO_LINKS, ICE, rate_hz=1000), **settings)


def read_torque_nm(run):
    """Return the torque of the first motor."""
    return float(run.sim.true_state().torques_nm[0])


def test_actuator_without_response_time_follows_at_once():
    run = open_rig({**TWO_LINKS, "motor": {"response_time_s": 0.0}})

    run.command(JointMode.TORQUE, 0.02)
    run.advance()
    assert read_torque_nm(run) == pytest.approx(0.02)

    run.command(JointMode.PASSIVE)
    run.advance()
    assert read_torque_nm(run) == pytest.approx(0.0, abs=ZERO_TOLERANCE_NM)


def test_actuator_before_first_command_has_no_torque_at_any_speed():
    run = open_rig()
    run.sim.data.qvel[JOINT_SPEED_INDEX] = 20.0  # rad/s, faster than the joint may be driven

    for _ in range(50):
        run.advance()
        assert read_torque_nm(run) == pytest.approx(0.0, abs=ZERO_TOLERANCE_NM)


@pytest.mark.parametrize("mode", [JointMode.POSITION, JointMode.VELOCITY, JointMode.TORQUE])
def test_actuator_torque_stays_within_robot_and_command_limits(mode):
    run = open_rig(HEAVY_ROTOR)
    robot_limit_nm = run.config.robot.limits.torque_nm
    far_target = -100.0  # rad, rad/s or Nm: in every mode it demands more than any limit

    run.command(mode, far_target, limit=50.0)
    run.advance(2 * RISE_S)
    assert read_torque_nm(run) == pytest.approx(-robot_limit_nm), "the robot's limit is lower"

    run.command(mode, far_target, limit=1.5)
    run.advance(RISE_S)
    assert read_torque_nm(run) == pytest.approx(-1.5), "the command's limit is lower"


def test_actuator_lowered_limit_applies_at_motor_response():
    """The torque does not jump to a lowered limit. In one step it decays at most as the motor responds."""
    run = open_rig(HEAVY_ROTOR)
    lowered_limit_nm = 1.0
    max_decay = np.exp(-STEP_S / RESPONSE_S)  # factor per step
    run.command(JointMode.TORQUE, 6.0)
    run.advance(2 * RISE_S)

    run.command(JointMode.TORQUE, 6.0, limit=lowered_limit_nm)
    before_nm = read_torque_nm(run)
    for _ in range(100):
        run.advance()
        torque_nm = read_torque_nm(run)
        assert torque_nm >= before_nm * max_decay - 1e-9, "the torque has jumped"
        before_nm = torque_nm

    assert before_nm == pytest.approx(lowered_limit_nm)


def test_actuator_does_not_drive_joint_beyond_its_speed_limit():
    run = open_rig()
    limit_rad_s = run.config.robot.limits.speed_rad_s
    max_angle_rad = 2.5  # the joint must not reach its end stop at 3 rad
    speeds_rad_s = []
    torques_nm = []

    run.command(JointMode.TORQUE, 3.0)
    for _ in range(200):
        run.advance()
        speeds_rad_s.append(run.sim.true_state().velocities_rad_s[0])
        torques_nm.append(read_torque_nm(run))
        if abs(run.sim.true_state().angles_rad[0]) > max_angle_rad:
            break

    # The response time of the motor lets the joint exceed its limit for a moment.
    assert 0.9 * limit_rad_s < max(speeds_rad_s) < 1.15 * limit_rad_s
    assert speeds_rad_s[-1] == pytest.approx(limit_rad_s, rel=0.02)
    assert torques_nm[-1] < 0.1, "the motor drives a joint that is as fast as allowed"


def test_actuator_below_nine_tenths_speed_has_full_torque():
    run = open_rig(HEAVY_ROTOR)
    limit_rad_s = run.config.robot.limits.speed_rad_s
    run.sim.data.qvel[JOINT_SPEED_INDEX] = 0.85 * limit_rad_s

    run.command(JointMode.TORQUE, 7.0)
    run.advance(RISE_S)

    speed_rad_s = run.sim.true_state().velocities_rad_s[0]
    assert speed_rad_s > 0.8 * limit_rad_s, "the joint is not fast enough for this test"
    assert read_torque_nm(run) == pytest.approx(7.0, rel=1e-3)


@pytest.mark.parametrize("before", list(JointMode))
@pytest.mark.parametrize("after", list(JointMode))
def test_actuator_mode_change_moves_torque_at_motor_response(before, after):
    targets = {
        JointMode.PASSIVE: 0.0,
        JointMode.POSITION: 0.1,
        JointMode.VELOCITY: 1.5,
        JointMode.TORQUE: -2.0,
    }
    run = open_rig(HEAVY_ROTOR)
    robot = run.config.robot
    response = 1 - np.exp(-STEP_S / RESPONSE_S)  # fraction of the missing torque per step
    run.command(before, targets[before])
    run.advance(RISE_S)

    run.command(after, targets[after])
    for _ in range(30):
        state = run.sim.true_state()
        torque_nm = read_torque_nm(run)
        demand_nm = compute_demand_nm(
            robot.motor, after, targets[after], state.angles_rad[0], state.velocities_rad_s[0]
        )
        run.advance()
        expected_nm = torque_nm + (demand_nm - torque_nm) * response
        assert read_torque_nm(run) == pytest.approx(expected_nm, abs=1e-6)


def compute_demand_nm(motor, mode, target, angle_rad, speed_rad_s):
    """Return the torque that a motor approaches in a mode with this target."""
    match mode:
        case JointMode.POSITION:
            error_rad = target - angle_rad
            return motor.stiffness_nm_per_rad * error_rad - motor.damping_nm_s_per_rad * speed_rad_s
        case JointMode.VELOCITY:
            return motor.velocity_gain_nm_s_per_rad * (target - speed_rad_s)
        case JointMode.TORQUE:
            return target
        case _:
            return 0.0


@pytest.mark.parametrize("response_s", [0.0, 0.005])
@pytest.mark.parametrize(("torque_nm", "speed"), [(7.0, 7.5), (1000.0, 100.0)])
def test_actuator_of_very_stiff_joint_is_stable(response_s, torque_nm, speed):
    motor = {
        "stiffness_nm_per_rad": 1000.0,
        "damping_nm_s_per_rad": 20.0,
        "response_time_s": response_s,
    }
    limits = {"torque_nm": torque_nm, "speed_rad_s": speed}
    run = SimulatorRig(make_config({"motor": motor, "limits": limits}))
    zigzag_rad = [0.3 * (-1) ** i for i in range(run.count)]  # no joint moves as its neighbors

    run.command([JointMode.POSITION] * run.count, zigzag_rad)
    run.advance(1.0)

    assert run.sim.true_state().angles_rad == pytest.approx(zigzag_rad, abs=1e-3)


def test_actuator_with_unstable_gains_is_refused():
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        SimulatorRig(
            make_config({"motor": {"response_time_s": 0.015, "damping_nm_s_per_rad": 0.5}})
        )


def test_simulator_scales_masses_and_gains_but_not_the_description():
    """Masses and motor gains are doubled in the simulation, and not in the description of the robot."""
    nominal_run, scaled_run = (
        open_rig(HEAVY_ROTOR, mass_scale=scale, motor_gain_scale=scale) for scale in (1.0, 2.0)
    )
    for run in (nominal_run, scaled_run):
        run.command(JointMode.POSITION, 0.01)
        run.advance()
    assert read_torque_nm(scaled_run) == pytest.approx(2 * read_torque_nm(nominal_run), rel=1e-3)
    assert read_torque_nm(nominal_run) > 0.01
    assert scaled_run.sim.describe() == nominal_run.sim.describe()
    nominal_mass_kg, scaled_mass_kg = (
        build_sim_model(make_config(), SimSettings(mass_scale=scale)).model.body_mass.sum()
        for scale in (1.0, 2.0)
    )
    assert scaled_mass_kg == pytest.approx(2 * nominal_mass_kg)


LATENCY_S = 0.005
WITH_LATENCY = {**HEAVY_ROTOR, "motor": {**HEAVY_ROTOR["motor"], "latency_s": LATENCY_S}}


def test_actuator_with_latency_follows_a_target_later():
    prompt_run = open_rig(HEAVY_ROTOR)
    delayed_run = open_rig(WITH_LATENCY)
    prompt_torques_nm = []
    delayed_torques_nm = []
    for run in (prompt_run, delayed_run):
        run.command(JointMode.POSITION, 0.0)
        run.advance(0.02)  # longer than the latency
        run.command(JointMode.POSITION, 0.1)

    for _ in range(20):
        prompt_run.advance()
        delayed_run.advance()
        prompt_torques_nm.append(read_torque_nm(prompt_run))
        delayed_torques_nm.append(read_torque_nm(delayed_run))

    latency_steps = round(LATENCY_S / STEP_S)
    assert delayed_torques_nm[:latency_steps] == pytest.approx([0.0] * latency_steps, abs=1e-6)
    assert delayed_torques_nm[latency_steps:] == pytest.approx(
        prompt_torques_nm[:-latency_steps], rel=1e-3
    )


def test_actuator_with_latency_changes_its_mode_at_once():
    """The latency delays targets within a mode. A new mode, above all PASSIVE, acts in the next step."""
    torque_nm = 2.0
    run = open_rig(WITH_LATENCY)

    run.command(JointMode.TORQUE, torque_nm)
    run.advance()
    assert read_torque_nm(run) > 0.1, "torque mode was delayed"

    run.command(JointMode.POSITION, 0.0)
    run.advance(RISE_S)
    assert read_torque_nm(run) == pytest.approx(0.0, abs=0.05)

    run.command(JointMode.TORQUE, torque_nm)
    run.advance(RISE_S)
    run.command(JointMode.PASSIVE)
    run.advance()
    torque_after_one_step_nm = torque_nm * np.exp(-STEP_S / RESPONSE_S)
    assert read_torque_nm(run) == pytest.approx(torque_after_one_step_nm, rel=1e-3)


def test_actuator_latency_of_single_joints_may_differ():
    """After a torque step for both joints, joint_1 follows in the first step, and joint_2 after its latency."""
    latency_steps = 3  # of joint_2; joint_1 has no latency
    follows_above_nm = (
        0.01  # the first step already reaches more, and a delayed joint has no torque
    )
    run = open_rig(
        {
            "chain": {"modules": 2},
            "motor": {"response_time_s": RESPONSE_S},
            "joints": {"joint_2": {"latency_s": latency_steps * STEP_S}},
        }
    )
    run.command(JointMode.TORQUE, 0.0)
    run.advance(0.01)  # longer than the latency

    run.command(JointMode.TORQUE, 0.5)
    joint_1_follows = []
    joint_2_follows = []
    for _ in range(latency_steps + 1):
        run.advance()
        torques_nm = run.sim.true_state().torques_nm
        joint_1_follows.append(bool(torques_nm[0] > follows_above_nm))
        joint_2_follows.append(bool(torques_nm[1] > follows_above_nm))

    assert joint_1_follows == [True, True, True, True]
    assert joint_2_follows == [False, False, False, True], "it must follow after three steps"
