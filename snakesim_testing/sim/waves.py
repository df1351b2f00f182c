"""Snakes whose joints follow a wave on flat ground: in the simulator, and by a momentum balance without MuJoCo."""

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.friction import DirectionalFriction
from snakesim_sim_backend.model.build import FREE_DOFS, FREE_QPOS, build
from snakesim_sim_backend.physics import Physics
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.sim.simulator_rig import G, make_config

SERVO_NM_PER_RAD = 300.0
SERVO_NM_S_PER_RAD = 10.0
PERIODS = 6
SKIPPED_PERIODS = 2  # at the start
SMOOTH_M_S = 0.002  # slower slip than that rubs less in the momentum balance
BALANCE_STEP_S = 0.0005


@dataclass(frozen=True)
class Wave:
    """Joint angles amplitude * sin(rate t + phase i) + bend, with i counted from the middle of the body."""

    amplitude: float = 0.5  # rad
    phase: float = 0.9  # rad
    rate: float = float(np.pi)  # rad/s
    bend: float = 0.0  # rad

    def at(self, time_s: float, count: int) -> Floats:
        """Return the angles of all joints in rad, (count,)."""
        places = np.arange(count) - 0.5 * (count - 1)
        return self.amplitude * np.sin(self.rate * time_s + self.phase * places) + self.bend

    def rates_at(self, time_s: float, count: int) -> Floats:
        """Return the velocities of all joints in rad/s, (count,)."""
        places = np.arange(count) - 0.5 * (count - 1)
        return self.amplitude * self.rate * np.cos(self.rate * time_s + self.phase * places)

    @property
    def reversed(self) -> "Wave":
        """Return the wave of a body whose head and tail are exchanged."""
        return Wave(self.amplitude, -self.phase, self.rate, self.bend)

    @property
    def period_s(self) -> float:
        """Return the period."""
        return 2 * np.pi / self.rate


@dataclass(frozen=True)
class Track:
    """Center of mass and vector from tail to head at the end of every step, (steps, 2) in m."""

    center: Floats
    axis: Floats
    step_s: float
    period_s: float

    @property
    def drift_mm_s(self) -> float:
        """Return the mean speed of the center along the mean axis of each period."""
        steps = round(self.period_s / self.step_s)
        found: list[float] = []
        for k in range(SKIPPED_PERIODS, PERIODS - 1):
            axis = self.axis[k * steps : (k + 1) * steps].mean(axis=0)
            way = self.center[(k + 1) * steps] - self.center[k * steps]
            found.append(float(way @ axis / np.linalg.norm(axis)) / self.period_s * 1e3)
        return float(np.mean(found))


def swim(
    wave: Wave,
    ground: dict[str, Any],
    robot: dict[str, Any] | None = None,
    *,
    step_s: float = 0.002,
    yaw_rad: float = 0.0,
) -> Track:
    """Simulate `planar13` on flat ground, with joints that are held to a wave by stiff servos.

    Args:
        wave: the wave.
        ground: the section `[ground]` of the scene.
        robot: what differs from `planar13`.
        step_s: physics step.
        yaw_rad: heading at the start.
    """
    config = make_config(robot, {"ground": ground})
    sim = build(config, SimSettings(timestep_s=step_s), motors=False)
    model, data = sim.model, mujoco.MjData(sim.model)
    assert sim.feet is not None
    count = model.nv - FREE_DOFS
    model.dof_damping[FREE_DOFS:], model.dof_frictionloss[FREE_DOFS:] = SERVO_NM_S_PER_RAD, 0.0
    data.qpos[2] = config.robot.module.radius_m
    data.qpos[3], data.qpos[6] = np.cos(yaw_rad / 2), np.sin(yaw_rad / 2)
    data.qpos[FREE_QPOS:] = wave.at(0.0, count)
    physics = Physics(sim, data)
    physics.begin()
    step_s = model.opt.timestep
    tail, head = sim.feet.geoms[[0, -1]]
    steps = int(PERIODS * wave.period_s / step_s) + 1
    center, axis = np.empty((steps, 2)), np.empty((steps, 2))
    for k in range(steps):
        after_s = (k + 1) * step_s
        wanted = SERVO_NM_PER_RAD * (wave.at(after_s, count) - data.qpos[FREE_QPOS:])
        data.qfrc_applied[FREE_DOFS:] = wanted + SERVO_NM_S_PER_RAD * wave.rates_at(after_s, count)
        physics.step(1)
        center[k] = data.subtree_com[0, :2]
        axis[k] = (data.geom_xpos[head] - data.geom_xpos[tail])[:2]
    return Track(center, axis, step_s, wave.period_s)


def momentum_balance(
    wave: Wave,
    coefficients: DirectionalFriction,
    viscous_s_per_m: complex = 0.0,
    step_s: float = BALANCE_STEP_S,
    *,
    in_the_middle: bool = False,
    separate_limits: bool = False,
) -> Track:
    """Compute the same without MuJoCo: links of prescribed angles in the plane, friction at the feet, momentum.

    Angles are about +z, tail first. Each link has its middle, mass and inertia. Every foot has half of the weight of
    both of its links, and their mean direction. Friction is smoothed below 2 mm/s.

    Args:
        wave: the wave.
        coefficients: of dry friction, by the direction of sliding.
        viscous_s_per_m: along the link, and as imaginary part across it.
        step_s: of the integrator.
        in_the_middle: each link rubs in its middle, as with wheels there, and not at its ends.
        separate_limits: friction along the link and across it do not limit each other, as with wheels that roll.
    """
    robot = make_config().robot
    lengths, masses = np.array(robot.link_lengths_m), np.array(robot.link_masses_kg)
    ends = lengths + 2 * robot.module.radius_m
    turning_kg_m2 = masses * (3 * robot.module.radius_m**2 + ends**2) / 12  # as of a cylinder, about its middle
    loads_n = 0.5 * G * (np.append(masses, 0.0) + np.append(0.0, masses))
    count = len(lengths) - 1
    pose, momentum = np.zeros(3), np.zeros(3)
    steps = int(PERIODS * wave.period_s / step_s) + 1
    center, axis = np.empty((steps, 2)), np.empty((steps, 2))
    for k in range(steps):
        time_s = k * step_s
        headings = pose[2] + np.append(0.0, np.cumsum(wave.at(time_s, count)))
        own_rates = np.append(0.0, np.cumsum(wave.rates_at(time_s, count)))
        directions = np.exp(1j * headings)
        along = directions * lengths
        swing = 1j * own_rates * along
        feet = complex(pose[0], pose[1]) + np.append(0.0, np.cumsum(along))
        feet_rates = np.append(0.0, np.cumsum(swing))  # in a base that stands still
        middles, middle_rates = feet[:-1] + 0.5 * along, feet_rates[:-1] + 0.5 * swing
        place = complex(np.sum(masses * middles) / masses.sum())
        arms = middles - place
        base = complex(pose[0], pose[1])
        own = np.sum(masses * middle_rates)
        own_spin = np.sum(masses * (np.conj(arms) * middle_rates).imag) + np.sum(turning_kg_m2 * own_rates)
        spin = (momentum[2] - own_spin) / np.sum(masses * np.abs(arms) ** 2 + turning_kg_m2)
        speed = (complex(momentum[0], momentum[1]) - own) / masses.sum() - 1j * spin * (place - base)
        velocities = speed + 1j * spin * (feet - base) + feet_rates
        tangents = np.append(directions, 0.0) + np.append(0.0, directions)
        tangents /= np.abs(tangents)
        points = feet
        if in_the_middle:
            velocities = speed + 1j * spin * (middles - base) + middle_rates
            tangents = directions
            points = middles
        weights_n = G * masses if in_the_middle else loads_n
        rub = (
            weights_n
            * tangents
            * brake(velocities * np.conj(tangents), coefficients, viscous_s_per_m, separate_limits=separate_limits)
        )
        momentum += step_s * np.array([rub.sum().real, rub.sum().imag, np.sum((np.conj(points - place) * rub).imag)])
        pose += step_s * np.array([speed.real, speed.imag, spin])
        center[k] = place.real, place.imag
        axis[k] = (feet[-1] - feet[0]).real, (feet[-1] - feet[0]).imag
    return Track(center, axis, step_s, wave.period_s)


def brake(
    velocities: Any, coefficients: DirectionalFriction, viscous_s_per_m: complex, *, separate_limits: bool = False
) -> Any:
    """Return the force of friction on what slides, divided by its normal force; all complex, along the link and across.

    Args:
        velocities: of what slides, in m/s.
        coefficients: of dry friction.
        viscous_s_per_m: along the link, and as imaginary part across it.
        separate_limits: friction along the link and across it do not limit each other.
    """
    along, across = velocities.real, velocities.imag
    of_along = np.where(along > 0, coefficients.forward, coefficients.backward)
    dry = (of_along * along + 1j * coefficients.sideways * across) / np.sqrt(np.abs(velocities) ** 2 + SMOOTH_M_S**2)
    if separate_limits:
        dry_along = of_along * along / np.sqrt(along**2 + SMOOTH_M_S**2)
        dry = dry_along + 1j * coefficients.sideways * across / np.sqrt(across**2 + SMOOTH_M_S**2)
    return -dry - viscous_s_per_m.real * along - 1j * viscous_s_per_m.imag * across
