"""Tests the search for the joint angles that were measured nearest to a time."""

import numpy as np

from snakesim_gnc.geometry.planar_body import JointAngleHistory


def test_joint_angle_history_finds_angles_nearest_to_a_time() -> None:
    random = np.random.default_rng(5)
    for _ in range(50):
        times_ns = np.unique(random.integers(0, 60, 12)).tolist()
        angles = JointAngleHistory()
        for time_ns in times_ns:
            angles.add(time_ns, [float(time_ns)])
        for wanted_ns in range(-5, 66):
            nearest_ns = min(times_ns, key=lambda time_ns: (abs(time_ns - wanted_ns), time_ns))
            assert angles.find_nearest(wanted_ns) == [float(nearest_ns)]
