"""Simulates a straight, stiff snake that glides over level ground, with MuJoCo and with an integrator of its own."""

import math
from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene_file.friction import DirectionalFriction
from snakesim_hal.wire.quantities import Vector
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.sim.simulator_rig import G, make_config, make_resting_body, merge_tables

FRICTION = 0.19
HEIGHT_M = 0.1  # of a step, and of an obstacle with a flat top
FAR_M = 10.0  # from where the snake is built: no scene may have an obstacle under it
STIFF_NM_PER_RAD = 200.0
ROLL_AND_YAW_DOFS = [3, 5]
LOCKED_KG_M2 = 1e4  # inertia about these axes, so that the round body does not roll or turn
TOLERANCE_M_S = 1e-9
LEVEL_GRAVITY: Vector = (0.0, 0.0, -G)

LEVEL_HILLS = {"height_m": 1e-5, "wavelength_m": 0.8, "area_m": 40.0}
SURFACES: dict[str, dict[str, Any]] = {
    "flat ground": {"ground": {"friction": FRICTION}},
    "level hills": {"ground": {"friction": FRICTION, "heightfield": LEVEL_HILLS}},
    "step": {
        "ground": {"friction": 0.9},
        "step": [
            {
                "position_m": [FAR_M, 0.0],
                "size_m": [16.0, 16.0],
                "height_m": HEIGHT_M,
                "friction": FRICTION,
            }
        ],
    },
    "top of an obstacle": {
        "ground": {"friction": 0.9},
        "box": [
            {"position_m": [FAR_M, 0.0], "size_m": [16.0, 16.0, HEIGHT_M], "friction": FRICTION}
        ],
    },
}


class GlidingSnake:
    """A straight snake of 8 modules at rest on one of `SURFACES`, which does not bend, roll or turn."""

    def __init__(
        self,
        surface: str,
        robot: dict[str, Any],
        step_s: float = 0.002,
        slope: dict[str, float] | None = None,
    ) -> None:
        scene = merge_tables(SURFACES[surface], {"ground": slope or {}})
        config = make_config({"chain": {"modules": 8}} | robot, scene)
        self.sim, self.data, self.physics = make_resting_body(
            config, SimSettings(timestep_s=step_s)
        )
        self.model = self.sim.model
        first = self.sim.first_link_body
        links = len(self.sim.link_geoms)
        self._masses_kg = self.model.body_mass[first : first + links]
        self._forces_w = self.data.xfrc_applied[first : first + links]
        self.mass_kg = float(self._masses_kg.sum())
        self.model.jnt_stiffness[1:] = STIFF_NM_PER_RAD
        self.model.dof_damping[6:] = 1.0
        self.model.dof_armature[ROLL_AND_YAW_DOFS] = LOCKED_KG_M2
        if surface in ("step", "top of an obstacle"):
            self.data.qpos[0] = FAR_M
            self.data.qpos[2] += HEIGHT_M
        self.physics.reset()
        self.go(0.6)

    @property
    def position_w(self) -> Floats:
        """Return the position of the center of mass, (2,) in m."""
        return self.data.subtree_com[self.sim.first_link_body, :2].copy()

    def go(self, time_s: float) -> None:
        """Run the simulation for a time."""
        self.physics.step(round(time_s / self.model.opt.timestep))

    def throw(self, velocity_w: Floats) -> None:
        """Give the body a velocity, in m/s."""
        self.data.qvel[:2] = velocity_w

    def push(self, force_per_weight: Floats) -> None:
        """Apply a force to every link in proportion to its weight."""
        self._forces_w[:, :2] = G * self._masses_kg[:, None] * force_per_weight

    def drag(self, velocity_w: Floats, time_s: float) -> Floats:
        """Drag the body at a constant velocity, and return the mean force on it in the second half, (2,) in N."""
        step_s = self.model.opt.timestep
        forces_n: list[Floats] = []
        # Of the velocity in one step; the body moves with the velocity after it.
        change = np.zeros(2)
        for _ in range(round(time_s / step_s)):
            before = velocity_w - change
            self.throw(before)
            self.physics.step(1)
            change = self.data.qvel[:2] - before
            forces_n.append(-self.mass_kg * change / step_s)
        return np.mean(forces_n[len(forces_n) // 2 :], axis=0)


def glide_without_mujoco(
    velocity_m_s: Floats,
    coefficients: DirectionalFriction,
    duration_s: float,
    step_s: float = 1e-4,
    gravity_w: Vector = LEVEL_GRAVITY,
) -> Floats:
    """Integrate the motion of a body that glides over ground without turning, until it stops.

    On a slope on which friction does not hold it, it does not stop.

    The integrator is the classical Runge-Kutta method.

    Args:
        velocity_m_s: (2,) velocity at the start, along the body and across it.
        coefficients: Coefficients of friction, by the direction of sliding.
        duration_s: Maximum time to integrate.
        step_s: Step of the integrator.
        gravity_w: Acceleration of gravity along the body, across it, and normal to the ground, m/s².

    Returns:
        (2,) displacement along the body and across it, m.
    """
    displacement_m = np.zeros(2)
    velocity_m_s = np.array(velocity_m_s, dtype=np.float64)
    along_ground_m_s2 = np.array(gravity_w[:2])
    normal_m_s2 = -gravity_w[2]
    is_held = np.linalg.norm(along_ground_m_s2) < normal_m_s2 * min(coefficients)

    def accelerate(velocity_m_s: Floats) -> Floats:
        return along_ground_m_s2 + normal_m_s2 * _compute_friction_per_weight(
            velocity_m_s, coefficients
        )

    for _ in range(round(duration_s / step_s)):
        if (
            is_held
            and np.linalg.norm(velocity_m_s) < 2.0 * normal_m_s2 * max(coefficients) * step_s
        ):
            break
        first = accelerate(velocity_m_s)
        second = accelerate(velocity_m_s + 0.5 * step_s * first)
        third = accelerate(velocity_m_s + 0.5 * step_s * second)
        fourth = accelerate(velocity_m_s + step_s * third)
        velocity_change_m_s = step_s / 6.0 * (first + 2.0 * second + 2.0 * third + fourth)
        displacement_m += step_s * (velocity_m_s + 0.5 * velocity_change_m_s)
        velocity_m_s += velocity_change_m_s
    return displacement_m


def make_tilted_gravity(slope_rad: float, towards_rad: float) -> Vector:
    """Return the acceleration of gravity along a body that lies along x, across it, and normal to sloping ground."""
    along_ground_m_s2 = G * math.sin(slope_rad)
    return (
        along_ground_m_s2 * math.cos(towards_rad),
        along_ground_m_s2 * math.sin(towards_rad),
        -G * math.cos(slope_rad),
    )


def _compute_friction_per_weight(velocity_m_s: Floats, coefficients: DirectionalFriction) -> Floats:
    """Return the friction over the normal force, along the body and across it, (2,)."""
    longitudinal_coefficient = (
        coefficients.forward if velocity_m_s[0] > 0 else coefficients.backward
    )
    return (
        -np.array([longitudinal_coefficient, coefficients.sideways])
        * velocity_m_s
        / max(float(np.linalg.norm(velocity_m_s)), TOLERANCE_M_S)
    )
