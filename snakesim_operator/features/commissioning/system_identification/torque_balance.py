"""Estimates friction, rotor inertia and torque constant of one joint from a record of its motion. Pure.

The torque that the motion needs is fitted to the measured torque, by `least_squares`:

    scale * torque = load + armature * acceleration + viscous * velocity + dry * sign(velocity) + offset

`load` is what the links need (`suspended_load`), computed with the masses of the robot file; `scale` is the real torque
divided by the measured torque. A latency of the measured torque is fitted along.

A motion that is not that of the model, as behind a gear with backlash, is wrong in all blocks of the record alike. So
what the balance does not explain widens its intervals (`ABSORBED_MISFIT`). Noise of the measured velocities, such as
the steps of a coarse register, also leaves torque unexplained, and is no such motion. It is measured, and subtracted.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.system_identification.least_squares import (
    IntervalEstimate,
    compute_independent_rms,
    solve_with_instruments,
)
from snakesim_operator.features.commissioning.system_identification.smoothing import (
    HALF_WINDOW_TICKS,
    compute_motion_direction,
    is_slow,
    smooth,
    smooth_derivative,
    smooth_second_derivative,
)

SLOW_RAD_S = 0.2  # below this velocity, dry friction is not what it is in motion
MAX_SLOW_FRACTION = 0.1  # of a smoothing window; windows with more are left out
JACKKNIFE_BLOCK_S = 1.0  # length of the jackknife's blocks
MAX_TORQUE_FRACTION = 0.95  # of the torque limit; above, the motor does not do what its servo wants
MODEL_MISFIT = 0.04  # rms fraction of the torque that the balance does not explain of intact joints
# What the balance leaves unexplained beyond that may also have been absorbed by the values: as much of it, times this.
# On drives with 10 to 45 mrad of backlash somewhere in the body, 1.5 covers the truth of all values.
ABSORBED_MISFIT = 2.0
LATENCY_COLUMN = 4  # of the regressors and instruments
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class JointRecord:
    """The record of one joint, every `period_s`; each signal is (ticks,)."""

    period_s: float
    angle_rad: Floats
    velocity_rad_s: Floats
    torque_nm: Floats  # as measured
    target_rad: Floats
    torque_limit_nm: float

    def is_below_torque_limit(self) -> Mask:
        """Return the ticks in which the motor can do what its servo wants, (ticks,)."""
        return np.abs(self.torque_nm) < MAX_TORQUE_FRACTION * self.torque_limit_nm


@dataclass(frozen=True)
class TorqueBalance:
    """The fitted torque balance."""

    dry_nm: IntervalEstimate
    viscous_nm_s_per_rad: IntervalEstimate
    armature_kg_m2: IntervalEstimate
    torque_scale: IntervalEstimate  # real torque divided by measured torque
    explained: float  # fraction of the variance of the torque
    misfit: float  # rms fraction of the torque that neither the model nor its usual shortcomings explain; 0: none
    torque_nm: Floats  # (ticks - 2 HALF_WINDOW_TICKS, 2): smoothed, and by the balance; NaN where it was not judged


def fit_torque_balance(
    record: JointRecord,
    between_nm: Floats,
    load_nm: Floats,
    load_by_angle_nm: Floats,
    *,
    fit_scale: bool,
) -> TorqueBalance:
    """Fit friction, rotor inertia and torque scale of a joint; the equation is in the module's docstring.

    Args:
        record: Motion and torque of the joint.
        between_nm: `ServoResponse.between_nm`, mean torque around each sample minus the sample, (ticks,).
        load_nm: Torque that the links need, from smoothed angles and velocities, (ticks - 2 HALF_WINDOW_TICKS,).
        load_by_angle_nm: The same torque with the velocities derived from the angles; it is an instrument.
        fit_scale: Whether to fit the torque scale; otherwise the scale is 1.

    Raises:
        ValueError: The joint moved too little.
    """
    period_s = record.period_s
    torque_nm = smooth(record.torque_nm + between_nm)
    regressors, instruments = _make_regression_columns(record, load_nm, load_by_angle_nm)
    is_slow_tick = is_slow(record.velocity_rad_s, SLOW_RAD_S, MAX_SLOW_FRACTION)
    is_used = ~is_slow_tick & record.is_below_torque_limit()[HALF_WINDOW_TICKS:-HALF_WINDOW_TICKS]
    fitted_torque_nm = torque_nm[is_used]
    noise_columns = regressors[is_used] - instruments[is_used]
    # The instrument of the latency is another signal, not the same one with other noise.
    noise_columns[:, LATENCY_COLUMN] = 0.0
    # The load is the last column; with a known scale it is subtracted from the torque.
    if not fit_scale:
        regressors = regressors[:, :-1]
        instruments = instruments[:, :-1]
        fitted_torque_nm = fitted_torque_nm - load_nm[is_used]
    fit = solve_with_instruments(
        regressors[is_used],
        fitted_torque_nm,
        instruments[is_used],
        number_jackknife_blocks(is_used, period_s),
    )
    explained = 1 - float(np.var(fit.residuals) / np.var(torque_nm[is_used]))
    coefficients = fit.values if fit_scale else np.append(fit.values, 1.0)
    noise_variance = _estimate_noise_variance(fit.residuals, noise_columns @ coefficients)
    noise_fraction = noise_variance / float(np.var(torque_nm[is_used]))
    misfit = max(1 - explained - noise_fraction - MODEL_MISFIT**2, 0.0) ** 0.5
    fit = fit.with_bias(
        ABSORBED_MISFIT
        * misfit
        * float(np.std(torque_nm[is_used]))
        / compute_independent_rms(regressors[is_used])
    )
    scale = IntervalEstimate(1.0, 0.0)
    if fit_scale:
        load_coefficient = fit.values[-1]  # measured torque divided by real torque
        scale = IntervalEstimate(
            float(1 / load_coefficient), float(fit.half_widths[-1] / load_coefficient**2)
        )
        fit = fit.divide_by_value(len(fit.values) - 1)
    dry_nm, viscous_nm_s_per_rad, armature_kg_m2, *_ = fit.estimates
    measured_and_fitted = np.column_stack((torque_nm, np.full(len(torque_nm), np.nan)))
    measured_and_fitted[is_used, 1] = torque_nm[is_used] - fit.residuals
    return TorqueBalance(
        dry_nm, viscous_nm_s_per_rad, armature_kg_m2, scale, explained, misfit, measured_and_fitted
    )


def _estimate_noise_variance(residuals: Floats, noise_difference: Floats) -> float:
    """Return the part of the residuals' variance that is due to noise of the regressors, N²·m².

    With the true torque of the model m, and with independent noises u of the regressors and v of the instruments, the
    residual is r = e - u, where e is what the model does not explain. The difference is d = u - v, so that

        E[r d] = -E[u^2]

    because e, which comes from the motion, is independent of both noises.

    Args:
        residuals: Residual torque, (n,).
        noise_difference: Torque by the regressors minus torque by the instruments, with the fitted values, (n,).
    """
    return max(-float(np.mean(residuals * noise_difference)), 0.0)


def _make_regression_columns(
    record: JointRecord, load_nm: Floats, load_by_angle_nm: Floats
) -> tuple[Floats, Floats]:
    """Return regressors and instruments of the torque balance of a joint.

    Columns: dry friction, viscous friction, rotor inertia, offset, latency of the torque, load. The instruments of
    velocity and acceleration come from the angles, whose noise is independent of that of the velocities.

    Args:
        record: Motion and torque of the joint, one row for each tick.
        load_nm: (ticks - 2 HALF_WINDOW_TICKS,) torque that the links need, from smoothed angles and velocities.
        load_by_angle_nm: The same, with the velocities derived from the angles.

    Returns:
        Regressors and instruments, (ticks - 2 HALF_WINDOW_TICKS, 6) each.
    """
    period_s = record.period_s
    direction = smooth(compute_motion_direction(record.velocity_rad_s))
    constant = np.ones(len(direction))
    regressors = np.column_stack(
        (
            direction,
            smooth(record.velocity_rad_s),
            smooth_derivative(record.velocity_rad_s, period_s),
            constant,
            smooth_derivative(record.torque_nm, period_s),
            load_nm,
        )
    )
    instruments = np.column_stack(
        (
            direction,
            smooth_derivative(record.angle_rad, period_s),
            smooth_second_derivative(record.angle_rad, period_s),
            constant,
            smooth_derivative(record.target_rad - record.angle_rad, period_s),
            load_by_angle_nm,
        )
    )
    return regressors, instruments


def number_jackknife_blocks(used: Mask, period_s: float) -> NDArray[np.int64]:
    """Return the number of the jackknife's block of each used tick."""
    numbers = (np.arange(len(used)) * period_s / JACKKNIFE_BLOCK_S).astype(np.int64)
    return numbers[used]
