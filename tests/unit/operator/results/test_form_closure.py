"""Contacts that hold a stiff body, and contacts that let it go."""

import numpy as np
import pytest

from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_operator.results.metrics.form_closure import (
    compute_form_closure_margin,
    find_body_contacts,
)


def margin(contacts: object, length_m: float) -> float:
    """contacts: a row each, place and normal."""
    rows = np.array(contacts, dtype=float).reshape(-1, 4)
    return compute_form_closure_margin(rows[:, :2], rows[:, 2:], length_m)


# A square of 0.2 m, touched on each side beside its middle: it cannot shift, and may turn one way.
TURNS = ((0.1, 0.05, -1, 0), (-0.1, -0.05, 1, 0), (0.05, -0.1, 0, 1), (-0.05, 0.1, 0, -1))


def test_form_closure_of_square_is_lost_without_one_contact() -> None:
    # Two contacts turn it one way, two the other way.
    wound = [*TURNS[:2], (-0.05, -0.1, 0, 1), (0.05, 0.1, 0, -1)]
    assert margin(wound, 0.1) > 0.05
    assert margin(TURNS, 0.1) <= 0.0  # all four turn it the same way
    for gone in range(4):
        assert margin([*wound[:gone], *wound[gone + 1 :]], 0.1) <= 0.0


def test_a_body_between_two_walls_may_slide_along_them() -> None:
    assert margin([(x, y, 0, -10 * y) for x in (-0.4, 0.0, 0.4) for y in (-0.1, 0.1)], 0.5) <= 0


def test_form_closure_by_pegs_on_both_sides_of_a_wave() -> None:
    normals = np.repeat([[-0.6, 0.8], [0.6, 0.8], [-0.6, 0.8]], 2, axis=0) * np.resize(
        [[1.0], [-1.0]], (6, 1)
    )
    places = np.repeat([[0.0, 0.0], [0.3, 0.0], [0.6, 0.0]], 2, axis=0) - 0.04 * normals
    held = compute_form_closure_margin(places, normals, 0.5)
    assert held > 0.05
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    assert compute_form_closure_margin(
        places @ turn.T + (3.0, -2.0), normals @ turn.T, 0.5
    ) == pytest.approx(held)


def test_form_closure_counts_an_obstacle_once_at_nearest_link() -> None:
    pegs = [
        KnownObstacle(name=f"{x} {y}", shape="cylinder", position_w=(x, y, 0.1), radius_m=0.05)
        for x, y in ((0.3, 0.105), (0.55, -0.1), (0.8, 0.2))
    ]
    chain = np.column_stack([np.linspace(0.0, 1.0, 11), np.zeros(11)])
    places, normals = find_body_contacts(chain, 0.04, ObstacleOutlines.from_obstacles(pegs))
    assert places == pytest.approx(np.array([[0.3, 0.04], [0.55, -0.04]]), abs=0.011)
    assert normals == pytest.approx(np.array([[0.0, -1.0], [0.0, 1.0]]), abs=0.11)
