"""One obstacle of the map: its surface, its shape with covariance, and the evidence that it exists. Pure.

The shape is fitted again whenever the surface has changed: circle or box, whichever explains it with fewer parameters
(Bayesian information criterion). So what began as a short arc becomes the box that it turns out to be.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from snakesim_gnc.guidance.box_fit import fit_boxes
from snakesim_gnc.guidance.circle_fit import RADIUS_M, fit_circles
from snakesim_gnc.guidance.surfaces import Surface, batched
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Obstacle

BOX_FROM = 5  # cells; fewer are a circle
ROUND_LIMIT_M = 0.16  # rounder things are boxes
ROUND_MISFIT = 0.8  # a cell: what a circle explains this well need not be tried as a box
LOYALTY = 4.0  # by which another shape must be better than the present one
LOST = np.full(2, np.nan)
HIT, MISS, TOUCH = 0.5, -0.8, 3.0  # log odds
SUREST = 5.0
BELIEVED = 0.2  # from here on it is reported
GONE = -1.0
MEMORY_S = 60.0  # belief in what is not seen again falls to 1/e
UNKNOWN_HEIGHT_M = 0.2


@dataclass
class Track:
    """An obstacle under observation."""

    number: int
    name: str  # stays, also when it turns out to be something else
    surface: Surface = field(default_factory=Surface)
    felt: bool = False
    log_odds: float = 0.0
    last_seen_ns: int = 0
    top_m: float = 0.0
    born_m2: float = 0.0  # variance of the robot's position when it was first seen: the map is no better than that
    drift_m2: float = 0.0  # of the robot's position, when the surface was last brought up to date
    shape: Literal["cylinder", "box"] = "cylinder"
    center_w: Floats = field(default_factory=lambda: np.zeros(2))
    yaw_rad: float = 0.0
    radius_m: float = RADIUS_M
    half_m: Floats = field(default_factory=lambda: np.zeros(2))
    position_sd_m: float = math.inf
    size_sd_m: float = math.inf
    cost: float = math.inf  # misfit and parameters of the shape

    @property
    def fitted(self) -> bool:
        """Whether the shape has been fitted to the surface."""
        return math.isfinite(self.cost)

    def believe(self, by: float) -> None:
        """More or less than before."""
        self.log_odds = min(self.log_odds + by, SUREST)

    def believed(self, now_ns: int) -> float:
        """Log odds that it is there, now."""
        return self.log_odds * math.exp(-max(now_ns - self.last_seen_ns, 0) * 1e-9 / MEMORY_S)

    def obstacle(self, now_ns: int, ground_z_m: float) -> Obstacle:
        """As a message."""
        height = max(self.top_m, UNKNOWN_HEIGHT_M)
        x, y = self.center_w.tolist()
        boxy = self.shape == "box"
        return Obstacle(
            name=self.name,
            shape=self.shape,
            position_w=(x, y, ground_z_m + height / 2),
            yaw_rad=self.yaw_rad if boxy else 0.0,
            radius_m=0.0 if boxy else self.radius_m,
            half_size_m=(float(self.half_m[0]), float(self.half_m[1]), height / 2) if boxy else (0.0, 0.0, 0.0),
            height_m=height,
            confidence=1.0 / (1.0 + math.exp(-self.believed(now_ns))),
            position_sd_m=min(self.position_sd_m, 10.0),
            size_sd_m=min(self.size_sd_m, 10.0),
            last_seen_ns=self.last_seen_ns,
            felt=self.felt,
        )


def fit(tracks: Sequence[Track]) -> None:
    """Fit the shapes of tracks to their surfaces, all at once."""
    if not tracks:
        return
    points, weight, outward, normal = batched([track.surface for track in tracks])
    began = np.array([track.center_w if track.shape == "cylinder" and track.fitted else LOST for track in tracks])
    circles = fit_circles(points, weight, outward, normal, began)
    cells = np.array([len(track.surface) for track in tracks])
    as_circle = circles.misfit + 3 * np.log(np.maximum(cells, 2))
    as_circle[circles.radius_m > ROUND_LIMIT_M] += 1e3
    as_box, boxes, row = np.full(len(tracks), np.inf), None, {}
    doubtful = np.flatnonzero((cells >= BOX_FROM) & (circles.misfit > ROUND_MISFIT * cells))
    if len(doubtful):
        most = int(cells[doubtful].max())
        boxes = fit_boxes(points[doubtful, :most], weight[doubtful, :most], outward[doubtful, :most])
        per = np.log(np.maximum(cells[doubtful], 2))
        as_box[doubtful] = boxes.misfit + np.where(boxes.faces > 1, 5, 4) * per
        row = {int(i): k for k, i in enumerate(doubtful)}
    for i, track in enumerate(tracks):
        loyalty = LOYALTY * (track.shape == "cylinder" or -1) if track.fitted else 0.0
        if boxes is None or as_circle[i] <= as_box[i] + loyalty:
            track.shape, track.cost = "cylinder", float(as_circle[i])
            track.center_w, track.radius_m = circles.center_w[i], float(circles.radius_m[i])
            spread = circles.covariance[i]
            track.position_sd_m = math.sqrt(float(np.linalg.eigvalsh(spread[:2, :2])[-1]))
            track.size_sd_m = math.sqrt(float(spread[2, 2]))
        else:
            k = row[i]
            track.shape, track.cost = "box", float(as_box[i])
            track.center_w, track.half_m, track.yaw_rad = boxes.center_w[k], boxes.half_m[k], float(boxes.yaw_rad[k])
            track.position_sd_m = float(boxes.center_sd_m[k].max())
            track.size_sd_m = float(boxes.half_sd_m[k].max())


def outlines_of(tracks: Sequence[Track]) -> Outlines:
    """The shapes of tracks, for distances to all of them."""
    boxy = np.array([t.shape == "box" for t in tracks], dtype=bool)
    yaw = np.array([t.yaw_rad for t in tracks], dtype=np.float64)
    half = np.array([t.half_m for t in tracks], dtype=np.float64).reshape(-1, 2)
    return Outlines(
        center_w=np.array([t.center_w for t in tracks], dtype=np.float64).reshape(-1, 2),
        turn=np.column_stack([np.cos(yaw), np.sin(yaw)]),
        half_m=np.where(boxy[:, None], half, 0.0),
        rounding_m=np.where(boxy, 0.0, [t.radius_m for t in tracks]),
    )


def position_sd_m(tracks: Sequence[Track]) -> Floats:
    """Of each, (n,)."""
    return np.array([t.position_sd_m for t in tracks], dtype=np.float64)
