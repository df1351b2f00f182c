"""Statistics of a LeRobot dataset: of its features, and of each channel of its pictures."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.playback.pictures import Pictures

QUANTILES = (1, 10, 50, 90, 99)  # percent
CHANNELS = 3

Statistics = dict[str, Any]


def feature_statistics(values: NDArray[Any]) -> Statistics:
    """Returns minimum, maximum, mean, deviation and quantiles of a feature, (n,) or (n, width)."""
    columns = values.astype(np.float64).reshape(len(values), -1)
    statistics: Statistics = {name: getattr(columns, name)(axis=0).tolist() for name in ("min", "max", "mean", "std")}
    quantiles = np.percentile(columns, QUANTILES, axis=0)
    for percent, row in zip(QUANTILES, quantiles, strict=True):
        statistics[f"q{percent:02d}"] = row.tolist()
    statistics["count"] = [len(values)]
    return statistics


def picture_statistics(pictures: Pictures, shown: NDArray[np.int64]) -> Statistics:
    """Returns those of each channel, 0 to 1, over the shown pictures; quantiles are not made of pictures."""
    mean = np.array(pictures.channel_means)[shown].mean(axis=0)
    mean_of_squares = np.array(pictures.channel_squares)[shown].mean(axis=0)
    return _channel_statistics(pictures.channel_min, pictures.channel_max, mean, mean_of_squares, len(shown))


def join_picture_statistics(parts: Sequence[Statistics]) -> Statistics:
    """Returns those of all episodes together."""
    minima, maxima, means, deviations = (
        np.array([part[name] for part in parts]).reshape(-1, CHANNELS) for name in ("min", "max", "mean", "std")
    )
    counts = np.array([part["count"][0] for part in parts])
    mean = np.average(means, axis=0, weights=counts)
    mean_of_squares = np.average(np.square(deviations) + np.square(means), axis=0, weights=counts)
    return _channel_statistics(minima.min(axis=0), maxima.max(axis=0), mean, mean_of_squares, int(counts.sum()))


def _channel_statistics(
    minimum: Floats, maximum: Floats, mean: Floats, mean_of_squares: Floats, count: int
) -> Statistics:
    """All arrays are (3,)."""
    variance = np.maximum(mean_of_squares - np.square(mean), 0.0)
    numbers = {"min": minimum, "max": maximum, "mean": mean, "std": np.sqrt(variance)}
    statistics: Statistics = {name: value.reshape(CHANNELS, 1, 1).tolist() for name, value in numbers.items()}
    statistics["count"] = [count]
    return statistics
