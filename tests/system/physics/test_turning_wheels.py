"""Wheels with separate limits: rolling does not reduce the friction of the tires sideways."""

import numpy as np
import pytest

from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_testing.sim.gliding import GlidingSnake
from snakesim_testing.sim.simulator_rig import G
from snakesim_testing.sim.waves import JointWave, integrate_momentum_balance, simulate_wave

ROLLING_FRICTION = 0.01
TIRE_FRICTION = 0.6
SECTION = {
    "radius_m": 0.03,
    "bearing_radius_m": 0.003,
    "bearing_friction": 0.1,
    "tire_friction": TIRE_FRICTION,
}
TURNING = {"wheels": {**SECTION, "separate_limits": True}}
COEFFICIENTS = DirectionalFriction(ROLLING_FRICTION, ROLLING_FRICTION, TIRE_FRICTION)
SLOW = JointWave(0.3, 0.7, 4.0)


def test_wheels_that_roll_and_slip_have_the_whole_friction_sideways() -> None:
    glider = GlidingSnake("flat ground", TURNING)
    force_n = glider.drag(np.array([0.5, 0.1]), 0.4)
    assert np.abs(force_n) / (glider.mass_kg * G) == pytest.approx(
        (ROLLING_FRICTION, TIRE_FRICTION), rel=0.01
    )
    slipping = GlidingSnake("flat ground", {"wheels": SECTION})
    force_n = slipping.drag(np.array([0.5, 0.1]), 0.4)
    assert abs(force_n[1]) / (slipping.mass_kg * G) < 0.2  # by the law of scales


@pytest.mark.parametrize("surface", ["flat ground", "level hills", "step", "top of an obstacle"])
def test_wheels_roll_easily_and_hold_sideways(surface: str) -> None:
    glider = GlidingSnake(surface, TURNING)
    force_n = glider.drag(np.array([0.5, 0.0]), 0.4)
    assert np.linalg.norm(force_n) / (glider.mass_kg * G) == pytest.approx(
        ROLLING_FRICTION, rel=0.02
    )
    held = GlidingSnake(surface, TURNING)
    held.push(np.array([0.0, 0.95 * TIRE_FRICTION]))
    held.go(0.5)
    before = held.position_w
    held.go(0.5)
    assert held.position_w == pytest.approx(before, abs=2e-4)
    held.push(np.array([0.0, 1.1 * TIRE_FRICTION]))
    held.go(0.5)
    assert (held.position_w - before)[1] > 1e-3


@pytest.mark.parametrize(
    "wave", [SLOW, pytest.param(SLOW.reversed, marks=pytest.mark.slow)], ids=["wave", "its reverse"]
)
def test_wave_drifts_as_the_momentum_balance_says(wave: JointWave) -> None:
    drift_mm_s = simulate_wave(wave, {"friction": 0.19}, TURNING).drift_mm_s
    expected_mm_s = integrate_momentum_balance(wave, COEFFICIENTS, separate_limits=True).drift_mm_s
    assert drift_mm_s == pytest.approx(expected_mm_s, rel=0.01)
