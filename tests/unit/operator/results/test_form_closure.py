"""Contacts that hold a stiff body, and contacts that let it go."""

import numpy as np
import pytest

from snakesim_hal.wire.messages import WorldContact
from snakesim_operator.results.form_closure import form_closure_margin


def touched(*places_and_normals: tuple[float, float, float, float]) -> list[WorldContact]:
    return [
        WorldContact(
            link=0,
            obstacle=None,
            body_s_m=0.0,
            position_w=(x, y, 0.0),
            normal_w=(nx, ny, 0.0),
            tangent_w=(-ny, nx, 0.0),
            force_w=(0.0, 0.0, 0.0),
        )
        for x, y, nx, ny in places_and_normals
    ]


# A square of 0.2 m, touched on each side beside its middle, so that none of its turns is free.
HELD = ((0.1, 0.05, -1, 0), (-0.1, -0.05, 1, 0), (0.05, -0.1, 0, 1), (-0.05, 0.1, 0, -1))


def test_a_square_that_cannot_turn_is_held_until_one_contact_is_gone() -> None:
    wound = [*HELD[:2], (-0.05, -0.1, 0, 1), (0.05, 0.1, 0, -1)]  # two contacts turn it one way, two the other way
    assert form_closure_margin(touched(*wound), 0.1) > 0.05
    assert form_closure_margin(touched(*HELD), 0.1) <= 0.0  # all four turn it the same way
    for gone in range(4):
        assert form_closure_margin(touched(*wound[:gone], *wound[gone + 1 :]), 0.1) <= 0.0


def test_a_body_between_two_walls_may_slide_along_them() -> None:
    assert form_closure_margin(touched(*((x, y, 0, -10 * y) for x in (-0.4, 0.0, 0.4) for y in (-0.1, 0.1))), 0.5) <= 0


def test_pegs_on_both_sides_of_a_wave_hold_it_wherever_it_lies() -> None:
    normals = np.repeat([[-0.6, 0.8], [0.6, 0.8], [-0.6, 0.8]], 2, axis=0) * np.resize([[1.0], [-1.0]], (6, 1))
    places = np.repeat([[0.0, 0.0], [0.3, 0.0], [0.6, 0.0]], 2, axis=0) - 0.04 * normals
    held = form_closure_margin(touched(*np.column_stack([places, normals]).tolist()), 0.5)
    assert held > 0.05
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    moved = np.column_stack([places @ turn.T + (3.0, -2.0), normals @ turn.T])
    assert form_closure_margin(touched(*moved.tolist()), 0.5) == pytest.approx(held)
