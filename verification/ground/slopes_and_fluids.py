"""Compares slopes and fluids with computations that do not use MuJoCo."""

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_testing.sim.gliding import GlidingSnake, glide_without_mujoco, make_tilted_gravity
from snakesim_testing.sim.swimming import HONEY, WATER, Swimmer, swim_wave, swim_without_mujoco
from verification.ground.tables import HU, SKIN, WAVES

SLOPES = {
    "0.1 rad, down ahead": (0.1, 0.0),
    "0.1 rad, down to the left and back": (0.1, 2.0),
    "0.3 rad, down ahead and to the right": (0.3, -0.7),
}
SLOPE_SURFACES = ("flat ground", "step")
THROW_M_S = (1.0, 0.6)
SLOPE_S = 1.0

FLUIDS = {"water": WATER, "honey": HONEY}
VELOCITIES_M_S = {
    "1.0 ahead": (1.0, 0.0, 0.0),
    "0.5 left": (0.0, 0.5, 0.0),
    "0.6 ahead, 0.3 left": (0.6, 0.3, 0.0),
    "-0.4 ahead, 0.2 left, 0.5 up": (-0.4, 0.2, 0.5),
}
FLUID_S = 0.3
FINE_STEP_S = 0.0005
FINE_STIFFNESS = 10.0
STEPS_S = (0.002, 0.001, 0.0005)


def compare_slopes() -> list[str]:
    """Return a table that compares bodies that glide on slopes with their equation of motion."""
    rows = [
        "| Surface | Slope | Simulator, mm | Runge-Kutta, mm | Difference |",
        "|---|---|---|---|---|",
    ]
    velocity_m_s = np.array(THROW_M_S)
    for surface in SLOPE_SURFACES:
        for name, (slope_rad, towards_rad) in SLOPES.items():
            glider = GlidingSnake(
                surface, SKIN, slope={"slope_rad": slope_rad, "slope_towards_rad": towards_rad}
            )
            glider.throw(velocity_m_s)
            start = glider.position_w
            glider.go(SLOPE_S)
            moved = glider.position_w - start
            gravity_w = make_tilted_gravity(slope_rad, towards_rad)
            expected = glide_without_mujoco(velocity_m_s, HU, SLOPE_S, gravity_w=gravity_w)
            rows.append(f"| {surface} | {name} | {_format_comparison(moved, expected)} |")
    return rows


def compare_fluid_forces() -> list[str]:
    """Return a table that compares the force of a fluid on a moving body with the documented formulas."""
    rows = ["| Fluid | Velocity, m/s | Simulator, N | Formulas, N |", "|---|---|---|---|"]
    for fluid, section in FLUIDS.items():
        swimmer = Swimmer(section)
        for name, velocity in VELOCITIES_M_S.items():
            velocity_m_s = np.array(velocity)
            measured = _format_force(swimmer.measure_force_n(velocity_m_s))
            computed = _format_force(swimmer.compute_force_n(velocity_m_s))
            rows.append(f"| {fluid} | {name} | {measured} | {computed} |")
    return rows


def compare_fluid_gliding() -> list[str]:
    """Return a table that compares bodies that glide in a fluid with their equation of motion."""
    rows = [
        "| Fluid | Thrown, m/s | Simulator, mm | Runge-Kutta, mm | Difference |",
        "|---|---|---|---|---|",
    ]
    for fluid, section in FLUIDS.items():
        for name, velocity in list(VELOCITIES_M_S.items())[:3]:
            swimmer = Swimmer(section)
            expected = swimmer.glide_without_mujoco(np.array(velocity), FLUID_S)[:2]
            moved = swimmer.glide(np.array(velocity), FLUID_S)[:2]
            rows.append(f"| {fluid} | {name} | {_format_comparison(moved, expected)} |")
    return rows


def compare_fluid_waves() -> list[str]:
    """Return a table that compares waves in a fluid with their momentum balance."""
    rows = [
        "| Fluid | Wave | Simulator, mm/s | Steps of 0.5 ms, stiffer servos | Momentum balance, mm/s |",
        "|---|---|---|---|---|",
    ]
    for fluid, section in FLUIDS.items():
        for name, wave in WAVES.items():
            ours = swim_wave(wave, section).drift_mm_s
            finer = swim_wave(wave, section, FINE_STEP_S, FINE_STIFFNESS).drift_mm_s
            balance = swim_without_mujoco(wave, section).drift_mm_s
            rows.append(f"| {fluid} | {name} | {ours:+.2f} | {finer:+.2f} | {balance:+.2f} |")
    return rows


def compare_fluid_steps() -> list[str]:
    """Return a table of a wave in water and its reverse, at several physics steps."""
    rows = ["| Physics step | Wave, mm/s | Its reverse, mm/s | Sum, mm/s |", "|---|---|---|---|"]
    wave = next(iter(WAVES.values()))
    for step_s in STEPS_S:
        drift = swim_wave(wave, WATER, step_s).drift_mm_s
        reverse = swim_wave(wave.reversed, WATER, step_s).drift_mm_s
        rows.append(
            f"| {1e3 * step_s:g} ms | {drift:+.2f} | {reverse:+.2f} | {drift + reverse:+.2f} |"
        )
    return rows


def _format_mm(vector_m: Floats) -> str:
    x, y = (1e3 * vector_m).tolist()
    return f"{x:+.1f}, {y:+.1f}"


def _format_force(force_n: Floats) -> str:
    return ", ".join(f"{component:+.3f}" for component in (force_n + 0.0).round(6) + 0.0)


def _format_comparison(moved_m: Floats, expected_m: Floats) -> str:
    """Return three cells: both displacements, and their difference in percent of the length of the path."""
    difference = np.linalg.norm(moved_m - expected_m) / np.linalg.norm(expected_m)
    return f"{_format_mm(moved_m)} | {_format_mm(expected_m)} | {100 * difference:.2f} %"
