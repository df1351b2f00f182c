"""A chain of links in the plane whose joints follow given angles: a momentum balance without MuJoCo.

It has the masses of the links, friction at joints and ends, and constant loads. Comparing it with the simulator shows
which part of a difference from a published value comes from the body, and which from motors and contacts.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scene_file.solids import GRAVITY_M_S2
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

FrictionLaw = Callable[[NDArray[np.complex128]], NDArray[np.complex128]]


@dataclass(frozen=True)
class JointWaves:
    """Periodic angles of all joints: angle = real part of the sum over h of c_h exp(i h phase)."""

    harmonics: NDArray[np.complex128]  # (harmonics, joints), the first one is the mean
    period_s: float

    @staticmethod
    def from_serpenoid(
        robot: RobotFile, winding_angle_rad: float, wavelength: float, period_s: float
    ) -> "JointWaves":
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
class ChainInstant:
    """A chain at one time. Vectors in the plane are complex numbers."""

    center: complex  # center of mass, m
    axis: complex  # from the end of the tail to the end of the head, m
    friction_power_w: float  # work against friction per time


class PlanarChain:
    """Links in the plane whose joints have prescribed angles and velocities, on ground with friction.

    The body starts at rest, with the end of its tail at the origin and its last link along x. Its momentum and its
    angular momentum change by friction alone. In each step, the velocity and the yaw rate of the whole body are those
    that give it these momenta, together with the motion of its joints.
    """

    def __init__(self, robot: RobotFile, *, has_middle_contacts: bool = False) -> None:
        """Place a chain at rest.

        Args:
            robot: Lengths and masses of the links.
            has_middle_contacts: If True, each link touches the ground in its middle, as with a pair of wheels there.
                If False, the contacts are at the joints and at both ends of the body.
        """
        self._lengths_m: Floats = np.array(robot.link_lengths_m)
        self._masses_kg: Floats = np.array(robot.link_masses_kg)
        self._mass_kg = float(self._masses_kg.sum())
        radius_m = robot.module.radius_m
        # As of cylinders with caps, about their middles.
        self._inertias_kg_m2 = (
            self._masses_kg * (3 * radius_m**2 + (self._lengths_m + 2 * radius_m) ** 2) / 12
        )
        self._has_middle_contacts = has_middle_contacts
        if has_middle_contacts:
            self._loads_n = GRAVITY_M_S2 * self._masses_kg
        else:
            self._loads_n = find_foot_loads_n(self._masses_kg)

        # State.
        self._tail_end = 0j
        self._tail_heading_rad = 0.0
        self._momentum = 0j
        self._angular_momentum = 0.0

    def advance(
        self, angles_rad: Floats, rates_rad_s: Floats, find_friction: FrictionLaw, step_s: float
    ) -> ChainInstant:
        """Make an explicit step.

        Args:
            angles_rad: Joint angles at the start of the step, tail to head.
            rates_rad_s: Joint velocities at the start of the step.
            find_friction: Returns the friction over the load of contacts, from their slips: real parts along the body,
                imaginary parts across it.
            step_s: Duration of the step.

        Returns:
            The chain at the start of the step.
        """
        masses_kg = self._masses_kg
        # The pose: heading and yaw rate relative to the tail link for each link, and its vector from rear to front end.
        headings_rad = self._tail_heading_rad + np.append(0.0, np.cumsum(angles_rad))
        relative_rates_rad_s = np.append(0.0, np.cumsum(rates_rad_s))
        links = (self._lengths_m * np.exp(1j * headings_rad)).astype(np.complex128)
        # Both ends of the body, and the joints.
        ends = self._tail_end + np.append(0.0, np.cumsum(links))
        middles = ends[:-1] + 0.5 * links
        center = complex(masses_kg @ middles / self._mass_kg)

        # Velocities that the joints alone cause while the tail link is stationary.
        link_end_rates = 1j * relative_rates_rad_s * links
        end_rates = np.append(0.0, np.cumsum(link_end_rates))
        middle_rates = end_rates[:-1] + 0.5 * link_end_rates

        # The velocity of the tail end and the yaw rate that give the whole body its momenta.
        arms = middles - center
        joint_part = (
            masses_kg @ (np.conj(arms) * middle_rates).imag
            + self._inertias_kg_m2 @ relative_rates_rad_s
        )
        inertia_kg_m2 = masses_kg @ np.abs(arms) ** 2 + self._inertias_kg_m2.sum()
        yaw_rate_rad_s = float((self._angular_momentum - joint_part) / inertia_kg_m2)
        center_velocity = (self._momentum - masses_kg @ middle_rates) / self._mass_kg
        tail_velocity = center_velocity - 1j * yaw_rate_rad_s * (center - self._tail_end)

        # Where the body touches the ground, with the velocities there, and the friction in the world.
        if self._has_middle_contacts:
            contacts = middles
            contact_rates = middle_rates
            tangents = links / np.abs(links)
        else:
            contacts = ends
            contact_rates = end_rates
            tangents = find_foot_tangents(links)
        velocities = (
            tail_velocity + 1j * yaw_rate_rad_s * (contacts - self._tail_end) + contact_rates
        )
        forces_n = (
            self._loads_n
            * tangents
            * find_friction((velocities * np.conj(tangents)).astype(np.complex128))
        )

        # The explicit step of the state.
        self._momentum += step_s * forces_n.sum()
        self._angular_momentum += step_s * float((np.conj(contacts - center) * forces_n).imag.sum())
        self._tail_end += step_s * tail_velocity
        self._tail_heading_rad += step_s * yaw_rate_rad_s
        friction_power_w = -float((forces_n * np.conj(velocities)).real.sum())
        return ChainInstant(center, complex(ends[-1] - ends[0]), friction_power_w)


@dataclass(frozen=True)
class ChainMotion:
    """How a chain moves, as means over whole periods."""

    speed_m_s: float  # of the center of mass, along the mean direction from tail to head
    ground_power_w: float  # work against friction per time


def find_chain_motion(
    robot: RobotFile, waves: JointWaves, friction: GroundFriction, step_s: float = STEP_S
) -> ChainMotion:
    """Return how a chain moves that starts at rest, over the periods after SKIPPED_PERIODS.

    Args:
        robot: Lengths and masses of the links.
        waves: Angles of the joints.
        friction: Friction of the ground.
        step_s: Duration of the explicit steps. Longer ones are stable on ground without dry friction.
    """
    chain = PlanarChain(robot)
    orders = np.arange(len(waves.harmonics))
    phase_rate = 2 * np.pi / waves.period_s
    steps_per_period = round(waves.period_s / step_s)

    def find_friction(slips: NDArray[np.complex128]) -> NDArray[np.complex128]:
        return find_friction_per_load(slips, friction, SMOOTH_M_S)

    instants: list[ChainInstant] = []
    for step in range((SKIPPED_PERIODS + MEASURED_PERIODS) * steps_per_period + 1):
        waves_now = np.exp(1j * orders * phase_rate * step * step_s)
        angles_rad = (waves_now @ waves.harmonics).real
        rates_rad_s = (1j * phase_rate * orders * waves_now @ waves.harmonics).real
        instants.append(chain.advance(angles_rad, rates_rad_s, find_friction, step_s))

    speeds_m_s: list[float] = []
    for period in range(SKIPPED_PERIODS, SKIPPED_PERIODS + MEASURED_PERIODS):
        first = period * steps_per_period
        last = first + steps_per_period
        displacement = instants[last].center - instants[first].center
        axis = sum(instant.axis for instant in instants[first:last])
        speeds_m_s.append((displacement * axis.conjugate()).real / abs(axis) / waves.period_s)
    measured = instants[SKIPPED_PERIODS * steps_per_period :]
    work_j = step_s * sum(instant.friction_power_w for instant in measured)
    return ChainMotion(float(np.mean(speeds_m_s)), work_j / (MEASURED_PERIODS * waves.period_s))
