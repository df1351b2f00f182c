"""Computes the torque with which each joint turns its links on a slippery floor. Pure.

A joint turns the part of the robot that is easier to turn: the one towards the tail, or the one towards the head. The
links of this part slide on the floor, so the joint must overcome their friction:

    torque = friction coefficient * gravity * sum over these links (mass * distance between link's middle and joint)

The robot lies straight.

An outermost joint that turns with less torque turns without its links. A joint between others may turn with less torque
and be sound, because in a small motion the other joints bend before all links slide.
"""

from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene_file.solids import GRAVITY_M_S2

# Of a floor and the links, at least. Hard plastic on a smooth floor has about this friction.
MIN_FLOOR_FRICTION = 0.2


def compute_sliding_torques_nm(
    link_lengths_m: Sequence[float], link_masses_kg: Sequence[float], end_weights_kg: float
) -> list[float]:
    """Return the torque with which each joint turns its links on a slippery floor, tail to head.

    Args:
        link_lengths_m: Length of every link, tail to head.
        link_masses_kg: Mass of every link.
        end_weights_kg: Mass of the weight on each of the first and the last link; 0 for none.
    """
    masses_kg = np.array(link_masses_kg)
    masses_kg[[0, -1]] += end_weights_kg
    front_ends_m = np.cumsum(link_lengths_m)
    centers_m = front_ends_m - np.array(link_lengths_m) / 2
    weights_n = GRAVITY_M_S2 * masses_kg
    joints_m = front_ends_m[:-1]
    return [
        MIN_FLOOR_FRICTION * _find_smaller_moment_nm(weights_n, centers_m - joint_m)
        for joint_m in joints_m.tolist()
    ]


def _find_smaller_moment_nm(weights_n: Floats, distances_m: Floats) -> float:
    """Return the moment of the weights on one side of a joint, of the side where it is smaller.

    Args:
        weights_n: Weight of every link.
        distances_m: Position of the middle of every link, from the joint towards the head.
    """
    moments_nm = weights_n * distances_m
    tail_moment_nm = -float(np.sum(moments_nm[distances_m < 0]))
    head_moment_nm = float(np.sum(moments_nm[distances_m > 0]))
    return min(tail_moment_nm, head_moment_nm)
