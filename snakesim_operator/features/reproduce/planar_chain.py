"""A chain of links in the plane whose joints follow given angles: a momentum balance without MuJoCo.

It has the masses of the links, friction at joints and ends, and constant loads. Comparing it with the simulator shows
which part of a difference from a published value comes from the body, and which from motors and contacts.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.model.robot import RobotFile
from snakesim_operator.features.reproduce.gait_motion import (
    GroundFriction,
    find_foot_loads_n,
    find_foot_tangents,
    find_friction_per_load,
)

STEP_S = 0.0005
SMOOTH_M_S = 0.004  # below this speed dry friction becomes smaller; explicit steps need it
SKIPPED_PERIODS = 3
MEASURED_PERIODS = 2


@dataclass(frozen=True)
class JointWaves:
    """Periodic angles of all joints: angle = real part of the sum over h of c_h exp(i h phase)."""

    harmonics: NDArray[np.complex128]  # (harmonics, joints), the first one is the mean
    period_s: float

    @staticmethod
    def from_serpenoid(robot: RobotFile, winding_angle_rad: float, wavelength: float, period_s: float) -> "JointWaves":
        """Return the angles of a robot on Hirose's serpenoid curve, whose wave travels from head to tail.

        Each link has the heading of the curve at its middle.

        Args:
            robot: The robot.
            winding_angle_rad: Angle between the axis of the curve and its steepest tangent.
            wavelength: Length of a wave along the body, in body lengths.
            period_s: Period of the wave.
        """
        lengths_m = np.array(robot.link_lengths_m)
        ends_m = np.cumsum(lengths_m)
        from_head = 1.0 - (ends_m - 0.5 * lengths_m) / ends_m[-1]
        headings = winding_angle_rad * np.exp(-2j * np.pi * from_head / wavelength)
        angles = np.diff(headings)
        return JointWaves(np.stack([np.zeros_like(angles), angles]), period_s)


@dataclass(frozen=True)
class ChainMotion:
    """How a chain moves, as means over whole periods."""

    speed_m_s: float  # of the center of mass, along the mean direction from tail to head
    ground_power_w: float  # work against friction per time


def find_chain_motion(robot: RobotFile, waves: JointWaves, friction: GroundFriction) -> ChainMotion:
    """Return how a chain moves that starts at rest, over the periods after SKIPPED_PERIODS.

    Args:
        robot: Lengths and masses of the links.
        waves: Angles of the joints.
        friction: Friction of the ground.
    """
    lengths_m = np.array(robot.link_lengths_m)
    masses_kg = np.array(robot.link_masses_kg)
    mass_kg = masses_kg.sum()
    radius_m = robot.module.radius_m
    inertias_kg_m2 = masses_kg * (3 * radius_m**2 + (lengths_m + 2 * radius_m) ** 2) / 12  # of cylinders with caps
    loads_n = find_foot_loads_n(masses_kg)
    orders = np.arange(len(waves.harmonics))
    turn_rate = 2 * np.pi / waves.period_s
    steps_per_period = round(waves.period_s / STEP_S)

    place = 0j  # of the tail end
    heading_rad = 0.0
    momentum = 0j
    spin_momentum = 0.0
    marks: list[complex] = []  # the center of mass at the end of each period
    axes: list[complex] = []  # the mean vector from tail to head in each period
    axis_sum = 0j
    work_j = 0.0  # against friction, in the periods that count
    for step in range((SKIPPED_PERIODS + MEASURED_PERIODS) * steps_per_period + 1):
        turns = np.exp(1j * orders * turn_rate * step * STEP_S)
        angles_rad = (turns @ waves.harmonics).real
        rates_rad_s = (1j * turn_rate * orders * turns @ waves.harmonics).real
        link_headings_rad = heading_rad + np.append(0.0, np.cumsum(angles_rad))
        link_rates_rad_s = np.append(0.0, np.cumsum(rates_rad_s))  # relative to the tail link
        links = lengths_m * np.exp(1j * link_headings_rad)
        feet = place + np.append(0.0, np.cumsum(links))
        middles = feet[:-1] + 0.5 * links
        center = complex(masses_kg @ middles / mass_kg)
        if step % steps_per_period == 0:
            marks.append(center)
            axes.append(axis_sum / steps_per_period)
            axis_sum = 0j
        axis_sum += feet[-1] - feet[0]

        # Velocities that the joints alone cause, and those of the body that give the whole its momentum.
        swings = 1j * link_rates_rad_s * links
        foot_rates = np.append(0.0, np.cumsum(swings))
        middle_rates = foot_rates[:-1] + 0.5 * swings
        arms = middles - center
        own_spin = masses_kg @ (np.conj(arms) * middle_rates).imag + inertias_kg_m2 @ link_rates_rad_s
        spin = (spin_momentum - own_spin) / (masses_kg @ np.abs(arms) ** 2 + inertias_kg_m2.sum())
        tail_velocity = (momentum - masses_kg @ middle_rates) / mass_kg - 1j * spin * (center - place)
        velocities = tail_velocity + 1j * spin * (feet - place) + foot_rates

        tangents = find_foot_tangents(links)
        forces_n = loads_n * tangents * find_friction_per_load(velocities * np.conj(tangents), friction, SMOOTH_M_S)
        if step >= SKIPPED_PERIODS * steps_per_period:
            work_j -= STEP_S * float((forces_n * np.conj(velocities)).real.sum())
        momentum += STEP_S * forces_n.sum()
        spin_momentum += STEP_S * float((np.conj(feet - center) * forces_n).imag.sum())
        place += STEP_S * tail_velocity
        heading_rad += STEP_S * float(spin)

    speeds: list[float] = []
    for k in range(SKIPPED_PERIODS, SKIPPED_PERIODS + MEASURED_PERIODS):
        way = marks[k + 1] - marks[k]
        axis = axes[k + 1]
        speeds.append((way * axis.conjugate()).real / abs(axis) / waves.period_s)
    return ChainMotion(float(np.mean(speeds)), work_j / (MEASURED_PERIODS * waves.period_s))
