"""Scores a map: compares the obstacles that guidance published with the true obstacles.

    score(world.obstacles, truth, head_w, heading_rad).position_m

Only obstacles near the head count. An obstacle is missed only if a camera at the head could see it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import KnownObstacle

MAX_RANGE_M = 1.0
FOV_RAD = math.pi / 2  # of the camera
# Of the full field of view, on each side; at 0.5 half of an obstacle would be outside.
HALF_FOV_FRACTION = 0.45
MIN_RANGE_M = 0.15  # minimum range of the camera
MAX_MATCH_DISTANCE_M = 0.05  # mean distance between the outlines of a match
OUTLINE_POINTS = 48
LINE_OF_SIGHT_FRACTIONS = np.linspace(0.0, 1.0, 24)[1:-1]  # where occlusion is tested


@dataclass
class MapScore:
    """Errors of one map, or of several added up. Each list has an entry for each matched obstacle near the head."""

    # Distance from the reported to the true center.
    position_errors_m: list[float] = field(default_factory=list[float])
    # Mean distance of the side that faces the head to the true outline.
    surface_errors_m: list[float] = field(default_factory=list[float])
    # Reported minus true radius, or longer half edge.
    size_errors_m: list[float] = field(default_factory=list[float])
    # Position error divided by the reported standard deviation.
    position_errors_in_sd: list[float] = field(default_factory=list[float])
    missed_count: int = 0  # true obstacles that are visible, but not reported
    ghost_count: int = 0  # reported obstacles without a true obstacle there
    reported_count: int = 0  # reported obstacles near the head
    visible_count: int = 0  # true obstacles that are visible

    def add(self, other: "MapScore") -> None:
        """Add the errors and counts of another map to this score."""
        for name in (
            "position_errors_m",
            "surface_errors_m",
            "size_errors_m",
            "position_errors_in_sd",
        ):
            getattr(self, name).extend(getattr(other, name))
        self.missed_count += other.missed_count
        self.ghost_count += other.ghost_count
        self.reported_count += other.reported_count
        self.visible_count += other.visible_count


def score_map(
    reported: Sequence[KnownObstacle],
    true_obstacles: Sequence[KnownObstacle],
    head_w: Sequence[float] | Floats,
    heading_rad: float,
) -> MapScore:
    """Compare a perceived map with the true obstacles within MAX_RANGE_M of the head.

    A reported obstacle matches the true one whose outline is nearest to its side that faces the head, if the mean
    distance is at most MAX_MATCH_DISTANCE_M. Otherwise it is a ghost. A visible true obstacle without a match is a
    miss.

    Args:
        reported: Obstacles of the map.
        true_obstacles: Obstacles of the scene.
        head_w: (2,) or more, position of the front end of the head, in m.
        heading_rad: Direction in which the camera looks.

    Returns:
        Errors of the matched obstacles, and numbers of ghosts and misses.
    """
    head = np.asarray(head_w, dtype=np.float64)[:2]
    near_true_obstacles = _select_nearby_obstacles(
        true_obstacles, head, MAX_RANGE_M + MAX_MATCH_DISTANCE_M
    )
    true_outlines = ObstacleOutlines.from_obstacles(near_true_obstacles)
    map_score = MapScore()
    matched_names: set[str] = set()
    for obstacle in _select_nearby_obstacles(reported, head, MAX_RANGE_M):
        map_score.reported_count += 1
        if not near_true_obstacles:
            map_score.ghost_count += 1
            continue
        distances_m = np.abs(
            true_outlines.compute_distances_m(find_facing_points_w(obstacle, head))
        )  # (points, obstacles)
        outline_errors_m = distances_m.mean(axis=0)
        nearest = int(np.argmin(outline_errors_m))
        if outline_errors_m[nearest] > MAX_MATCH_DISTANCE_M:
            map_score.ghost_count += 1
            continue
        true_obstacle = near_true_obstacles[nearest]
        matched_names.add(true_obstacle.name)
        position_error_m = math.dist(obstacle.position_w[:2], true_obstacle.position_w[:2])
        map_score.position_errors_m.append(position_error_m)
        map_score.surface_errors_m.append(float(outline_errors_m[nearest]))
        map_score.size_errors_m.append(_get_half_size_m(obstacle) - _get_half_size_m(true_obstacle))
        map_score.position_errors_in_sd.append(position_error_m / max(obstacle.position_sd_m, 1e-4))
    for true_obstacle in find_visible_obstacles(true_obstacles, head, heading_rad):
        map_score.visible_count += 1
        if true_obstacle.name not in matched_names:
            map_score.missed_count += 1
    return map_score


def find_visible_obstacles(
    obstacles: Sequence[KnownObstacle], head_w: Floats, heading_rad: float
) -> list[KnownObstacle]:
    """Return the obstacles within MAX_RANGE_M of the head that a camera at the head sees.

    An obstacle is visible if its center is in the field of view, its outline is at least MIN_RANGE_M away, and other
    obstacles hide less than half of the side that faces the camera.

    Args:
        obstacles: Obstacles of the scene, which may hide one another.
        head_w: (2,) position of the camera, in m.
        heading_rad: Direction in which the camera looks.
    """
    near_obstacles = _select_nearby_obstacles(obstacles, head_w, MAX_RANGE_M)
    outlines = ObstacleOutlines.from_obstacles(near_obstacles)
    visible_obstacles: list[KnownObstacle] = []
    for i, obstacle in enumerate(near_obstacles):
        x, y = np.array(obstacle.position_w[:2]) - head_w
        bearing_rad = (math.atan2(y, x) - heading_rad + math.pi) % (2 * math.pi) - math.pi
        is_in_view = abs(bearing_rad) <= HALF_FOV_FRACTION * FOV_RAD
        if not is_in_view or outlines.compute_distances_m(head_w)[i] < MIN_RANGE_M:
            continue
        # Sample the line of sight to each point of the facing side, and look for other obstacles on it.
        facing_w = find_facing_points_w(obstacle, head_w)
        # (steps, points, 2).
        sight_w = head_w + LINE_OF_SIGHT_FRACTIONS[:, None, None] * (facing_w - head_w)
        is_inside = outlines.compute_distances_m(sight_w) < 0  # (steps, points, obstacles)
        is_inside[..., i] = False  # an obstacle does not hide itself
        is_hidden = is_inside.any(axis=(0, 2))  # (points,)
        if is_hidden.mean() < 0.5:
            visible_obstacles.append(obstacle)
    return visible_obstacles


def find_facing_points_w(obstacle: KnownObstacle, from_w: Floats) -> Floats:
    """Return points on the side of an obstacle that faces a viewer, also if another obstacle hides them.

    Args:
        obstacle: A cylinder or a box.
        from_w: (2,) position of the viewer, in m.

    Returns:
        (n, 2) points on the outline, in m; the whole outline if the viewer is inside.
    """
    if obstacle.shape == "box":
        points, normals = _sample_box_outline(obstacle)
    else:
        angles = (np.arange(OUTLINE_POINTS) + 0.5) * 2 * math.pi / OUTLINE_POINTS
        normals = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        points = obstacle.radius_m * normals
    points = points + np.array(obstacle.position_w[:2])
    is_facing = ((from_w - points) * normals).sum(axis=1) > 0
    return points[is_facing] if is_facing.any() else points


def _sample_box_outline(obstacle: KnownObstacle) -> tuple[Floats, Floats]:
    """Return points on the outline of a box relative to its center, and the outward normals there, both (n, 2)."""
    points_per_side = OUTLINE_POINTS // 4
    half_size = np.array(obstacle.half_size_m[:2])
    # Positions along a side, from -1 at one corner to 1 at the other.
    along = (np.arange(points_per_side) + 0.5) / points_per_side * 2 - 1
    # Outward normal and direction of each side, in the axes of the box.
    sides = [(np.array([sign, 0.0]), np.array([0.0, 1.0])) for sign in (1.0, -1.0)]
    sides += [(np.array([0.0, sign]), np.array([1.0, 0.0])) for sign in (1.0, -1.0)]
    points = np.vstack(
        [(normal + along[:, None] * direction) * half_size for normal, direction in sides]
    )
    normals = np.vstack([np.broadcast_to(normal, (len(along), 2)) for normal, _ in sides])
    # The transpose of the rotation by the yaw angle, because points and normals are rows.
    cos = math.cos(obstacle.yaw_rad)
    sin = math.sin(obstacle.yaw_rad)
    rotation = np.array([[cos, sin], [-sin, cos]])
    return points @ rotation, normals @ rotation


def align_map(
    reported: Sequence[KnownObstacle], from_w: Sequence[float], to_w: Sequence[float]
) -> list[KnownObstacle]:
    """Align a map with the true pose: move it rigidly, as the estimated pose of the base moves to the true pose.

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
    corrected: list[KnownObstacle] = []
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


def _select_nearby_obstacles(
    obstacles: Sequence[KnownObstacle], head_w: Floats, max_distance_m: float
) -> list[KnownObstacle]:
    """Return the obstacles whose outline is within a distance of the head, in m."""
    is_near_by_obstacle = (
        ObstacleOutlines.from_obstacles(obstacles).compute_distances_m(head_w) <= max_distance_m
    )
    return [
        obstacle
        for obstacle, is_near in zip(obstacles, is_near_by_obstacle.tolist(), strict=True)
        if is_near
    ]


def _get_half_size_m(obstacle: KnownObstacle) -> float:
    return max(obstacle.half_size_m[:2]) if obstacle.shape == "box" else obstacle.radius_m
