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
    add_tether,
    compute_torque_per_newton,
    explain_missing_authority,
    solve_unit_forces,
)
from snakesim_gnc.geometry.planar import wrenches
from snakesim_hal.base.arrays import Floats

Names = tuple[str, str, str]  # of the obstacles, tail to head
Three = tuple[PlannedContact, PlannedContact, PlannedContact]  # o_1, o_2, o_3, tail to head

TORQUE_DECIMALS = 3  # triplets whose torque per newton is equal to 1 mN·m/N count as equally good


@dataclass(frozen=True)
class Triplet:
    """Three planned contacts, solved once. They do not depend on the body's position."""

    names: Names
    contacts: Three
    unit: UnitForces
    unit_force_3: float  # lambda_3 for 1 N of propulsion, N/N
    torque_per_n: float  # N·m/N, absolute; the maximum of all joints between o_2 and o_3, whose lever begins at o_2

    @cached_property
    def unit_wrenches(self) -> Floats:
        """(3, 3) forces and moments of the three contacts for 1 N of propulsion, with the tether's force at o_1."""
        points_w = np.array([contact.point_w for contact in self.contacts])
        normals_w = np.array([contact.normal_w for contact in self.contacts])
        tether_w = -np.array(self.contacts[0].tangent_w)
        return wrenches(points_w, add_tether(self.unit.forces, normals_w, tether_w))


@dataclass(frozen=True)
class Choice:
    """A triplet, its present place on the body, and the propulsion joint."""

    triplet: Triplet
    body_s_m: tuple[float, float, float]  # of o_1, o_2, o_3, from the tail end along the body
    joint: int  # index among the yaw joints, tail to head
    torque_per_n: float  # N·m/N, on the part of the body ahead of that joint


def solve_triplets(threes: Sequence[Three], *, condition_max: float) -> list[Triplet]:
    """Compute the unit forces of several triplets at once.

    Args:
        threes: three contacts each, tail to head.
        condition_max: triplets above this condition number cannot be used; see `solve_unit_forces`.
    """
    if not threes:
        return []
    units = solve_unit_forces(
        np.array([[contact.point_w for contact in three] for three in threes]),
        np.array([[contact.normal_w for contact in three] for three in threes]),
        np.array([three[0].tangent_w for three in threes]),
        condition_max=condition_max,
    )
    return [_make_triplet(three, unit) for three, unit in zip(threes, units, strict=True)]


def _make_triplet(three: Three, unit: UnitForces) -> Triplet:
    _, middle, ahead = three
    unit_force_3 = float(unit.forces[2])
    max_torque = compute_torque_per_newton(unit_force_3, ahead.point_w, ahead.normal_w, middle.point_w)
    return Triplet(_get_names(three), three, unit, unit_force_3, abs(max_torque))


def _get_names(three: Three) -> Names:
    return three[0].obstacle, three[1].obstacle, three[2].obstacle


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
    node_body_s_m: Sequence[float], behind_m: float, ahead_m: float, present: int | None, hold_on_m: float
) -> int | None:
    """Find the joint that propels a triplet of push-points o_1, o_2, o_3 (tail to head).

    It is the first joint ahead of o_2 and behind o_3, because that joint has the longest lever.

    Args:
        node_body_s_m: (n_nodes,) arc lengths of the body's nodes from the tail end; joint i is node i + 1.
        behind_m: arc length of o_2 on the body.
        ahead_m: arc length of o_3 on the body.
        present: the present propulsion joint of this triplet. It remains until the joint behind it is `hold_on_m`
            past o_2, so that noise does not switch back and forth.
        hold_on_m: that distance.

    Returns:
        Index of the joint, or None if there is no joint between o_2 and o_3.
    """
    joint = max(bisect_right(node_body_s_m, behind_m) - 1, 0)
    last_joint = len(node_body_s_m) - 3
    if joint > last_joint or node_body_s_m[joint + 1] >= ahead_m:
        return None
    next_joint = joint + 1
    if present != next_joint or next_joint > last_joint:
        return joint
    has_just_passed = node_body_s_m[joint + 1] - behind_m < hold_on_m
    next_is_behind_o_3 = node_body_s_m[next_joint + 1] < ahead_m
    if has_just_passed and next_is_behind_o_3:
        return present
    return joint


def choose_triplet(
    choices: Sequence[Choice], present: Triplet | None, *, switch_fraction: float, banned: Collection[Names] = ()
) -> Choice | None:
    """Choose the triplet to push with.

    The present triplet stays as long as it can be used, unless another needs less than `switch_fraction` of its torque.
    Candidates for its successor need little more than the minimum torque. Among them, in this order, the successor

    1. shares as many push-points with the present triplet as possible,
    2. needs the least torque,
    3. is nearest to the tail: then the short end of the body swings with the propulsion joint, and the long end stays
       in its corridor.

    Args:
        choices: triplets that can propel.
        present: the triplet that pushes now; None if none does.
        switch_fraction: ratio of two torques per newton, 0 to 1.
        banned: names of triplets that must not be chosen.

    Returns:
        The choice; None if there is none.
    """
    permitted_choices = [choice for choice in choices if choice.triplet.names not in banned]
    if not permitted_choices:
        return None
    min_torque = min(choice.triplet.torque_per_n for choice in permitted_choices)
    for choice in permitted_choices:
        if choice.triplet is present and min_torque >= switch_fraction * choice.triplet.torque_per_n:
            return choice
    present_names: frozenset[str] = frozenset()
    if present is not None:
        present_names = frozenset(present.names)

    def rank(choice: Choice) -> tuple[int, float, float]:
        shared_count = len(present_names.intersection(choice.triplet.names))
        return shared_count, -round(choice.triplet.torque_per_n, TORQUE_DECIMALS), -choice.body_s_m[1]

    candidates = [choice for choice in permitted_choices if switch_fraction * choice.triplet.torque_per_n <= min_torque]
    return max(candidates, key=rank)


class Triplets:
    """Finds all choices for the present push-points. Solves each three contacts only once."""

    def __init__(self, *, condition_max: float, authority_min: float, hold_on_m: float) -> None:
        """Start without solved triplets.

        Args:
            condition_max: triplets above this condition number cannot be used.
            authority_min: joints whose lever is so nearly along the normal at o_3 cannot be used, sine of the angle.
            hold_on_m: the joint behind o_2 takes over when it is so far past o_2.
        """
        self._condition_max = condition_max
        self._authority_min = authority_min
        self._hold_on_m = hold_on_m
        self._solved: dict[Names, Triplet] = {}

    def find_choices(
        self,
        points: Sequence[PushPoint],
        nodes_w: Floats,
        node_body_s_m: Sequence[float],
        present: Choice | None,
        barred_joint: int | None,
    ) -> tuple[list[Choice], list[str]]:
        """Find every triplet that can propel with some joint.

        Args:
            points: push-points, tail to head.
            nodes_w: (2, n_nodes) m, the body.
            node_body_s_m: (n_nodes,) arc lengths of the nodes from the tail end.
            present: the choice that pushes now.
            barred_joint: a joint that must not propel.

        Returns:
            The choices, and why the other triplets cannot propel.
        """
        choices: list[Choice] = []
        refused: list[str] = []
        triples = find_alternating_triples([point.contact.side for point in points])
        triplets = self._solve([(points[i].contact, points[j].contact, points[k].contact) for i, j, k in triples])
        for (i, j, k), triplet in zip(triples, triplets, strict=True):
            places_m = (points[i].body_s_m, points[j].body_s_m, points[k].body_s_m)
            present_joint = None
            if present is not None and present.triplet is triplet:
                present_joint = present.joint
            choice = self._choose_joint(triplet, places_m, nodes_w, node_body_s_m, present_joint, barred_joint)
            if isinstance(choice, Choice):
                choices.append(choice)
            else:
                refused.append(f"{'/'.join(triplet.names)}: {choice}")
        return choices, refused

    def _choose_joint(
        self,
        triplet: Triplet,
        places_m: tuple[float, float, float],
        nodes_w: Floats,
        node_body_s_m: Sequence[float],
        present_joint: int | None,
        barred_joint: int | None,
    ) -> Choice | str:
        """Return a triplet with its propulsion joint and the torque for 1 N, or the reason why it cannot propel.

        Args:
            triplet: three contacts, with the forces for 1 N of propulsion.
            places_m: arc lengths of the contacts on the body.
            nodes_w: (2, n_nodes) m, the body; joint i is node i + 1.
            node_body_s_m: (n_nodes,) arc lengths of the nodes from the tail end.
            present_joint: the present propulsion joint of this triplet, if any.
            barred_joint: a joint that must not propel.
        """
        if triplet.unit.reason:
            return triplet.unit.reason
        _, behind_m, ahead_m = places_m
        joint = find_propulsion_joint(node_body_s_m, behind_m, ahead_m, present_joint, self._hold_on_m)
        if joint is None:
            return "no joint between o_2 and o_3"
        if joint == barred_joint:
            return "its propulsion joint has left its reference too far"
        joint_w = (float(nodes_w[0, joint + 1]), float(nodes_w[1, joint + 1]))
        ahead = triplet.contacts[2]
        why_not = explain_missing_authority(ahead.point_w, ahead.normal_w, joint_w, self._authority_min)
        if why_not:
            return why_not
        torque_per_n = compute_torque_per_newton(triplet.unit_force_3, ahead.point_w, ahead.normal_w, joint_w)
        return Choice(triplet, places_m, joint, torque_per_n)

    def _solve(self, threes: Sequence[Three]) -> list[Triplet]:
        """Return the triplets of these contacts. Solves those that are new, and discards those that are gone."""
        solved: dict[Names, Triplet] = {}
        for three in threes:
            known = self._solved.get(_get_names(three))
            if known is not None and known.contacts == three:
                solved[known.names] = known
        new = [three for three in threes if _get_names(three) not in solved]
        for triplet in solve_triplets(new, condition_max=self._condition_max):
            solved[triplet.names] = triplet
        self._solved = solved
        return [solved[_get_names(three)] for three in threes]
