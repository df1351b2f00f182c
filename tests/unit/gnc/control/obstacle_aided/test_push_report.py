"""Tests the report of a push: its push-points with their forces, and the reason why a body does not advance."""

from collections.abc import Sequence

import numpy as np
import pytest

from snakesim_gnc.control.contact_forces import NetContactForce
from snakesim_gnc.control.obstacle_aided.push import find_body_contacts, solve_push
from snakesim_gnc.control.obstacle_aided.push_report import (
    explain_push_standstill,
    make_push_point_messages,
)
from snakesim_gnc.geometry.planar_body import PlanarBody
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_testing.gnc.stage import make_robot, make_world

BODY = PlanarBody(make_robot())
BODY_RADIUS_M = 0.04
PEG_RADIUS_M = 0.05
GAP_M = 0.001  # between a peg and the body
WAVE_AMPLITUDE_M = 0.06
WAVE_NUMBER_RAD_PER_M = 2 * np.pi / 0.6
BODY_W = np.vstack(
    [
        np.array(BODY.body_points_s_m),
        WAVE_AMPLITUDE_M * np.sin(WAVE_NUMBER_RAD_PER_M * np.array(BODY.body_points_s_m)),
    ]
)  # a body that undulates along x


def make_peg(name: str, x_m: float, side: int) -> KnownObstacle:
    """Return a peg beside an inflection of the body: on its left (1) or its right (-1)."""
    slope = WAVE_AMPLITUDE_M * WAVE_NUMBER_RAD_PER_M * np.cos(WAVE_NUMBER_RAD_PER_M * x_m)
    left_w = np.array([-slope, 1.0]) / np.hypot(slope, 1.0)
    position_w = np.array([x_m, 0.0]) + side * (PEG_RADIUS_M + BODY_RADIUS_M + GAP_M) * left_w
    return KnownObstacle(
        name=name,
        shape="cylinder",
        position_w=(*position_w.tolist(), 0.1),
        radius_m=PEG_RADIUS_M,
        height_m=0.2,
    )


def solve_push_off(pegs: Sequence[KnownObstacle]):
    """Return the contacts of the body with pegs, and the push off these."""
    outlines = ObstacleOutlines.from_obstacles(pegs)
    contacts = find_body_contacts(BODY_W, BODY_RADIUS_M, outlines, max_gap_m=0.03, friction=0.0)
    angle_slopes = np.zeros(len(BODY_W[0]) - 2)
    return contacts, solve_push(BODY_W, contacts, angle_slopes, contact_gap_scale_m=0.005)


def test_push_report_forces_sum_to_requested_push() -> None:
    push_n = 10.0
    world = make_world(
        obstacles=[make_peg("c", 0.9, -1), make_peg("a", 0.3, -1), make_peg("b", 0.6, 1)]
    )
    contacts, push = solve_push_off(world.obstacles)
    push_points = make_push_point_messages(BODY, world, contacts, push, push_n)
    # Push-points are in order from tail to head.
    assert [point.obstacle for point in push_points] == ["a", "b", "c"]
    force_sum_n = np.sum([point.force_w for point in push_points], axis=0)
    assert push.is_balanced
    assert force_sum_n[0] == pytest.approx(push_n, rel=0.15)
    assert abs(force_sum_n[1]) < 1.0
    # Tangents point to the head.
    assert all(point.tangent_w[0] > 0.0 for point in push_points)


@pytest.mark.parametrize(
    ("pegs", "force_n", "max_force_n", "expected_reason"),
    [
        ((), 5.0, 0.0, "no obstacle is near enough to push off"),
        (
            (make_peg("a", 0.3, -1),),
            5.0,
            0.0,
            "contacts lost, the obstacle beside the body cannot push it forward",
        ),
        (
            (make_peg("a", 0.3, -1), make_peg("b", 0.6, 1), make_peg("c", 0.9, -1)),
            3.0,
            3.0,
            "allow no more than 3.0 N",
        ),
        (
            (make_peg("a", 0.3, -1), make_peg("b", 0.6, 1), make_peg("c", 0.9, -1)),
            9.0,
            30.0,
            "no obstacle touches the body",
        ),
    ],
)
def test_push_standstill_without_contact_forces_is_explained(
    pegs: tuple[KnownObstacle, ...], force_n: float, max_force_n: float, expected_reason: str
) -> None:
    no_contact = NetContactForce(
        max_contact_n=0.0,
        forward_n=0.0,
        backward_n=0.0,
        blocking_obstacle="",
        touched_obstacles=frozenset(),
    )
    contacts, push = solve_push_off(pegs)
    is_jammed, reason = explain_push_standstill(
        contacts, push, force_n, max_force_n, no_contact, ["a", "b", "c"]
    )
    assert not is_jammed
    assert expected_reason in reason
