"""Least squares with instruments, and 95 % intervals from a jackknife over blocks of the record. Pure.

Noise in a regressor shrinks its coefficient. So the normal equations are formed with instruments Z, which are other
measurements of the same motion with another noise, instead of with the regressors X:

    Z' X beta = Z' y                                                   Source: Durbin (1954)

Residuals of neighboring ticks are correlated, so their scatter is too small a measure. The covariance of beta comes
from how beta changes when one of the n blocks of the record after the other is left out:

    cov(beta) = (n - 1) / n * sum over blocks of (beta_without - beta) (beta_without - beta)'      Source: Tukey (1958)
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

Z95 = 1.959964  # two-sided 95 % quantile of the normal distribution
# The jackknife's intervals are widened by this factor. On emulated drives with hidden parameters, seeds 0 to 19, the
# intervals without it covered 67 to 96 % of the true values.
INTERVAL_FACTOR = 1.7
MAX_CONDITION = 1e8  # of the normalized normal equations; above, the regressors are not independent
MIN_BLOCKS_PER_VALUE = 2


@dataclass(frozen=True)
class IntervalEstimate:
    """An estimated value with its 95 % interval."""

    value: float
    half_width: float  # the interval is value - half_width to value + half_width

    def contains(self, truth: float) -> bool:
        """Return whether the interval contains a value."""
        return abs(truth - self.value) <= self.half_width

    def scale_by(self, factor: float) -> "IntervalEstimate":
        """Return this estimate multiplied by a known factor."""
        return IntervalEstimate(self.value * factor, self.half_width * abs(factor))

    def multiply_by(self, other: "IntervalEstimate") -> "IntervalEstimate":
        """Return the product with an independent estimate; its interval is right to first order."""
        half_width = (
            (self.half_width * other.value) ** 2 + (self.value * other.half_width) ** 2
        ) ** 0.5
        return IntervalEstimate(self.value * other.value, half_width)

    def widen_by(self, uncertainty: float) -> "IntervalEstimate":
        """Return this estimate with an independent uncertainty added to its interval."""
        return IntervalEstimate(self.value, float(np.hypot(self.half_width, uncertainty)))


@dataclass(frozen=True)
class LeastSquaresFit:
    """The solution of a least-squares problem with k values."""

    values: Floats  # (k,)
    covariance: Floats  # (k, k)
    degrees_of_freedom: int
    residuals: Floats  # (rows,)
    # (k,), by which each interval is wider to either side; None: no bias.
    bias: Floats | None = None

    @property
    def half_widths(self) -> Floats:
        """The half widths of the 95 % intervals, (k,)."""
        by_scatter: Floats = (
            INTERVAL_FACTOR
            * compute_student_t_95(self.degrees_of_freedom)
            * np.sqrt(np.diag(self.covariance))
        )
        if self.bias is None:
            return by_scatter
        return by_scatter + self.bias

    @property
    def estimates(self) -> Sequence[IntervalEstimate]:
        """Each value with its interval."""
        pairs = zip(self.values, self.half_widths, strict=True)
        return [IntervalEstimate(float(value), float(half_width)) for value, half_width in pairs]

    def with_bias(self, bias: Floats) -> "LeastSquaresFit":
        """Return the same fit with intervals that are wider by a bias, (k,), to either side."""
        return replace(self, bias=bias)

    def divide_by_value(self, index: int) -> "LeastSquaresFit":
        """Return the fit of all values divided by the value at an index, with the covariance to first order.

        The Jacobian of v_i / d with respect to v is (I - v e_d' / d) / d, where d is the value at `index`.
        """
        divisor = self.values[index]
        values = self.values / divisor
        jacobian = np.eye(len(values)) / divisor
        jacobian[:, index] -= values / divisor
        bias = None
        if self.bias is not None:
            bias = np.abs(jacobian) @ self.bias
        covariance = jacobian @ self.covariance @ jacobian.T
        return LeastSquaresFit(values, covariance, self.degrees_of_freedom, self.residuals, bias)


def solve_with_instruments(
    regressors: Floats, target: Floats, instruments: Floats, blocks: NDArray[np.int64]
) -> LeastSquaresFit:
    """Solve a least-squares problem with instruments: find b so that Z' (y - X b) = 0.

    The covariance of b is estimated by the jackknife: the problem is solved again without each block of the record.

    Args:
        regressors: X, (rows, k).
        target: Y, (rows,).
        instruments: Z, (rows, k); the regressors themselves for ordinary least squares.
        blocks: (rows,) number of the block of the record to which each row belongs.

    Returns:
        The values b with their covariance, and the residuals y - X b.

    Raises:
        ValueError: The rows are too few or do not determine the values.
    """
    block_ids = np.unique(blocks)
    block_count = len(block_ids)
    value_count = regressors.shape[1]
    if block_count < MIN_BLOCKS_PER_VALUE * value_count:
        raise ValueError(
            "too little motion is left to judge; let it run longer, with larger motion"
        )
    normal_matrix = instruments.T @ regressors
    if _compute_condition_number(normal_matrix, instruments, regressors) > MAX_CONDITION:
        raise ValueError("its motion does not tell the values apart; was it moved at all?")
    right_side = instruments.T @ target
    values: Floats = np.linalg.solve(normal_matrix, right_side).astype(np.float64)
    jackknife_changes: list[Floats] = []  # of the values, when one block is left out
    for block in block_ids:
        is_left_out = blocks == block
        reduced_matrix = normal_matrix - instruments[is_left_out].T @ regressors[is_left_out]
        reduced_right_side = right_side - instruments[is_left_out].T @ target[is_left_out]
        reduced_values = np.linalg.solve(reduced_matrix, reduced_right_side)
        jackknife_changes.append(reduced_values - values)
    scatter = np.array(jackknife_changes).T @ np.array(jackknife_changes)
    covariance: Floats = (scatter * ((block_count - 1) / block_count)).astype(np.float64)
    residuals = target - regressors @ values
    return LeastSquaresFit(values, covariance, block_count - value_count, residuals)


def _compute_condition_number(
    normal_matrix: Floats, instruments: Floats, regressors: Floats
) -> float:
    """Return the condition number of the normal equations with all columns scaled to length 1."""
    instrument_lengths = np.linalg.norm(instruments, axis=0) + 1e-300
    regressor_lengths = np.linalg.norm(regressors, axis=0) + 1e-300
    return float(np.linalg.cond(normal_matrix / np.outer(instrument_lengths, regressor_lengths)))


def compute_student_t_95(degrees_of_freedom: int) -> float:
    """Return the two-sided 95 % quantile of Student's t.

        t = z + (z^3 + z) / (4 n) + (5 z^5 + 16 z^3 + 3 z) / (96 n^2)

    Source: Fisher and Cornish (1960), the expansion in 1 / n.
    """
    z = Z95
    n = degrees_of_freedom
    return z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)


def compute_independent_rms(regressors: Floats) -> Floats:
    """Return the rms of the part of each column that is linearly independent of the other columns, (k,)."""
    independent_rms: list[float] = []
    for column in range(regressors.shape[1]):
        others = np.delete(regressors, column, axis=1)
        coefficients = np.linalg.lstsq(others, regressors[:, column], rcond=None)[0]
        remainder = regressors[:, column] - others @ coefficients
        independent_rms.append(float(np.sqrt(np.mean(remainder**2))))
    return np.maximum(np.array(independent_rms), 1e-12)
