"""What `python -m benchmarks.forces` prints: every controller in the case study, and why solved forces differ.

Runs of `triplet` and `peg_row` in this process. Contact forces are taken from the simulator in every physics step, so
neither table depends on when the contact sensor looks.
"""

import argparse
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any
from unittest import mock

import numpy as np

import snakesim
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.measured_force import FORCE_WINDOW_S
from snakesim_hal.wire.messages import ControlState
from snakesim_operator.results.metrics.force_tracking import (
    MIN_CONTACT_FORCE_N,
    MIN_DESIRED_FORCE_N,
)
from snakesim_sim_backend.backend import SimBackend
from snakesim_sim_backend.state.contacts import GeomPair, ObstacleContactReader

SCENARIOS = ("triplet", "peg_row")
SHIPPED = (
    "obstacle_aided",
    "obstacle_triplet",
    "path_following",
    "lateral_undulation",
    "head_steered_undulation",
    "compliant_undulation",
    "hold",
)
# A mission's speed does not change them.
WITHOUT_PATH = "lateral_undulation", "compliant_undulation", "hold"
AMPLITUDES_RAD = (0.2, 0.3, 0.4, 0.5, 0.6)  # of the wave
FASTER_M_S = 0.3
STEP_S = 0.002
SHIFTS_S = np.arange(-0.1, 0.105, 0.01)  # from command to force
CASES = "| scenario | controller | m in 8 s | J/m | N·s/m |\n|---|---|---|---|---|"
CAUSES = (
    "| scenario | controller | desired, N | measured, N | desired, but no contact | measured, not desired "
    "| too much or little in all | wrong share | correlation | at its best, after |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)

Forces = Mapping[str, Floats]  # of each obstacle, in every physics step


def wave(amplitude_rad: float) -> Callable[[float, int], Floats]:
    """A wave that grows from straight, wherever the joints are."""
    lag_rad = 0.9 * np.arange(13)[::-1]
    return lambda time_s, joints: (
        min(time_s, 1.0) * amplitude_rad * np.sin(np.pi * time_s - lag_rad)
    )


def run_and_measure_forces(
    scenario: str, controller: Any, **options: Any
) -> tuple[snakesim.Result, Forces]:
    """A run of 8 s, and the forces of all obstacles in it."""
    with recording_contact_forces() as steps:
        result = snakesim.run(
            scenario, controller=controller, duration=options.pop("duration", 8), set=options
        )
    names = dict.fromkeys(name for found in steps for name in found)
    return result, {name: np.array([found.get(name, 0.0) for found in steps]) for name in names}


@contextmanager
def recording_contact_forces() -> Iterator[list[dict[str, float]]]:
    """Record the contact forces of simulations that run within the context.

    Yields:
        One entry for each physics step: the force on each obstacle that the body touches, N, by its name.
    """
    steps: list[dict[str, float]] = []
    advance = SimBackend.advance

    def advance_and_record(self: SimBackend) -> None:
        physics = self.physics
        step = physics.step
        touches = ObstacleContactReader(self.sim, self.data, physics.contacts)

        def step_and_record(count: int) -> None:
            for _ in range(count):
                step(1)
                steps.append(_sum_by_obstacle(touches.sum_forces_n(), self.sim.obstacle_of_geom))

        with mock.patch.object(physics, "step", step_and_record):
            advance(self)

    with mock.patch.object(SimBackend, "advance", advance_and_record):
        yield steps


def _sum_by_obstacle(
    forces_n: Mapping[GeomPair, float], obstacle_of_geom: list[str | None]
) -> dict[str, float]:
    """Return the force on each obstacle, from the forces between geoms of links and obstacles."""
    force_of_obstacle: dict[str, float] = {}
    for (first, second), force_n in forces_n.items():
        name = obstacle_of_geom[first] or obstacle_of_geom[second] or ""
        force_of_obstacle[name] = force_of_obstacle.get(name, 0.0) + force_n
    return force_of_obstacle


def measure_case(scenario: str, label: str, controller: Any, **options: Any) -> tuple[float, str]:
    """Run a controller in a scenario, and return the distance in m and a row of the table of cases.

    Args:
        scenario: Name of the scenario.
        label: Text of the row about the controller.
        controller: Name or class of the controller.
        options: Changes of the scenario, by key.
    """
    result, forces = run_and_measure_forces(scenario, controller, **options)
    distance_m, joules = result.summary.advance_m or 0.0, result.summary.energy_j_per_m
    impulse_ns = STEP_S * sum(float(force.sum()) for force in forces.values())
    per_m = f"{joules:.1f} | {impulse_ns / distance_m:.0f}" if joules is not None else "- | -"
    return distance_m, f"| `{scenario}` | {label} | {distance_m:.2f} | {per_m} |"


def iter_cases(scenario: str) -> Iterator[str]:
    """Yield rows of a table: bundled controllers at the mission's speed and at a higher one, and waves."""
    for name in SHIPPED:
        yield measure_case(scenario, f"`{name}`", name)[1]
    for name in SHIPPED if scenario == "triplet" else ():
        if name not in WITHOUT_PATH:
            label = f"`{name}`, {FASTER_M_S} m/s asked for"
            yield measure_case(scenario, label, name, **{"mission.speed_m_s": FASTER_M_S})[1]
    waves = [
        (rad, *measure_case(scenario, f"wave, {rad} rad", wave(rad))) for rad in AMPLITUDES_RAD
    ]
    best = max(waves, key=lambda found: found[1])
    yield next(row for rad, _, row in waves if rad == 0.3)
    yield best[2].replace(
        f"{best[0]} rad", f"{best[0]} rad (of {len(waves)} tried the one that goes furthest)"
    )


def measure_difference_causes(scenario: str, controller: str, **options: Any) -> str:
    """Run a controller, and return the row of its differences between desired and measured contact forces.

    Args:
        scenario: Name of the scenario.
        controller: Name of the controller.
        options: Changes of the scenario, by key.
    """
    result, forces = run_and_measure_forces(scenario, controller, **options)
    states = [state for state in result.record.control_states if state.state == "Locomoting"]
    desired_n, measured_n = tabulate_forces(states, forces, 0.0)  # (n_states, n_obstacles)
    requests_force = (desired_n >= MIN_DESIRED_FORCE_N).any(axis=1)
    desired_n = desired_n[requests_force]
    measured_n = measured_n[requests_force]
    parts_n = _decompose_force_error(desired_n, measured_n)
    fractions = " | ".join(f"{part_n / sum(parts_n):.0%}" for part_n in parts_n)
    correlations = [
        compute_correlation(*tabulate_forces(states, forces, float(shift_s)))
        for shift_s in SHIFTS_S
    ]
    best = int(np.argmax(correlations))
    return (
        f"| `{scenario}` | `{controller}` | {desired_n.sum(axis=1).mean():.1f} | {measured_n.sum(axis=1).mean():.1f} "
        f"| {fractions} "
        f"| {compute_correlation(desired_n, measured_n):.2f} "
        f"| {correlations[best]:.2f}, {1e3 * SHIFTS_S[best]:.0f} ms |"
    )


def _decompose_force_error(
    desired_n: Floats, measured_n: Floats
) -> tuple[float, float, float, float]:
    """Decompose the difference between desired and measured contact forces (in N) by its causes.

    Args:
        desired_n: (n_states, n_obstacles) forces that the controller desired.
        measured_n: (n_states, n_obstacles) forces at the same times.

    Returns:
        Sums over all states: desired without contact, measured but not desired, error of the total force, and error of
        its distribution among the obstacles.
    """
    without_contact_n = float(desired_n[measured_n < MIN_CONTACT_FORCE_N].sum())
    undesired_n = float(measured_n[desired_n == 0.0].sum())
    in_both = (desired_n > 0.0) & (measured_n >= MIN_CONTACT_FORCE_N)
    total_error_n = 0.0
    distribution_error_n = 0.0
    for state_index in np.flatnonzero(in_both.any(axis=1)):
        desired_forces_n = desired_n[state_index, in_both[state_index]]
        measured_forces_n = measured_n[state_index, in_both[state_index]]
        scale = measured_forces_n.sum() / desired_forces_n.sum()
        total_error_n += abs(measured_forces_n.sum() - desired_forces_n.sum())
        distribution_error_n += float(np.abs(measured_forces_n - scale * desired_forces_n).sum())
    return without_contact_n, undesired_n, total_error_n, distribution_error_n


def tabulate_forces(
    states: Sequence[ControlState], forces: Forces, shift_s: float
) -> tuple[Floats, Floats]:
    """Tabulate desired and measured contact forces by state and obstacle.

    Args:
        states: Reported states of the controller, with the desired forces.
        forces: Measured force on each obstacle in each physics step, N.
        shift_s: Time by which the measured forces are taken later than the states.

    Returns:
        Desired and measured forces in N, (n_states, n_obstacles) each. Measured forces are means over FORCE_WINDOW_S.
    """
    pushed_obstacles = {
        point.obstacle
        for state in states
        for point in state.push_points
        if point.obstacle is not None
    }
    names = sorted({*forces, *pushed_obstacles})
    shape = (len(states), len(names))

    # Measured: the mean over a window around the time of each state, as a difference of cumulative sums.
    measured_n = np.zeros(shape)
    window_steps = round(FORCE_WINDOW_S / STEP_S)
    for column, name in enumerate(names):
        force_per_step_n = forces.get(name, np.zeros(1))
        sums_n = np.concatenate(([0.0], np.cumsum(force_per_step_n)))
        for row, state in enumerate(states):
            middle_step = round((1e-9 * state.timestamp_ns + shift_s) / STEP_S)
            begin_step = middle_step - window_steps // 2
            first = min(max(begin_step, 0), len(sums_n) - 1)
            last = min(max(begin_step + window_steps, 0), len(sums_n) - 1)
            measured_n[row, column] = (sums_n[last] - sums_n[first]) / window_steps

    # Desired: the sum over the push-points on each obstacle.
    desired_n = np.zeros(shape)
    column_by_name = {name: column for column, name in enumerate(names)}
    for row, state in enumerate(states):
        for point, force_n in zip(state.push_points, state.desired_force_n, strict=True):
            if point.obstacle is not None:
                desired_n[row, column_by_name[point.obstacle]] += force_n
    return desired_n, measured_n


def compute_correlation(desired_n: Floats, measured_n: Floats) -> float:
    """Over all push-points that are judged."""
    judged = desired_n >= MIN_DESIRED_FORCE_N
    if judged.sum() < 2 or desired_n[judged].std() == 0.0 or measured_n[judged].std() == 0.0:
        return 0.0
    return float(np.corrcoef(desired_n[judged], measured_n[judged])[0, 1])


def main() -> int:
    """Print both tables, a row as soon as it is known."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=("cases", "causes"), help="one of the two tables")
    only = parser.parse_args().only
    if only != "causes":
        print(CASES, flush=True)
        for scenario in SCENARIOS:
            for row in iter_cases(scenario):
                print(row, flush=True)
        print()
    if only != "cases":
        print(CAUSES, flush=True)
        for scenario in SCENARIOS:
            for controller in ("obstacle_aided", "obstacle_triplet"):
                print(measure_difference_causes(scenario, controller), flush=True)
    return 0
