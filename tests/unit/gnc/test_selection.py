"""Push-points and the choice of a triplet and a joint."""

import math
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from snakesim_gnc.control.obstacle_triplet.contacts import PushPoint, find_push_points, plan_contact
from snakesim_gnc.control.obstacle_triplet.selection import (
    PropulsionChoice,
    TripletFinder,
    choose_triplet,
    find_alternating_triples,
    find_propulsion_joint,
    solve_triplets,
)
from snakesim_gnc.geometry.body_on_path import BodyOnPath
from snakesim_hal.model.geometry.route import Route
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_testing.gnc.stage import (
    BODY_RADIUS_M,
    CLEARANCE_M,
    compute_body_points,
    make_pegs,
    make_route,
    make_stage,
)

SEGMENTS = [0.055, *[0.11] * 12, 0.055]
NODE_S = [0.0, *np.cumsum(SEGMENTS).tolist()]
STRAIGHT = Route([(0.0, 0.0), (5.0, 0.0)])
NEAR = {"search_middle_s_m": 1.5, "window_m": 3.0}
LIMITS = {"gap_m": 0.06, "give_up_gap_m": 0.12, "end_m": 0.03}


def planned_row():
    route = make_route()
    return [plan_contact(route, peg, BODY_RADIUS_M, **NEAR) for peg in make_pegs(route)[:9]]


def points_at(tail_s_m, *, kept=(), off_w=(0.0, 0.0)):
    stage = make_stage()
    lie = BodyOnPath(stage.route, SEGMENTS).compute_pose_at(tail_s_m)
    measured = compute_body_points(stage, tail_s_m) + np.array(off_w)[:, None]
    return find_push_points(planned_row(), kept, lie, measured, NODE_S, **LIMITS), lie


def test_a_peg_is_met_at_its_inflection():
    route = make_route()
    for contact, s in zip(planned_row(), route.find_inflections_s_m(), strict=False):
        assert contact.path_s_m == pytest.approx(s, abs=1e-3)
        assert contact.clearance_m == pytest.approx(CLEARANCE_M, abs=1e-5)
        assert contact.normal_w[0] > 0  # it pushes forward
        assert np.dot(contact.normal_w, contact.tangent_w) == pytest.approx(0.0, abs=1e-12)
    assert [c.side for c in planned_row()[:4]] in ([1, -1, 1, -1], [-1, 1, -1, 1])


@pytest.mark.parametrize(
    ("y_m", "shape", "clearance_m"),
    [
        (0.1, {"shape": "sphere", "radius_m": 0.03}, 0.03),
        (-0.1, {"shape": "sphere", "radius_m": 0.03}, 0.03),
        (
            0.3,
            {"shape": "box", "yaw_rad": math.pi / 4, "half_size_m": (0.1, 0.1, 0.1)},
            0.26 - 0.1 * math.sqrt(2),
        ),
    ],
    ids=["ball on the left", "ball on the right", "corner of a turned box"],
)
def test_selection_beside_straight_path_uses_nearest_obstacle_point(y_m, shape, clearance_m):
    contact = plan_contact(
        STRAIGHT, KnownObstacle(name="it", position_w=(2.0, y_m, 0.0), **shape), 0.04, **NEAR
    )
    assert contact.point_w == pytest.approx((2.0, 0.0), abs=1e-3)
    assert contact.normal_w == pytest.approx((0.0, -math.copysign(1.0, y_m)))
    assert contact.side == -math.copysign(1.0, y_m)
    assert contact.clearance_m == pytest.approx(clearance_m, abs=1e-4)


def test_a_box_that_the_path_runs_into_has_no_clearance():
    box = KnownObstacle(
        name="box", shape="box", position_w=(2.0, -0.05, 0.0), half_size_m=(0.1, 0.1, 0.1)
    )
    contact = plan_contact(STRAIGHT, box, 0.04, **NEAR)
    assert contact.clearance_m < -0.04
    assert contact.side == 1


def test_push_points_are_those_that_the_body_covers():
    points, lie = points_at(0.2)
    assert [p.contact.obstacle for p in points] == ["peg_0", "peg_1", "peg_2", "peg_3", "peg_4"]
    for point in points:
        on_body = [np.interp(point.contact.path_s_m, lie.body_points_s_m, NODE_S)]
        assert [point.body_s_m] == pytest.approx(on_body)
        assert point.gap_m == pytest.approx(CLEARANCE_M, abs=2e-3)


def test_selection_body_off_path_is_too_far_from_push_points():
    near, _ = points_at(0.2, off_w=(0.07, 0.0))
    assert near  # that is mostly along the path
    far, _ = points_at(0.2, off_w=(0.0, 0.08))
    assert not far


def test_what_is_being_pushed_may_get_further_away():
    off = (0.0, 0.08)
    names = [p.contact.obstacle for p in points_at(0.2)[0]]
    assert len(points_at(0.2, kept=names, off_w=off)[0]) > len(points_at(0.2, off_w=off)[0])
    assert not points_at(0.2, kept=names, off_w=(5.0, 5.0))[0]


def test_contacts_at_the_tips_do_not_count():
    s = make_route().find_inflections_s_m()[0]
    assert "peg_0" in [p.contact.obstacle for p in points_at(s - 0.04)[0]]
    assert "peg_0" not in [p.contact.obstacle for p in points_at(s - 0.02)[0]]


@given(st.lists(st.sampled_from([-1, 1]), max_size=10))
def test_every_three_on_alternating_sides_are_a_triple(sides):
    found = find_alternating_triples(sides)
    threes = combinations(range(len(sides)), 3)
    assert sorted(found) == [(i, j, k) for i, j, k in threes if sides[i] == -sides[j] == sides[k]]


@given(st.floats(0.0, 1.2), st.floats(0.05, 0.5), st.one_of(st.none(), st.integers(0, 12)))
def test_selection_propulsion_joint_is_first_ahead_of_middle_contact(behind, distance, present):
    joint = find_propulsion_joint(NODE_S, behind, behind + distance, present, 0.003)
    between = [i for i in range(13) if behind < NODE_S[i + 1] < behind + distance]
    if joint is None:
        assert not between
    else:
        assert joint in between
        assert joint == between[0] or (
            joint == present == between[0] + 1 and NODE_S[between[0] + 1] - behind < 0.003
        )


def test_noise_does_not_pass_the_turn_to_and_fro():
    place = NODE_S[6]
    assert find_propulsion_joint(NODE_S, place - 0.001, 1.2, 6, 0.003) == 6
    assert find_propulsion_joint(NODE_S, place - 0.004, 1.2, 6, 0.003) == 5
    assert find_propulsion_joint(NODE_S, place - 0.001, 1.2, 5, 0.003) == 5
    assert find_propulsion_joint(NODE_S, place - 0.001, 1.2, None, 0.003) == 5


def choices_in_row(count=7):
    row = planned_row()
    triplets = solve_triplets(
        [(row[i], row[i + 1], row[i + 2]) for i in range(count)], condition_max=100.0
    )
    return [
        PropulsionChoice(t, (0.1 + 0.3 * i, 0.4 + 0.3 * i, 0.7 + 0.3 * i), 3 + i, 0.1)
        for i, t in enumerate(triplets)
    ]


def test_selection_keeps_triplet_and_successor_shares_most_push_points():
    row = choices_in_row()
    assert choose_triplet(row, row[3].triplet, switch_fraction=0.5) is row[3]
    rest = [row[0], row[1], row[4], row[6]]
    assert choose_triplet(rest, row[3].triplet, switch_fraction=0.5) is row[4]


def test_of_equals_the_one_nearest_to_the_tail_is_chosen():
    row = choices_in_row()
    assert choose_triplet(row, None, switch_fraction=0.5) is row[0]
    assert (
        choose_triplet(row, None, switch_fraction=0.5, banned_triplets=[row[0].triplet.names])
        is row[1]
    )
    assert (
        choose_triplet(
            row, None, switch_fraction=0.5, banned_triplets=[c.triplet.names for c in row]
        )
        is None
    )


def test_points_become_choices_with_a_joint_each():
    points, lie = points_at(0.2)
    triplets = TripletFinder(condition_max=100.0, authority_min=0.02, hold_on_m=0.003)
    found, refused = triplets.find_propulsion_choices(points, lie.body_points_w, NODE_S, None, None)
    threes = [[int(name[-1]) for name in c.triplet.names] for c in found]
    assert threes == [[0, 1, 2], [0, 1, 4], [1, 2, 3], [2, 3, 4]]
    assert len(refused) == 1
    assert "peg_0/peg_3/peg_4: a contact would have to pull: lambda_1" in refused[0]
    for choice in found:
        assert choice.body_s_m[1] < NODE_S[choice.joint + 1] < choice.body_s_m[2]
        assert abs(choice.torque_per_n) <= choice.triplet.torque_per_n + 1e-9
    barred, why = triplets.find_propulsion_choices(
        points, lie.body_points_w, NODE_S, None, found[0].joint
    )
    assert [c.joint for c in barred] == [c.joint for c in found if c.joint != found[0].joint]
    assert len(barred) + len(why) == len(found) + len(refused)


@pytest.mark.parametrize(
    ("slope_deg", "pushes"),
    [(29.5, ["012", "014", "123", "234"]), (30.5, ["014"]), (37.5, ["014"]), (38.0, [])],
)
def test_the_steepest_wave_depends_on_the_spacing(slope_deg: float, pushes: list[str]):
    """On a row of pegs at distances a and b along a wave of slope alpha, lambda_1 > 0 where cos 2 alpha > a/(a + b)."""
    route = make_route(math.tan(math.radians(slope_deg)) * 0.6 / math.tau)
    planned = [plan_contact(route, peg, BODY_RADIUS_M, **NEAR) for peg in make_pegs(route)[:5]]
    points = [PushPoint(contact, 0.1 + 0.3 * i, 0.0) for i, contact in enumerate(planned)]
    triplets = TripletFinder(condition_max=100.0, authority_min=0.02, hold_on_m=0.003)
    found, refused = triplets.find_propulsion_choices(
        points, BodyOnPath(route, SEGMENTS).compute_pose_at(0.2).body_points_w, NODE_S, None, None
    )
    assert ["".join(name[-1] for name in c.triplet.names) for c in found] == pushes
    assert all("lambda_1" in why for why in refused)
