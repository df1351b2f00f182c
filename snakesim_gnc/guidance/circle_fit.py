"""Circles through the visible parts of surfaces, with covariance; many obstacles at once. Pure.

Gauss-Newton on the distances of points from the circle, with a prior on the radius. The visible arc of a cylinder fixes
center and radius; a short arc leaves both uncertain along the line of sight, and the covariance says so.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats

RADIUS_M, RADIUS_SD_M = 0.05, 0.03  # prior: what stands around, before it was looked at
SMALLEST_M, LARGEST_M = 0.01, 0.5
STEPS = 5
OUTLIER_SD = 3.0
MODEL_SD_M = 0.0015  # of real surfaces from a circle or box, and of points that are means over a cell


@dataclass(frozen=True)
class Circles:
    """One a row."""

    center_w: Floats  # (b, 2)
    radius_m: Floats  # (b,)
    covariance: Floats  # (b, 3, 3) of x, y, radius
    misfit: Floats  # (b,) sum of squared, weighted, limited distances


def fit_circles(points: Floats, weight: Floats, outward: Floats, normal_weight: Floats, began_w: Floats) -> Circles:
    """points (b, p, 2), weight (b, p), outward (b, p, 2), normal_weight (b, p), as of `batched`.

    began_w: (b, 2) centers of earlier fits; NaN: none.
    """
    weight = softened(weight)
    share = weight / weight.sum(axis=1, keepdims=True)
    center = np.where(np.isnan(began_w), np.einsum("bp,bpk->bk", share, points - RADIUS_M * outward), began_w)
    radius = np.einsum(
        "bp,bp->b", share, np.hypot(points[..., 0] - center[:, None, 0], points[..., 1] - center[:, None, 1])
    )
    information = np.zeros((len(points), 3, 3))
    for _ in range(STEPS):
        offset = points - center[:, None]
        distance = np.maximum(np.hypot(offset[..., 0], offset[..., 1]), 1e-9)
        error = distance - radius[:, None]
        trusted = weight * np.minimum(1.0, OUTLIER_SD / np.maximum(np.abs(error) * np.sqrt(weight), 1e-9))
        rows = np.stack([-offset[..., 0] / distance, -offset[..., 1] / distance, -np.ones_like(distance)], axis=-1)
        information = np.einsum("bp,bpi,bpj->bij", trusted, rows, rows)
        gradient = np.einsum("bp,bpi->bi", trusted * error, rows)
        across = np.stack([outward[..., 1], -outward[..., 0], np.zeros_like(distance)], axis=-1)  # of a felt normal
        missed = np.einsum("bpk,bpk->bp", across[..., :2], -offset)
        information += np.einsum("bp,bpi,bpj->bij", normal_weight, across, across)
        gradient += np.einsum("bp,bpi->bi", normal_weight * missed, across)
        information[:, 2, 2] += RADIUS_SD_M**-2
        gradient[:, 2] += (radius - RADIUS_M) * RADIUS_SD_M**-2
        information[:, [0, 1], [0, 1]] += 1.0
        step = -np.linalg.solve(information, gradient[..., None])[..., 0]
        step *= np.minimum(1.0, 0.04 / np.maximum(np.abs(step).max(axis=1), 1e-9))[:, None]
        center = center + step[:, :2]
        radius = np.clip(radius + step[:, 2], SMALLEST_M, LARGEST_M)
    offset = points - center[:, None]
    error = np.hypot(offset[..., 0], offset[..., 1]) - radius[:, None]
    misfit = np.minimum(weight * error * error, OUTLIER_SD**2).sum(axis=1)
    surplus = np.maximum(misfit / np.maximum((weight > 0).sum(axis=1) - 3, 1), 1.0)
    return Circles(center, radius, np.linalg.inv(information) * surplus[:, None, None], misfit)


def softened(weight: Floats) -> Floats:
    """Weights (b, p) with the deviation of real surfaces from any model added; 0 stays 0."""
    return weight / (1.0 + weight * MODEL_SD_M**2)
