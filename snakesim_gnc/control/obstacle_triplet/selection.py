"""Chooses three push-points and a joint for propulsion.

Any three push-points on alternating sides are a triplet, whether others lie between them or not: on a steep wave, and
beside obstacles that brake, neighbors cannot push, and contacts further apart can. The best triplet needs the least
torque for a newton of propulsion, so that the torque limit of a joint allows the most propulsion. Mostly these are
neighbors, because their levers are short.
"""

from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from snakesim_gnc.control.obstacle_triplet.contacts import PlannedContact, PushPoint
from snakesim_gnc.control.obstacle_triplet.statics import (
    UnitForces,
    add_tether_force,
    compute_torque_per_newton,
    find_authority_problem,
    solve_unit_forces,
)
from snakesim_gnc.geometry.planar import compute_wrenches
from snakesim_hal.base.arrays import Floats

ObstacleNames = tuple[str, str, str]  # of the obstacles, tail to head
ContactTriple = tuple[PlannedContact, PlannedContact, PlannedContact]  # o_1, o_2, o_3, tail to head

TORQUE_DECIMALS = 3  # triplets whose torque per newton is equal to 1 mN·m/N count as equally good


@dataclass(frozen=True)
class ContactTriplet:
    """Three planned contacts, solved once. They do not depend on the body's position."""

    names: ObstacleNames
    contacts: ContactTriple
    unit_forces: UnitForces
    force_3_per_n: float  # lambda_3 for 1 N of propulsion, N/N
    torque_per_n: float  # N·m/N, absolute; the maximum of all joints between o_2 and o_3, whose lever begins at o_2

    @cached_property
    def unit_wrenches(self) -> Floats:
        """(3, 3) forces and moments of the three contacts for 1 N of propulsion, with the tether's force at o_1."""
        points_w = np.array([contact.point_w for contact in self.contacts])
        normals_w = np.array([contact.normal_w for contact in self.contacts])
        tether_w = -np.array(self.contacts[0].tangent_w)
        return compute_wrenches(
            points_w, add_tether_force(self.unit_forces.forces, normals_w, tether_w)
        )


@dataclass(frozen=True)
class PropulsionChoice:
    """A triplet, its current place on the body, and the propulsion joint."""

    triplet: ContactTriplet
    body_s_m: tuple[float, float, float]  # of o_1, o_2, o_3, from the tail end along the body
    joint: int  # index among the yaw joints, tail to head
    torque_per_n: float  # N·m/N, on the part of the body ahead of that joint


def solve_triplets(
    contact_triples: Sequence[ContactTriple], *, condition_max: float
) -> list[ContactTriplet]:
    """Solve the contact forces for 1 N of propulsion of several triplets at once.

    Args:
        contact_triples: Three contacts for each triplet, tail to head.
        condition_max: Condition number above which a triplet cannot be used; see `solve_unit_forces`.

    Returns:
        The triplets in the same order. A triplet that cannot propel has the reason in `unit_forces.reason`.
    """
    if not contact_triples:
        return []
    all_unit_forces = solve_unit_forces(
        np.array(
            [[contact.point_w for contact in contact_triple] for contact_triple in contact_triples]
        ),
        np.array(
            [[contact.normal_w for contact in contact_triple] for contact_triple in contact_triples]
        ),
        np.array([contact_triple[0].tangent_w for contact_triple in contact_triples]),
        condition_max=condition_max,
    )
    return [
        _make_triplet(contact_triple, unit_forces)
        for contact_triple, unit_forces in zip(contact_triples, all_unit_forces, strict=True)
    ]


def _make_triplet(contact_triple: ContactTriple, unit_forces: UnitForces) -> ContactTriplet:
    _, middle, front = contact_triple
    force_3_per_n = float(unit_forces.forces[2])
    max_torque = compute_torque_per_newton(
        force_3_per_n, front.point_w, front.normal_w, middle.point_w
    )
    return ContactTriplet(
        _get_obstacle_names(contact_triple),
        contact_triple,
        unit_forces,
        force_3_per_n,
        abs(max_torque),
    )


def _get_obstacle_names(contact_triple: ContactTriple) -> ObstacleNames:
    return contact_triple[0].obstacle, contact_triple[1].obstacle, contact_triple[2].obstacle


def find_alternating_triples(sides: Sequence[int]) -> list[tuple[int, int, int]]:
    """Return all index triples i < j < k of contacts on alternating sides, in the order of their middle j."""
    n = len(sides)
    triples: list[tuple[int, int, int]] = []
    for j in range(1, n - 1):
        behind = [i for i in range(j) if sides[i] != sides[j]]
        ahead = [k for k in range(j + 1, n) if sides[k] != sides[j]]
        for i in behind:
            for k in ahead:
                triples.append((i, j, k))
    return triples


def find_propulsion_joint(
    body_points_s_m: Sequence[float],
    o_2_s_m: float,
    o_3_s_m: float,
    current_joint_index: int | None,
    hold_on_m: float,
) -> int | None:
    """Find the joint that propels a triplet of push-points o_1, o_2, o_3 (tail to head).

    It is the first joint ahead of o_2 and behind o_3, because that joint has the longest lever.

    Args:
        body_points_s_m: (n_points,) arc lengths of the body's points (tail end, joints, head end) from the tail end.
            Joint i is point i + 1.
        o_2_s_m: Arc length of o_2 on the body, from the tail end.
        o_3_s_m: Arc length of o_3 on the body, from the tail end.
        current_joint_index: Current propulsion joint of this triplet; None if it has none. It remains the propulsion
            joint until the joint behind it is `hold_on_m` past o_2, so that noise does not switch back and forth.
        hold_on_m: Distance past o_2 at which the joint behind takes over.

    Returns:
        Index of the joint, or None if there is no joint between o_2 and o_3.
    """
    joint = max(bisect_right(body_points_s_m, o_2_s_m) - 1, 0)
    last_joint = len(body_points_s_m) - 3
    if joint > last_joint or body_points_s_m[joint + 1] >= o_3_s_m:
        return None
    next_joint = joint + 1
    if current_joint_index != next_joint or next_joint > last_joint:
        return joint
    has_just_passed = body_points_s_m[joint + 1] - o_2_s_m < hold_on_m
    next_is_behind_o_3 = body_points_s_m[next_joint + 1] < o_3_s_m
    if has_just_passed and next_is_behind_o_3:
        return current_joint_index
    return joint


def choose_triplet(
    choices: Sequence[PropulsionChoice],
    current_triplet: ContactTriplet | None,
    *,
    switch_fraction: float,
    banned_triplets: Collection[ObstacleNames] = (),
) -> PropulsionChoice | None:
    """Choose the triplet of push-points with which the body pushes itself forward.

    The current triplet stays as long as it can be used, unless another needs less than `switch_fraction` of its torque.
    Candidates for its successor need little more than the minimum torque. Among them, in this order, the successor

    1. shares as many push-points with the current triplet as possible,
    2. needs the least torque,
    3. is nearest to the tail: then the short end of the body swings with the propulsion joint, and the long end stays
       in its corridor.

    Args:
        choices: Triplets that can propel.
        current_triplet: The triplet that pushes now; None if none does.
        switch_fraction: Ratio of two torques per newton, 0 to 1.
        banned_triplets: Obstacle names of the triplets that must not be chosen.

    Returns:
        The chosen triplet with its joint; None if all are banned, or if there are no choices.
    """
    allowed_choices = [choice for choice in choices if choice.triplet.names not in banned_triplets]
    if not allowed_choices:
        return None
    min_torque = min(choice.triplet.torque_per_n for choice in allowed_choices)
    for choice in allowed_choices:
        if (
            choice.triplet is current_triplet
            and min_torque >= switch_fraction * choice.triplet.torque_per_n
        ):
            return choice
    current_obstacles: frozenset[str] = frozenset()
    if current_triplet is not None:
        current_obstacles = frozenset(current_triplet.names)

    def compute_rank(choice: PropulsionChoice) -> tuple[int, float, float]:
        shared_count = len(current_obstacles.intersection(choice.triplet.names))
        return (
            shared_count,
            -round(choice.triplet.torque_per_n, TORQUE_DECIMALS),
            -choice.body_s_m[1],
        )

    candidates = [
        choice
        for choice in allowed_choices
        if switch_fraction * choice.triplet.torque_per_n <= min_torque
    ]
    return max(candidates, key=compute_rank)


class TripletFinder:
    """Finds all choices for the current push-points. Solves each three contacts only once."""

    def __init__(self, *, condition_max: float, authority_min: float, hold_on_m: float) -> None:
        """Create a finder of triplets that has not solved any yet.

        Args:
            condition_max: Condition number above which a triplet cannot be used.
            authority_min: Sine of the angle between a joint's lever and the normal at o_3 below which the joint cannot
                be used.
            hold_on_m: Distance past o_2 at which the joint behind takes over as propulsion joint.
        """
        self._condition_max = condition_max
        self._authority_min = authority_min
        self._hold_on_m = hold_on_m
        self._solved_triplets: dict[ObstacleNames, ContactTriplet] = {}

    def find_propulsion_choices(
        self,
        points: Sequence[PushPoint],
        body_points_w: Floats,
        body_point_arc_lengths_m: Sequence[float],
        current_choice: PropulsionChoice | None,
        excluded_joint_index: int | None,
    ) -> tuple[list[PropulsionChoice], list[str]]:
        """Find every contact triplet against which some joint can propel the robot.

        Args:
            points: Push-points, tail to head.
            body_points_w: (2, n_points) tail end, joints about the vertical axis and head end of the body in the
                world, m.
            body_point_arc_lengths_m: (n_points,) arc lengths of these points from the tail end.
            current_choice: The choice that propels the robot now; None if none does.
            excluded_joint_index: Index of a joint that must not propel; None if every joint may.

        Returns:
            The choices (a triplet with its propelling joint), and for each other triplet a text with its obstacles and
            why no joint can propel.
        """
        choices: list[PropulsionChoice] = []
        refusal_reasons: list[str] = []
        index_triples = find_alternating_triples([point.contact.side for point in points])
        triplets = self._solve_triplets_cached(
            [(points[i].contact, points[j].contact, points[k].contact) for i, j, k in index_triples]
        )
        for (i, j, k), triplet in zip(index_triples, triplets, strict=True):
            contact_arc_lengths_m = (points[i].body_s_m, points[j].body_s_m, points[k].body_s_m)
            # Triplets are cached: contacts that have not changed give the same object.
            current_joint = None
            if current_choice is not None and current_choice.triplet is triplet:
                current_joint = current_choice.joint
            choice_or_reason = self._choose_propulsion_joint(
                triplet,
                contact_arc_lengths_m,
                body_points_w,
                body_point_arc_lengths_m,
                current_joint,
                excluded_joint_index,
            )
            if isinstance(choice_or_reason, PropulsionChoice):
                choices.append(choice_or_reason)
            else:
                refusal_reasons.append(f"{'/'.join(triplet.names)}: {choice_or_reason}")
        return choices, refusal_reasons

    def _choose_propulsion_joint(
        self,
        triplet: ContactTriplet,
        contacts_s_m: tuple[float, float, float],
        body_points_w: Floats,
        body_points_s_m: Sequence[float],
        current_joint_index: int | None,
        excluded_joint_index: int | None,
    ) -> PropulsionChoice | str:
        """Return a triplet with its propulsion joint and the torque for 1 N, or the reason why it cannot propel.

        Args:
            triplet: Three contacts, with the forces for 1 N of propulsion.
            contacts_s_m: Arc lengths of the three contacts on the body, from the tail end.
            body_points_w: (2, n_points) points of the body in the world, m. Joint i is point i + 1, because point 0 is
                the tail end.
            body_points_s_m: (n_points,) arc lengths of these points from the tail end.
            current_joint_index: Current propulsion joint of this triplet; None if it has none.
            excluded_joint_index: Index of a joint that must not propel; None if every joint may.
        """
        if triplet.unit_forces.reason:
            return triplet.unit_forces.reason
        _, o_2_s_m, o_3_s_m = contacts_s_m
        joint = find_propulsion_joint(
            body_points_s_m, o_2_s_m, o_3_s_m, current_joint_index, self._hold_on_m
        )
        if joint is None:
            return "no joint between o_2 and o_3"
        if joint == excluded_joint_index:
            return "its propulsion joint has left its reference too far"
        joint_w = (float(body_points_w[0, joint + 1]), float(body_points_w[1, joint + 1]))
        o_3 = triplet.contacts[2]
        authority_problem = find_authority_problem(
            o_3.point_w, o_3.normal_w, joint_w, self._authority_min
        )
        if authority_problem:
            return authority_problem
        torque_per_n = compute_torque_per_newton(
            triplet.force_3_per_n, o_3.point_w, o_3.normal_w, joint_w
        )
        return PropulsionChoice(triplet, contacts_s_m, joint, torque_per_n)

    def _solve_triplets_cached(
        self, contact_triples: Sequence[ContactTriple]
    ) -> list[ContactTriplet]:
        """Return the triplets of these contacts in order. Solve only those that are new, and forget all others."""
        solved_triplets: dict[ObstacleNames, ContactTriplet] = {}
        for contact_triple in contact_triples:
            known_triplet = self._solved_triplets.get(_get_obstacle_names(contact_triple))
            if known_triplet is not None and known_triplet.contacts == contact_triple:
                solved_triplets[known_triplet.names] = known_triplet
        new_triples = [
            contact_triple
            for contact_triple in contact_triples
            if _get_obstacle_names(contact_triple) not in solved_triplets
        ]
        for triplet in solve_triplets(new_triples, condition_max=self._condition_max):
            solved_triplets[triplet.names] = triplet
        self._solved_triplets = solved_triplets
        return [
            solved_triplets[_get_obstacle_names(contact_triple)]
            for contact_triple in contact_triples
        ]
