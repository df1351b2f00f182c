"""The motor model of the emulators, which equals that of the simulator."""

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

STEP_S = 1e-3
RESPONSE_S = 0.01
RATED_NM = 4.0
SPEED_LIMIT_RAD_S = 5.0  # speed limit
AT_REST = np.zeros(1)


def make_motor(**robot):
    """Return the power stage of one motor, and the configuration of its run."""
    run = make_can_config(1, **{f"robot__{key}": value for key, value in robot.items()})
    return PowerStages(run.robot, STEP_S), run


def set_demand(motors, mode, target, limit=RATED_NM):
    """Set mode, target and torque limit of the motor."""
    motors.set_demand(0, mode, target, limit, 40.0, 1.0, SPEED_LIMIT_RAD_S)


def test_motor_torque_follows_demand_with_first_order_lag():
    motors, _ = make_motor()
    set_demand(motors, JointMode.TORQUE, 2.0)
    for step in range(1, 40):
        assert motors.compute_torques(AT_REST, AT_REST)[0] == pytest.approx(
            2.0 * (1 - np.exp(-step * STEP_S / RESPONSE_S))
        )


def test_motor_without_response_time_reaches_demand_immediately():
    motors, _ = make_motor(motor__response_time_s=0.0)
    set_demand(motors, JointMode.TORQUE, 2.0)
    assert motors.compute_torques(AT_REST, AT_REST)[0] == pytest.approx(2.0)
    set_demand(motors, JointMode.PASSIVE, 0.0)
    assert motors.compute_torques(AT_REST, AT_REST)[0] == 0.0


@pytest.mark.parametrize("mode", list(JointMode))
def test_motor_mode_change_moves_torque_at_motor_response(mode):
    motors, _ = make_motor()
    set_demand(motors, JointMode.TORQUE, 3.0)
    for _ in range(100):
        motors.compute_torques(AT_REST, AT_REST)
    set_demand(motors, mode, -3.0)
    torque_nm = motors.compute_torques(AT_REST, AT_REST)[0]
    assert abs(torque_nm - 3.0) <= 2 * RATED_NM * (10 + 1) * (1 - np.exp(-STEP_S / RESPONSE_S))
    assert torque_nm > -RATED_NM
    motors, _ = make_motor()
    set_demand(motors, JointMode.TORQUE, 3.0)
    motors.torque_nm[:] = 3.0
    set_demand(motors, JointMode.PASSIVE, 0.0)
    assert motors.compute_torques(AT_REST, AT_REST)[0] == pytest.approx(
        3.0 * np.exp(-STEP_S / RESPONSE_S)
    )


def test_motor_torque_stays_within_rating_and_setpoint_limit():
    motors, _ = make_motor()
    set_demand(motors, JointMode.TORQUE, 30.0, limit=9.0)
    for _ in range(200):
        assert motors.compute_torques(AT_REST, AT_REST)[0] <= RATED_NM
    set_demand(motors, JointMode.TORQUE, 30.0, limit=1.0)
    first_torque_nm = motors.compute_torques(AT_REST, AT_REST)[0]
    assert first_torque_nm == pytest.approx(RATED_NM * np.exp(-STEP_S / RESPONSE_S))
    for _ in range(50):
        motors.compute_torques(AT_REST, AT_REST)
    assert motors.torque_nm[0] == 1.0


def test_motor_torque_fades_to_zero_at_speed_limit():
    motors, _ = make_motor()
    set_demand(motors, JointMode.TORQUE, RATED_NM)
    for speed_rad_s, expected_nm in (
        (0.89 * SPEED_LIMIT_RAD_S, RATED_NM),
        (SPEED_LIMIT_RAD_S, 0.0),
        (0.95 * SPEED_LIMIT_RAD_S, 0.5 * RATED_NM),
    ):
        for _ in range(200):
            motors.compute_torques(AT_REST, np.array([speed_rad_s]))
        assert motors.torque_nm[0] == pytest.approx(expected_nm, abs=1e-6)
    motors, _ = make_motor()
    assert motors.compute_torques(AT_REST, np.array([3 * SPEED_LIMIT_RAD_S]))[0] == 0.0, (
        "a passive motor has no torque at this speed"
    )


def test_motor_position_mode_at_1_ms_is_stable_and_arrives():
    run = load_scenario("triplet").config
    physics_model = InertiaModel(run, InertiaSettings())
    motors = PowerStages(run.robot, physics_model.step_s)
    motor_data = run.robot.motor
    for i in range(13):
        motors.set_demand(
            i,
            JointMode.POSITION,
            0.4,
            7.0,
            motor_data.stiffness_nm_per_rad,
            motor_data.damping_nm_s_per_rad,
            7.5,
        )
    for _ in range(1000):
        physics_model.advance(
            motors.compute_torques(physics_model.angle_rad, physics_model.velocity_rad_s)
        )
    assert physics_model.angle_rad == pytest.approx([0.4] * 13, abs=0.1 / 60 + 1e-4)
    assert np.abs(physics_model.velocity_rad_s).max() < 1e-3


TICKS_UNTIL_STEADY = 100  # by then, the torque has reached its demand


def make_hot_motor() -> PowerStages:
    """Return a motor that demands 3 N·m and may have half of its rated torque because of heat."""
    motors, _ = make_motor()
    set_demand(motors, JointMode.TORQUE, 3.0)
    motors.compute_torques(AT_REST, AT_REST)
    motors.apply_derating(np.array([0.5]))
    return motors


def test_motor_torque_of_hot_motor_is_derated() -> None:
    motors = make_hot_motor()
    assert motors.find_derated()[0]
    for _ in range(TICKS_UNTIL_STEADY):
        motors.compute_torques(AT_REST, AT_REST)
    assert motors.torque_nm[0] == RATED_NM / 2


def test_motor_small_demand_of_hot_motor_is_not_derated() -> None:
    motors = make_hot_motor()
    set_demand(motors, JointMode.TORQUE, 1.0)
    motors.compute_torques(AT_REST, AT_REST)
    assert not motors.find_derated()[0]


def test_motor_demanded_limit_below_heat_limit_is_not_reduced_further() -> None:
    motors = make_hot_motor()
    set_demand(motors, JointMode.TORQUE, 3.0, limit=RATED_NM / 4)
    for _ in range(TICKS_UNTIL_STEADY):
        motors.compute_torques(AT_REST, AT_REST)
    assert motors.torque_nm[0] == RATED_NM / 4


def test_motor_model_equals_that_of_the_simulator():
    run = load_scenario("triplet").config
    count = run.robot.chain.modules
    motor_data = run.robot.motor
    limits = run.robot.limits
    timestep_s = 2e-4
    sim = SimBackend(run, SimSettings(timestep_s=timestep_s))
    physics_model = MujocoPhysicsModel(run, PhysicsModelSettings(timestep_s=timestep_s))
    motors = PowerStages(run.robot, physics_model.step_s)
    offsets = 0.1 * np.sin(np.arange(count))
    for mode, target in (
        (JointMode.POSITION, physics_model.angle_rad + offsets),
        (JointMode.VELOCITY, 3 * offsets),
        (JointMode.TORQUE, 5 * offsets),
    ):
        damping = (
            motor_data.damping_nm_s_per_rad
            if mode == JointMode.POSITION
            else motor_data.velocity_gain_nm_s_per_rad
        )
        for i in range(count):
            gains = (motor_data.stiffness_nm_per_rad, damping, limits.speed_rad_s)
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
        true_state = sim.true_state()
        assert physics_model.angle_rad == pytest.approx(true_state.angles_rad, abs=1e-3)
        assert motors.torque_nm == pytest.approx(true_state.torques_nm, abs=0.05)
