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
FOV_RAD = math.pi / 2  # of the camera
VISIBLE_FRACTION = 0.45  # of the field of view on each side; at its edge half of an obstacle is outside
MIN_RANGE_M = 0.15  # a camera sees nothing nearer
MATCH_M = 0.05  # between a reported outline and the true one
OUTLINE_POINTS = 48
SIGHT = np.linspace(0.0, 1.0, 24)[1:-1]  # fractions of a line of sight at which an obstacle may hide what is behind


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
        """Add the score of another map."""
        for name in ("position_m", "surface_m", "size_m", "in_sd"):
            getattr(self, name).extend(getattr(other, name))
        self.misses += other.misses
        self.ghosts += other.ghosts
        self.reported += other.reported
        self.visible += other.visible


def score(
    reported: Sequence[Obstacle],
    truth: Sequence[Obstacle],
    head_w: Sequence[float] | Floats,
    heading_rad: float,
) -> MapScore:
    """Compare a perceived map with the true obstacles within NEAR_M of the head.

    A reported obstacle matches the true one whose outline is nearest to its side that faces the head, if the mean
    distance is at most MATCH_M. Otherwise it is a ghost. A visible true obstacle without a match is a miss.

    Args:
        reported: The obstacles of the map.
        truth: The true obstacles.
        head_w: (2,) or more, the front of the head, in m.
        heading_rad: Direction in which the camera looks.
    """
    head = np.asarray(head_w, dtype=np.float64)[:2]
    near_truth = _within(truth, head, NEAR_M + MATCH_M)
    true_outlines = Outlines.from_obstacles(near_truth)
    result = MapScore()
    matched_names: set[str] = set()
    for obstacle in _within(reported, head, NEAR_M):
        result.reported += 1
        if not near_truth:
            result.ghosts += 1
            continue
        distances_m = np.abs(true_outlines.distance_m(facing_points_w(obstacle, head)))  # (points, obstacles)
        outline_errors_m = distances_m.mean(axis=0)
        nearest = int(np.argmin(outline_errors_m))
        if outline_errors_m[nearest] > MATCH_M:
            result.ghosts += 1
            continue
        true_obstacle = near_truth[nearest]
        matched_names.add(true_obstacle.name)
        position_error_m = math.dist(obstacle.position_w[:2], true_obstacle.position_w[:2])
        result.position_m.append(position_error_m)
        result.surface_m.append(float(outline_errors_m[nearest]))
        result.size_m.append(_size_m(obstacle) - _size_m(true_obstacle))
        result.in_sd.append(position_error_m / max(obstacle.position_sd_m, 1e-4))
    for true_obstacle in visible(truth, head, heading_rad):
        result.visible += 1
        if true_obstacle.name not in matched_names:
            result.misses += 1
    return result


def visible(truth: Sequence[Obstacle], head_w: Floats, heading_rad: float) -> list[Obstacle]:
    """Return the obstacles within NEAR_M of the head that a camera at the head sees.

    An obstacle is visible if its center is in the field of view, its outline is at least MIN_RANGE_M away, and other
    obstacles hide less than half of the side that faces the camera.

    Args:
        truth: The true obstacles.
        head_w: (2,) position of the camera, in m.
        heading_rad: Direction in which the camera looks.
    """
    near = _within(truth, head_w, NEAR_M)
    outlines = Outlines.from_obstacles(near)
    visible_obstacles: list[Obstacle] = []
    for i, obstacle in enumerate(near):
        x, y = np.array(obstacle.position_w[:2]) - head_w
        bearing_rad = (math.atan2(y, x) - heading_rad + math.pi) % (2 * math.pi) - math.pi
        is_in_view = abs(bearing_rad) <= VISIBLE_FRACTION * FOV_RAD
        if not is_in_view or outlines.distance_m(head_w)[i] < MIN_RANGE_M:
            continue
        # Sample the line of sight to each point of the facing side, and look for other obstacles on it.
        facing_w = facing_points_w(obstacle, head_w)
        sight_w = head_w + SIGHT[:, None, None] * (facing_w - head_w)  # (steps, points, 2)
        is_inside = outlines.distance_m(sight_w) < 0  # (steps, points, obstacles)
        is_inside[..., i] = False  # an obstacle does not hide itself
        is_hidden = is_inside.any(axis=(0, 2))  # (points,)
        if is_hidden.mean() < 0.5:
            visible_obstacles.append(obstacle)
    return visible_obstacles


def facing_points_w(obstacle: Obstacle, from_w: Floats) -> Floats:
    """Return points (n, 2) on the part of the outline that faces a place, whatever stands between."""
    if obstacle.shape == "box":
        points, normals = _box_outline(obstacle)
    else:
        angles = (np.arange(OUTLINE_POINTS) + 0.5) * 2 * math.pi / OUTLINE_POINTS
        normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points = obstacle.radius_m * normals
    points = points + np.array(obstacle.position_w[:2])
    is_facing = ((from_w - points) * normals).sum(axis=1) > 0
    return points[is_facing] if is_facing.any() else points


def _box_outline(obstacle: Obstacle) -> tuple[Floats, Floats]:
    """Return points around a box's center, and the outward normals there, both (n, 2)."""
    side_points = OUTLINE_POINTS // 4
    half_size = np.array(obstacle.half_size_m[:2])
    along = (np.arange(side_points) + 0.5) / side_points * 2 - 1  # -1 to 1
    sides = [(np.array([sign, 0.0]), np.array([0.0, 1.0])) for sign in (1.0, -1.0)]  # normal and direction
    sides += [(np.array([0.0, sign]), np.array([1.0, 0.0])) for sign in (1.0, -1.0)]
    points = np.vstack([(normal + along[:, None] * direction) * half_size for normal, direction in sides])
    normals = np.vstack([np.broadcast_to(normal, (len(along), 2)) for normal, _ in sides])
    cos = math.cos(obstacle.yaw_rad)
    sin = math.sin(obstacle.yaw_rad)
    rotation = np.array([[cos, sin], [-sin, cos]])
    return points @ rotation, normals @ rotation


def moved(reported: Sequence[Obstacle], from_w: Sequence[float], to_w: Sequence[float]) -> list[Obstacle]:
    """Move a map rigidly, by the motion that takes the estimated pose of the base to its true pose.

    This removes the pose error from the errors of a map, so that only the errors of perception remain.

    Args:
        reported: Obstacles of the map.
        from_w: Estimated x and y in m, and heading in rad.
        to_w: True x and y in m, and heading in rad.

    Returns:
        Copies of the obstacles with corrected positions and yaw angles; heights stay.
    """
    rotation_rad = to_w[2] - from_w[2]
    cos = math.cos(rotation_rad)
    sin = math.sin(rotation_rad)
    corrected: list[Obstacle] = []
    for obstacle in reported:
        x, y, z = obstacle.position_w
        offset_x = x - from_w[0]
        offset_y = y - from_w[1]
        corrected_x = to_w[0] + cos * offset_x - sin * offset_y
        corrected_y = to_w[1] + sin * offset_x + cos * offset_y
        position_w = (corrected_x, corrected_y, z)
        yaw_rad = obstacle.yaw_rad + rotation_rad
        corrected.append(msgspec.structs.replace(obstacle, position_w=position_w, yaw_rad=yaw_rad))
    return corrected


def _within(obstacles: Sequence[Obstacle], head_w: Floats, within_m: float) -> list[Obstacle]:
    """Return the obstacles whose outline is within a distance of the head."""
    near = Outlines.from_obstacles(obstacles).distance_m(head_w) <= within_m
    return [one for one, is_near in zip(obstacles, near.tolist(), strict=True) if is_near]


def _size_m(obstacle: Obstacle) -> float:
    return max(obstacle.half_size_m[:2]) if obstacle.shape == "box" else obstacle.radius_m
