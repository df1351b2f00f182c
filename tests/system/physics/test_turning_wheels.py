"""Wheels with separate friction limits keep the sideways friction of their tires while they roll."""

import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_testing.sim.gliding import GlidingSnake
from snakesim_testing.sim.simulator_rig import G
from snakesim_testing.sim.waves import JointWave, integrate_momentum_balance, simulate_wave

ROLLING_FRICTION = 0.01
TIRE_FRICTION = 0.6
WHEELS = {
    "radius_m": 0.03,
    "bearing_radius_m": 0.003,
    "bearing_friction": 0.1,
    "tire_friction": TIRE_FRICTION,
}
SEPARATE_LIMITS = {"wheels": {**WHEELS, "separate_limits": True}}
COEFFICIENTS = DirectionalFriction(ROLLING_FRICTION, ROLLING_FRICTION, TIRE_FRICTION)
SLOW_WAVE = JointWave(0.3, 0.7, 4.0)


def measure_friction_per_weight(snake: GlidingSnake, velocity_m_s: tuple[float, float]) -> Floats:
    """Drag a snake for 0.4 s at a velocity along its wheels and across them, and return friction over weight, (2,)."""
    force_n = snake.drag(velocity_w=np.array(velocity_m_s), time_s=0.4)
    return np.abs(force_n) / (snake.mass_kg * G)


ROLLING_AND_SLIPPING_M_S = (0.5, 0.1)  # along the wheels and across them


def test_wheels_with_separate_limits_keep_full_sideways_friction() -> None:
    """Wheels that roll and slip have the rolling friction along them, and the full friction of the tires across."""
    snake = GlidingSnake("flat ground", {"wheels": {**WHEELS, "separate_limits": True}})
    friction = measure_friction_per_weight(snake, ROLLING_AND_SLIPPING_M_S)
    assert friction == pytest.approx((ROLLING_FRICTION, TIRE_FRICTION), rel=0.01)


def test_wheels_with_common_limit_lose_sideways_friction_by_rolling() -> None:
    """One limit for the whole force, as scales have it, leaves less for the direction in which the wheels slip less."""
    snake = GlidingSnake("flat ground", {"wheels": WHEELS})  # separate_limits is false by default
    _, sideways_friction = measure_friction_per_weight(snake, ROLLING_AND_SLIPPING_M_S)
    a_third_of_tire_friction = 0.2
    assert sideways_friction < a_third_of_tire_friction


@pytest.mark.parametrize("surface", ["flat ground", "level hills", "step", "top of an obstacle"])
def test_wheels_roll_easily_and_slip_sideways_above_tire_friction(surface: str) -> None:
    glider = GlidingSnake(surface, SEPARATE_LIMITS)
    force_n = glider.drag(velocity_w=np.array([0.5, 0.0]), time_s=0.4)
    assert np.linalg.norm(force_n) / (glider.mass_kg * G) == pytest.approx(
        ROLLING_FRICTION, rel=0.02
    )
    pushed = GlidingSnake(surface, SEPARATE_LIMITS)
    pushed.push(np.array([0.0, 0.95 * TIRE_FRICTION]))
    pushed.go(0.5)
    position_w = pushed.position_w
    pushed.go(0.5)
    assert pushed.position_w == pytest.approx(position_w, abs=2e-4)
    pushed.push(np.array([0.0, 1.1 * TIRE_FRICTION]))
    pushed.go(0.5)
    assert (pushed.position_w - position_w)[1] > 1e-3


@pytest.mark.heavy
@pytest.mark.parametrize(
    "wave",
    [SLOW_WAVE, pytest.param(SLOW_WAVE.reversed, marks=pytest.mark.slow)],
    ids=["wave", "its reverse"],
)
def test_wave_on_wheels_drifts_as_momentum_balance_computes(wave: JointWave) -> None:
    drift_mm_s = simulate_wave(wave, {"friction": 0.19}, SEPARATE_LIMITS).drift_mm_s
    expected_mm_s = integrate_momentum_balance(wave, COEFFICIENTS, separate_limits=True).drift_mm_s
    assert drift_mm_s == pytest.approx(expected_mm_s, rel=0.01)
