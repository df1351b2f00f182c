"""Computes the torque with which a joint turns its links on a slippery floor."""

import pytest

from snakesim_operator.features.commissioning.joint_check.sliding_torque import (
    MIN_FLOOR_FRICTION,
    compute_sliding_torques_nm,
)

LENGTHS_M = [0.05, 0.1, 0.1, 0.05]
MASSES_KG = [0.15, 0.3, 0.3, 0.15]
FRICTION = MIN_FLOOR_FRICTION * 9.81


def test_sliding_torque_of_end_joint_contains_its_link_and_weight() -> None:
    torque_nm = FRICTION * (0.15 + 1.0) * 0.025  # the friction acts in the middle of the link
    torques_nm = compute_sliding_torques_nm(LENGTHS_M, MASSES_KG, end_weights_kg=1.0)
    assert torques_nm[0] == pytest.approx(torque_nm, rel=1e-3)
    assert torques_nm[-1] == pytest.approx(torque_nm, rel=1e-3)


def test_sliding_torque_of_middle_joint_contains_all_links_of_one_side() -> None:
    torque_nm = FRICTION * (0.3 * 0.05 + 0.15 * 0.125)
    torques_nm = compute_sliding_torques_nm(LENGTHS_M, MASSES_KG, end_weights_kg=0.0)
    assert torques_nm[1] == pytest.approx(torque_nm, rel=1e-3)


def test_sliding_torque_is_that_of_the_lighter_side() -> None:
    heavy_tail_kg = [5.0, *MASSES_KG[1:]]
    torques_nm = compute_sliding_torques_nm(LENGTHS_M, heavy_tail_kg, end_weights_kg=0.0)
    assert torques_nm[1] == pytest.approx(FRICTION * (0.3 * 0.05 + 0.15 * 0.125), rel=1e-3)
