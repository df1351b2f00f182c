"""The forces that `benchmarks.forces` counts, against what the robot's own sensor says of the same run."""

import numpy as np
import pytest

from snakesim_testing.runs.desired_and_measured_forces import (
    STEP_S,
    measure_difference_causes,
    run_and_measure_forces,
)


def test_step_forces_average_to_contact_sensor_samples():
    result, forces = run_and_measure_forces("triplet", "obstacle_aided", duration=2.0)
    steps = round(0.05 / STEP_S)
    at_end = [float(force[-steps:].mean()) for force in forces.values()]
    assert len(forces) >= 3
    assert max(at_end) > 1.0
    # That is of one link.
    assert max(at_end) == pytest.approx(result.record.contact_peak_n[-1], rel=0.5)
    impulses_ns = STEP_S * np.sum(list(forces.values()), axis=1)
    assert impulses_ns.sum() > 10.0  # more than 4 N of drag for two seconds, across the way


def test_shares_of_the_causes_make_up_all_of_the_difference():
    cells = [
        cell.strip()
        for cell in measure_difference_causes("triplet", "obstacle_aided", duration=2.0).split("|")[
            1:-1
        ]
    ]
    assert sum(int(cell.rstrip("%")) for cell in cells[4:8]) == pytest.approx(100, abs=2)
    # Asked for: more than the ground's drag, for contacts push across the way.
    assert float(cells[2]) > 4.0
