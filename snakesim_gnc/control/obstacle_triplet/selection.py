"""The choice of three push-points and a joint for propulsion. Pure.

Any three on alternating sides are a triplet, with others between them or not: on a steep wave, and beside obstacles
that brake, neighbors cannot push, and contacts further apart can. The best one needs the least torque for a newton of
propulsion, so that a joint's limit allows the most. Neighbors mostly do: their levers are short.
"""

from bisect import bisect_right
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from snakesim_gnc.control.obstacle_triplet.contacts import PlannedContact, PushPoint
from snakesim_gnc.control.obstacle_triplet.statics import (
    UnitForces,
    loads,
    no_authority,
    torque_per_newton,
    unit_forces,
)
from snakesim_gnc.geometry.planar import wrenches
from snakesim_hal.base.arrays import Floats

Names = tuple[str, str, str]
Three = tuple[PlannedContact, PlannedContact, PlannedContact]


@dataclass(frozen=True)
class Triplet:
    """Three planned contacts, solved once; independent of the body's position."""

    names: Names
    contacts: Three
    unit: UnitForces
    unit_force_3: float
    torque_per_n: float  # the most that a joint between o_2 and o_3 needs: with its lever from o_2 on; absolute

    @cached_property
    def unit_wrenches(self) -> Floats:
        """(3, 3): of the three contacts for 1 N, the tether's at o_1 included."""
        points, normals = (np.array([getattr(c, name) for c in self.contacts]) for name in ("point_w", "normal_w"))
        return wrenches(points, loads(self.unit.forces, normals, -np.array(self.contacts[0].tangent_w)))


@dataclass(frozen=True)
class Choice:
    """A triplet, its present place on the body, and the propulsion joint."""

    triplet: Triplet
    body_s_m: tuple[float, float, float]
    joint: int  # among the joints that bend, tail to head
    torque_per_n: float  # N·m/N, on the part ahead of that joint


def solve(threes: Sequence[Three], *, condition_max: float) -> list[Triplet]:
    """Unit forces of each three contacts, tail to head."""
    if not threes:
        return []
    units = unit_forces(
        np.array([[c.point_w for c in three] for three in threes]),
        np.array([[c.normal_w for c in three] for three in threes]),
        np.array([three[0].tangent_w for three in threes]),
        condition_max=condition_max,
    )
    return [_triplet(three, unit) for three, unit in zip(threes, units, strict=True)]


def _triplet(three: Three, unit: UnitForces) -> Triplet:
    (_, middle, ahead), unit_force_3 = three, float(unit.forces[2])
    torque = torque_per_newton(unit_force_3, ahead.point_w, ahead.normal_w, middle.point_w)
    return Triplet(_names(three), three, unit, unit_force_3, abs(torque))


def _names(three: Three) -> Names:
    return three[0].obstacle, three[1].obstacle, three[2].obstacle


def alternating(sides: Sequence[int]) -> list[tuple[int, int, int]]:
    """Index triples on alternating sides, by their middle, tail to head."""
    n = len(sides)
    return [
        (i, j, k)
        for j in range(1, n - 1)
        for i in range(j)
        if sides[i] != sides[j]
        for k in range(j + 1, n)
        if sides[k] != sides[j]
    ]


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
    choices: Sequence[Choice], present: Triplet | None, *, switch_fraction: float, banned: Collection[Names] = ()
) -> Choice | None:
    """The triplet to push with, or None when there is none.

    The present one stays as long as it can be used, unless another needs less than `switch_fraction` of its torque. Its
    successor shares as many push-points with it as possible, among those that need little more than the minimum torque;
    then the one with the minimum torque, and of equals the one nearest to the tail: then the short end of the body
    swings with the propulsion joint, and the long one stays in its corridor.
    """
    free = [c for c in choices if c.triplet.names not in banned]
    if not free:
        return None
    least = min(c.triplet.torque_per_n for c in free)
    names: frozenset[str] = frozenset() if present is None else frozenset(present.names)
    for choice in free:
        if choice.triplet is present and least >= switch_fraction * choice.triplet.torque_per_n:
            return choice
    cheap = [c for c in free if switch_fraction * c.triplet.torque_per_n <= least]
    return max(
        cheap,
        key=lambda c: (len(names.intersection(c.triplet.names)), -round(c.triplet.torque_per_n, 3), -c.body_s_m[1]),
    )


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
        threes = alternating([p.contact.side for p in points])
        triplets = self._solve([(points[i].contact, points[j].contact, points[k].contact) for i, j, k in threes])
        for (i, j, k), triplet in zip(threes, triplets, strict=True):
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

    def _solve(self, threes: Sequence[Three]) -> list[Triplet]:
        """Those that are new are solved, those that are gone forgotten."""
        before, after = self._solved, dict[Names, Triplet]()
        for three in threes:
            known = before.get(_names(three))
            if known is not None and known.contacts == three:
                after[known.names] = known
        new = [three for three in threes if _names(three) not in after]
        after |= {triplet.names: triplet for triplet in solve(new, condition_max=self._condition_max)}
        self._solved = after
        return [after[_names(three)] for three in threes]
