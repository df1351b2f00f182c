"""What is found of a joint whose motion is known in closed form: right, and as sure as it says."""

import numpy as np
import pytest

from snakesim_operator.features.commissioning.system_identification.smoothing import (
    smooth,
    smooth_derivative,
    smooth_second_derivative,
)
from snakesim_operator.features.commissioning.system_identification.torque_balance import (
    JointRecord,
    TorqueBalance,
    fit_torque_balance,
)
from snakesim_testing.messages import raises_error

TRUTH = {"dry_nm": 0.15, "viscous_nm_s_per_rad": 0.1, "armature_kg_m2": 0.005}
INERTIA_KG_M2, WEIGHT_NM_PER_RAD, SCALE = 0.02, 1.5, 1.2
PERIOD_S = 0.005


def found(seed: int, *, scaled: bool) -> TorqueBalance:
    """By a swing and three tones, with the noise of planar13."""
    pick = np.random.default_rng(seed)
    time_s = np.arange(0, 20, PERIOD_S)
    angle, speed, more = (np.zeros_like(time_s) for _ in range(3))
    for size, hz in ((0.25, 0.3), (0.03, 1.3), (0.02, 2.9), (0.01, 5.3)):
        rate, phase = 2 * np.pi * hz, pick.uniform(0, 2 * np.pi)
        angle += size * np.sin(rate * time_s + phase)
        speed += size * rate * np.cos(rate * time_s + phase)
        more -= size * rate**2 * np.sin(rate * time_s + phase)
    torque = (INERTIA_KG_M2 + TRUTH["armature_kg_m2"]) * more + WEIGHT_NM_PER_RAD * angle
    torque += TRUTH["viscous_nm_s_per_rad"] * speed + TRUTH["dry_nm"] * np.sign(speed)
    told = torque / (SCALE if scaled else 1.0) + 0.01 * pick.standard_normal(len(time_s))
    target = angle + torque / 60  # of a servo
    angle = angle + 0.0005 * pick.standard_normal(len(time_s))
    speed = speed + 0.005 * pick.standard_normal(len(time_s))
    moved = JointRecord(PERIOD_S, angle, speed, told, target, 7.0)
    weight = WEIGHT_NM_PER_RAD * smooth(angle)
    load = weight + INERTIA_KG_M2 * smooth_derivative(speed, PERIOD_S)
    by_angle = weight + INERTIA_KG_M2 * smooth_second_derivative(angle, PERIOD_S)
    return fit_torque_balance(moved, np.zeros(len(time_s)), load, by_angle, fit_scale=scaled)


@pytest.mark.parametrize("scaled", [True, False])
def test_torque_balance_intervals_have_their_coverage(scaled: bool) -> None:
    trials = [found(seed, scaled=scaled) for seed in range(60)]
    truth = TRUTH | {"torque_scale": SCALE if scaled else 1.0}
    for name, value in truth.items():
        values = [getattr(trial, name) for trial in trials]
        covered = np.mean([one.contains(value) for one in values])
        assert covered >= 0.87, f"{name}: {covered}"  # 95 % of 60, less three standard deviations
        assert np.median([one.half_width for one in values]) < 0.1 * value, name
        assert abs(np.mean([one.value for one in values]) / value - 1) < 0.05, name


def test_a_joint_at_rest_tells_nothing() -> None:
    still = np.zeros(4000)
    moved = JointRecord(PERIOD_S, still, still, still, still, 7.0)
    none = smooth(still)
    with raises_error(ValueError):
        fit_torque_balance(moved, still, none, none, fit_scale=True)
