"""Tests the simulated motors: their four modes, their limits, and changes between the modes."""

import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.model.build import build_sim_model
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config

RESPONSE_S = 0.01
ZERO_TOLERANCE_NM = 1e-12
STEP_S = 0.001
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
    run.sim.data.qvel[6] = 20.0
    for _ in range(50):
        run.advance()
        assert read_torque_nm(run) == pytest.approx(0.0, abs=ZERO_TOLERANCE_NM)


@pytest.mark.parametrize("mode", [JointMode.POSITION, JointMode.VELOCITY, JointMode.TORQUE])
def test_actuator_torque_stays_within_robot_and_command_limits(mode):
    run = open_rig(HEAVY_ROTOR)
    run.command(mode, -100.0, limit=50.0)
    run.advance(0.2)
    assert read_torque_nm(run) == pytest.approx(-run.config.robot.limits.torque_nm)
    run.command(mode, -100.0, limit=1.5)
    run.advance(0.1)
    assert read_torque_nm(run) == pytest.approx(-1.5)


def test_actuator_lowered_limit_applies_at_motor_response():
    run = open_rig(HEAVY_ROTOR)
    run.command(JointMode.TORQUE, 6.0)
    run.advance(0.2)
    run.command(JointMode.TORQUE, 6.0, limit=1.0)
    before_nm = read_torque_nm(run)
    for _ in range(100):
        run.advance()
        assert read_torque_nm(run) >= before_nm * np.exp(-1e-3 / RESPONSE_S) - 1e-9
        before_nm = read_torque_nm(run)
    assert before_nm == pytest.approx(1.0)


def test_actuator_does_not_drive_joint_beyond_its_speed_limit():
    run = open_rig()
    limit_rad_s = run.config.robot.limits.speed_rad_s
    run.command(JointMode.TORQUE, 3.0)
    speeds_rad_s = []
    torques_nm = []
    for _ in range(200):
        run.advance()
        speeds_rad_s.append(run.sim.true_state().velocities_rad_s[0])
        torques_nm.append(read_torque_nm(run))
        if abs(run.sim.true_state().angles_rad[0]) > 2.5:
            break
    # The response time of the motor lets the joint exceed its limit for a moment.
    assert 0.9 * limit_rad_s < max(speeds_rad_s) < 1.15 * limit_rad_s
    assert speeds_rad_s[-1] == pytest.approx(limit_rad_s, rel=0.02)
    assert torques_nm[-1] < 0.1


def test_actuator_below_nine_tenths_speed_has_full_torque():
    run = open_rig(HEAVY_ROTOR)
    limit_rad_s = run.config.robot.limits.speed_rad_s
    run.sim.data.qvel[6] = 0.85 * limit_rad_s
    run.command(JointMode.TORQUE, 7.0)
    run.advance(0.1)
    assert run.sim.true_state().velocities_rad_s[0] > 0.8 * limit_rad_s
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
    run.command(before, targets[before])
    run.advance(0.1)
    run.command(after, targets[after])
    for _ in range(30):
        state = run.sim.true_state()
        torque_nm = read_torque_nm(run)
        demand_nm = compute_demand_nm(
            robot.motor, after, targets[after], state.angles_rad[0], state.velocities_rad_s[0]
        )
        run.advance()
        response = 1 - np.exp(-STEP_S / RESPONSE_S)
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
    zigzag_rad = [0.3 * (-1) ** i for i in range(13)]
    run.command([JointMode.POSITION] * 13, zigzag_rad)
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
    for run in (prompt_run, delayed_run):
        run.command(JointMode.POSITION, 0.0)
        run.advance(0.02)
        run.command(JointMode.POSITION, 0.1)
    prompt_torques_nm = []
    delayed_torques_nm = []
    for _ in range(20):
        prompt_run.advance()
        delayed_run.advance()
        prompt_torques_nm.append(read_torque_nm(prompt_run))
        delayed_torques_nm.append(read_torque_nm(delayed_run))
    steps = round(LATENCY_S / STEP_S)
    assert delayed_torques_nm[:steps] == pytest.approx([0.0] * steps, abs=1e-6)
    assert delayed_torques_nm[steps:] == pytest.approx(prompt_torques_nm[:-steps], rel=1e-3)


def test_actuator_with_latency_changes_its_mode_at_once():
    run = open_rig(WITH_LATENCY)
    run.command(JointMode.TORQUE, 2.0)
    run.advance()
    assert read_torque_nm(run) > 0.1
    run.command(JointMode.POSITION, 0.0)
    run.advance(0.1)
    assert read_torque_nm(run) == pytest.approx(0.0, abs=0.05)
    run.command(JointMode.TORQUE, 2.0)
    run.advance(0.1)
    run.command(JointMode.PASSIVE)
    run.advance()
    assert read_torque_nm(run) == pytest.approx(2.0 * np.exp(-0.001 / RESPONSE_S), rel=1e-3)


def test_actuator_latency_of_single_joints_may_differ():
    latency_steps = 3
    joints = {"joint_2": {"latency_s": 0.003}}
    run = open_rig(
        {"chain": {"modules": 2}, "motor": {"response_time_s": RESPONSE_S}, "joints": joints}
    )
    run.command(JointMode.TORQUE, 0.0)
    run.advance(0.01)
    run.command(JointMode.TORQUE, 0.5)
    for step in range(4):
        run.advance()
        torques_nm = run.sim.true_state().torques_nm
        assert torques_nm[0] > 0.01
        assert bool(torques_nm[1] > 0.01) is (step >= latency_steps)
