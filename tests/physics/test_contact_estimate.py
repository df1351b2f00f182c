"""The contact estimate against the simulator's truth, on runs that push off pegs."""

from itertools import product

import numpy as np
import pytest

from tests.physics.contact_score import score


@pytest.mark.parametrize(("scenario", "with_pose"), product(["triplet", "peg_row"], [True, False]))
def test_the_median_error_of_a_push_is_below_15_percent(scenario: str, with_pose: bool) -> None:
    found = score(scenario, seconds=3.0, with_pose=with_pose)
    assert len(found.share) > 100
    assert np.median(found.share) < 0.15
    assert len(found.place_m) > 0.95 * len(found.share)  # so few are missed
    assert found.ghosts < 0.1 * len(found.share)
    assert np.median(found.place_m) < 0.04


def test_without_imus_three_of_four_pushes_are_still_found() -> None:
    found = score("triplet", "-robot.sensors.imu", "-robot.sensors.contacts", seconds=3.0, with_pose=False)
    assert len(found.place_m) > 0.75 * len(found.share) > 75
    assert np.median(found.share) < 0.4 and np.median(found.place_m) < 0.05
