"""The motors: four modes, their limits, and what happens between the modes."""

import numpy as np
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.model.build import build_sim_model
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.messages import raises_error
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config

RESPONSE_S = 0.01
NOTHING = 1e-12  # N·m
TWO_LINKS = {
    "chain": {"modules": 1},
    "limits": {"angle_rad": 3.0},
    "motor": {"response_time_s": RESPONSE_S},
}
# Hardly moves.
HEAVY_ROTOR = {**TWO_LINKS, "motor": {"response_time_s": RESPONSE_S, "armature_kg_m2": 10.0}}
ICE = {"ground": {"friction": 0.0}}


def fast_run(robot=None, **settings):
    """One joint on ice, sampled at every physics step of 1 ms."""
    return SimulatorRig(make_config(robot or TWO_LINKS, ICE, rate_hz=1000), **settings)


def torque(run):
    return float(run.sim.true_state().torques_nm[0])


def test_a_motor_without_response_time_answers_at_once():
    run = fast_run({**TWO_LINKS, "motor": {"response_time_s": 0.0}})
    run.command(JointMode.TORQUE, 0.02)
    run.advance()
    assert torque(run) == pytest.approx(0.02)
    run.command(JointMode.PASSIVE)
    run.advance()
    assert torque(run) == pytest.approx(0.0, abs=NOTHING)


def test_actuator_before_first_command_has_no_torque_at_any_speed():
    run = fast_run()
    run.sim.data.qvel[6] = 20.0
    for _ in range(50):
        run.advance()
        assert torque(run) == pytest.approx(0.0, abs=NOTHING)


@pytest.mark.parametrize("mode", [JointMode.POSITION, JointMode.VELOCITY, JointMode.TORQUE])
def test_actuator_torque_stays_within_robot_and_command_limits(mode):
    run = fast_run(HEAVY_ROTOR)
    run.command(mode, -100.0, limit=50.0)
    run.advance(0.2)
    assert torque(run) == pytest.approx(-run.config.robot.limits.torque_nm)
    run.command(mode, -100.0, limit=1.5)
    run.advance(0.1)
    assert torque(run) == pytest.approx(-1.5)


def test_actuator_lowered_limit_applies_at_motor_response():
    run = fast_run(HEAVY_ROTOR)
    run.command(JointMode.TORQUE, 6.0)
    run.advance(0.2)
    run.command(JointMode.TORQUE, 6.0, limit=1.0)
    before = torque(run)
    for _ in range(100):
        run.advance()
        assert torque(run) >= before * np.exp(-1e-3 / RESPONSE_S) - 1e-9
        before = torque(run)
    assert before == pytest.approx(1.0)


def test_the_motor_does_not_drive_a_joint_beyond_its_speed():
    run = fast_run()
    limit = run.config.robot.limits.speed_rad_s
    run.command(JointMode.TORQUE, 3.0)
    speeds, torques = [], []
    for _ in range(200):
        run.advance()
        speeds.append(run.sim.true_state().velocities_rad_s[0])
        torques.append(torque(run))
        if abs(run.sim.true_state().angles_rad[0]) > 2.5:
            break
    # Beyond it by what the motor's response lets through.
    assert 0.9 * limit < max(speeds) < 1.15 * limit
    assert speeds[-1] == pytest.approx(limit, rel=0.02)
    assert torques[-1] < 0.1


def test_actuator_below_nine_tenths_speed_has_full_torque():
    run = fast_run(HEAVY_ROTOR)
    limit = run.config.robot.limits.speed_rad_s
    run.sim.data.qvel[6] = 0.85 * limit
    run.command(JointMode.TORQUE, 7.0)
    run.advance(0.1)
    assert run.sim.true_state().velocities_rad_s[0] > 0.8 * limit
    assert torque(run) == pytest.approx(7.0, rel=1e-3)


@pytest.mark.parametrize("before", list(JointMode))
@pytest.mark.parametrize("after", list(JointMode))
def test_actuator_mode_change_moves_torque_at_motor_response(before, after):
    targets = {
        JointMode.PASSIVE: 0.0,
        JointMode.POSITION: 0.1,
        JointMode.VELOCITY: 1.5,
        JointMode.TORQUE: -2.0,
    }
    run = fast_run(HEAVY_ROTOR)
    robot = run.config.robot
    run.command(before, targets[before])
    run.advance(0.1)
    run.command(after, targets[after])
    for _ in range(30):
        state, had = run.sim.true_state(), torque(run)
        angle, speed = state.angles_rad[0], state.velocities_rad_s[0]
        demand = {
            JointMode.PASSIVE: 0.0,
            JointMode.POSITION: robot.motor.stiffness_nm_per_rad * (targets[after] - angle)
            - robot.motor.damping_nm_s_per_rad * speed,
            JointMode.VELOCITY: robot.motor.velocity_gain_nm_s_per_rad * (targets[after] - speed),
            JointMode.TORQUE: targets[after],
        }[after]
        run.advance()
        wanted = had + (demand - had) * (1 - np.exp(-1e-3 / RESPONSE_S))
        assert torque(run) == pytest.approx(wanted, abs=1e-6)


@pytest.mark.parametrize("response_s", [0.0, 0.005])
@pytest.mark.parametrize(("torque_nm", "speed"), [(7.0, 7.5), (1000.0, 100.0)])
def test_very_stiff_joints_are_stable(response_s, torque_nm, speed):
    stiff = {
        "stiffness_nm_per_rad": 1000.0,
        "damping_nm_s_per_rad": 20.0,
        "response_time_s": response_s,
    }
    run = SimulatorRig(
        make_config({"motor": stiff, "limits": {"torque_nm": torque_nm, "speed_rad_s": speed}})
    )
    zigzag = [0.3 * (-1) ** i for i in range(13)]
    run.command([JointMode.POSITION] * 13, zigzag)
    run.advance(1.0)
    assert run.sim.true_state().angles_rad == pytest.approx(zigzag, abs=1e-3)


def test_gains_that_swing_up_are_refused():
    with raises_error(ConfigError, code="drive/unsupported-setting"):
        SimulatorRig(
            make_config({"motor": {"response_time_s": 0.015, "damping_nm_s_per_rad": 0.5}})
        )


def test_a_body_that_is_not_as_its_file_says():
    """Twice as heavy, motors twice as stiff; and a description that knows nothing of it."""
    plain, other = (
        fast_run(HEAVY_ROTOR, mass_scale=scale, motor_gain_scale=scale) for scale in (1.0, 2.0)
    )
    for run in (plain, other):
        run.command(JointMode.POSITION, 0.01)
        run.advance()
    assert torque(other) == pytest.approx(2 * torque(plain), rel=1e-3)
    assert torque(plain) > 0.01
    assert other.sim.describe() == plain.sim.describe()
    light, heavy = (
        build_sim_model(make_config(), SimSettings(mass_scale=scale)).model.body_mass.sum()
        for scale in (1.0, 2.0)
    )
    assert heavy == pytest.approx(2 * light)


LATENCY_S = 0.005
LATE = {**HEAVY_ROTOR, "motor": {**HEAVY_ROTOR["motor"], "latency_s": LATENCY_S}}


def test_a_motor_with_latency_follows_a_target_that_much_later():
    prompt = fast_run(HEAVY_ROTOR)
    late = fast_run(LATE)
    for run in (prompt, late):
        run.command(JointMode.POSITION, 0.0)
        run.advance(0.02)
        run.command(JointMode.POSITION, 0.1)
    torques = {"prompt": [], "late": []}
    for _ in range(20):
        prompt.advance()
        late.advance()
        torques["prompt"].append(torque(prompt))
        torques["late"].append(torque(late))
    steps = round(LATENCY_S / 0.001)
    assert torques["late"][:steps] == pytest.approx([0.0] * steps, abs=1e-6)
    assert torques["late"][steps:] == pytest.approx(torques["prompt"][:-steps], rel=1e-3)


def test_a_motor_with_latency_changes_its_mode_at_once_and_never_follows_an_older_target():
    run = fast_run(LATE)
    run.command(JointMode.TORQUE, 2.0)
    run.advance()
    assert torque(run) > 0.1
    run.command(JointMode.POSITION, 0.0)
    run.advance(0.1)
    assert torque(run) == pytest.approx(0.0, abs=0.05)
    run.command(JointMode.TORQUE, 2.0)
    run.advance(0.1)
    run.command(JointMode.PASSIVE)
    run.advance()
    assert torque(run) == pytest.approx(2.0 * np.exp(-0.001 / RESPONSE_S), rel=1e-3)


def test_latency_of_single_joints_may_differ():
    joints = {"joint_2": {"latency_s": 0.003}}
    run = fast_run(
        {"chain": {"modules": 2}, "motor": {"response_time_s": RESPONSE_S}, "joints": joints}
    )
    run.command(JointMode.TORQUE, 0.0)
    run.advance(0.01)
    run.command(JointMode.TORQUE, 0.5)
    for step in range(4):
        run.advance()
        torques_nm = run.sim.true_state().torques_nm
        assert torques_nm[0] > 0.01
        assert bool(torques_nm[1] > 0.01) is (step >= 3)
