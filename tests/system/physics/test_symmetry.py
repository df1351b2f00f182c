"""Flat ground produces no spurious thrust: a mirrored, reversed or rotated wave moves the snake accordingly.

A symmetric snake with a reversed wave must drift in the opposite direction, equally fast, for every physics step.
A difference would be a force that real ground does not have.
"""

import numpy as np
import pytest

from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_testing.sim.waves import (
    BodyTrack,
    JointWave,
    integrate_momentum_balance,
    simulate_wave,
)

GROUND_FRICTION = 0.1
MAX_SPURIOUS_DRIFT_MM_S = 1.0
SEED = 20261123


def simulate_on_flat_ground(
    wave: JointWave, step_s: float = 0.002, *, yaw_rad: float = 0.0
) -> BodyTrack:
    """Simulate the shipped robot with this wave on flat ground."""
    return simulate_wave(wave, {"friction": GROUND_FRICTION}, step_s=step_s, yaw_rad=yaw_rad)


def draw_random_waves(count: int) -> list[JointWave]:
    """Return the same random waves in every call."""
    rng = np.random.default_rng(SEED)
    return [
        JointWave(
            rng.uniform(0.2, 0.6),
            rng.uniform(0.5, 1.2),
            rng.uniform(2.0, 5.0),
            rng.uniform(-0.05, 0.05),
        )
        for _ in range(count)
    ]


FIRST_WAVE, *OTHER_WAVES = draw_random_waves(4)


@pytest.mark.parametrize(
    "wave", [FIRST_WAVE, *(pytest.param(wave, marks=pytest.mark.slow) for wave in OTHER_WAVES)]
)
def test_reversed_wave_reverses_the_drift(wave: JointWave) -> None:
    drift_mm_s = simulate_on_flat_ground(wave).drift_mm_s
    reversed_drift_mm_s = simulate_on_flat_ground(wave.reversed).drift_mm_s
    assert abs(drift_mm_s + reversed_drift_mm_s) < MAX_SPURIOUS_DRIFT_MM_S
    assert max(abs(drift_mm_s), abs(reversed_drift_mm_s)) > 3.0


@pytest.mark.slow
@pytest.mark.timeout(600)  # 60 runs, with steps from 0.5 ms
@pytest.mark.parametrize("step_s", [0.0005, 0.001, 0.002])
def test_reversed_wave_reverses_the_drift_for_every_physics_step(step_s: float) -> None:
    sums = []  # of the drifts of a wave and its reverse
    differences = []  # from the drift with steps of 1 ms
    speeds = []
    for wave in draw_random_waves(20):
        drift_mm_s = simulate_on_flat_ground(wave, step_s).drift_mm_s
        sums.append(abs(drift_mm_s + simulate_on_flat_ground(wave.reversed, step_s).drift_mm_s))
        differences.append(abs(drift_mm_s - simulate_on_flat_ground(wave, 0.001).drift_mm_s))
        speeds.append(abs(drift_mm_s))
    print(
        f"steps of {step_s * 1e3:g} ms: drift {min(speeds):.1f} to {max(speeds):.1f} mm/s, of a wave and "
        f"its reverse in sum at most {max(sums):.2f} mm/s, from that with 1 ms at most {max(differences):.2f} mm/s"
    )
    assert max(sums) < MAX_SPURIOUS_DRIFT_MM_S
    assert max(differences) < MAX_SPURIOUS_DRIFT_MM_S


@pytest.mark.heavy
def test_reflected_or_rotated_snake_moves_reflected_or_rotated() -> None:
    wave = JointWave(bend=0.04)
    reflected_wave = JointWave(-wave.amplitude, bend=-wave.bend)
    yaw_rad = 0.7
    center = simulate_on_flat_ground(wave).center[-1]
    reflected_center = simulate_on_flat_ground(reflected_wave).center[-1]
    rotated_center = simulate_on_flat_ground(wave, yaw_rad=yaw_rad).center[-1]
    expected_rotated = complex(*center) * np.exp(1j * yaw_rad)
    assert np.linalg.norm(center) > 0.02
    assert reflected_center == pytest.approx(center * [1.0, -1.0], abs=1e-6)
    assert rotated_center == pytest.approx([expected_rotated.real, expected_rotated.imag], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "wave",
    [
        pytest.param(JointWave(), marks=pytest.mark.slow),
        JointWave().reversed,
        JointWave(0.3, 0.7, 4.0),
        JointWave(0.7, -0.75, 7.854),  # the wave of the contact-search gait
    ],
)
def test_wave_on_coulomb_friction_drifts_as_momentum_balance_computes(wave: JointWave) -> None:
    isotropic = DirectionalFriction(GROUND_FRICTION, GROUND_FRICTION, GROUND_FRICTION)
    drift_mm_s = simulate_on_flat_ground(wave).drift_mm_s
    expected_mm_s = integrate_momentum_balance(wave, isotropic).drift_mm_s
    print(f"{wave}: {drift_mm_s:+.2f} mm/s, momentum balance {expected_mm_s:+.2f} mm/s")
    assert drift_mm_s == pytest.approx(expected_mm_s, abs=MAX_SPURIOUS_DRIFT_MM_S)
