"""What ranging sensors would see of upright shapes on a ground, computed exactly: the truth for guidance."""

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from snakesim_gnc.guidance.ranging.depth_scan import CameraIntrinsics
from snakesim_gnc.guidance.ranging.scan import AzimuthScan, RangeNoise, make_scan
from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import DepthImage, KnownObstacle, RangeScan
from snakesim_operator.features.robots.urdf_tree import make_rotation_from_rpy

Ground = Callable[[Floats, Floats], Floats]
INTRINSICS = CameraIntrinsics(width=160, height=120, fx_px=90.0, fy_px=90.0, cx_px=79.5, cy_px=59.5)
DEPTH_RANGE_M = (0.05, 3.0)
DEPTH_UNIT_M = 0.001
MAX_RAY_MULTIPLE = 50.0  # a ray that is longer meets nothing
GROUND_ITERATIONS = 8  # towards the point at which a ray meets hilly ground
MAX_DESCENDING_SLOPE = -1e-3  # vertical component of a ray; a flatter ray never meets the ground


def make_cylinder(
    name: str, x: float, y: float, radius_m: float = 0.05, height_m: float = 0.2
) -> KnownObstacle:
    """Return an upright cylinder."""
    return KnownObstacle(
        name=name,
        shape="cylinder",
        position_w=(x, y, height_m / 2),
        radius_m=radius_m,
        height_m=height_m,
    )


def make_box(
    name: str, x: float, y: float, size_m: tuple[float, float], yaw_rad: float = 0.0
) -> KnownObstacle:
    """Return an upright box."""
    half = (size_m[0] / 2, size_m[1] / 2, 0.1)
    return KnownObstacle(
        name=name,
        shape="box",
        position_w=(x, y, 0.1),
        yaw_rad=yaw_rad,
        half_size_m=half,
        height_m=0.2,
    )


def flat_ground(x: Floats, _y: Floats) -> Floats:
    """Return the height of a ground without hills, which is 0 everywhere."""
    return np.zeros_like(x)


def make_hills(height_m: float = 0.02, wavelength_m: float = 1.5) -> Ground:
    """Return the height function of smooth hills, with `height_m` from the lowest to the highest point."""
    k = 2 * math.pi / wavelength_m
    return lambda x, y: 0.25 * height_m * (np.sin(k * x + 0.7) + np.sin(k * y + 2.0))


@dataclass
class SensorErrors:
    """Errors of a range sensor: noise that grows with the squared distance, and pixels that drop out."""

    floor_m: float = 0.0
    per_m2: float = 0.0
    dropout: float = 0.0
    random: np.random.Generator = field(default_factory=lambda: np.random.default_rng(1))

    def apply(self, distance_m: Floats) -> Floats:
        """Return measured distances, with errors; infinite where nothing is measured."""
        with np.errstate(invalid="ignore"):
            noise = (self.floor_m + self.per_m2 * distance_m**2) * self.random.standard_normal(
                distance_m.shape
            )
            seen = np.where(
                self.random.random(distance_m.shape) < self.dropout, np.inf, distance_m + noise
            )
        return np.where(np.isfinite(distance_m), seen, np.inf)


def compute_ray_distances(
    origin: Floats, rays: Floats, obstacles: Sequence[KnownObstacle], ground: Ground = flat_ground
) -> Floats:
    """Compute how far each ray goes before it meets an obstacle or the ground.

    Args:
        origin: (3,) start of all rays, m.
        rays: (n, 3) directions, of any length.
        obstacles: Upright cylinders and boxes.
        ground: Height of the ground as a function of x and y.

    Returns:
        (n,) distances as multiples of the length of each ray; infinite for a ray that meets nothing.
    """
    slopes = rays[:, 2]
    nearest = np.full(len(rays), np.inf)
    # Rays that are parallel to a surface divide by zero. The result is infinite, or not a number, and is sorted out.
    with np.errstate(divide="ignore", invalid="ignore"):
        # Where descending rays meet flat ground.
        t = np.where(slopes < 0, -origin[2] / slopes, np.inf)
        t = np.minimum(t, MAX_RAY_MULTIPLE)
        # From there, go along each ray by its height above the ground until it lies on the hilly ground.
        for _ in range(GROUND_ITERATIONS):
            points = origin + t[:, None] * rays
            heights_m = points[:, 2] - ground(points[:, 0], points[:, 1])
            t = np.where(slopes < MAX_DESCENDING_SLOPE, t - heights_m / slopes, np.inf)
            t = np.clip(t, 0.0, MAX_RAY_MULTIPLE)
        nearest = np.where(t < MAX_RAY_MULTIPLE, t, nearest)
        # Obstacles in front of the ground. Those behind the origin have a negative multiple.
        for obstacle in obstacles:
            t = _intersect_upright_obstacle(origin, rays, obstacle)
            nearest = np.minimum(nearest, np.where(t > 0, t, np.inf))
    return nearest


def _intersect_upright_obstacle(origin: Floats, rays: Floats, obstacle: KnownObstacle) -> Floats:
    """Return the multiple of each ray at which it enters the side of a cylinder or box, (n,); infinite if nowhere.

    Top and bottom of the obstacle are open: a ray that enters there meets nothing.

    Args:
        origin: (3,) start of all rays, m.
        rays: (n, 3) directions.
        obstacle: Upright cylinder or box.
    """
    from_center = origin[:2] - np.array(obstacle.position_w[:2])
    if obstacle.shape == "cylinder":
        t = _intersect_circle(from_center, rays[:, :2], obstacle.radius_m)
    else:
        t = _intersect_rectangle(from_center, rays[:, :2], obstacle)
    height_m = origin[2] + t * rays[:, 2]
    middle_m = obstacle.position_w[2]
    half_height_m = obstacle.height_m / 2
    meets_side = (height_m >= middle_m - half_height_m) & (height_m <= middle_m + half_height_m)
    return np.where(meets_side, t, np.inf)


def _intersect_circle(from_center: Floats, flat_rays: Floats, radius_m: float) -> Floats:
    """Return where rays in the plane enter a circle: the smaller root of a t² + 2 b t + c = 0."""
    a = (flat_rays**2).sum(1)
    b = flat_rays @ from_center
    c = from_center @ from_center - radius_m**2
    discriminant = b * b - a * c
    return np.where(discriminant >= 0, (-b - np.sqrt(discriminant)) / a, np.inf)


def _intersect_rectangle(from_center: Floats, flat_rays: Floats, box: KnownObstacle) -> Floats:
    """Return where rays in the plane enter the rectangle of a box: where they are between both pairs of edges."""
    cosine = math.cos(box.yaw_rad)
    sine = math.sin(box.yaw_rad)
    local_from_world = np.array([[cosine, sine], [-sine, cosine]])
    start = local_from_world @ from_center  # (2,)
    directions = flat_rays @ local_from_world.T  # (n, 2)
    half_size_m = np.array(box.half_size_m[:2])
    at_lower_edges = (-half_size_m - start) / directions  # (n, 2)
    at_upper_edges = (half_size_m - start) / directions
    enter = np.minimum(at_lower_edges, at_upper_edges).max(1)
    leave = np.maximum(at_lower_edges, at_upper_edges).min(1)
    return np.where(enter <= leave, enter, np.inf)


def render_depth_image(
    obstacles: Sequence[KnownObstacle],
    position_w: Floats,
    world_from_camera: Floats,
    *,
    ground: Ground = flat_ground,
    sensor_errors: SensorErrors | None = None,
    timestamp_ns: int = 0,
    link_index: int = 0,
    position_l: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> DepthImage:
    """Render the image of a depth camera with the optics of INTRINSICS. The tick of the image is 0.

    Args:
        obstacles: What the camera can see, besides the ground.
        position_w: (3,) position of the camera in the world, m.
        world_from_camera: (3, 3) rotation matrix from the camera's frame to the world.
        ground: Height of the ground as a function of x and y.
        sensor_errors: Errors of the camera. If None, the camera is exact.
        timestamp_ns: Time of the image.
        link_index: Index of the link that carries the camera, as the message reports it.
        position_l: Position of the camera on this link, as the message reports it, m. It does not move the camera.
    """
    # Their component along the viewing direction is 1, so that distances along them are depths.
    rays = INTRINSICS.compute_rays().astype(np.float64) @ world_from_camera.T
    errors = sensor_errors or SensorErrors()
    depth_m = errors.apply(compute_ray_distances(position_w, rays, obstacles, ground))
    min_range_m, max_range_m = DEPTH_RANGE_M
    is_measured = np.isfinite(depth_m) & (depth_m < max_range_m) & (depth_m > min_range_m)
    depth_counts = np.where(is_measured, depth_m / DEPTH_UNIT_M, 0.0)  # 0: not measured
    return DepthImage(
        tick=0,
        timestamp_ns=timestamp_ns,
        link=link_index,
        position_l=position_l,
        orientation_l_wxyz=(1.0, 0.0, 0.0, 0.0),
        **asdict(INTRINSICS),
        range_min_m=min_range_m,
        range_max_m=max_range_m,
        scale_m=DEPTH_UNIT_M,
        depth=np.round(depth_counts).astype("<u2").tobytes(),
    )


def render_lidar_scan(
    obstacles: Sequence[KnownObstacle],
    position_w: Floats,
    world_from_lidar: Floats,
    *,
    beam_count: int = 181,
    timestamp_ns: int = 0,
) -> RangeScan:
    """Return the scan of an exact planar lidar that covers half a turn.

    Args:
        obstacles: What the beams can hit, besides flat ground.
        position_w: (3,) position of the lidar in the world, m.
        world_from_lidar: (3, 3) rotation matrix from the lidar's frame, in which x points forward, to the world.
        beam_count: Number of beams, from right to left.
        timestamp_ns: Time of the scan.
    """
    max_range_m = 4.0
    angles_rad = np.linspace(-math.pi / 2, math.pi / 2, beam_count)
    rays = (
        np.stack([np.cos(angles_rad), np.sin(angles_rad), np.zeros(beam_count)], axis=1)
        @ world_from_lidar.T
    )
    distances_m = compute_ray_distances(position_w, rays, obstacles)
    # A message needs a step above 0.
    angle_step_rad = float(angles_rad[1] - angles_rad[0]) if beam_count > 1 else 0.01
    return RangeScan(
        tick=0,
        timestamp_ns=timestamp_ns,
        link=0,
        position_l=(0.0, 0.0, 0.0),
        orientation_l_wxyz=(1.0, 0.0, 0.0, 0.0),
        angle_min_rad=-math.pi / 2,
        angle_step_rad=angle_step_rad,
        range_min_m=0.02,
        range_max_m=max_range_m,
        range_m=[
            float(distance_m) if distance_m < max_range_m else None for distance_m in distances_m
        ],
    )


def make_lidar_scan(
    *obstacles: KnownObstacle, at: tuple[float, float] = (0.0, 0.0), timestamp_ns: int = 0
) -> AzimuthScan:
    """Return the scan of a lidar near the ground that looks along x, with the given obstacles around it."""
    position = np.array([*at, 0.05])
    ahead = make_rotation(0.0)
    ranges = render_lidar_scan(
        obstacles, position, ahead, beam_count=361, timestamp_ns=timestamp_ns
    )
    return make_scan(ranges, position, ahead, 0.0, RangeNoise(0.002, 0.0))


def make_rotation(yaw_rad: float, pitch_rad: float = 0.0, roll_rad: float = 0.0) -> Floats:
    """Return the rotation matrix from a sensor's frame to the world: by yaw, then pitch (downwards), then roll."""
    return make_rotation_from_rpy(roll_rad, pitch_rad, yaw_rad)
