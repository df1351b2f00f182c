"""A body of endless length on a serpenoid curve, without inertia: forces are in balance at any time.

The body moves along its curve at the speed V of the wave, while the curve as a whole slips backward at the speed w.
With the angle theta between the tangent and the axis of the curve, a point of the body has the velocity

    V - w cos theta    along the body
    w sin theta        across it

The body travels at V <cos theta> - w, where <> is the mean over a wave. The slip w follows from the balance of the
friction along the axis. On average there is no force across the axis.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.reproduce.gait_motion import (
    MIN_SLIP_M_S,
    GroundFriction,
    find_friction_per_load,
)

PHASES = np.linspace(0.0, 2 * np.pi, 720, endpoint=False)
BISECTIONS = 60


@dataclass(frozen=True)
class EndlessMotion:
    """How an endless body moves. Speeds are fractions of the speed of the wave along the body."""

    speed: float
    slip: float
    cost: float  # work of friction over load, distance and the forward coefficient; NaN without dry friction


def find_axis_ratio(winding_angle_rad: float) -> float:
    """Return the length of a serpenoid curve along its axis over that along the body: the Bessel function J0."""
    return float(np.mean(np.cos(winding_angle_rad * np.cos(PHASES))))


def find_endless_motion(
    winding_angle_rad: float, friction: GroundFriction, wave_m_s: float = 1.0
) -> EndlessMotion:
    """Return how an endless body moves.

    Args:
        winding_angle_rad: Angle between the axis of the curve and its steepest tangent.
        friction: Friction of the ground.
        wave_m_s: Speed of the wave along the body, which matters if dry and viscous friction act together.
    """
    angles_rad = winding_angle_rad * np.cos(PHASES)
    low = 0.0
    high = 1.0
    for _ in range(BISECTIONS):
        slip = 0.5 * (low + high)
        if _find_force(slip, angles_rad, friction, wave_m_s) < 0.0:
            low = slip
        else:
            high = slip
    slip = 0.5 * (low + high)
    speed = float(np.mean(np.cos(angles_rad))) - slip
    velocities = _find_slips(slip, angles_rad, wave_m_s)
    forces = find_friction_per_load(velocities, friction, MIN_SLIP_M_S)
    power = float(np.mean(-(forces * np.conj(velocities)).real))
    forward = friction.dry.forward
    cost = power / (forward * speed * wave_m_s) if forward > 0.0 else float("nan")
    return EndlessMotion(speed, slip, cost)


def _find_slips(slip: float, angles_rad: Floats, wave_m_s: float) -> NDArray[np.complex128]:
    """Return the velocities of the body along itself in m/s, and as imaginary part across."""
    along = 1.0 - slip * np.cos(angles_rad)
    across = slip * np.sin(angles_rad)
    return (wave_m_s * (along + 1j * across)).astype(np.complex128)


def _find_force(
    slip: float, angles_rad: Floats, friction: GroundFriction, wave_m_s: float
) -> float:
    """Return the mean force of friction along the axis of the curve, divided by the load."""
    forces = find_friction_per_load(_find_slips(slip, angles_rad, wave_m_s), friction, MIN_SLIP_M_S)
    # The axis has the direction (cos theta, -sin theta) along the body and across it.
    return float(np.mean(forces.real * np.cos(angles_rad) - forces.imag * np.sin(angles_rad)))
