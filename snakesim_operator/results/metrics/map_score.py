"""The quality of a map: the obstacles that guidance published, compared with the true ones. Pure.

    score(world.obstacles, truth, head_w, heading_rad).position_m

Only what is near the head counts, and of misses only what a camera there could see: not behind it, nor hidden.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Obstacle

NEAR_M = 1.0
VIEW_RAD = math.pi / 2  # of the camera
NEAREST_M = 0.15  # a camera sees nothing nearer
MATCH_M = 0.05  # between a reported outline and the true one
POINTS = 48  # on an outline
SIGHT = np.linspace(0.0, 1.0, 24)[1:-1]  # of a line of sight, where it is looked whether something hides


@dataclass
class MapScore:
    """Of one map, or of several added up. Lists have an entry for each matched obstacle near the head."""

    position_m: list[float] = field(default_factory=list[float])  # of centers, from where they are
    surface_m: list[float] = field(default_factory=list[float])  # of the side that faces the head, mean
    size_m: list[float] = field(default_factory=list[float])  # reported radius, or longer half, less the true one
    in_sd: list[float] = field(default_factory=list[float])  # error of the position in reported standard deviations
    misses: int = 0  # that could be seen, and are not reported
    ghosts: int = 0  # reported, with nothing there
    reported: int = 0  # near the head
    visible: int = 0  # true ones that could be seen

    def add(self, other: "MapScore") -> None:
        """Add another map's."""
        for name in ("position_m", "surface_m", "size_m", "in_sd"):
            getattr(self, name).extend(getattr(other, name))
        self.misses, self.ghosts = self.misses + other.misses, self.ghosts + other.ghosts
        self.reported, self.visible = self.reported + other.reported, self.visible + other.visible


def score(
    reported: Sequence[Obstacle],
    truth: Sequence[Obstacle],
    head_w: Sequence[float] | Floats,
    heading_rad: float,
) -> MapScore:
    """Score the obstacles whose outlines are within NEAR_M of the head's front (2,)."""
    head = np.asarray(head_w, dtype=np.float64)[:2]
    near = _within(truth, head, NEAR_M + MATCH_M)
    true_outlines = Outlines.of(near)
    found = MapScore()
    matched: set[str] = set()
    for one in _within(reported, head, NEAR_M):
        found.reported += 1
        errors = np.abs(true_outlines.distance_m(facing_points_w(one, head))).mean(axis=0)
        best = int(np.argmin(errors)) if near else -1
        if best < 0 or errors[best] > MATCH_M:
            found.ghosts += 1
            continue
        true = near[best]
        matched.add(true.name)
        off = math.dist(one.position_w[:2], true.position_w[:2])
        found.position_m.append(off)
        found.surface_m.append(float(errors[best]))
        found.size_m.append(_size_m(one) - _size_m(true))
        found.in_sd.append(off / max(one.position_sd_m, 1e-4))
    for true in visible(truth, head, heading_rad):
        found.visible += 1
        found.misses += true.name not in matched
    return found


def visible(truth: Sequence[Obstacle], head_w: Floats, heading_rad: float) -> list[Obstacle]:
    """True obstacles near the head whose center lies in view, and half of whose facing side no other one hides."""
    near = _within(truth, head_w, NEAR_M)
    outlines, found = Outlines.of(near), list[Obstacle]()
    for i, true in enumerate(near):
        to = np.array(true.position_w[:2]) - head_w
        off = (math.atan2(to[1], to[0]) - heading_rad + math.pi) % (2 * math.pi) - math.pi
        if abs(off) > 0.45 * VIEW_RAD or outlines.distance_m(head_w)[i] < NEAREST_M:
            continue
        facing = facing_points_w(true, head_w)
        sight = head_w + SIGHT[:, None, None] * (facing - head_w)  # (steps, points, 2)
        inside = outlines.distance_m(sight) < 0
        inside[..., i] = False
        if inside.any(axis=(0, 2)).mean() < 0.5:
            found.append(true)
    return found


def facing_points_w(obstacle: Obstacle, from_w: Floats) -> Floats:
    """Points (n, 2) on the part of the outline that can be seen from a place, were nothing else there."""
    turn = (np.arange(POINTS) + 0.5) * 2 * math.pi / POINTS
    normal = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    if obstacle.shape == "box":
        half = np.array(obstacle.half_size_m[:2])
        along = (np.arange(POINTS // 4) + 0.5) / (POINTS // 4) * 2 - 1
        sides = [(np.array([s, 0.0]), np.array([0.0, 1.0])) for s in (1.0, -1.0)]
        sides += [(np.array([0.0, s]), np.array([1.0, 0.0])) for s in (1.0, -1.0)]
        points = np.vstack([(side + along[:, None] * run) * half for side, run in sides])
        normal = np.vstack([np.broadcast_to(side, (len(along), 2)) for side, _ in sides])
        c, s = math.cos(obstacle.yaw_rad), math.sin(obstacle.yaw_rad)
        turned = np.array([[c, s], [-s, c]])
        points, normal = points @ turned, normal @ turned
    else:
        points = obstacle.radius_m * normal
    points = points + np.array(obstacle.position_w[:2])
    seen = ((from_w - points) * normal).sum(axis=1) > 0
    return points[seen] if seen.any() else points


def moved(reported: Sequence[Obstacle], from_w: Sequence[float], to_w: Sequence[float]) -> list[Obstacle]:
    """Obstacles as they are when the base, thought to be at `from_w`, is at `to_w`, both x, y, heading.

    It takes a wrong pose out of a map's errors: what is left is the map as the robot sees it.
    """
    turn = to_w[2] - from_w[2]
    c, s = math.cos(turn), math.sin(turn)
    found: list[Obstacle] = []
    for one in reported:
        x, y = one.position_w[0] - from_w[0], one.position_w[1] - from_w[1]
        place = (to_w[0] + c * x - s * y, to_w[1] + s * x + c * y, one.position_w[2])
        found.append(msgspec.structs.replace(one, position_w=place, yaw_rad=one.yaw_rad + turn))
    return found


def _within(obstacles: Sequence[Obstacle], head_w: Floats, within_m: float) -> list[Obstacle]:
    """Those whose outline is so near."""
    near = Outlines.of(obstacles).distance_m(head_w) <= within_m
    return [one for one, is_near in zip(obstacles, near.tolist(), strict=True) if is_near]


def _size_m(obstacle: Obstacle) -> float:
    return max(obstacle.half_size_m[:2]) if obstacle.shape == "box" else obstacle.radius_m
