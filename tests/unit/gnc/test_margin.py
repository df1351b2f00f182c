"""The propulsion margin against brute force, and the forces and torques of a push against statics."""

from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from snakesim_gnc.control.obstacle_aided.push import BodyContacts, find_body_contacts, solve_push
from snakesim_gnc.geometry.planar import compute_wrenches
from snakesim_gnc.navigation.path_search.margin import MAX_CONTACT_FORCE_N, compute_margins_n
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_testing.gnc.stage import BODY_RADIUS_M, compute_body_points, make_stage
from snakesim_testing.hypothesis_profiles import choose_trial_count

SEEDS = st.integers(0, 2**31)


def touching(
    tail_s_m: float, pegs: list[KnownObstacle] | None = None
) -> tuple[np.ndarray, BodyContacts, np.ndarray]:
    """Nodes of a body on the usual route, what touches it, and its joints' change of angle per metre of the way."""
    stage = make_stage()
    nodes = compute_body_points(stage, tail_s_m)
    outlines = ObstacleOutlines.from_obstacles(stage.pegs if pegs is None else pegs)
    slope = (angles_of(compute_body_points(stage, tail_s_m + 0.01)) - angles_of(nodes)) / 0.01
    return (
        nodes,
        find_body_contacts(nodes, BODY_RADIUS_M, outlines, max_gap_m=0.03, friction=0.0),
        slope,
    )


def angles_of(nodes: np.ndarray) -> np.ndarray:
    headings = np.arctan2(*np.diff(nodes, axis=1)[::-1])
    return np.diff(np.unwrap(headings))


@given(seed=SEEDS, count=st.integers(3, 8))
@settings(max_examples=choose_trial_count(50))
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
        # Nearly singular threes may be better still.
        assert found <= best * (1 + 1e-6) or best == 0.0 or found > best


def test_contacts_on_one_side_cannot_push() -> None:
    points = np.array([[0.2, 0.04], [0.6, 0.04], [1.0, 0.04], [1.3, 0.04]])
    contacts = compute_wrenches(points, np.tile([0.0, -1.0], (4, 1)))
    drag = np.array([1.0, 0.0, 0.0])
    assert compute_margins_n(contacts[None], drag[None])[0] == 0.0
    assert compute_margins_n(contacts[None, :2], drag[None])[0] == 0.0  # nor can two


@pytest.mark.parametrize("tail_s_m", [0.1, 0.3, 0.55, 0.9])
def test_a_push_is_in_balance_and_only_pushes(tail_s_m: float) -> None:
    nodes, touches, slope = touching(tail_s_m)
    push = solve_push(nodes, touches, slope, contact_gap_scale_m=0.005)
    assert len(touches) >= 3
    assert push.is_balanced
    assert push.contact_forces.min() >= 0.0
    forces = push.contact_forces[:, None] * touches.directions_w
    run = np.diff(nodes, axis=1).T
    share = np.hypot(*run.T) / np.hypot(*run.T).sum()
    drag = share[:, None] * run / np.hypot(*run.T)[:, None]
    assert forces.sum(axis=0) == pytest.approx(drag.sum(axis=0), abs=0.05)
    middles = nodes[:, :-1].T + 0.5 * run
    moment = np.sum(compute_wrenches(touches.positions_w, forces)[:, 2]) - np.sum(
        compute_wrenches(middles, drag)[:, 2]
    )
    assert moment == pytest.approx(0.0, abs=0.1)
    for joint, torque in enumerate(
        push.joint_torques_nm
    ):  # what is ahead of each joint is in balance, too
        at = nodes[:, joint + 1]
        ahead = touches.body_s_m > np.hypot(*run.T)[: joint + 1].sum()
        held = np.sum(compute_wrenches(touches.positions_w - at, forces)[ahead, 2])
        braked = np.sum(compute_wrenches(middles - at, drag)[joint + 1 :, 2])
        assert torque + held - braked == pytest.approx(0.0, abs=1e-9)


@given(seed=SEEDS)
@settings(max_examples=choose_trial_count(30))
def test_whatever_touches_it_a_balanced_push_has_no_pull(seed: int) -> None:
    random = np.random.default_rng(seed)
    pegs = [peg for peg in make_stage().pegs if random.uniform() < 0.6]
    nodes, touches, slope = touching(float(random.uniform(0.0, 2.0)), pegs)
    push = solve_push(nodes, touches, slope, contact_gap_scale_m=0.005)
    assert (push.contact_forces >= 0.0).all()
    assert np.isfinite(push.joint_torques_nm).all()
    if len(touches) < 3:
        assert not push.is_balanced


@pytest.mark.parametrize("tail_s_m", [0.1, 0.3, 0.55, 0.9])
def test_margin_joints_do_not_work_against_each_other(tail_s_m: float) -> None:
    nodes, touches, slope = touching(tail_s_m)
    thrifty, smallest = (
        solve_push(nodes, touches, one, contact_gap_scale_m=0.005)
        for one in (slope, np.zeros_like(slope))
    )
    assert thrifty.is_balanced
    assert smallest.is_balanced
    done, circled = (np.abs(one.joint_torques_nm * slope).sum() for one in (thrifty, smallest))
    assert done < 0.9 * circled
    assert done < 1.5  # J per metre and newton; by virtual work 1 is the least


@pytest.mark.parametrize("tail_s_m", [0.1, 0.3, 0.55])
def test_margin_contacts_with_extra_cost_leave_push_to_others(tail_s_m: float) -> None:
    nodes, touches, slope = touching(tail_s_m)
    three = np.argsort(touches.body_s_m)[:3]
    dearer = np.full(len(touches), 1000.0)
    dearer[three] = 0.0
    push = solve_push(nodes, touches, slope, contact_gap_scale_m=0.005, extra_cost=dearer)
    usual = solve_push(nodes, touches, slope, contact_gap_scale_m=0.005)
    assert push.balance_residual < 0.1
    assert np.delete(push.contact_forces, three).sum() < 0.2 * push.contact_forces.sum()
    assert (
        len(touches) == 3
        or np.delete(usual.contact_forces, three).sum()
        > np.delete(push.contact_forces, three).sum()
    )
