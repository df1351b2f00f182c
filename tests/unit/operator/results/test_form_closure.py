"""The form closure margin of a stiff body: positive if the contacts prevent every motion."""

import numpy as np
import pytest

from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_operator.results.metrics.form_closure import (
    compute_form_closure_margin,
    find_body_contacts,
)


def compute_margin(contacts: object, length_m: float) -> float:
    """Return the margin of contacts that are rows of x, y, normal x and normal y."""
    rows = np.array(contacts, dtype=float).reshape(-1, 4)
    return compute_form_closure_margin(rows[:, :2], rows[:, 2:], length_m)


# A square of 0.2 m has a contact near the middle of each side: it cannot shift, but it can turn in one direction.
TURNING_CONTACTS = (
    (0.1, 0.05, -1, 0),
    (-0.1, -0.05, 1, 0),
    (0.05, -0.1, 0, 1),
    (-0.05, 0.1, 0, -1),
)


def test_form_closure_of_square_is_lost_without_one_contact() -> None:
    # Two contacts turn the square in one direction, and two in the other direction.
    holding_contacts = [*TURNING_CONTACTS[:2], (-0.05, -0.1, 0, 1), (0.05, 0.1, 0, -1)]
    assert compute_margin(holding_contacts, 0.1) > 0.05
    assert compute_margin(TURNING_CONTACTS, 0.1) <= 0.0  # all four turn it in the same direction
    for removed in range(4):
        remaining = [*holding_contacts[:removed], *holding_contacts[removed + 1 :]]
        assert compute_margin(remaining, 0.1) <= 0.0


def test_form_closure_between_two_parallel_walls_is_missing() -> None:
    walls = [(x, y, 0, -10 * y) for x in (-0.4, 0.0, 0.4) for y in (-0.1, 0.1)]
    assert compute_margin(walls, 0.5) <= 0


def test_form_closure_of_wave_between_pegs_ignores_its_pose() -> None:
    sides = np.resize([[1.0], [-1.0]], (6, 1))
    normals = np.repeat([[-0.6, 0.8], [0.6, 0.8], [-0.6, 0.8]], 2, axis=0) * sides
    centers = np.repeat([[0.0, 0.0], [0.3, 0.0], [0.6, 0.0]], 2, axis=0)
    positions = centers - 0.04 * normals
    margin = compute_form_closure_margin(positions, normals, 0.5)
    assert margin > 0.05
    rotation = np.array([[0.6, -0.8], [0.8, 0.6]])
    moved_margin = compute_form_closure_margin(
        positions @ rotation.T + (3.0, -2.0), normals @ rotation.T, 0.5
    )
    assert moved_margin == pytest.approx(margin)


def test_form_closure_counts_an_obstacle_once_at_nearest_link() -> None:
    pegs = [
        KnownObstacle(name=f"{x} {y}", shape="cylinder", position_w=(x, y, 0.1), radius_m=0.05)
        for x, y in ((0.3, 0.105), (0.55, -0.1), (0.8, 0.2))
    ]
    chain = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])
    positions, normals = find_body_contacts(chain, 0.04, ObstacleOutlines.from_obstacles(pegs))
    assert positions == pytest.approx(np.array([[0.3, 0.04], [0.55, -0.04]]), abs=0.011)
    assert normals == pytest.approx(np.array([[0.0, -1.0], [0.0, 1.0]]), abs=0.11)
