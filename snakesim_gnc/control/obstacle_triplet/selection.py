"""The choice of three push-points and a joint for propulsion. Pure.

Only neighbours on alternating sides make a triplet: from the middle contact, the nearest one on the other side behind
it and the nearest one on the other side ahead of it. So a body of thirty modules has few candidates, and the
choice moves along the body instead of jumping between all combinations.
"""

from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.control.obstacle_triplet.contacts import PlannedContact, PushPoint
from snakesim_gnc.control.obstacle_triplet.statics import (
    UnitForces,
    loads,
    no_authority,
    torque_per_newton,
    unit_forces,
)
from snakesim_gnc.control.planar import wrenches

Floats = NDArray[np.float64]
Names = tuple[str, str, str]


@dataclass(frozen=True)
class Triplet:
    """Three planned contacts, solved once; independent of the body's position."""

    names: Names
    contacts: tuple[PlannedContact, PlannedContact, PlannedContact]
    unit: UnitForces
    unit_wrenches: Floats  # (3, 3): of the three contacts for 1 N, the tether's at o_1 included
    unit_force_3: float
    torque_per_n: float  # the most that a joint between o_2 and o_3 needs: with its lever from o_2 on; absolute


@dataclass(frozen=True)
class Choice:
    """A triplet, its present place on the body, and the propulsion joint."""

    triplet: Triplet
    body_s_m: tuple[float, float, float]
    joint: int  # among the joints that bend, tail to head
    torque_per_n: float  # N·m/N, on the part ahead of that joint


def solve(contacts: tuple[PlannedContact, PlannedContact, PlannedContact], *, condition_max: float) -> Triplet:
    """Unit forces of three contacts, tail to head."""
    points = np.array([c.point_w for c in contacts])
    normals = np.array([c.normal_w for c in contacts])
    unit = unit_forces(points, normals, np.array(contacts[0].tangent_w), condition_max=condition_max)
    tangent = np.array(contacts[0].tangent_w)
    unit_force_3 = float(unit.forces[2])
    return Triplet(
        names=(contacts[0].obstacle, contacts[1].obstacle, contacts[2].obstacle),
        contacts=contacts,
        unit=unit,
        unit_wrenches=wrenches(points, loads(unit.forces, normals, -tangent)),
        unit_force_3=unit_force_3,
        torque_per_n=abs(torque_per_newton(unit_force_3, points[2], normals[2], points[1])),
    )


def alternating(sides: Sequence[int]) -> list[tuple[int, int, int]]:
    """Index triples of neighbours on alternating sides, by their middle, tail to head."""
    found: list[tuple[int, int, int]] = []
    last: dict[int, int] = {}  # side -> the newest contact on it
    waiting: list[tuple[int, int]] = []  # (behind, middle) of triples that lack their third
    for k, side in enumerate(sides):
        found += [(i, j, k) for i, j in waiting if sides[j] != side]
        waiting = [(i, j) for i, j in waiting if sides[j] == side]
        behind = last.get(-side)
        if behind is not None:
            waiting.append((behind, k))
        last[side] = k
    return found


def propulsion_joint(
    node_body_s_m: Sequence[float], behind_m: float, ahead_m: float, present: int | None, hold_on_m: float
) -> int | None:
    """The first joint ahead of o_2 and behind o_3, or None: it has the longest lever.

    Joint i is node i + 1. The present joint remains until the one behind it is `hold_on_m` past o_2, so that
    noise does not switch back and forth.
    """
    joint = max(bisect_right(node_body_s_m, behind_m) - 1, 0)
    last = len(node_body_s_m) - 3
    if joint > last or node_body_s_m[joint + 1] >= ahead_m:
        return None
    late = node_body_s_m[joint + 1] - behind_m < hold_on_m
    if late and present == joint + 1 <= last and node_body_s_m[joint + 2] < ahead_m:
        return present
    return joint


def choose(
    choices: Sequence[Choice], present: Triplet | None, *, switch_share: float, banned: Collection[Names] = ()
) -> Choice | None:
    """The triplet to push with, or None when there is none.

    The present one stays as long as it can be used, unless another needs less than `switch_share` of its torque. Its
    successor shares as many push-points with it as possible, among those that need little more than the minimum torque;
    then the one with the minimum torque, and of equals the one nearest to the tail: then the short end of the body
    swings with the propulsion joint, and the long one stays in its corridor.
    """
    free = [c for c in choices if c.triplet.names not in banned]
    if not free:
        return None
    least = min(c.triplet.torque_per_n for c in free)
    names: Collection[str] = () if present is None else present.names
    for choice in free:
        if choice.triplet is present and least >= switch_share * choice.triplet.torque_per_n:
            return choice
    cheap = [c for c in free if switch_share * c.triplet.torque_per_n <= least]
    return max(cheap, key=lambda c: (_shared(c, names), -round(c.triplet.torque_per_n, 3), -c.body_s_m[1]))


def _shared(choice: Choice, names: Collection[str]) -> int:
    return sum(name in names for name in choice.triplet.names)


class Triplets:
    """All choices for the present push-points; solves each three contacts once."""

    def __init__(self, *, condition_max: float, authority_min: float, hold_on_m: float) -> None:
        self._condition_max = condition_max
        self._authority_min = authority_min
        self._hold_on_m = hold_on_m
        self._solved: dict[Names, Triplet] = {}

    def choices(
        self,
        points: Sequence[PushPoint],
        nodes_w: Floats,
        node_body_s_m: Sequence[float],
        present: Choice | None,
        barred_joint: int | None,
    ) -> tuple[list[Choice], list[str]]:
        """Every triplet that can propel with some joint, and why the others cannot. nodes_w: (2, n_nodes)."""
        found: list[Choice] = []
        refused: list[str] = []
        for i, j, k in alternating([p.contact.side for p in points]):
            triplet = self._solve((points[i].contact, points[j].contact, points[k].contact))
            places = (points[i].body_s_m, points[j].body_s_m, points[k].body_s_m)
            turn = present.joint if present is not None and present.triplet is triplet else None
            choice = self._choice(triplet, places, nodes_w, node_body_s_m, turn, barred_joint)
            if isinstance(choice, Choice):
                found.append(choice)
            else:
                refused.append(f"{'/'.join(triplet.names)}: {choice}")
        return found, refused

    def _choice(
        self,
        triplet: Triplet,
        places_m: tuple[float, float, float],
        nodes_w: Floats,
        node_body_s_m: Sequence[float],
        turn: int | None,
        barred_joint: int | None,
    ) -> Choice | str:
        """The triplet with its joint, or why it cannot propel."""
        if triplet.unit.reason:
            return triplet.unit.reason
        joint = propulsion_joint(node_body_s_m, places_m[1], places_m[2], turn, self._hold_on_m)
        if joint is None:
            return "no joint between o_2 and o_3"
        if joint == barred_joint:
            return "its propulsion joint has left its reference too far"
        spot = (float(nodes_w[0, joint + 1]), float(nodes_w[1, joint + 1]))
        ahead = triplet.contacts[2]
        blocked = no_authority(ahead.point_w, ahead.normal_w, spot, self._authority_min)
        if blocked:
            return blocked
        return Choice(
            triplet, places_m, joint, torque_per_newton(triplet.unit_force_3, ahead.point_w, ahead.normal_w, spot)
        )

    def _solve(self, contacts: tuple[PlannedContact, PlannedContact, PlannedContact]) -> Triplet:
        names = (contacts[0].obstacle, contacts[1].obstacle, contacts[2].obstacle)
        known = self._solved.get(names)
        if known is None or known.contacts != contacts:
            known = self._solved[names] = solve(contacts, condition_max=self._condition_max)
        return known
