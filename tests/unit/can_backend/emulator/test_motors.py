"""The motors' law, and that the simulator's motors have the same one."""

import numpy as np
import pytest

from snakesim_drivers.emulation.inertia import InertiaModel, InertiaSettings
from snakesim_hal.backend import SafeSetpoints
from snakesim_hal.model.scenario import load_scenario
from snakesim_hal.physics.motors import PowerStages
from snakesim_hal.wire.messages import JointMode
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.physics_model import MujocoPhysicsModel
from snakesim_sim_backend.settings import PhysicsModelSettings, SimSettings
from snakesim_testing.can.driver_loop import make_can_config

STEP_S, RESPONSE_S, RATED_NM, SPEED = 1e-3, 0.01, 4.0, 5.0
REST = np.zeros(1)


def motor(**robot):
    run = make_can_config(1, **{f"robot__{key}": value for key, value in robot.items()})
    return PowerStages(run.robot, STEP_S), run


def drive(motors, mode, target, limit=RATED_NM):
    motors.set_demand(0, mode, target, limit, 40.0, 1.0, SPEED)


def test_torque_mode_follows_as_a_first_order_lag():
    motors, _ = motor()
    drive(motors, JointMode.TORQUE, 2.0)
    for k in range(1, 40):
        assert motors.compute_torques(REST, REST)[0] == pytest.approx(
            2.0 * (1 - np.exp(-k * STEP_S / RESPONSE_S))
        )


def test_a_motor_without_response_time_answers_at_once():
    motors, _ = motor(motor__response_time_s=0.0)
    drive(motors, JointMode.TORQUE, 2.0)
    assert motors.compute_torques(REST, REST)[0] == pytest.approx(2.0)
    drive(motors, JointMode.PASSIVE, 0.0)
    assert motors.compute_torques(REST, REST)[0] == 0.0


@pytest.mark.parametrize("mode", list(JointMode))
def test_motor_mode_change_moves_torque_at_motor_response(mode):
    motors, _ = motor()
    drive(motors, JointMode.TORQUE, 3.0)
    for _ in range(100):
        motors.compute_torques(REST, REST)
    drive(motors, mode, -3.0)
    after = motors.compute_torques(REST, REST)[0]
    assert abs(after - 3.0) <= 2 * RATED_NM * (10 + 1) * (1 - np.exp(-STEP_S / RESPONSE_S))
    assert after > -RATED_NM
    motors, _ = motor()
    drive(motors, JointMode.TORQUE, 3.0)
    motors.torque_nm[:] = 3.0
    drive(motors, JointMode.PASSIVE, 0.0)
    assert motors.compute_torques(REST, REST)[0] == pytest.approx(
        3.0 * np.exp(-STEP_S / RESPONSE_S)
    )


def test_motor_torque_stays_within_rating_and_setpoint_limit():
    motors, _ = motor()
    drive(motors, JointMode.TORQUE, 30.0, limit=9.0)
    for _ in range(200):
        assert motors.compute_torques(REST, REST)[0] <= RATED_NM
    drive(motors, JointMode.TORQUE, 30.0, limit=1.0)
    first = motors.compute_torques(REST, REST)[0]
    assert first == pytest.approx(RATED_NM * np.exp(-STEP_S / RESPONSE_S))
    for _ in range(50):
        motors.compute_torques(REST, REST)
    assert motors.torque_nm[0] == 1.0


def test_motor_torque_fades_to_zero_at_speed_limit():
    motors, _ = motor()
    drive(motors, JointMode.TORQUE, RATED_NM)
    for speed, torque in ((0.89 * SPEED, RATED_NM), (SPEED, 0.0), (0.95 * SPEED, 0.5 * RATED_NM)):
        for _ in range(200):
            motors.compute_torques(REST, np.array([speed]))
        assert motors.torque_nm[0] == pytest.approx(torque, abs=1e-6)
    motors, _ = motor()
    assert motors.compute_torques(REST, np.array([3 * SPEED]))[0] == 0.0, "and none when passive"


def test_motor_position_mode_at_1_ms_is_stable_and_arrives():
    run = load_scenario("triplet").config
    physics_model = InertiaModel(run, InertiaSettings())
    motors, m = PowerStages(run.robot, physics_model.step_s), run.robot.motor
    for i in range(13):
        motors.set_demand(
            i, JointMode.POSITION, 0.4, 7.0, m.stiffness_nm_per_rad, m.damping_nm_s_per_rad, 7.5
        )
    for _ in range(1000):
        physics_model.advance(
            motors.compute_torques(physics_model.angle_rad, physics_model.velocity_rad_s)
        )
    assert physics_model.angle_rad == pytest.approx([0.4] * 13, abs=0.1 / 60 + 1e-4)
    assert np.abs(physics_model.velocity_rad_s).max() < 1e-3


TICKS_UNTIL_STEADY = 100  # until the torque has followed its demand


def make_hot_motor() -> PowerStages:
    """Return a motor that demands 3 N·m and may have half of its rated torque because of heat."""
    motors, _ = motor()
    drive(motors, JointMode.TORQUE, 3.0)
    motors.compute_torques(REST, REST)
    motors.apply_derating(np.array([0.5]))
    return motors


def test_motor_torque_of_hot_motor_is_derated() -> None:
    motors = make_hot_motor()
    assert motors.find_derated()[0]
    for _ in range(TICKS_UNTIL_STEADY):
        motors.compute_torques(REST, REST)
    assert motors.torque_nm[0] == RATED_NM / 2


def test_motor_small_demand_of_hot_motor_is_not_derated() -> None:
    motors = make_hot_motor()
    drive(motors, JointMode.TORQUE, 1.0)
    motors.compute_torques(REST, REST)
    assert not motors.find_derated()[0]


def test_motor_demanded_limit_below_heat_limit_is_not_reduced_further() -> None:
    motors = make_hot_motor()
    drive(motors, JointMode.TORQUE, 3.0, limit=RATED_NM / 4)
    for _ in range(TICKS_UNTIL_STEADY):
        motors.compute_torques(REST, REST)
    assert motors.torque_nm[0] == RATED_NM / 4


def test_the_simulator_s_motors_do_the_same():
    run = load_scenario("triplet").config
    count, motor, limits = run.robot.chain.modules, run.robot.motor, run.robot.limits
    fine_s = 2e-4
    sim = SimBackend(run, SimSettings(timestep_s=fine_s))
    physics_model = MujocoPhysicsModel(run, PhysicsModelSettings(timestep_s=fine_s))
    motors = PowerStages(run.robot, physics_model.step_s)
    swing = 0.1 * np.sin(np.arange(count))
    for mode, target in (
        (JointMode.POSITION, physics_model.angle_rad + swing),
        (JointMode.VELOCITY, 3 * swing),
        (JointMode.TORQUE, 5 * swing),
    ):
        damping = (
            motor.damping_nm_s_per_rad
            if mode == JointMode.POSITION
            else motor.velocity_gain_nm_s_per_rad
        )
        for i in range(count):
            gains = (motor.stiffness_nm_per_rad, damping, limits.speed_rad_s)
            motors.set_demand(i, mode, float(target[i]), limits.torque_nm, *gains)
        for _ in range(4):
            sim.enact(
                SafeSetpoints([mode] * count, target.tolist(), [limits.torque_nm] * count), "armed"
            )
            sim.advance()
            for _ in range(round(run.period_ns * 1e-9 / physics_model.step_s)):
                physics_model.advance(
                    motors.compute_torques(physics_model.angle_rad, physics_model.velocity_rad_s)
                )
        truth = sim.true_state()
        assert physics_model.angle_rad == pytest.approx(truth.angles_rad, abs=1e-3)
        assert motors.torque_nm == pytest.approx(truth.torques_nm, abs=0.05)
