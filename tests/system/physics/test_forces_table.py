"""Compares the forces that `benchmarks.forces` measures with the robot's contact sensor in the same run."""

import numpy as np
import pytest

from snakesim_testing.runs.desired_and_measured_forces import (
    STEP_S,
    measure_difference_causes,
    run_and_measure_forces,
)

SENSOR_PERIOD_S = 0.05


@pytest.mark.heavy
def test_step_forces_average_to_contact_sensor_samples():
    result, forces = run_and_measure_forces("triplet", "obstacle_aided", duration=2.0)
    steps_per_sample = round(SENSOR_PERIOD_S / STEP_S)
    final_forces_n = [float(force_n[-steps_per_sample:].mean()) for force_n in forces.values()]
    assert len(forces) >= 3
    assert max(final_forces_n) > 1.0
    # The sensor measures the force on one link.
    assert max(final_forces_n) == pytest.approx(result.record.contact_peak_n[-1], rel=0.5)
    impulses_ns = STEP_S * np.sum(list(forces.values()), axis=1)
    # The ground's drag is about 4 N for two seconds, and contacts also push across the direction of travel.
    assert impulses_ns.sum() > 10.0


@pytest.mark.heavy
def test_difference_causes_add_up_to_100_percent():
    table_row = measure_difference_causes("triplet", "obstacle_aided", duration=2.0)
    cells = [cell.strip() for cell in table_row.split("|")[1:-1]]
    desired_force_n = float(cells[2])
    cause_percentages = [int(cell.rstrip("%")) for cell in cells[4:8]]
    assert sum(cause_percentages) == pytest.approx(100, abs=2)
    # More than the ground's drag of about 4 N, because contacts also push across the direction of travel.
    assert desired_force_n > 4.0
