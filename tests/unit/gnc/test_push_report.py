"""What a controller tells about its push: where, how hard, and the class of a stall."""

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
NODES = np.vstack(
    [
        np.array(BODY.body_points_s_m),
        0.06 * np.sin(2 * np.pi * np.array(BODY.body_points_s_m) / 0.6),
    ]
)


def peg(name: str, x: float, side: int) -> KnownObstacle:
    """A peg beside the wave at an inflection, 1 mm off the body."""
    slope = 0.06 * 2 * np.pi / 0.6 * np.cos(2 * np.pi * x / 0.6)
    left = np.array([-slope, 1.0]) / np.hypot(slope, 1.0)
    place = np.array([x, 0.0]) + side * (0.05 + 0.04 + 0.001) * left
    return KnownObstacle(
        name=name, shape="cylinder", position_w=(*place.tolist(), 0.1), radius_m=0.05, height_m=0.2
    )


def pushing(pegs: Sequence[KnownObstacle]):
    touches = find_body_contacts(
        NODES, 0.04, ObstacleOutlines.from_obstacles(pegs), max_gap_m=0.03, friction=0.0
    )
    return touches, solve_push(
        NODES, touches, np.zeros(len(NODES[0]) - 2), contact_gap_scale_m=0.005
    )


def test_push_report_forces_sum_to_requested_push() -> None:
    world = make_world(obstacles=[peg("c", 0.9, -1), peg("a", 0.3, -1), peg("b", 0.6, 1)])
    touches, push = pushing(world.obstacles)
    reported = make_push_point_messages(BODY, world, touches, push, 10.0)
    assert [contact.obstacle for contact in reported] == ["a", "b", "c"]  # tail to head
    total = np.sum([contact.force_w for contact in reported], axis=0)
    assert push.is_balanced
    assert total[0] == pytest.approx(10.0, rel=0.15)
    assert abs(total[1]) < 1.0
    assert all(contact.tangent_w[0] > 0.0 for contact in reported)  # towards the head


@pytest.mark.parametrize(
    ("pegs", "force_n", "max_force_n", "words"),
    [
        ((), 5.0, 0.0, "no obstacle is near enough to push off"),
        (
            (peg("a", 0.3, -1),),
            5.0,
            0.0,
            "contacts lost, the obstacle beside the body cannot push it forward",
        ),
        (
            (peg("a", 0.3, -1), peg("b", 0.6, 1), peg("c", 0.9, -1)),
            3.0,
            3.0,
            "allow no more than 3.0 N",
        ),
        (
            (peg("a", 0.3, -1), peg("b", 0.6, 1), peg("c", 0.9, -1)),
            9.0,
            30.0,
            "no obstacle touches the body",
        ),
    ],
)
def test_a_stall_has_a_class(
    pegs: tuple[KnownObstacle, ...], force_n: float, max_force_n: float, words: str
) -> None:
    nothing = NetContactForce(
        max_contact_n=0.0,
        forward_n=0.0,
        backward_n=0.0,
        blocking_obstacle="",
        touched_obstacles=frozenset(),
    )
    jammed, why = explain_push_standstill(
        *pushing(pegs), force_n, max_force_n, nothing, ["a", "b", "c"]
    )
    assert not jammed
    assert words in why
