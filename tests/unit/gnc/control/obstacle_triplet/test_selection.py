"""Tests how push-points are found, and how a triplet of them and a propulsion joint are chosen."""

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
BODY_S_M = [0.0, *np.cumsum(SEGMENTS).tolist()]  # of the tail, the joints and the head, on the body
STRAIGHT = Route([(0.0, 0.0), (5.0, 0.0)])
SEARCH_WINDOW = {"search_middle_s_m": 1.5, "window_m": 3.0}  # on the path
LIMITS = {"gap_m": 0.06, "give_up_gap_m": 0.12, "end_m": 0.03}
HYSTERESIS_M = 0.003  # by which noise must not change the propulsion joint
TAIL_S_M = 0.2  # place of the tail on the path, from where the body covers the first five pegs


def plan_peg_contacts():
    """Return the planned contacts with the first nine pegs along the usual route, from tail to head."""
    route = make_route()
    return [
        plan_contact(route, peg, BODY_RADIUS_M, **SEARCH_WINDOW) for peg in make_pegs(route)[:9]
    ]


def find_points_at(tail_s_m, *, kept=(), offset_w=(0.0, 0.0)):
    """Return the push-points of a body at this place of the path, or beside it, and its pose on the path."""
    stage = make_stage()
    pose = BodyOnPath(stage.route, SEGMENTS).compute_pose_at(tail_s_m)
    measured_w = compute_body_points(stage, tail_s_m) + np.array(offset_w)[:, None]
    points = find_push_points(plan_peg_contacts(), kept, pose, measured_w, BODY_S_M, **LIMITS)
    return points, pose


def list_obstacles(points):
    return [point.contact.obstacle for point in points]


def test_planned_contact_with_peg_is_at_an_inflection():
    contacts = plan_peg_contacts()
    for contact, inflection_s_m in zip(contacts, make_route().find_inflections_s_m(), strict=False):
        assert contact.path_s_m == pytest.approx(inflection_s_m, abs=1e-3)
        assert contact.clearance_m == pytest.approx(CLEARANCE_M, abs=1e-5)
        assert contact.normal_w[0] > 0, "the peg pushes forward"
        assert np.dot(contact.normal_w, contact.tangent_w) == pytest.approx(0.0, abs=1e-12)
    sides = [contact.side for contact in contacts[:4]]
    assert sides in ([1, -1, 1, -1], [-1, 1, -1, 1])


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
def test_planned_contact_beside_straight_path_uses_nearest_obstacle_point(y_m, shape, clearance_m):
    obstacle = KnownObstacle(name="obstacle", position_w=(2.0, y_m, 0.0), **shape)
    contact = plan_contact(STRAIGHT, obstacle, BODY_RADIUS_M, **SEARCH_WINDOW)
    assert contact.point_w == pytest.approx((2.0, 0.0), abs=1e-3)
    assert contact.normal_w == pytest.approx((0.0, -math.copysign(1.0, y_m)))
    assert contact.side == -math.copysign(1.0, y_m)
    assert contact.clearance_m == pytest.approx(clearance_m, abs=1e-4)


def test_planned_contact_with_box_on_path_has_negative_clearance():
    box = KnownObstacle(
        name="box", shape="box", position_w=(2.0, -0.05, 0.0), half_size_m=(0.1, 0.1, 0.1)
    )
    contact = plan_contact(STRAIGHT, box, BODY_RADIUS_M, **SEARCH_WINDOW)
    assert contact.clearance_m < -0.04
    assert contact.side == 1


def test_push_points_are_contacts_that_the_body_covers():
    points, pose = find_points_at(TAIL_S_M)

    assert list_obstacles(points) == ["peg_0", "peg_1", "peg_2", "peg_3", "peg_4"]
    for point in points:
        body_s_m = np.interp(point.contact.path_s_m, pose.body_points_s_m, BODY_S_M)
        assert [point.body_s_m] == pytest.approx([body_s_m])
        assert point.gap_m == pytest.approx(CLEARANCE_M, abs=2e-3)


def test_push_points_of_body_beside_path_are_too_far():
    """A new push-point has a gap of at most 6 cm. A shift along x, as the path leads, hardly changes it."""
    shifted_along_path, _ = find_points_at(TAIL_S_M, offset_w=(0.07, 0.0))
    shifted_across_path, _ = find_points_at(TAIL_S_M, offset_w=(0.0, 0.08))

    assert shifted_along_path
    assert not shifted_across_path


def test_present_push_points_may_be_further_away_than_new_ones():
    """A present push-point is given up at a gap of 12 cm, twice the gap at which a new one is found."""
    beside_path_w = (0.0, 0.08)
    present = list_obstacles(find_points_at(TAIL_S_M)[0])

    new_points, _ = find_points_at(TAIL_S_M, offset_w=beside_path_w)
    kept_points, _ = find_points_at(TAIL_S_M, kept=present, offset_w=beside_path_w)

    assert len(kept_points) > len(new_points)


def test_present_push_points_far_from_body_are_given_up():
    present = list_obstacles(find_points_at(TAIL_S_M)[0])

    distant_points, _ = find_points_at(TAIL_S_M, kept=present, offset_w=(5.0, 5.0))

    assert not distant_points


def test_contacts_at_the_tips_of_body_are_no_push_points():
    """The last 3 cm of the body cannot push: `end_m` in LIMITS."""
    contact_s_m = make_route().find_inflections_s_m()[0]

    inside, _ = find_points_at(contact_s_m - 0.04)  # the contact is 4 cm ahead of the tail
    at_tip, _ = find_points_at(contact_s_m - 0.02)

    assert "peg_0" in list_obstacles(inside)
    assert "peg_0" not in list_obstacles(at_tip)


@given(st.lists(st.sampled_from([-1, 1]), max_size=10))
def test_alternating_triples_are_all_threes_on_alternating_sides(sides):
    triples = find_alternating_triples(sides)
    combined = combinations(range(len(sides)), 3)
    assert sorted(triples) == [
        (i, j, k) for i, j, k in combined if sides[i] == -sides[j] == sides[k]
    ]


@given(st.floats(0.0, 1.2), st.floats(0.05, 0.5), st.one_of(st.none(), st.integers(0, 12)))
def test_selection_propulsion_joint_is_first_ahead_of_middle_contact(
    middle_s_m, distance_m, present_joint
):
    head_s_m = middle_s_m + distance_m  # of the contact nearest to the head

    joint = find_propulsion_joint(BODY_S_M, middle_s_m, head_s_m, present_joint, HYSTERESIS_M)

    between = [i for i in range(13) if middle_s_m < BODY_S_M[i + 1] < head_s_m]
    if joint is None:
        assert not between, "a joint is between the contacts, but none was found"
    else:
        assert joint in between
        first = between[0]
        is_kept = (
            joint == present_joint == first + 1 and BODY_S_M[first + 1] - middle_s_m < HYSTERESIS_M
        )
        assert joint == first or is_kept, "another joint than the first is not the present one"


FIRST_JOINT = 5  # ahead of a middle contact that is just behind it
FIRST_JOINT_S_M = BODY_S_M[FIRST_JOINT + 1]  # BODY_S_M begins with the tail


@pytest.mark.parametrize(
    ("distance_m", "present_joint", "expected_joint"),
    [
        (0.001, FIRST_JOINT + 1, FIRST_JOINT + 1),
        (0.004, FIRST_JOINT + 1, FIRST_JOINT),
        (0.001, FIRST_JOINT, FIRST_JOINT),
        (0.001, None, FIRST_JOINT),
    ],
    ids=[
        "next joint is kept within the hysteresis",
        "next joint is given up beyond the hysteresis",
        "first joint is kept",
        "first joint is chosen without a present one",
    ],
)
def test_selection_noise_does_not_change_the_propulsion_joint(
    distance_m: float, present_joint: int | None, expected_joint: int
):
    """When the middle contact passes a joint, the present joint stays until the contact is 3 mm away."""
    middle_s_m = FIRST_JOINT_S_M - distance_m
    head_s_m = 1.2  # of the contact nearest to the head, with several joints between the contacts

    joint = find_propulsion_joint(BODY_S_M, middle_s_m, head_s_m, present_joint, HYSTERESIS_M)

    assert joint == expected_joint


def make_choices(count=7):
    """Return choices of neighboring triplets, each one peg nearer to the head than the one before."""
    contacts = plan_peg_contacts()
    triplets = solve_triplets(
        [(contacts[i], contacts[i + 1], contacts[i + 2]) for i in range(count)],
        condition_max=100.0,
    )
    return [
        PropulsionChoice(triplet, (0.1 + 0.3 * i, 0.4 + 0.3 * i, 0.7 + 0.3 * i), 3 + i, 0.1)
        for i, triplet in enumerate(triplets)
    ]


SWITCH_FRACTION = (
    0.5  # another triplet must need less torque than this fraction to replace the present one
)


def test_selection_keeps_the_present_triplet():
    choices = make_choices()
    present = choices[3]

    chosen = choose_triplet(choices, present.triplet, switch_fraction=SWITCH_FRACTION)

    assert chosen is present


def test_selection_of_successor_shares_most_push_points_with_present_triplet():
    """Without triplet 3, triplet 4 follows: it shares two of its three pegs, the others share at most one."""
    choices = make_choices()
    present = choices[3]
    left = [choices[0], choices[1], choices[4], choices[6]]

    chosen = choose_triplet(left, present.triplet, switch_fraction=SWITCH_FRACTION)

    assert chosen is choices[4]


def test_selection_of_equal_triplets_is_nearest_to_the_tail():
    choices = make_choices()

    assert choose_triplet(choices, None, switch_fraction=SWITCH_FRACTION) is choices[0]


def test_selection_skips_banned_triplets():
    choices = make_choices()
    names = [choice.triplet.names for choice in choices]

    without_first = choose_triplet(
        choices, None, switch_fraction=SWITCH_FRACTION, banned_triplets=names[:1]
    )
    without_all = choose_triplet(
        choices, None, switch_fraction=SWITCH_FRACTION, banned_triplets=names
    )

    assert without_first is choices[1]
    assert without_all is None


def make_triplet_finder() -> TripletFinder:
    return TripletFinder(condition_max=100.0, authority_min=0.02, hold_on_m=HYSTERESIS_M)


def find_choices_of_five_pegs(
    excluded_joint: int | None = None,
) -> tuple[list[PropulsionChoice], list[str]]:
    """Return the choices and the refusals for a body that touches peg_0 to peg_4, without a present choice."""
    points, pose = find_points_at(TAIL_S_M)
    choices, refusals = make_triplet_finder().find_propulsion_choices(
        points, pose.body_points_w, BODY_S_M, None, excluded_joint
    )
    return list(choices), list(refusals)


def test_triplet_finder_returns_alternating_triplets_that_push():
    """Of five pegs on alternating sides, five triplets alternate. In one of them a contact would have to pull."""
    choices, refusals = find_choices_of_five_pegs()

    assert [choice.triplet.names for choice in choices] == [
        ("peg_0", "peg_1", "peg_2"),
        ("peg_0", "peg_1", "peg_4"),
        ("peg_1", "peg_2", "peg_3"),
        ("peg_2", "peg_3", "peg_4"),
    ]
    assert len(refusals) == 1
    assert "peg_0/peg_3/peg_4: a contact would have to pull: lambda_1" in refusals[0]


def test_triplet_finder_chooses_joints_between_middle_and_front_contact():
    choices, _ = find_choices_of_five_pegs()

    assert choices, "there is nothing to compare"
    for choice in choices:
        _, middle_s_m, front_s_m = choice.body_s_m
        joint_s_m = BODY_S_M[choice.joint + 1]  # BODY_S_M begins with the tail
        assert middle_s_m < joint_s_m < front_s_m, choice.triplet.names


def test_triplet_finder_joint_needs_at_most_torque_of_its_triplet():
    choices, _ = find_choices_of_five_pegs()

    assert choices, "there is nothing to compare"
    for choice in choices:
        assert abs(choice.torque_per_n) <= choice.triplet.torque_per_n + 1e-9, choice.triplet.names


def test_triplet_finder_refuses_triplets_of_an_excluded_joint():
    choices, refusals = find_choices_of_five_pegs()
    excluded_joint = choices[0].joint

    other_choices, more_refusals = find_choices_of_five_pegs(excluded_joint)

    assert [choice.joint for choice in other_choices] == [
        choice.joint for choice in choices if choice.joint != excluded_joint
    ]
    assert len(other_choices) + len(more_refusals) == len(choices) + len(refusals), (
        "each triplet is a choice, or is refused with a reason"
    )


@pytest.mark.parametrize(
    ("slope_deg", "expected_triplets"),
    [(29.5, ["012", "014", "123", "234"]), (30.5, ["014"]), (37.5, ["014"]), (38.0, [])],
)
def test_triplet_finder_maximum_slope_depends_on_peg_spacing(
    slope_deg: float, expected_triplets: list[str]
):
    """On a row of pegs at distances a and b along a wave of slope alpha, lambda_1 > 0 where cos 2 alpha > a/(a + b)."""
    route = make_route(math.tan(math.radians(slope_deg)) * 0.6 / math.tau)
    contacts = [
        plan_contact(route, peg, BODY_RADIUS_M, **SEARCH_WINDOW) for peg in make_pegs(route)[:5]
    ]
    points = [PushPoint(contact, 0.1 + 0.3 * i, 0.0) for i, contact in enumerate(contacts)]
    body_w = BodyOnPath(route, SEGMENTS).compute_pose_at(0.2).body_points_w
    choices, refusals = make_triplet_finder().find_propulsion_choices(
        points, body_w, BODY_S_M, None, None
    )
    triplets = ["".join(name[-1] for name in choice.triplet.names) for choice in choices]
    assert triplets == expected_triplets
    assert all("lambda_1" in refusal for refusal in refusals)
