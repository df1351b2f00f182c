"""Computes the statistics of a LeRobot dataset: of its features, and of the color channels of its images."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.playback.pictures import CameraImages

QUANTILES_PERCENT = (1, 10, 50, 90, 99)
CHANNELS = 3  # red, green, blue

Statistics = dict[str, Any]  # as in `meta/stats.json`


def compute_feature_statistics(values: NDArray[Any]) -> Statistics:
    """Compute minimum, maximum, mean, standard deviation and quantiles of a feature.

    Args:
        values: (n,) or (n, width) values.

    Returns:
        For each statistic by name a list with an item for each column; and `count`, the number of values.
    """
    columns = values.astype(np.float64).reshape(len(values), -1)
    statistics: Statistics = {
        "min": columns.min(axis=0).tolist(),
        "max": columns.max(axis=0).tolist(),
        "mean": columns.mean(axis=0).tolist(),
        "std": columns.std(axis=0).tolist(),
    }
    quantiles = np.percentile(columns, QUANTILES_PERCENT, axis=0)
    for percent, row in zip(QUANTILES_PERCENT, quantiles, strict=True):
        statistics[f"q{percent:02d}"] = row.tolist()
    statistics["count"] = [len(values)]
    return statistics


def compute_image_statistics(images: CameraImages, image_indices: NDArray[np.int64]) -> Statistics:
    """Compute the statistics of each color channel, 0 to 1, without quantiles.

    Args:
        images: Images of one camera.
        image_indices: (n,) indices of the images that count.
    """
    mean = np.array(images.channel_means)[image_indices].mean(axis=0)
    mean_of_squares = np.array(images.channel_squares)[image_indices].mean(axis=0)
    return _format_channels(
        images.channel_min, images.channel_max, mean, mean_of_squares, len(image_indices)
    )


def merge_image_statistics(parts: Sequence[Statistics]) -> Statistics:
    """Merge the image statistics of several episodes, weighted by their numbers of images."""
    minima = _stack_channels(parts, "min")
    maxima = _stack_channels(parts, "max")
    means = _stack_channels(parts, "mean")
    deviations = _stack_channels(parts, "std")
    counts = np.array([part["count"][0] for part in parts])
    mean = np.average(means, axis=0, weights=counts)
    squares = np.square(deviations) + np.square(means)
    mean_of_squares = np.average(squares, axis=0, weights=counts)
    return _format_channels(
        minima.min(axis=0), maxima.max(axis=0), mean, mean_of_squares, int(counts.sum())
    )


def _stack_channels(parts: Sequence[Statistics], name: str) -> Floats:
    """Return one statistic of all parts as an array, (parts, 3)."""
    return np.array([part[name] for part in parts]).reshape(-1, CHANNELS)


def _format_channels(
    minimum: Floats, maximum: Floats, mean: Floats, mean_of_squares: Floats, count: int
) -> Statistics:
    """Format statistics as LeRobot expects them, (3, 1, 1) each, from arrays of shape (3,)."""
    variance = np.maximum(mean_of_squares - np.square(mean), 0.0)
    array_by_name = {"min": minimum, "max": maximum, "mean": mean, "std": np.sqrt(variance)}
    statistics: Statistics = {}
    for name, value in array_by_name.items():
        statistics[name] = value.reshape(CHANNELS, 1, 1).tolist()
    statistics["count"] = [count]
    return statistics
