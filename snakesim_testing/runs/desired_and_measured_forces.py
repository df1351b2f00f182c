"""Compares the contact forces that controllers desire with those that the simulator computes.

`python -m benchmarks.forces` runs this program. It simulates `triplet` and `peg_row`, and prints two tables: distance,
energy and impulse of every controller, and the causes of differences between desired and measured forces. The forces
come from the simulator in every physics step. Thus neither table depends on the times at which the sensor samples.
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
SHIPPED_CONTROLLERS = (
    "obstacle_aided",
    "obstacle_triplet",
    "path_following",
    "lateral_undulation",
    "head_steered_undulation",
    "compliant_undulation",
    "hold",
)
# The speed of the mission does not change these controllers.
CONTROLLERS_WITHOUT_PATH = ("lateral_undulation", "compliant_undulation", "hold")
WAVE_AMPLITUDES_RAD = (0.2, 0.3, 0.4, 0.5, 0.6)
WAVE_LAG_RAD = 0.9  # between adjacent joints
REFERENCE_AMPLITUDE_RAD = 0.3  # the table contains this wave and the fastest one
HIGHER_SPEED_M_S = 0.3
STEP_S = 0.002
DURATION_S = 8
SHIFTS_S = np.arange(-0.1, 0.105, 0.01)  # delay of the measured force after the state
CASES_HEADER = "| scenario | controller | m in 8 s | J/m | N·s/m |\n|---|---|---|---|---|"
CAUSES_HEADER = (
    "| scenario | controller | desired, N | measured, N | desired, but no contact | measured, not desired "
    "| too much or little in all | wrong share | correlation | at its best, after |\n"
    "|---|---|---|---|---|---|---|---|---|---|"
)

Forces = Mapping[str, Floats]  # force on each obstacle in N, by its name, in every physics step


def make_wave(amplitude_rad: float) -> Callable[[float, int], Floats]:
    """Return a controller that moves a wave along the body, whose amplitude grows from 0 in the first second."""
    lag_rad = WAVE_LAG_RAD * np.arange(13)[::-1]
    return lambda time_s, joints: (
        min(time_s, 1.0) * amplitude_rad * np.sin(np.pi * time_s - lag_rad)
    )


def run_and_measure_forces(
    scenario: str, controller: Any, **options: Any
) -> tuple[snakesim.Result, Forces]:
    """Run a scenario for 8 s, and return its result and the forces on all obstacles.

    Args:
        scenario: Name of the scenario.
        controller: Name or class of the controller, or a function.
        **options: Changes of the scenario, by key, and a `duration` in s that replaces the 8 s.
    """
    duration_s = options.pop("duration", DURATION_S)
    with recording_contact_forces() as steps:
        result = snakesim.run(scenario, controller=controller, duration=duration_s, set=options)
    names = dict.fromkeys(name for step in steps for name in step)
    return result, {name: np.array([step.get(name, 0.0) for step in steps]) for name in names}


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
    distance_m = result.summary.advance_m or 0.0
    energy_j_per_m = result.summary.energy_j_per_m
    if energy_j_per_m is None:
        per_m = "- | -"
    else:
        impulse_ns = STEP_S * sum(float(force.sum()) for force in forces.values())
        per_m = f"{energy_j_per_m:.1f} | {impulse_ns / distance_m:.0f}"
    return distance_m, f"| `{scenario}` | {label} | {distance_m:.2f} | {per_m} |"


def iter_cases(scenario: str) -> Iterator[str]:
    """Yield rows of a table: bundled controllers at the mission's speed and at a higher one, and waves."""
    for name in SHIPPED_CONTROLLERS:
        yield measure_case(scenario, f"`{name}`", name)[1]
    if scenario == "triplet":
        yield from _iter_cases_at_higher_speed(scenario)
    yield from _iter_wave_cases(scenario)


def _iter_cases_at_higher_speed(scenario: str) -> Iterator[str]:
    for name in SHIPPED_CONTROLLERS:
        if name not in CONTROLLERS_WITHOUT_PATH:
            label = f"`{name}`, {HIGHER_SPEED_M_S} m/s asked for"
            yield measure_case(scenario, label, name, **{"mission.speed_m_s": HIGHER_SPEED_M_S})[1]


def _iter_wave_cases(scenario: str) -> Iterator[str]:
    """Yield the row of the reference amplitude, and the row of the amplitude that advances furthest."""
    distance_and_row_by_amplitude = {
        rad: measure_case(scenario, f"wave, {rad} rad", make_wave(rad))
        for rad in WAVE_AMPLITUDES_RAD
    }
    yield distance_and_row_by_amplitude[REFERENCE_AMPLITUDE_RAD][1]
    best_rad = max(WAVE_AMPLITUDES_RAD, key=lambda rad: distance_and_row_by_amplitude[rad][0])
    note = f"(of {len(WAVE_AMPLITUDES_RAD)} tried the one that goes furthest)"
    best_row = distance_and_row_by_amplitude[best_rad][1]
    yield best_row.replace(f"{best_rad} rad", f"{best_rad} rad {note}")


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
    """Return the correlation of desired and measured forces where a force was desired, or 0 if it is undefined."""
    is_desired = desired_n >= MIN_DESIRED_FORCE_N
    if is_desired.sum() < 2:
        return 0.0
    desired_forces_n = desired_n[is_desired]
    measured_forces_n = measured_n[is_desired]
    if desired_forces_n.std() == 0.0 or measured_forces_n.std() == 0.0:
        return 0.0
    return float(np.corrcoef(desired_forces_n, measured_forces_n)[0, 1])


def main() -> int:
    """Print both tables, each row as soon as its run has ended."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", choices=("cases", "causes"), help="one of the two tables")
    only = parser.parse_args().only
    if only != "causes":
        print(CASES_HEADER, flush=True)
        for scenario in SCENARIOS:
            for row in iter_cases(scenario):
                print(row, flush=True)
        print()
    if only != "cases":
        print(CAUSES_HEADER, flush=True)
        for scenario in SCENARIOS:
            for controller in ("obstacle_aided", "obstacle_triplet"):
                print(measure_difference_causes(scenario, controller), flush=True)
    return 0
