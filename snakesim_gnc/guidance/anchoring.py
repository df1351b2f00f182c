"""Dead reckoning held by known obstacles: what the body touches is at its skin, and nothing is in it. Pure.

For each obstacle near the body, the gap between its outline and the body's skin, as the reckoned pose has it, is
measured as zero

    where a contact on that side of the body, near that place, is felt
    where it would be negative: the body would lie in the obstacle

Three contacts whose normals do not meet in a point hold the body as firmly as a pose sensor; fewer leave it free along
what they do not touch.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from snakesim_gnc.guidance.body_history import Body
from snakesim_gnc.guidance.localization import Localizer
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Contact, Description, Obstacle

MIN_FORCE_N = 1.0  # weaker pushes may be anything
NEAR_LINKS = 1.5  # along the body, in lengths of a link: how far an estimated contact may be off
FARTHEST_M = 0.06  # a contact that is felt is not of an obstacle further away than this
DEEPEST_M = 0.04  # deeper than this the body lies on another side of it, and nothing can be told
POINTS = 12  # on the axis of each link


class Trust(NamedTuple):
    """Standard deviations of a gap that is measured as zero, at each turn."""

    touch_m: float
    sunk_m: float


# Sensors tell contacts at every turn, with the same error each time. Estimated ones come seldom, and while the body
# waits for one, its own steps along the path, which it takes on trust, would lead it away. Tuned on `triplet`.
MEASURED, ESTIMATED = Trust(0.03, 0.02), Trust(0.003, 0.002)


class Anchors:
    """The known obstacles, and one robot's body."""

    def __init__(self, robot: Description, known: Sequence[Obstacle]) -> None:
        self._outlines = Outlines.of(known)
        self._lengths = np.array([link.length_m for link in robot.links])
        self._radii = np.array([link.radius_m for link in robot.links])
        self._share = (np.arange(POINTS) + 0.5) / POINTS

    def hold(self, localizer: Localizer, angles_rad: Floats, felt: Sequence[Contact], trust: Trust) -> None:
        """Correct the localizer's base, at the joint angles of its last move. felt: contacts of that time."""
        if not len(self._outlines):
            return
        body = localizer.history.lay(localizer.base, angles_rad)
        steps = (self._lengths[:, None] * body.rotations[:, :2, 0])[:, None]
        axis = (body.origins_w[:, None, :2] + self._share[:, None] * steps).reshape(-1, 2)
        gaps = self._outlines.distance_m(axis) - np.repeat(self._radii, POINTS)[:, None]
        nearest = gaps.argmin(axis=0)
        near = np.flatnonzero((gaps.min(axis=0) < FARTHEST_M) & (gaps.min(axis=0) > -DEEPEST_M))
        _, normals = self._outlines.towards(axis[nearest[near]], near)
        rows: list[Floats] = []
        found: list[tuple[float, float]] = []
        for obstacle, normal in zip(near.tolist(), normals, strict=True):
            at = int(nearest[obstacle])
            gap_m = float(gaps[at, obstacle])
            if gap_m >= 0.0 and self._measured_force_n(body, felt, at, normal) <= MIN_FORCE_N:
                continue
            found.append((gap_m, trust.sunk_m if gap_m < 0.0 else trust.touch_m))
            x, y = axis[at] - localizer.base.planar_w[:2]
            rows.append(np.array([normal[0], normal[1], normal[1] * x - normal[0] * y]))
        if rows:
            gaps_m, sds_m = np.array(found).T
            localizer.correct_along(np.array(rows), -gaps_m, sds_m)

    def _measured_force_n(self, body: Body, felt: Sequence[Contact], at: int, normal_w: Floats) -> float:
        """Forces near a point of the axis that push the way that an obstacle there would."""
        place = (at + 0.5) / POINTS
        return math.fsum(
            math.hypot(*one.force_l)
            for one in felt
            if abs(one.link + one.position_l[0] / self._lengths[one.link] - place) < NEAR_LINKS
            and float((body.rotations[one.link] @ np.array(one.normal_l))[:2] @ normal_w) > 0.0
        )
