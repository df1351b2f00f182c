"""Non-negative least squares with few columns. Pure.

Columns are added one after another (Lawson and Hanson's active set), until the noise explains the rest.
"""

import numpy as np

from snakesim_hal.base.arrays import Floats

MIN_GRADIENT_SD = 1.0  # standard deviations by which a column may show to be added
MIN_SIGNIFICANCE_SD = 3.0  # standard deviations by which a column must show to stay
MAX_STEPS = 30
TINY = 1e-12  # avoids divisions by zero
ZERO_AMOUNT = 1e-9


def fit_fewest_columns(columns: Floats, right_side: Floats) -> tuple[Floats, Floats]:
    """Return amounts x >= 0 of few columns with A x = b up to noise of standard deviation 1, and their covariance.

    Forward selection by gradient; the first column is always active. At the end, columns that other columns can replace
    are dropped again.

    Args:
        columns: (m, k) matrix A.
        right_side: (m,) right-hand side b.

    Returns:
        Amounts (k,), and their covariance (k, k), both zero for columns that are not active.
    """
    amounts = np.zeros(columns.shape[1])
    active = _add_columns_until_explained(columns, right_side, amounts)
    active, active_covariance = _drop_insignificant_columns(columns, right_side, amounts, active)
    covariance = np.zeros((len(amounts), len(amounts)))
    covariance[np.ix_(active, active)] = active_covariance
    return amounts, covariance


def _add_columns_until_explained(columns: Floats, right_side: Floats, amounts: Floats) -> list[int]:
    """Add the column with the largest gradient, again and again, until all gradients are within the noise.

    Args:
        columns: (m, k) matrix A.
        right_side: (m,) right-hand side b.
        amounts: (k,) amounts x, which are changed to the solution.

    Returns:
        Indices of the active columns.
    """
    active = [0]
    lengths = np.linalg.norm(columns, axis=0) + TINY
    for _ in range(MAX_STEPS):
        active = _solve_nonnegative(columns, right_side, amounts, active)
        residual = right_side - columns @ amounts
        gradient = columns.T @ residual / lengths
        gradient[active] = 0.0
        best = int(np.argmax(gradient))
        if gradient[best] < MIN_GRADIENT_SD:
            break
        active.append(best)
    return active


def _drop_insignificant_columns(
    columns: Floats, right_side: Floats, amounts: Floats, active: list[int]
) -> tuple[list[int], Floats]:
    """Drop the least significant column, again and again, until all remaining columns are significant.

    Args:
        columns: (m, k) matrix A.
        right_side: (m,) right-hand side b.
        amounts: (k,) amounts x, which are changed to the solution with the remaining columns.
        active: Indices of the active columns; columns are removed from the list. Column 0 is never removed.

    Returns:
        The indices of the remaining columns, and the covariance of their amounts.
    """
    while True:
        active_columns = columns[:, active]
        covariance = np.asarray(np.linalg.pinv(active_columns.T @ active_columns), np.float64)
        significance = amounts[active] / np.sqrt(np.diag(covariance) + TINY)
        significance[[column == 0 for column in active]] = np.inf
        if not active or significance.min() >= MIN_SIGNIFICANCE_SD:
            return active, covariance
        active.pop(int(np.argmin(significance)))
        active = _solve_nonnegative(columns, right_side, amounts, active)


def _solve_nonnegative(
    columns: Floats, right_side: Floats, amounts: Floats, active: list[int]
) -> list[int]:
    """Solve least squares over the active columns, and drop the columns whose amounts would become negative.

    The amounts move from their current values towards the solution until the first amount is zero. That column is
    dropped, and the equations are solved again (inner loop of the active-set method of Lawson and Hanson).

    Args:
        columns: (m, k) matrix A.
        right_side: (m,) right-hand side b.
        amounts: (k,) current amounts, which are replaced by the solution.
        active: Indices of the columns that may have an amount above zero.

    Returns:
        Indices of the columns that stay active.
    """
    while active:
        solution = np.linalg.lstsq(columns[:, active], right_side, rcond=None)[0]
        current_amounts = amounts[active]
        is_negative = solution <= 0.0
        if not is_negative.any():
            amounts[:] = 0.0
            amounts[active] = solution
            return active
        steps_to_zero = current_amounts[is_negative] / (
            current_amounts[is_negative] - solution[is_negative] + TINY
        )
        step = float(np.min(steps_to_zero))
        stepped_amounts = current_amounts + step * (solution - current_amounts)
        is_dropped = is_negative & (stepped_amounts <= ZERO_AMOUNT)
        if not is_dropped.any():
            is_dropped = is_negative
        amounts[:] = 0.0
        active = [column for column, dropped in zip(active, is_dropped, strict=True) if not dropped]
        amounts[active] = np.maximum(stepped_amounts[~is_dropped], 0.0)
    amounts[:] = 0.0
    return active
