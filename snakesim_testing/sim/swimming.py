"""Simulates a snake that swims in MuJoCo's fluid, with MuJoCo and with the formulas of its documentation.

Source: MuJoCo's documentation, Computation, Fluid forces, Ellipsoid model. Like MuJoCo, the formulas here leave out the
forces of added mass that are in proportion to acceleration. The largest area of an ellipsoid is pi r_max r_mid.
"""

from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.links import compute_capsule_inertia
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scene_file.fluid import Fluid
from snakesim_sim_backend.laws.chain import FREE_DOFS
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.sim.simulator_rig import make_config, make_resting_body
from snakesim_testing.sim.waves import (
    BALANCE_STEP_S,
    PERIODS,
    BodyTrack,
    JointWave,
    follow_wave,
)

HEIGHT_M = 5.0  # above the ground
STIFF_NM_PER_RAD = 200.0
LOCKED_KG_M2 = 1e6  # inertia about all axes, so that a straight body does not turn
MIN_SPEED = 1e-12  # m/s and rad/s, avoids 0 / 0
QUADRATURE_POINTS = 400
WATER: dict[str, Any] = {"density_kg_m3": 1000.0, "viscosity_pa_s": 0.001}
HONEY: dict[str, Any] = {"density_kg_m3": 1400.0, "viscosity_pa_s": 10.0}


class Ellipsoids:
    """The links of a snake as ellipsoids with their long axes along x, in a fluid.

    Vectors, (links, 3), are in the frames of the links, x along the link and z up.
    """

    def __init__(self, robot: RobotFile, fluid: Fluid) -> None:
        """Give each ellipsoid the length and radius of the link's capsule."""
        radius_m = robot.module.radius_m
        half_lengths_m = np.array(robot.link_lengths_m) / 2 + radius_m
        radii = np.column_stack([half_lengths_m, np.full((len(half_lengths_m), 2), radius_m)])
        self.fluid = fluid
        self.radii_m = radii
        self.sphere_radius_m = radii.mean(axis=1, keepdims=True)
        self.volume_m3 = 4.0 / 3.0 * np.pi * radii.prod(axis=1, keepdims=True)
        self.largest_m2 = np.pi * half_lengths_m[:, None] * radius_m
        # Moments of the bodies that the rotating ellipsoids sweep.
        others_m = np.column_stack(
            [np.full_like(half_lengths_m, radius_m), half_lengths_m, half_lengths_m]
        )
        moments = 8 * np.pi / 15 * radii * others_m**4
        self.swept = fluid.angular_drag * moments
        self.swept += fluid.slender_drag * (moments.max(axis=1, keepdims=True) - moments)
        self.added_kg, self.added_kg_m2 = self._find_added_inertia()

    def find_projected_areas_m2(self, velocities: Floats) -> Floats:
        """Return the areas of the ellipsoids as seen along their velocities, (links, 1)."""
        products = self.radii_m.prod(axis=1, keepdims=True) / self.radii_m  # r_j r_k
        numerator = np.sum(products**4 * velocities**2, axis=1, keepdims=True)
        denominator = np.sum(products**2 * velocities**2, axis=1, keepdims=True)
        return np.pi * np.sqrt(numerator / np.maximum(denominator, MIN_SPEED**2))

    def compute_forces(self, velocities: Floats, rates: Floats) -> tuple[Floats, Floats]:
        """Return the forces in N and the torques about the middles in N·m, (links, 3) each.

        Args:
            velocities: (links, 3), m/s.
            rates: (links, 3), angular velocities in rad/s.
        """
        fluid = self.fluid
        density = fluid.density_kg_m3
        speeds = np.linalg.norm(velocities, axis=1, keepdims=True)
        projected_m2 = self.find_projected_areas_m2(velocities)

        # Drag and viscous resistance.
        drag_m2 = fluid.blunt_drag * projected_m2 + fluid.slender_drag * (
            self.largest_m2 - projected_m2
        )
        resistance = (
            density * drag_m2 * speeds + 6 * np.pi * self.sphere_radius_m * fluid.viscosity_pa_s
        )
        forces = -resistance * velocities
        turning = density * np.linalg.norm(self.swept * rates, axis=1, keepdims=True)
        turning += 8 * np.pi * self.sphere_radius_m**3 * fluid.viscosity_pa_s
        torques = -turning * rates

        # Lift.
        forces += fluid.magnus_lift * density * self.volume_m3 * np.cross(rates, velocities)
        normals = velocities / self.radii_m**2
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), MIN_SPEED)
        cosines = np.sum(normals * velocities, axis=1, keepdims=True) / np.maximum(
            speeds, MIN_SPEED
        )
        circulations = (
            fluid.kutta_lift * density * projected_m2 * cosines * np.cross(normals, velocities)
        )
        forces += np.cross(circulations, velocities)

        # Added mass, without the parts in proportion to acceleration.
        momenta = self.added_kg * velocities
        forces += np.cross(momenta, rates)
        torques += np.cross(momenta, velocities) + np.cross(self.added_kg_m2 * rates, rates)
        return forces, torques

    def _find_added_inertia(self) -> tuple[Floats, Floats]:
        """Return added masses in kg and added moments of inertia in kg·m², (links, 3) each."""
        radii = self.radii_m
        nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE_POINTS)
        place = 0.5 * (nodes + 1.0)
        # The integral over lambda from 0 to infinity, with lambda = (r_max s / (1 - s))^2.
        ratio = place / (1.0 - place)
        squares = radii.max(axis=1, keepdims=True) ** 2
        lambdas = squares * ratio**2
        change = squares * (ratio / (1.0 - place) ** 2 * weights)
        factors = radii[:, :, None] ** 2 + lambdas[:, None, :]  # (links, 3, points)
        root = np.sqrt(factors.prod(axis=1))
        kappa = radii.prod(axis=1, keepdims=True) * np.sum(
            change[:, None] / (factors * root[:, None]), axis=2
        )
        displaced_kg = self.fluid.density_kg_m3 * self.volume_m3
        added_kg = displaced_kg * kappa / (2.0 - kappa)
        # About y and z, the added moments are equal, and about the long axis the fluid does not move.
        difference = radii[:, 1:2] ** 2 - radii[:, 0:1] ** 2
        total = radii[:, 1:2] ** 2 + radii[:, 0:1] ** 2
        kappa_difference = kappa[:, 0:1] - kappa[:, 1:2]
        moments = (
            displaced_kg
            / 5
            * difference**2
            * kappa_difference
            / (2 * difference - total * kappa_difference)
        )
        return added_kg, np.column_stack([np.zeros_like(moments), moments, moments])


class Swimmer:
    """A straight, stiff snake of 8 modules in a fluid, high above the ground. It does not turn."""

    def __init__(self, fluid: dict[str, Any], step_s: float = 0.002) -> None:
        config = make_config({"chain": {"modules": 8}}, {"fluid": fluid})
        assert config.scene.fluid is not None
        self.sim, self.data, self.physics = make_resting_body(
            config, SimSettings(timestep_s=step_s)
        )
        self.model = self.sim.model
        self.mass_kg = float(self.model.body_mass[self.sim.first_link_body :].sum())
        self.ellipsoids = Ellipsoids(config.robot, config.scene.fluid)
        self.model.jnt_stiffness[1:] = STIFF_NM_PER_RAD
        self.model.dof_damping[FREE_DOFS:] = 1.0
        self.model.dof_armature[3:FREE_DOFS] = LOCKED_KG_M2
        self.data.qpos[2] = HEIGHT_M
        self.physics.reset()

    def measure_force_n(self, velocity_m_s: Floats) -> Floats:
        """Return the force of the fluid on the moving body, (3,) in N, at this velocity."""
        self.data.qvel[:3] = velocity_m_s
        self.physics.forward()
        return self.data.qfrc_fluid[:3].copy()

    def compute_force_n(self, velocity_m_s: Floats) -> Floats:
        """Return this force from the formulas, without MuJoCo."""
        links = len(self.ellipsoids.radii_m)
        forces_n, _ = self.ellipsoids.compute_forces(
            np.tile(velocity_m_s, (links, 1)), np.zeros((links, 3))
        )
        return forces_n.sum(axis=0)

    def glide(self, velocity_m_s: Floats, time_s: float) -> Floats:
        """Start the body with a velocity, and return how far it moves, (3,) in m."""
        self.data.qvel[:3] = velocity_m_s
        before_m = self.data.qpos[:3].copy()
        self.physics.step(round(time_s / self.model.opt.timestep))
        return self.data.qpos[:3] - before_m

    def glide_without_mujoco(
        self, velocity_m_s: Floats, time_s: float, step_s: float = 2e-3
    ) -> Floats:
        """Return this distance from the formulas, integrated by the classical Runge-Kutta method."""
        displacement_m = np.zeros(3)
        for _ in range(round(time_s / step_s)):
            first = self.compute_force_n(velocity_m_s) / self.mass_kg
            second = self.compute_force_n(velocity_m_s + 0.5 * step_s * first) / self.mass_kg
            third = self.compute_force_n(velocity_m_s + 0.5 * step_s * second) / self.mass_kg
            fourth = self.compute_force_n(velocity_m_s + step_s * third) / self.mass_kg
            displacement_m += step_s * (velocity_m_s + step_s / 6.0 * (first + second + third))
            velocity_m_s = velocity_m_s + step_s / 6.0 * (
                first + 2.0 * second + 2.0 * third + fourth
            )
        return displacement_m


def swim_wave(
    wave: JointWave, fluid: dict[str, Any], step_s: float = 0.002, stiffness: float = 1.0
) -> BodyTrack:
    """Simulate `planar13` in a fluid, with joints that follow a wave by stiff servos.

    Args:
        wave: Joint angles as a function of time.
        fluid: Section `[fluid]` of the scene.
        step_s: Physics step.
        stiffness: Stiffness and damping of the servos, in those of waves on the ground.

    Returns:
        The motion of the body over PERIODS periods of the wave.
    """
    config = make_config(scene={"fluid": fluid})
    sim, data, physics = make_resting_body(config, SimSettings(timestep_s=step_s))
    data.qpos[2] = HEIGHT_M
    return follow_wave(sim, data, physics, wave, stiffness)


def swim_without_mujoco(
    wave: JointWave, fluid: dict[str, Any], step_s: float = BALANCE_STEP_S
) -> BodyTrack:
    """Compute the motion of `swim_wave` without MuJoCo, by a momentum balance of links in the plane.

    Points and vectors in the plane are complex numbers x + iy. The joint angles are prescribed by the wave. They and
    the momenta of the body determine its motion; the forces of the fluid change the momenta.

    Args:
        wave: Joint angles as a function of time.
        fluid: Section `[fluid]` of the scene.
        step_s: Step of the explicit Euler method.

    Returns:
        The motion of the body over PERIODS periods of the wave.
    """
    config = make_config(scene={"fluid": fluid})
    assert config.scene.fluid is not None
    robot = config.robot
    lengths_m = np.array(robot.link_lengths_m)
    masses_kg = np.array(robot.link_masses_kg)
    inertias_kg_m2 = np.array(
        [
            compute_capsule_inertia(length_m, robot.module.radius_m, mass_kg)[2]
            for length_m, mass_kg in zip(lengths_m, masses_kg, strict=True)
        ]
    )
    ellipsoids = Ellipsoids(robot, config.scene.fluid)
    zeros = np.zeros_like(lengths_m)
    count = len(lengths_m) - 1
    step_count = int(PERIODS * wave.period_s / step_s) + 1
    center_m = np.empty((step_count, 2))
    axis_m = np.empty((step_count, 2))
    # Pose of the tail link, linear momentum in kg·m/s, and angular momentum about the center of mass in kg·m²/s.
    tail = 0j
    heading_rad = 0.0
    momentum = 0j
    spin = 0.0
    for k in range(step_count):
        time_s = k * step_s
        # The pose of every link, and the body's center of mass.
        headings = heading_rad + np.append(0.0, np.cumsum(wave.at(time_s, count)))
        relative_rates = np.append(0.0, np.cumsum(wave.rates_at(time_s, count)))
        tangents = np.exp(1j * headings)
        ends = tail + np.append(0.0, np.cumsum(lengths_m * tangents))
        middles = 0.5 * (ends[:-1] + ends[1:])
        center = complex(masses_kg @ middles / masses_kg.sum())

        # The motion of the joints alone, and then the motion of the tail that gives the body its momenta.
        end_rates = np.append(0.0, np.cumsum(1j * relative_rates * lengths_m * tangents))
        middle_rates = 0.5 * (end_rates[:-1] + end_rates[1:])
        arms = middles - center
        joint_spin = (
            masses_kg @ (np.conj(arms) * middle_rates).imag + inertias_kg_m2 @ relative_rates
        )
        inertia_kg_m2 = masses_kg @ np.abs(arms) ** 2 + inertias_kg_m2.sum()
        yaw_rate = float((spin - joint_spin) / inertia_kg_m2)  # of the tail link
        center_velocity = (momentum - masses_kg @ middle_rates) / masses_kg.sum()
        tail_velocity = center_velocity - 1j * yaw_rate * (center - tail)
        velocities = tail_velocity + 1j * yaw_rate * (middles - tail) + middle_rates
        rates = yaw_rate + relative_rates

        # The forces of the fluid, from the velocities in the frames of the links, change the momenta.
        local = velocities * np.conj(tangents)
        forces, torques = ellipsoids.compute_forces(
            np.column_stack([local.real, local.imag, zeros]), np.column_stack([zeros, zeros, rates])
        )
        forces_w = (forces[:, 0] + 1j * forces[:, 1]) * tangents
        momentum += step_s * complex(forces_w.sum())
        spin += step_s * float((np.conj(arms) * forces_w).imag.sum() + torques[:, 2].sum())

        # Record this pose, and advance it by the step.
        center_m[k] = center.real, center.imag
        axis = ends[-1] - ends[0]
        axis_m[k] = axis.real, axis.imag
        tail += step_s * tail_velocity
        heading_rad += step_s * yaw_rate
    return BodyTrack(center_m, axis_m, step_s, wave.period_s)
