"""The propulsion margin against brute force, and the forces and torques of a push against statics."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snakesim_gnc.control.push import Touches, find_touches, push_forward
from snakesim_gnc.geometry.planar import wrenches
from snakesim_gnc.navigation.path_search.margin import MAX_CONTACT_FORCE_N, compute_margins_n
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Obstacle
from snakesim_testing.gnc.stage import BODY_RADIUS_M, make_stage, nodes_of

SEEDS = st.integers(0, 2**31)


def touching(tail_s_m: float, pegs: list[Obstacle] | None = None) -> tuple[np.ndarray, Touches, np.ndarray]:
    """Nodes of a body on the usual route, what touches it, and its joints' change of angle per metre of the way."""
    stage = make_stage()
    nodes = nodes_of(stage, tail_s_m)
    outlines = Outlines.from_obstacles(stage.pegs if pegs is None else pegs)
    slope = (angles_of(nodes_of(stage, tail_s_m + 0.01)) - angles_of(nodes)) / 0.01
    return nodes, find_touches(nodes, BODY_RADIUS_M, outlines, reach_m=0.03, friction=0.0), slope


def angles_of(nodes: np.ndarray) -> np.ndarray:
    headings = np.arctan2(*np.diff(nodes, axis=1)[::-1])
    return np.diff(np.unwrap(headings))


@given(seed=SEEDS, count=st.integers(3, 8))
@settings(max_examples=50)
def test_the_margin_is_that_of_the_best_three_contacts(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    contacts, drag = random.normal(size=(2, count, 3)), random.normal(size=(2, 3))
    for body in range(2):
        best = 0.0
        for three in combinations(range(count), 3):
            matrix = contacts[body, three].T
            if abs(np.linalg.det(matrix)) > 1e-3:
                forces = np.linalg.solve(matrix, drag[body])
                if forces.min() > 1e-9:
                    best = max(best, MAX_CONTACT_FORCE_N / forces.max())
        found = compute_margins_n(contacts, drag)[body]
        assert found >= best * (1 - 1e-6)
        assert found <= best * (1 + 1e-6) or best == 0.0 or found > best  # nearly singular threes may be better still


def test_contacts_on_one_side_cannot_push() -> None:
    points = np.array([[0.2, 0.04], [0.6, 0.04], [1.0, 0.04], [1.3, 0.04]])
    contacts = wrenches(points, np.tile([0.0, -1.0], (4, 1)))
    drag = np.array([1.0, 0.0, 0.0])
    assert compute_margins_n(contacts[None], drag[None])[0] == 0.0
    assert compute_margins_n(contacts[None, :2], drag[None])[0] == 0.0  # nor can two


@pytest.mark.parametrize("tail_s_m", [0.1, 0.3, 0.55, 0.9])
def test_a_push_is_in_balance_and_only_pushes(tail_s_m: float) -> None:
    nodes, touches, slope = touching(tail_s_m)
    push = push_forward(nodes, touches, slope, contact_gap_scale_m=0.005)
    assert len(touches) >= 3
    assert push.balanced
    assert push.lambdas.min() >= 0.0
    forces = push.lambdas[:, None] * touches.directions_w
    run = np.diff(nodes, axis=1).T
    share = np.hypot(*run.T) / np.hypot(*run.T).sum()
    drag = share[:, None] * run / np.hypot(*run.T)[:, None]
    assert forces.sum(axis=0) == pytest.approx(drag.sum(axis=0), abs=0.05)
    middles = nodes[:, :-1].T + 0.5 * run
    moment = np.sum(wrenches(touches.places_w, forces)[:, 2]) - np.sum(wrenches(middles, drag)[:, 2])
    assert moment == pytest.approx(0.0, abs=0.1)
    for joint, torque in enumerate(push.torques_nm):  # what is ahead of each joint is in balance, too
        at = nodes[:, joint + 1]
        ahead = touches.body_s_m > np.hypot(*run.T)[: joint + 1].sum()
        held = np.sum(wrenches(touches.places_w - at, forces)[ahead, 2])
        braked = np.sum(wrenches(middles - at, drag)[joint + 1 :, 2])
        assert torque + held - braked == pytest.approx(0.0, abs=1e-9)


@given(seed=SEEDS)
@settings(max_examples=30)
def test_whatever_touches_it_a_balanced_push_has_no_pull(seed: int) -> None:
    random = np.random.default_rng(seed)
    pegs = [peg for peg in make_stage().pegs if random.uniform() < 0.6]
    nodes, touches, slope = touching(float(random.uniform(0.0, 2.0)), pegs)
    push = push_forward(nodes, touches, slope, contact_gap_scale_m=0.005)
    assert (push.lambdas >= 0.0).all()
    assert np.isfinite(push.torques_nm).all()
    if len(touches) < 3:
        assert not push.balanced


@pytest.mark.parametrize("tail_s_m", [0.1, 0.3, 0.55, 0.9])
def test_margin_joints_do_not_work_against_each_other(tail_s_m: float) -> None:
    nodes, touches, slope = touching(tail_s_m)
    thrifty, smallest = (
        push_forward(nodes, touches, one, contact_gap_scale_m=0.005) for one in (slope, np.zeros_like(slope))
    )
    assert thrifty.balanced
    assert smallest.balanced
    done, circled = (np.abs(one.torques_nm * slope).sum() for one in (thrifty, smallest))
    assert done < 0.9 * circled
    assert done < 1.5  # J per metre and newton; by virtual work 1 is the least


@pytest.mark.parametrize("tail_s_m", [0.1, 0.3, 0.55])
def test_margin_contacts_with_extra_cost_leave_push_to_others(tail_s_m: float) -> None:
    nodes, touches, slope = touching(tail_s_m)
    three = np.argsort(touches.body_s_m)[:3]
    dearer = np.full(len(touches), 1000.0)
    dearer[three] = 0.0
    push = push_forward(nodes, touches, slope, contact_gap_scale_m=0.005, extra_cost=dearer)
    usual = push_forward(nodes, touches, slope, contact_gap_scale_m=0.005)
    assert push.residual < 0.1
    assert np.delete(push.lambdas, three).sum() < 0.2 * push.lambdas.sum()
    assert len(touches) == 3 or np.delete(usual.lambdas, three).sum() > np.delete(push.lambdas, three).sum()
