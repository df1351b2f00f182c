"""One obstacle of the map: its surface, its shape with standard deviations, and the evidence that it exists. Pure.

The shape is fitted again whenever the surface has changed. It is a circle or a box, whichever explains the surface
better at the price of its parameters (Bayesian information criterion). So an obstacle that began as a short arc becomes
a box when more of it is seen.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from snakesim_gnc.guidance.mapping.box_fit import FittedBoxes, fit_boxes
from snakesim_gnc.guidance.mapping.circle_fit import PRIOR_RADIUS_M, FittedCircles, fit_circles
from snakesim_gnc.guidance.mapping.surfaces import SurfaceCells, stack_surfaces
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import KnownObstacle

# Circle or box.
MIN_BOX_CELLS = 5  # a surface of fewer cells is a circle
MAX_CIRCLE_RADIUS_M = 0.16  # a larger round thing is taken for a box
TOO_LARGE_CIRCLE_COST = 1e3
MAX_GOOD_CIRCLE_COST_PER_CELL = 0.8  # per cell: if a circle explains it this well, no box is tried
SHAPE_CHANGE_COST = 4.0  # by which another shape must be better than the current one
CIRCLE_PARAMETER_COUNT = 3
BOX_PARAMETER_COUNT = 5
SINGLE_FACE_BOX_PARAMETER_COUNT = 4  # of a box of which one face was seen: its depth is not fitted
NO_CENTER = np.full(2, np.nan)

# Evidence, as log odds.
HIT_LOG_ODDS = 0.5
MISS_LOG_ODDS = -0.8
TOUCH_LOG_ODDS = 3.0
MAX_LOG_ODDS = 5.0
MIN_REPORTED_LOG_ODDS = 0.2  # an obstacle above this is reported
MIN_KEPT_LOG_ODDS = -1.0  # below this it is dropped
LOG_ODDS_DECAY_TIME_S = 60.0  # belief in what is not seen again falls to 1/e in this time

DEFAULT_HEIGHT_M = 0.2  # reported while nothing higher was seen
MAX_SD_M = 10.0  # upper limit of what is reported


@dataclass
class ObstacleTrack:
    """An obstacle under observation. Its name stays, even if the obstacle turns out to be something else."""

    # Identity.
    number: int
    name: str
    # What was measured.
    surface: SurfaceCells = field(default_factory=SurfaceCells)
    is_touched: bool = False  # the body has touched it
    log_odds: float = 0.0
    last_seen_ns: int = 0
    top_m: float = 0.0  # highest point seen, above the ground
    # Variance of the robot's position when the obstacle was first seen: the map is no better than that.
    initial_variance_m2: float = 0.0
    # Total drift variance of the robot's position when the surface was last brought up to date.
    position_variance_m2: float = 0.0
    # The shape, in the world.
    shape: Literal["cylinder", "box"] = "cylinder"
    center_w: Floats = field(default_factory=lambda: np.zeros(2))
    yaw_rad: float = 0.0  # of a box
    radius_m: float = PRIOR_RADIUS_M  # of a cylinder
    # Half size of a box along and across yaw.
    half_size_m: Floats = field(default_factory=lambda: np.zeros(2))
    position_sd_m: float = math.inf
    size_sd_m: float = math.inf
    penalized_cost: float = math.inf  # misfit of the shape, and the price of its parameters

    @property
    def is_fitted(self) -> bool:
        """Whether the shape has been fitted to the surface."""
        return math.isfinite(self.penalized_cost)

    def add_evidence(self, log_odds: float) -> None:
        """Add evidence that the obstacle exists, or, if negative, that it does not."""
        self.log_odds = min(self.log_odds + log_odds, MAX_LOG_ODDS)

    def compute_log_odds_at(self, now_ns: int) -> float:
        """Return the log odds that the obstacle is there now."""
        age_ns = max(now_ns - self.last_seen_ns, 0)
        return self.log_odds * math.exp(-age_ns * 1e-9 / LOG_ODDS_DECAY_TIME_S)

    def to_obstacle(self, now_ns: int, ground_z_m: float) -> KnownObstacle:
        """Return the track as an obstacle of a world model, with its shape, size, confidence and uncertainty.

        Args:
            now_ns: Robot time; the confidence decreases with the time since the obstacle was last seen.
            ground_z_m: Height of the ground in the world.
        """
        height_m = max(self.top_m, DEFAULT_HEIGHT_M)
        x, y = self.center_w.tolist()
        yaw_rad = 0.0
        radius_m = 0.0
        half_size_m = (0.0, 0.0, 0.0)
        if self.shape == "box":
            yaw_rad = self.yaw_rad
            half_size_m = (float(self.half_size_m[0]), float(self.half_size_m[1]), height_m / 2)
        else:
            radius_m = self.radius_m
        return KnownObstacle(
            name=self.name,
            shape=self.shape,
            position_w=(x, y, ground_z_m + height_m / 2),
            yaw_rad=yaw_rad,
            radius_m=radius_m,
            half_size_m=half_size_m,
            height_m=height_m,
            confidence=1.0 / (1.0 + math.exp(-self.compute_log_odds_at(now_ns))),
            position_sd_m=min(self.position_sd_m, MAX_SD_M),
            size_sd_m=min(self.size_sd_m, MAX_SD_M),
            last_seen_ns=self.last_seen_ns,
            touched=self.is_touched,
        )

    def set_circle(self, circles: FittedCircles, row: int, cost: float) -> None:
        """Take the shape from a row of a circle fit."""
        covariance = circles.covariance[row]
        self.shape = "cylinder"
        self.penalized_cost = cost
        self.center_w = circles.center_w[row]
        self.radius_m = float(circles.radius_m[row])
        self.position_sd_m = math.sqrt(float(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
        self.size_sd_m = math.sqrt(float(covariance[2, 2]))

    def set_box(self, boxes: FittedBoxes, row: int, cost: float) -> None:
        """Take the shape from a row of a box fit."""
        self.shape = "box"
        self.penalized_cost = cost
        self.center_w = boxes.center_w[row]
        self.half_size_m = boxes.half_m[row]
        self.yaw_rad = float(boxes.yaw_rad[row])
        self.position_sd_m = float(boxes.center_sd_m[row].max())
        self.size_sd_m = float(boxes.half_size_sd_m[row].max())


def fit_shapes(tracks: Sequence[ObstacleTrack]) -> None:
    """Fit a circle or a box to the surface of each track, in one vectorized computation.

    The shape with the lower cost is used: the misfit plus a penalty for each parameter (Bayesian information
    criterion). A box is tried only for tracks with enough cells that a circle does not fit well.

    Args:
        tracks: The tracks, whose shapes are changed.
    """
    if not tracks:
        return
    points, weights, outward_directions, normal_weights = stack_surfaces(
        [track.surface for track in tracks]
    )
    cell_counts = np.array([len(track.surface) for track in tracks])
    log_cell_counts = np.log(np.maximum(cell_counts, 2))

    initial_center_w = np.array([_find_initial_center(track) for track in tracks])
    circles = fit_circles(points, weights, outward_directions, normal_weights, initial_center_w)
    circle_cost = circles.fit_cost + CIRCLE_PARAMETER_COUNT * log_cell_counts
    circle_cost[circles.radius_m > MAX_CIRCLE_RADIUS_M] += TOO_LARGE_CIRCLE_COST

    box_cost = np.full(len(tracks), np.inf)
    box_row_by_track: dict[int, int] = {}  # row in `boxes`, by index of the track
    boxes: FittedBoxes | None = None
    candidates = np.flatnonzero(
        (cell_counts >= MIN_BOX_CELLS)
        & (circles.fit_cost > MAX_GOOD_CIRCLE_COST_PER_CELL * cell_counts)
    )
    if len(candidates):
        max_cell_count = int(cell_counts[candidates].max())
        boxes = fit_boxes(
            points[candidates, :max_cell_count],
            weights[candidates, :max_cell_count],
            outward_directions[candidates, :max_cell_count],
        )
        parameter_counts = np.where(
            boxes.seen_face_count > 1, BOX_PARAMETER_COUNT, SINGLE_FACE_BOX_PARAMETER_COUNT
        )
        box_cost[candidates] = boxes.fit_cost + parameter_counts * log_cell_counts[candidates]
        box_row_by_track = {int(index): row for row, index in enumerate(candidates)}

    for index, track in enumerate(tracks):
        if boxes is None or circle_cost[index] <= box_cost[index] + _compute_circle_preference(
            track
        ):
            track.set_circle(circles, index, float(circle_cost[index]))
        else:
            track.set_box(boxes, box_row_by_track[index], float(box_cost[index]))


def _find_initial_center(track: ObstacleTrack) -> Floats:
    """Return the center from which a circle fit begins; NaN without an earlier one."""
    if track.shape == "cylinder" and track.is_fitted:
        return track.center_w
    return NO_CENTER


def _compute_circle_preference(track: ObstacleTrack) -> float:
    """Return by how much a circle may cost more than a box. It favors the shape that the track has."""
    if not track.is_fitted:
        return 0.0
    return SHAPE_CHANGE_COST if track.shape == "cylinder" else -SHAPE_CHANGE_COST


def make_outlines(tracks: Sequence[ObstacleTrack]) -> ObstacleOutlines:
    """Return the shapes of tracks, for distances to all of them."""
    is_box = np.array([track.shape == "box" for track in tracks], dtype=bool)
    yaw_rad = np.array([track.yaw_rad for track in tracks], dtype=np.float64)
    half_m = np.array([track.half_size_m for track in tracks], dtype=np.float64).reshape(-1, 2)
    return ObstacleOutlines(
        center_w=np.array([track.center_w for track in tracks], dtype=np.float64).reshape(-1, 2),
        direction=np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad)]),
        half_m=np.where(is_box[:, None], half_m, 0.0),
        rounding_m=np.where(is_box, 0.0, [track.radius_m for track in tracks]),
    )


def get_position_sds_m(tracks: Sequence[ObstacleTrack]) -> Floats:
    """Return the standard deviations of the positions of tracks, (n,)."""
    return np.array([track.position_sd_m for track in tracks], dtype=np.float64)
