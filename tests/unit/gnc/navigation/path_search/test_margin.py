"""Compares propulsion margins with a brute-force search, and checks the forces and torques of a push by statics."""

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
GAP_SCALE_M = 0.005


def make_touched_body(
    tail_s_m: float, pegs: list[KnownObstacle] | None = None
) -> tuple[np.ndarray, BodyContacts, np.ndarray]:
    """Return a body on the usual route among pegs.

    Returns:
        Body points (2, n), contacts, and the change of each joint's angle per metre of the way.
    """
    stage = make_stage()
    step_m = 0.01
    body_w = compute_body_points(stage, tail_s_m)
    next_body_w = compute_body_points(stage, tail_s_m + step_m)
    angle_slopes = (
        compute_joint_angles_rad(next_body_w) - compute_joint_angles_rad(body_w)
    ) / step_m
    outlines = ObstacleOutlines.from_obstacles(stage.pegs if pegs is None else pegs)
    contacts = find_body_contacts(body_w, BODY_RADIUS_M, outlines, max_gap_m=0.03, friction=0.0)
    return body_w, contacts, angle_slopes


def compute_joint_angles_rad(body_w: np.ndarray) -> np.ndarray:
    """Return the angles of the joints of a body with these points (2, n)."""
    headings_rad = np.arctan2(*np.diff(body_w, axis=1)[::-1])
    return np.diff(np.unwrap(headings_rad))


@given(seed=SEEDS, count=st.integers(3, 8))
@settings(max_examples=choose_trial_count(50))
def test_margin_is_that_of_the_best_three_contacts(seed: int, count: int) -> None:
    random = np.random.default_rng(seed)
    wrenches = random.normal(size=(2, count, 3))
    drag = random.normal(size=(2, 3))
    for body in range(2):
        best_n = 0.0
        for three in combinations(range(count), 3):
            matrix = wrenches[body, three].T
            if abs(np.linalg.det(matrix)) > 1e-3:
                forces = np.linalg.solve(matrix, drag[body])
                if forces.min() > 1e-9:
                    best_n = max(best_n, MAX_CONTACT_FORCE_N / forces.max())
        margin_n = compute_margins_n(wrenches, drag)[body]
        assert margin_n >= best_n * (1 - 1e-6)
        # Nearly singular threes, which this test leaves out, may be better still.
        assert margin_n <= best_n * (1 + 1e-6) or best_n == 0.0 or margin_n > best_n


def test_margin_of_contacts_on_one_side_is_zero() -> None:
    points_m = np.array([[0.2, 0.04], [0.6, 0.04], [1.0, 0.04], [1.3, 0.04]])
    wrenches = compute_wrenches(points_m, np.tile([0.0, -1.0], (4, 1)))
    drag = np.array([1.0, 0.0, 0.0])
    assert compute_margins_n(wrenches[None], drag[None])[0] == 0.0
    # Two contacts cannot push either.
    assert compute_margins_n(wrenches[None, :2], drag[None])[0] == 0.0


@pytest.mark.parametrize("tail_s_m", [0.1, 0.3, 0.55, 0.9])
def test_push_balances_drag_with_forces_that_never_pull(tail_s_m: float) -> None:
    body_w, contacts, angle_slopes = make_touched_body(tail_s_m)
    push = solve_push(body_w, contacts, angle_slopes, contact_gap_scale_m=GAP_SCALE_M)
    assert len(contacts) >= 3
    assert push.is_balanced
    assert push.contact_forces.min() >= 0.0

    # The contacts balance a drag of 1 N that acts on the links along the body.
    forces = push.contact_forces[:, None] * contacts.directions_w
    segments_w = np.diff(body_w, axis=1).T
    lengths_m = np.hypot(*segments_w.T)
    drag = (lengths_m / lengths_m.sum())[:, None] * segments_w / lengths_m[:, None]
    assert forces.sum(axis=0) == pytest.approx(drag.sum(axis=0), abs=0.05)
    middles_w = body_w[:, :-1].T + 0.5 * segments_w
    contact_moment = np.sum(compute_wrenches(contacts.positions_w, forces)[:, 2])
    drag_moment = np.sum(compute_wrenches(middles_w, drag)[:, 2])
    assert contact_moment - drag_moment == pytest.approx(0.0, abs=0.1)

    # The part of the body ahead of each joint is in balance, too.
    for joint, torque_nm in enumerate(push.joint_torques_nm):
        joint_w = body_w[:, joint + 1]
        is_ahead = contacts.body_s_m > lengths_m[: joint + 1].sum()
        contact_moment = np.sum(
            compute_wrenches(contacts.positions_w - joint_w, forces)[is_ahead, 2]
        )
        drag_moment = np.sum(compute_wrenches(middles_w - joint_w, drag)[joint + 1 :, 2])
        assert torque_nm + contact_moment - drag_moment == pytest.approx(0.0, abs=1e-9)


@given(seed=SEEDS)
@settings(max_examples=choose_trial_count(30))
def test_push_off_random_pegs_never_pulls(seed: int) -> None:
    random = np.random.default_rng(seed)
    pegs = [peg for peg in make_stage().pegs if random.uniform() < 0.6]
    body_w, contacts, angle_slopes = make_touched_body(float(random.uniform(0.0, 2.0)), pegs)
    push = solve_push(body_w, contacts, angle_slopes, contact_gap_scale_m=GAP_SCALE_M)
    assert (push.contact_forces >= 0.0).all()
    assert np.isfinite(push.joint_torques_nm).all()
    if len(contacts) < 3:
        assert not push.is_balanced


@pytest.mark.parametrize("tail_s_m", [0.1, 0.3, 0.55, 0.9])
def test_push_joints_do_not_work_against_each_other(tail_s_m: float) -> None:
    body_w, contacts, angle_slopes = make_touched_body(tail_s_m)
    # The second solver does not know how the joints move, so that it minimizes forces and not work.
    least_work, least_force = (
        solve_push(body_w, contacts, slopes, contact_gap_scale_m=GAP_SCALE_M)
        for slopes in (angle_slopes, np.zeros_like(angle_slopes))
    )
    assert least_work.is_balanced
    assert least_force.is_balanced
    # Work in J per metre of the way and per newton of the push. By virtual work, 1 is the minimum.
    work, work_of_least_force = (
        np.abs(push.joint_torques_nm * angle_slopes).sum() for push in (least_work, least_force)
    )
    assert work < 0.9 * work_of_least_force
    assert work < 1.5


@pytest.mark.parametrize("tail_s_m", [0.1, 0.3, 0.55])
def test_push_contacts_with_extra_cost_carry_less_force(tail_s_m: float) -> None:
    body_w, contacts, angle_slopes = make_touched_body(tail_s_m)
    cheap_contacts = np.argsort(contacts.body_s_m)[:3]
    extra_cost = np.full(len(contacts), 1000.0)
    extra_cost[cheap_contacts] = 0.0
    push = solve_push(
        body_w, contacts, angle_slopes, contact_gap_scale_m=GAP_SCALE_M, extra_cost=extra_cost
    )
    usual_push = solve_push(body_w, contacts, angle_slopes, contact_gap_scale_m=GAP_SCALE_M)
    costly_forces_n = np.delete(push.contact_forces, cheap_contacts)
    usual_costly_forces_n = np.delete(usual_push.contact_forces, cheap_contacts)
    assert push.balance_residual < 0.1
    assert costly_forces_n.sum() < 0.2 * push.contact_forces.sum()
    assert len(contacts) == 3 or usual_costly_forces_n.sum() > costly_forces_n.sum()
