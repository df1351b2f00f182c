"""Flat ground pushes nobody: what moves a mirrored, reversed or turned snake is mirrored, reversed or turned as well.

A symmetric snake whose wave runs the other way must drift the other way, by as much, whatever the physics step. What is
left over is a force that no ground has.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
import pytest

from snakesim_hal.base.arrays import Floats
from snakesim_sim_backend.model.build import FREE_DOFS, FREE_QPOS, build
from snakesim_sim_backend.physics import Physics
from snakesim_sim_backend.settings import SimSettings
from snakesim_testing.sim.simulator_rig import G, make_config

MU = 0.1
SERVO = (300.0, 10.0)  # N·m/rad and N·m·s/rad
PERIODS, SKIPPED = 6, 2
GHOST_MM_S = 1.0
SEED = 20261123


@dataclass(frozen=True)
class Wave:
    """Joint angles amplitude * sin(rate t + phase i) + bend, with i counted from the middle of the body."""

    amplitude: float = 0.5
    phase: float = 0.9
    rate: float = float(np.pi)
    bend: float = 0.0

    def at(self, time_s: float, count: int) -> Floats:
        places = np.arange(count) - 0.5 * (count - 1)
        return self.amplitude * np.sin(self.rate * time_s + self.phase * places) + self.bend

    def rates_at(self, time_s: float, count: int) -> Floats:
        places = np.arange(count) - 0.5 * (count - 1)
        return self.amplitude * self.rate * np.cos(self.rate * time_s + self.phase * places)

    @property
    def reversed(self) -> "Wave":
        """As a body does it whose head and tail are exchanged."""
        return Wave(self.amplitude, -self.phase, self.rate, self.bend)


def random_waves(count: int) -> list[Wave]:
    rng = np.random.default_rng(SEED)
    return [
        Wave(rng.uniform(0.2, 0.6), rng.uniform(0.5, 1.2), rng.uniform(2.0, 5.0), rng.uniform(-0.05, 0.05))
        for _ in range(count)
    ]


@dataclass(frozen=True)
class Track:
    """Centre of mass and vector from tail to head at the end of every step, (steps, 2) in m."""

    center: Floats
    axis: Floats
    step_s: float
    period_s: float

    @property
    def drift_mm_s(self) -> float:
        """Mean speed of the center along the mean axis of each period."""
        steps = round(self.period_s / self.step_s)
        found: list[float] = []
        for k in range(SKIPPED, PERIODS - 1):
            axis = self.axis[k * steps : (k + 1) * steps].mean(axis=0)
            way = self.center[(k + 1) * steps] - self.center[k * steps]
            found.append(float(way @ axis / np.linalg.norm(axis)) / self.period_s * 1e3)
        return float(np.mean(found))


def swim(wave: Wave, step_s: float = 0.002, *, yaw_rad: float = 0.0) -> Track:
    """The shipped robot on flat ground, its joints held to the wave by stiff servos."""
    config = make_config(scene={"ground": {"friction": MU}})
    sim = build(config, SimSettings(timestep_s=step_s), motors=False)
    model, data = sim.model, mujoco.MjData(sim.model)
    assert sim.feet is not None
    count, (stiffness, damping) = model.nv - FREE_DOFS, SERVO
    model.dof_damping[FREE_DOFS:], model.dof_frictionloss[FREE_DOFS:] = damping, 0.0
    data.qpos[2] = config.robot.module.radius_m
    data.qpos[3], data.qpos[6] = np.cos(yaw_rad / 2), np.sin(yaw_rad / 2)
    data.qpos[FREE_QPOS:] = wave.at(0.0, count)
    physics = Physics(sim, data)
    physics.begin()
    step_s, period_s = model.opt.timestep, 2 * np.pi / wave.rate
    tail, head = sim.feet.geoms[[0, -1]]
    steps = int(PERIODS * period_s / step_s) + 1
    center, axis = np.empty((steps, 2)), np.empty((steps, 2))
    for k in range(steps):
        after_s = (k + 1) * step_s
        wanted = stiffness * (wave.at(after_s, count) - data.qpos[FREE_QPOS:])
        data.qfrc_applied[FREE_DOFS:] = wanted + damping * wave.rates_at(after_s, count)
        physics.step(1)
        center[k] = data.subtree_com[0, :2]
        axis[k] = (data.geom_xpos[head] - data.geom_xpos[tail])[:2]
    return Track(center, axis, step_s, period_s)


def momentum_balance(wave: Wave, step_s: float = 0.0005) -> Track:
    """The same without MuJoCo: links of prescribed angles in the plane, Coulomb friction at the feet, momentum.

    Angles about +z, tail first; of every link its middle, mass and inertia. Friction is smoothed below 2 mm/s.
    """
    robot = make_config().robot
    lengths, masses = np.array(robot.link_lengths_m), np.array(robot.link_masses_kg)
    ends = lengths + 2 * robot.module.radius_m
    turning_kg_m2 = masses * (3 * robot.module.radius_m**2 + ends**2) / 12  # as of a cylinder, about its middle
    loads_n = 0.5 * G * (np.append(masses, 0.0) + np.append(0.0, masses))
    count = len(lengths) - 1
    pose, momentum = np.zeros(3), np.zeros(3)
    period_s = 2 * np.pi / wave.rate
    steps = int(PERIODS * period_s / step_s) + 1
    center, axis = np.empty((steps, 2)), np.empty((steps, 2))
    for k in range(steps):
        time_s = k * step_s
        headings = pose[2] + np.append(0.0, np.cumsum(wave.at(time_s, count)))
        own_rates = np.append(0.0, np.cumsum(wave.rates_at(time_s, count)))
        along = np.exp(1j * headings) * lengths
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
        rub = -MU * loads_n * velocities / np.sqrt(np.abs(velocities) ** 2 + 0.002**2)
        momentum += step_s * np.array([rub.sum().real, rub.sum().imag, np.sum((np.conj(feet - place) * rub).imag)])
        pose += step_s * np.array([speed.real, speed.imag, spin])
        center[k] = place.real, place.imag
        axis[k] = (feet[-1] - feet[0]).real, (feet[-1] - feet[0]).imag
    return Track(center, axis, step_s, period_s)


FIRST, *OTHERS = random_waves(4)


@pytest.mark.parametrize("wave", [FIRST, *(pytest.param(wave, marks=pytest.mark.slow) for wave in OTHERS)])
def test_a_reversed_wave_drifts_the_other_way_by_as_much(wave: Wave) -> None:
    there, back = swim(wave).drift_mm_s, swim(wave.reversed).drift_mm_s
    assert abs(there + back) < GHOST_MM_S
    assert max(abs(there), abs(back)) > 3.0


@pytest.mark.slow
@pytest.mark.timeout(600)  # 60 runs, in steps of down to 0.5 ms
@pytest.mark.parametrize("step_s", [0.0005, 0.001, 0.002])
def test_waves_drift_oppositely_when_reversed(step_s: float) -> None:
    sums, differences, speeds = [], [], []
    for wave in random_waves(20):
        there = swim(wave, step_s).drift_mm_s
        sums.append(abs(there + swim(wave.reversed, step_s).drift_mm_s))
        differences.append(abs(there - swim(wave, 0.001).drift_mm_s))
        speeds.append(abs(there))
    print(
        f"steps of {step_s * 1e3:g} ms: drift {min(speeds):.1f} to {max(speeds):.1f} mm/s, of a wave and "
        f"its reverse in sum at most {max(sums):.2f} mm/s, from that with 1 ms at most {max(differences):.2f} mm/s"
    )
    assert max(sums) < GHOST_MM_S
    assert max(differences) < GHOST_MM_S


def test_reflected_or_rotated_snake_moves_reflected_or_rotated() -> None:
    wave, yaw_rad = Wave(bend=0.04), 0.7
    reflected = Wave(-wave.amplitude, bend=-wave.bend)
    plain = swim(wave).center[-1]
    assert np.linalg.norm(plain) > 0.02
    assert swim(reflected).center[-1] == pytest.approx(plain * [1.0, -1.0], abs=1e-6)
    turned = complex(*plain) * np.exp(1j * yaw_rad)
    assert swim(wave, yaw_rad=yaw_rad).center[-1] == pytest.approx([turned.real, turned.imag], abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(
    "wave",
    [
        pytest.param(Wave(), marks=pytest.mark.slow),
        Wave().reversed,
        Wave(0.3, 0.7, 4.0),
        Wave(0.7, -0.75, 7.854),  # of the search for contacts
    ],
)
def test_it_drifts_as_a_momentum_balance_with_coulomb_friction_says(wave: Wave) -> None:
    ours, balance = swim(wave).drift_mm_s, momentum_balance(wave).drift_mm_s
    print(f"{wave}: {ours:+.2f} mm/s, momentum balance {balance:+.2f} mm/s")
    assert ours == pytest.approx(balance, abs=GHOST_MM_S)
