"""Compares the simulated laws of ground and friction with computations that do not use them."""

from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_testing.sim.gliding import FRICTION, SURFACES, GlidingSnake, glide_without_mujoco
from snakesim_testing.sim.simulator_rig import G
from snakesim_testing.sim.waves import JointWave, integrate_momentum_balance, simulate_wave
from verification.ground.cost import measure_medians_us
from verification.ground.wheeled import ROLLING_FRICTION, TIRE_FRICTION, WHEELS, WheeledSnake

HU = DirectionalFriction(0.11, 0.14, 0.19)
NO_FRICTION = DirectionalFriction(0.0, 0.0, 0.0)
ROLLING = DirectionalFriction(ROLLING_FRICTION, ROLLING_FRICTION, TIRE_FRICTION)
SKIN = {"skin": {"forward": HU.forward, "backward": HU.backward, "sideways": HU.sideways}}
ON_WHEELS = {"wheels": WHEELS}
ON_SEPARATE_LIMITS = {"wheels": WHEELS | {"separate_limits": True}}
CLOTH = {"friction": FRICTION}
MUD = {"friction": 0.0, "viscous": {"along_s_per_m": 0.5, "across_s_per_m": 3.0}}
MUD_S_PER_M = 0.5 + 3.0j
WAVES = {
    "0.3 sin(4 t + 0.7 i)": JointWave(0.3, 0.7, 4.0),
    "its reverse, 0.3 sin(4 t - 0.7 i)": JointWave(0.3, -0.7, 4.0),
    "0.5 sin(6.28 t + 0.5 i)": JointWave(0.5, 0.5, 6.28),
}
THROWS = {"1.0 forward, 0.6 left": (1.0, 0.6), "0.8 backward, 0.8 left": (-0.8, 0.8)}
GLIDING_S = 1.5
DRAG_M_S = 0.2

HILLS = {
    "ground": {
        "friction": FRICTION,
        "heightfield": {"height_m": 0.1, "wavelength_m": 0.8, "area_m": 6.0},
    }
}
PEGS = {
    "ground": CLOTH,
    "cylinder": [
        {"position_m": [0.25 * i, 0.1 * (-1) ** i], "radius_m": 0.05, "friction": 0.2}
        for i in range(6)
    ],
}
PIPE = {
    "ground": CLOTH,
    "pipe": [
        {
            "position_m": [2.0, 0.0],
            "length_m": 8.0,
            "radius_m": 0.21,
            "inner_radius_m": 0.2,
            "friction": FRICTION,
        }
    ],
}
POSTS = {
    "ground": CLOTH,
    "cylinder": [peg | {"stiffness_n_per_m": 300.0} for peg in PEGS["cylinder"]],  # pyright: ignore
}
COST_CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "flat ground, isotropic": ({}, {"ground": CLOTH}),
    "flat ground, scales": (SKIN, {"ground": CLOTH}),
    "flat ground, wheels": (ON_WHEELS, {"ground": CLOTH}),
    "flat ground, viscous": ({}, {"ground": MUD}),
    "hills, isotropic": ({}, HILLS),
    "hills, scales": (SKIN, HILLS),
    "flat ground and six rough pegs": ({}, PEGS),
    "flat ground and six rough posts on springs": ({}, POSTS),
    "hollow pipe": ({}, PIPE),
    "water": ({}, {"ground": CLOTH, "fluid": {"density_kg_m3": 1000.0, "viscosity_pa_s": 0.001}}),
}


def compare_waves() -> list[str]:
    """Return a table that compares simulated waves with their momentum balance."""
    laws: dict[str, tuple[dict[str, Any], dict[str, Any], DirectionalFriction, complex]] = {
        "isotropic": ({}, CLOTH, DirectionalFriction(FRICTION, FRICTION, FRICTION), 0j),
        "scales": (SKIN, CLOTH, HU, 0j),
        "wheels": (ON_WHEELS, CLOTH, ROLLING, 0j),
        "viscous": ({}, MUD, NO_FRICTION, MUD_S_PER_M),
    }
    rows = ["| Law | Wave | Simulator, mm/s | Momentum balance, mm/s |", "|---|---|---|---|"]
    for law, (robot, ground, coefficients, viscous) in laws.items():
        for name, wave in WAVES.items():
            ours = simulate_wave(wave, ground, robot).drift_mm_s
            balance = integrate_momentum_balance(wave, coefficients, viscous).drift_mm_s
            rows.append(f"| {law} | {name} | {ours:+.2f} | {balance:+.2f} |")
    return rows


def compare_gliding() -> list[str]:
    """Return a table that compares bodies that glide to rest with their equation of motion."""
    rows = [
        "| Surface | Thrown, m/s | Simulator, mm | Runge-Kutta, mm | Difference |",
        "|---|---|---|---|---|",
    ]
    for surface in SURFACES:
        for name, velocity in THROWS.items():
            glider = GlidingSnake(surface, SKIN)
            glider.throw(np.array(velocity))
            start = glider.position_w
            glider.go(GLIDING_S)
            moved = glider.position_w - start
            expected = glide_without_mujoco(np.array(velocity), HU, GLIDING_S)
            difference = np.linalg.norm(moved - expected) / np.linalg.norm(expected)
            rows.append(
                f"| {surface} | {name} | {_format_mm(moved)} | {_format_mm(expected)} | {100 * difference:.2f} % |"
            )
    return rows


def compare_drag() -> list[str]:
    """Return a table of the forces on bodies that are dragged at a constant speed, divided by their weight."""
    rows = ["| Surface | Forward | Backward | Sideways |", "|---|---|---|---|"]
    rows.append(f"| coefficients | {HU.forward:.4f} | {HU.backward:.4f} | {HU.sideways:.4f} |")
    for surface in SURFACES:
        cells: list[str] = []
        for direction in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)):
            glider = GlidingSnake(surface, SKIN)
            force_n = glider.drag(DRAG_M_S * np.array(direction), 0.6)
            cells.append(f"{np.linalg.norm(force_n) / (glider.mass_kg * G):.4f}")
        rows.append(f"| {surface} | {' | '.join(cells)} |")
    return rows


def compare_wheels() -> list[str]:
    """Return a table that compares wheels as bodies with wheels as friction."""
    bodies = WheeledSnake()
    glider = GlidingSnake("flat ground", ON_WHEELS)
    rolling_m_s2 = np.linalg.norm(glider.drag(np.array([0.5, 0.0]), 0.4)) / glider.mass_kg
    creep_mm_s = _measure_creep_mm_s(ON_WHEELS)
    separate_glider = GlidingSnake("flat ground", ON_SEPARATE_LIMITS)
    separate_m_s2 = (
        np.linalg.norm(separate_glider.drag(np.array([0.5, 0.0]), 0.4)) / separate_glider.mass_kg
    )
    separate_creep_mm_s = _measure_creep_mm_s(ON_SEPARATE_LIMITS)
    rows = [
        "| Quantity | Wheels as bodies | Wheels as friction | The same law in the middle of the links | "
        "`separate_limits` | Balance with separate limits | Separate limits in the middle |",
        "|---|---|---|---|---|---|---|",
        f"| deceleration of a straight snake, m/s² | {bodies.coast(0.5, 0.4):.4f} | {rolling_m_s2:.4f} | "
        f"{ROLLING_FRICTION * G:.4f} | {separate_m_s2:.4f} | {ROLLING_FRICTION * G:.4f} | {ROLLING_FRICTION * G:.4f} |",
        f"| creep sideways under 80 % of what holds, mm/s | {bodies.push_sideways(0.8 * TIRE_FRICTION, 1.0):.3f} | "
        f"{creep_mm_s:.6f} | 0 | {separate_creep_mm_s:.6f} | 0 | 0 |",
    ]
    for name, wave in WAVES.items():
        ours = simulate_wave(wave, CLOTH, ON_WHEELS).drift_mm_s
        middle = integrate_momentum_balance(wave, ROLLING, in_the_middle=True).drift_mm_s
        separate_middle = integrate_momentum_balance(
            wave, ROLLING, in_the_middle=True, separate_limits=True
        ).drift_mm_s
        with_bodies = bodies.swim(wave).drift_mm_s
        ours_separate = simulate_wave(wave, CLOTH, ON_SEPARATE_LIMITS).drift_mm_s
        separate_balance = integrate_momentum_balance(
            wave, ROLLING, separate_limits=True
        ).drift_mm_s
        rows.append(
            f"| drift of {name}, mm/s | {with_bodies:+.1f} | {ours:+.1f} | {middle:+.1f} | {ours_separate:+.1f} | "
            f"{separate_balance:+.1f} | {separate_middle:+.1f} |"
        )
    return rows


def _measure_creep_mm_s(wheels: dict[str, Any]) -> float:
    """Return the sideways speed of a body on wheels under 80 % of the force that the tires can hold."""
    creep = GlidingSnake("flat ground", wheels)
    creep.push(np.array([0.0, 0.8 * TIRE_FRICTION]))
    creep.go(0.5)
    before = creep.position_w
    creep.go(1.0)
    return 1e3 * float((creep.position_w - before)[1])


def measure_cost(round_count: int) -> list[str]:
    """Return a table of the CPU time of a physics step with each law."""
    rows = ["| Ground | C version, µs | Python version, µs |", "|---|---|---|"]
    for name, times_us in measure_medians_us(COST_CASES, round_count).items():
        rows.append(f"| {name} | {times_us['c']:.1f} | {times_us['python']:.1f} |")
    return rows


def _format_mm(vector_m: Floats) -> str:
    x, y = (1e3 * vector_m).tolist()
    return f"{x:+.1f}, {y:+.1f}"
