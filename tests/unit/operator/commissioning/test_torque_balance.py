"""Fits the torque balance of a joint with known parameters, and checks the estimates and their intervals."""

import numpy as np
import pytest

from snakesim_operator.features.commissioning.system_identification.smoothing import (
    smooth,
    smooth_derivative,
    smooth_second_derivative,
)
from snakesim_operator.features.commissioning.system_identification.torque_balance import (
    MODEL_MISFIT,
    JointRecord,
    TorqueBalance,
    fit_torque_balance,
)
from snakesim_testing.messages import raises_error

TRUTH = {"dry_nm": 0.15, "viscous_nm_s_per_rad": 0.1, "armature_kg_m2": 0.005}
INERTIA_KG_M2 = 0.02  # of the links that the joint moves
WEIGHT_NM_PER_RAD = 1.5
TORQUE_SCALE = 1.2  # true torque divided by the torque that the drive reports
PERIOD_S = 0.005
DURATION_S = 20
MIN_COVERAGE = 0.87  # 95 % of 60 trials, less three standard deviations
TONES = ((0.25, 0.3), (0.03, 1.3), (0.02, 2.9), (0.01, 5.3))  # amplitude in rad and frequency in Hz
SERVO_STIFFNESS_NM_PER_RAD = 60
TORQUE_LIMIT_NM = 7.0
# Standard deviations of the noise of planar13.
ANGLE_NOISE_RAD = 0.0005
SPEED_NOISE_RAD_S = 0.005
FOREIGN_FREQUENCY_HZ = 4.1
TORQUE_NOISE_NM = 0.01


def fit_simulated_joint(
    seed: int,
    *,
    scaled: bool,
    speed_noise_rad_s: float = SPEED_NOISE_RAD_S,
    foreign_torque_nm: float = 0.0,
) -> TorqueBalance:
    """Fit the torque balance of a joint that moves as a sum of tones with random phases.

    Args:
        seed: of the phases and of the measurement noise.
        scaled: whether the drive reports torques with a wrong scale, which the fit must find.
        speed_noise_rad_s: standard deviation of the noise of the measured speed.
        foreign_torque_nm: amplitude of a torque that the model does not contain.
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(0, DURATION_S, PERIOD_S)
    angle_rad = np.zeros_like(time_s)
    speed_rad_s = np.zeros_like(time_s)
    acceleration_rad_s2 = np.zeros_like(time_s)
    for amplitude_rad, frequency_hz in TONES:
        rate_rad_s = 2 * np.pi * frequency_hz
        phase_rad = rng.uniform(0, 2 * np.pi)
        angle_rad += amplitude_rad * np.sin(rate_rad_s * time_s + phase_rad)
        speed_rad_s += amplitude_rad * rate_rad_s * np.cos(rate_rad_s * time_s + phase_rad)
        acceleration_rad_s2 -= (
            amplitude_rad * rate_rad_s**2 * np.sin(rate_rad_s * time_s + phase_rad)
        )
    torque_nm = (INERTIA_KG_M2 + TRUTH["armature_kg_m2"]) * acceleration_rad_s2
    torque_nm += WEIGHT_NM_PER_RAD * angle_rad
    torque_nm += TRUTH["viscous_nm_s_per_rad"] * speed_rad_s
    torque_nm += TRUTH["dry_nm"] * np.sign(speed_rad_s)
    target_rad = angle_rad + torque_nm / SERVO_STIFFNESS_NM_PER_RAD

    scale = TORQUE_SCALE if scaled else 1.0
    reported_torque_nm = torque_nm / scale + TORQUE_NOISE_NM * rng.standard_normal(len(time_s))
    reported_torque_nm += foreign_torque_nm * np.sin(2 * np.pi * FOREIGN_FREQUENCY_HZ * time_s)
    measured_angle_rad = angle_rad + ANGLE_NOISE_RAD * rng.standard_normal(len(time_s))
    measured_speed_rad_s = speed_rad_s + speed_noise_rad_s * rng.standard_normal(len(time_s))
    record = JointRecord(
        PERIOD_S,
        measured_angle_rad,
        measured_speed_rad_s,
        reported_torque_nm,
        target_rad,
        TORQUE_LIMIT_NM,
    )
    weight_nm = WEIGHT_NM_PER_RAD * smooth(measured_angle_rad)
    load_by_speed_nm = weight_nm + INERTIA_KG_M2 * smooth_derivative(measured_speed_rad_s, PERIOD_S)
    load_by_angle_nm = weight_nm + INERTIA_KG_M2 * smooth_second_derivative(
        measured_angle_rad, PERIOD_S
    )
    return fit_torque_balance(
        record, np.zeros(len(time_s)), load_by_speed_nm, load_by_angle_nm, fit_scale=scaled
    )


@pytest.mark.parametrize("scaled", [True, False])
def test_torque_balance_intervals_have_their_coverage(scaled: bool) -> None:
    trials = [fit_simulated_joint(seed, scaled=scaled) for seed in range(60)]
    truth = TRUTH | {"torque_scale": TORQUE_SCALE if scaled else 1.0}
    for name, true_value in truth.items():
        estimates = [getattr(trial, name) for trial in trials]
        coverage = np.mean([estimate.contains(true_value) for estimate in estimates])
        assert coverage >= MIN_COVERAGE, f"{name}: {coverage}"
        median_half_width = np.median([estimate.half_width for estimate in estimates])
        assert median_half_width < 0.1 * true_value, name
        mean_value = np.mean([estimate.value for estimate in estimates])
        assert abs(mean_value / true_value - 1) < 0.05, name


def test_torque_balance_noisy_speed_is_no_misfit() -> None:
    for seed in range(10):
        noisy = fit_simulated_joint(seed, scaled=True, speed_noise_rad_s=0.05)
        assert noisy.explained < 1 - MODEL_MISFIT**2
        assert noisy.misfit < 0.02, noisy.misfit


def test_torque_balance_unmodeled_torque_is_misfit_despite_noise() -> None:
    for seed in range(10):
        wrong = fit_simulated_joint(
            seed, scaled=True, speed_noise_rad_s=0.05, foreign_torque_nm=0.05
        )
        assert wrong.misfit > 0.05, wrong.misfit


def test_torque_balance_of_joint_at_rest_raises_error() -> None:
    at_rest = np.zeros(4000)
    record = JointRecord(PERIOD_S, at_rest, at_rest, at_rest, at_rest, TORQUE_LIMIT_NM)
    no_load = smooth(at_rest)
    with raises_error(ValueError):
        fit_torque_balance(record, at_rest, no_load, no_load, fit_scale=True)
