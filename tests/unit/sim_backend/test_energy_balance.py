"""Tests the energy balance of a body that undulates on the ground, and the work that its samples show."""

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest

from snakesim_hal.wire.messages import JointMode
from snakesim_testing.sim.simulator_rig import SimulatorRig, make_config

WAVE_AMPLITUDE_RAD = 0.5
WAVE_PERIOD_S = 2.0
WAVE_LAG_RAD = 0.6  # from joint to joint
STEP_S = 0.002
SLIPPERY = 0.02
ROUGH = 0.3
JOINT_FRICTION = {"friction_nm": 0.05, "viscous_nm_s_per_rad": 0.05}


@dataclass
class EnergyBalance:
    """Energies of a run, in J, over all physics steps; and the work that its samples show."""

    motor_work_j: float = 0.0
    ground_work_j: float = 0.0  # negative: the ground takes energy
    damping_work_j: float = 0.0  # of the joints' viscous friction
    dry_friction_work_j: float = 0.0  # of the joints
    kinetic_energy_j: float = 0.0  # at the end
    sampled_work_j: float = 0.0
    squared_velocity_rad2_s: float = 0.0  # of all joints, integrated over time


def run_wave(
    duration_s: float = 2.0, friction: float = SLIPPERY, rate_hz: int = 100, motor=None
) -> EnergyBalance:
    """Undulate in position mode, and add up the work of every physics step and of every sample."""
    config = make_config(
        {"motor": motor or {}}, {"ground": {"friction": friction}}, rate_hz=rate_hz
    )
    rig = SimulatorRig(config, timestep_s=STEP_S)
    period_s = config.period_ns * 1e-9
    balance = EnergyBalance()
    lags_rad = WAVE_LAG_RAD * np.arange(rig.count)
    for tick in range(round(duration_s / period_s)):
        time_s = tick * period_s
        ramp = min(time_s, 1.0)  # the wave grows within a second
        phases_rad = 2.0 * np.pi * time_s / WAVE_PERIOD_S + lags_rad
        targets_rad = ramp * WAVE_AMPLITUDE_RAD * np.sin(phases_rad)
        rig.command(JointMode.POSITION, targets_rad.tolist())
        for _ in range(round(period_s / STEP_S)):
            _add_physics_step(rig, balance)
        rig.tick += 1
        joints = rig.sample().joints
        balance.sampled_work_j += period_s * float(np.dot(joints.torque_nm, joints.velocity_rad_s))
    momentum = np.zeros(rig.sim.sim.model.nv)
    mujoco.mj_mulM(rig.sim.sim.model, rig.sim.data, momentum, rig.sim.data.qvel)
    balance.kinetic_energy_j = 0.5 * float(rig.sim.data.qvel @ momentum)
    return balance


def _add_physics_step(rig: SimulatorRig, balance: EnergyBalance) -> None:
    """Make one physics step, and add its work: forces times the mean velocity of the step."""
    model = rig.sim.sim.model
    data = rig.sim.data
    velocity_before = data.qvel.copy()
    rig.sim.physics.step(1)
    displacement = 0.5 * STEP_S * (velocity_before + data.qvel)
    viscous_torques = -model.dof_damping * data.qvel  # MuJoCo integrates damping implicitly
    balance.motor_work_j += float(data.qfrc_actuator @ displacement)
    balance.ground_work_j += float((data.qfrc_passive - data.qfrc_damper) @ displacement)
    balance.damping_work_j += float(viscous_torques @ displacement)
    # Nothing else constrains the body.
    balance.dry_friction_work_j += float(data.qfrc_constraint @ displacement)
    balance.squared_velocity_rad2_s += float(np.sum(displacement[6:] ** 2)) / STEP_S


@pytest.mark.parametrize("motor", [{}, JOINT_FRICTION], ids=["no joint friction", "joint friction"])
@pytest.mark.parametrize("friction", [SLIPPERY, ROUGH])
def test_energy_balance_motor_work_equals_friction_and_kinetic_energy(friction, motor):
    balance = run_wave(friction=friction, motor=motor)
    dissipated_j = -(balance.ground_work_j + balance.damping_work_j + balance.dry_friction_work_j)
    assert balance.motor_work_j > 0.5
    assert dissipated_j + balance.kinetic_energy_j == pytest.approx(balance.motor_work_j, rel=0.01)


def compute_missing_torque_nm_s_per_rad(
    stiffness: float, period_s: float, response_time_s: float
) -> float:
    """Return how much the torque at the end of a control period is below its mean, per speed of the joint.

    The target leads the joint by a sawtooth, because it steps once in a period. The torque follows that sawtooth with
    the motor's response time.
    """
    steps = round(period_s / STEP_S)
    decay = np.exp(-STEP_S / response_time_s)
    torque = 0.0
    torques: list[float] = []
    for _ in range(100):  # periods, until the torque repeats
        torques.clear()
        for step in range(steps):
            torque = decay * torque - (1.0 - decay) * stiffness * STEP_S * step
            torques.append(torque)
    return float(np.mean(torques)) - torques[-1]


@pytest.mark.parametrize("friction", [SLIPPERY, ROUGH])
def test_energy_balance_samples_miss_torque_of_new_targets(friction):
    """The missing work depends on the motion, and not on the ground."""
    balance = run_wave(friction=friction)
    motor = make_config().robot.motor
    missing = compute_missing_torque_nm_s_per_rad(
        motor.stiffness_nm_per_rad, 0.01, motor.response_time_s
    )
    expected_j = missing * balance.squared_velocity_rad2_s
    assert balance.motor_work_j - balance.sampled_work_j == pytest.approx(expected_j, rel=0.1)


def test_energy_balance_sampled_work_is_negative_on_slippery_ground():
    balance = run_wave(friction=SLIPPERY)
    assert balance.motor_work_j > 0.0
    assert balance.sampled_work_j < 0.0


def test_energy_balance_samples_of_every_step_are_complete():
    balance = run_wave(rate_hz=round(1.0 / STEP_S))
    assert balance.sampled_work_j == pytest.approx(balance.motor_work_j, abs=0.03)
