"""Confidence intervals: of means over runs, by Student's t, and of success rates, by Wilson."""

import math
from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats

Z95 = 1.959964  # two-sided 95 % quantile of the normal distribution
# Of Student's t, for 1 to 8 degrees of freedom.
STUDENT_T_QUANTILES_95 = 12.706, 4.303, 3.182, 2.776, 2.571, 2.447, 2.365, 2.306


def compute_mean_interval(values: Sequence[float]) -> tuple[float, float]:
    """Return the 95 % confidence interval of the mean of two or more values: mean -+ t s / sqrt(n), by Student's t."""
    mean, half_width = find_mean_and_half_width(np.asarray(values, dtype=float))
    return float(mean - half_width), float(mean + half_width)


def find_mean_and_half_width(values: Floats) -> tuple[Floats, Floats]:
    """Return the mean over runs, and half the width of its 95 % confidence interval.

        half width = t s / sqrt(n)

    t is the two-sided 95 % quantile of Student's t for n - 1 degrees of freedom, and s the standard deviation of the
    sample. The runs count as independent, and their values as normally distributed.

    Args:
        values: (n, ...) a value of each of n runs, two or more. NaN makes the result NaN.
    """
    count = len(values)
    standard_error = np.std(values, axis=0, ddof=1) / math.sqrt(count)
    return np.mean(values, axis=0), find_student_t_quantile_95(count - 1) * standard_error


def find_student_t_quantile_95(degrees_of_freedom: int) -> float:
    """Return the two-sided 95 % quantile of Student's t: from a table, or by its expansion in 1 / n.

        t = z + (z^3 + z) / (4 n) + (5 z^5 + 16 z^3 + 3 z) / (96 n^2)

    Source: Abramowitz and Stegun, table 26.10 and equation 26.7.5.
    """
    n = degrees_of_freedom
    if n <= len(STUDENT_T_QUANTILES_95):
        return STUDENT_T_QUANTILES_95[n - 1]
    z = Z95
    first = (z**3 + z) / 4
    second = (5 * z**5 + 16 * z**3 + 3 * z) / 96
    return z + first / n + second / n**2


def compute_wilson_interval(success_count: int, trial_count: int) -> tuple[float, float]:
    """Return the 95 % confidence interval of a success rate.

    With p = successes / n, n trials and z = 1.96:

        (p + z^2 / (2 n) -+ z sqrt(p (1 - p) / n + z^2 / (4 n^2))) / (1 + z^2 / n)

    Source: Wilson (1927), "Probable inference, the law of succession, and statistical inference".
    """
    if trial_count == 0:
        return 0.0, 1.0
    p = success_count / trial_count
    z2_by_n = Z95**2 / trial_count
    center = (p + z2_by_n / 2) / (1 + z2_by_n)
    half_width = (
        Z95 * math.sqrt(p * (1 - p) / trial_count + z2_by_n / (4 * trial_count)) / (1 + z2_by_n)
    )
    return max(center - half_width, 0.0), min(center + half_width, 1.0)
