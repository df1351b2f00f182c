"""Estimates stiffness, damping, response time and latency of a joint's position servo, and its bandwidth. Pure.

The torque that the drive answers its targets with is fitted to the measured torque, by `least_squares`:

    response_time * d(torque)/dt + torque = stiffness * (target(t - latency) - angle) - damping * velocity + offset

It is not known how long a drive holds what it measures. Up to `DRIVE_LOOP_S` of that is in the intervals.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.system_identification.least_squares import (
    IntervalEstimate,
    LeastSquaresFit,
    solve_with_instruments,
)
from snakesim_operator.features.commissioning.system_identification.smoothing import filter_columns
from snakesim_operator.features.commissioning.system_identification.torque_balance import (
    JointRecord,
    number_jackknife_blocks,
)

SPECTRUM_SEGMENT_S = 4.0  # length of the pieces whose spectra are averaged
MIN_EXCITATION = 1e-4  # of the strongest power; with less power, a frequency is not evaluated
DRIVE_LOOP_S = 0.001  # period of a drive's own control loop
STEPS_PER_TICK = 10  # of the servo model
# Time scale beyond which angles come from the encoder, below it from the velocities.
ENCODER_SMOOTHING_S = 0.2
Gains = NDArray[np.floating[Any]]  # stiffness, damping, offset


@dataclass(frozen=True)
class ServoResponse:
    """The fitted response of a position servo, in torque as it is measured."""

    stiffness_nm_per_rad: IntervalEstimate
    damping_nm_s_per_rad: IntervalEstimate
    response_time_s: IntervalEstimate
    latency_s: IntervalEstimate
    explained: float  # fraction of the variance of the torque
    torque_nm: Floats  # (ticks,), by this servo
    between_nm: Floats  # (ticks,), mean torque around each sample minus the sample: a target's step bends it in a tick


def fit_servo(record: JointRecord) -> ServoResponse:
    """Fit stiffness, damping, response time and latency of a position servo; the equation is in the module's docstring.

    The torque is linear in the gains once latency and response time are chosen. So these two are searched first, then
    all four are refined by one Gauss-Newton step, which also gives their covariance.

    Raises:
        ValueError: The joint moved too little.
    """
    model = _ServoModel(record)
    latency_s, response_time_s = model.search_delays()
    regressors = model.compute_regressors(latency_s, response_time_s)
    gains = np.linalg.lstsq(regressors, model.torque_nm, rcond=None)[0]
    latency_derivative, response_time_derivative = model.compute_delay_derivatives(
        latency_s, response_time_s, gains
    )
    jacobian = np.column_stack((regressors, latency_derivative, response_time_derivative))
    residuals = model.torque_nm - regressors @ gains
    step = solve_with_instruments(jacobian, residuals, jacobian, model.blocks)
    fit = replace(step, values=np.concatenate((gains, (latency_s, response_time_s))) + step.values)
    return _make_servo_response(model, fit)


def _make_servo_response(model: "_ServoModel", fit: LeastSquaresFit) -> ServoResponse:
    """Return the fitted servo, and the torque that it would have had in this motion."""
    stiffness, damping, offset, latency, response_time = fit.estimates
    fine_inputs = model.compute_lagged_inputs(
        max(latency.value, 0.0), max(response_time.value, 0.0)
    )
    fine_torque_nm = fine_inputs @ fit.values[:2]
    return ServoResponse(
        stiffness_nm_per_rad=stiffness,
        damping_nm_s_per_rad=damping.widen_by(stiffness.value * DRIVE_LOOP_S / 2),
        response_time_s=response_time,
        latency_s=latency.widen_by(DRIVE_LOOP_S / 2),
        explained=1 - float(np.var(fit.residuals) / np.var(model.torque_nm)),
        torque_nm=_sample_at_ticks(fine_torque_nm) + offset.value,
        between_nm=_mean_around_samples(fine_torque_nm),
    )


class _ServoModel:
    """The torque of a position servo as a linear function of its gains, for any latency and response time."""

    FIRST_TICK = 2  # before it, the model has no past

    def __init__(self, record: JointRecord) -> None:
        used = record.is_below_torque_limit()[self.FIRST_TICK :]
        self._record = record
        self._angle_rad = _fuse_angles(record)
        self._is_used = used
        self.torque_nm = record.torque_nm[self.FIRST_TICK :][used]  # (rows,)
        self.blocks = number_jackknife_blocks(used, record.period_s)  # (rows,)

    def compute_regressors(self, latency_s: float, response_time_s: float) -> Floats:
        """Return what stiffness, damping and offset are multiplied with, (rows, 3)."""
        sampled = _sample_at_ticks(self.compute_lagged_inputs(latency_s, response_time_s))
        return np.column_stack(
            (sampled[self.FIRST_TICK :][self._is_used], np.ones(len(self.torque_nm)))
        )

    def compute_lagged_inputs(self, latency_s: float, response_time_s: float) -> Floats:
        """Compute the inputs of the servo, target minus angle and minus velocity, behind delay and first-order lag.

        A target begins at its tick, and holds until the next. Only the target is delayed. Each row is at the end of its
        step.

        Args:
            latency_s: Delay from a target to its effect.
            response_time_s: Time constant of the lag.

        Returns:
            (ticks * STEPS_PER_TICK, 2), in rad and rad/s.
        """
        record = self._record
        tick_count = len(self._angle_rad)
        step_s = record.period_s / STEPS_PER_TICK
        step_times_s = np.arange(tick_count * STEPS_PER_TICK) * step_s
        tick_times_s = np.arange(tick_count) * record.period_s
        angle_rad = np.interp(step_times_s, tick_times_s, self._angle_rad)
        velocity_rad_s = np.interp(step_times_s, tick_times_s, record.velocity_rad_s)
        whole_steps, fraction_of_step = divmod(latency_s / step_s, 1.0)
        held_target_rad = np.repeat(record.target_rad, STEPS_PER_TICK)
        delayed_indices = np.clip(np.arange(len(step_times_s)) - int(whole_steps), 0, None)
        earlier_indices = np.clip(delayed_indices - 1, 0, None)
        target_rad = (1 - fraction_of_step) * held_target_rad[
            delayed_indices
        ] + fraction_of_step * held_target_rad[earlier_indices]
        inputs = np.column_stack((target_rad - angle_rad, -velocity_rad_s))
        # A first-order lag is the convolution with an exponential, which is cut off after 12 time constants.
        decay = np.exp(-step_s / max(response_time_s, 1e-6))
        kernel_step_count = min(int(np.ceil(12 * response_time_s / step_s)) + 1, len(step_times_s))
        kernel = (1 - decay) * decay ** np.arange(kernel_step_count)
        return np.column_stack(
            [np.convolve(column, kernel)[: len(step_times_s)] for column in inputs.T]
        )

    def compute_squared_error(self, latency_s: float, response_time_s: float) -> float:
        """Return the sum of squared residuals with the best gains."""
        regressors = self.compute_regressors(latency_s, response_time_s)
        gains = np.linalg.lstsq(regressors, self.torque_nm, rcond=None)[0]
        return float(np.sum((self.torque_nm - regressors @ gains) ** 2))

    def search_delays(self) -> tuple[float, float]:
        """Find latency and response time with the smallest squared error, by a coarse grid and a pattern search.

        The pattern search moves to the best of eight neighbors, and halves its step where no neighbor is better.

        Returns:
            Latency and response time in s.
        """
        period_s = self._record.period_s
        grid = [
            (latency_ticks * period_s, response_ticks * period_s)
            for latency_ticks in (0, 1, 2, 3)
            for response_ticks in (0.3, 1, 3)
        ]
        best_delays = min(grid, key=lambda neighbor: self.compute_squared_error(*neighbor))
        min_error = self.compute_squared_error(*best_delays)
        step_s = period_s / 2
        while step_s > period_s / 200:
            neighbor_error, neighbor = min(
                (self.compute_squared_error(*pair), pair)
                for pair in self._list_neighbors(best_delays, step_s)
            )
            if neighbor_error < min_error:
                min_error = neighbor_error
                best_delays = neighbor
            else:
                step_s /= 2
        return best_delays

    def _list_neighbors(
        self, delays: tuple[float, float], step_s: float
    ) -> list[tuple[float, float]]:
        """Return the eight pairs of delays that are one step away, without those that are too short."""
        latency_s, response_time_s = delays
        pairs: list[tuple[float, float]] = []
        for i in (-1, 0, 1):
            for j in (-1, 0, 1):
                pair = (latency_s + i * step_s, response_time_s + j * step_s)
                is_long_enough = pair[0] >= 0 and pair[1] >= self._record.period_s / 100
                if (i or j) and is_long_enough:
                    pairs.append(pair)
        return pairs

    def compute_delay_derivatives(
        self, latency_s: float, response_time_s: float, gains: Gains
    ) -> tuple[Floats, Floats]:
        """Return the derivatives of the torque with respect to latency and response time, (rows,) each, in N·m/s."""
        step_s = self._record.period_s / STEPS_PER_TICK
        shorter_s = max(latency_s - step_s, 0.0)
        later = self.compute_regressors(latency_s + step_s, response_time_s)
        earlier = self.compute_regressors(shorter_s, response_time_s)
        by_latency = (later - earlier) @ gains
        by_latency /= latency_s + step_s - shorter_s
        fast_s = 0.8 * response_time_s
        slow_s = 1.2 * response_time_s
        slower = self.compute_regressors(latency_s, slow_s)
        faster = self.compute_regressors(latency_s, fast_s)
        by_response_time = (slower - faster) @ gains / (slow_s - fast_s)
        return by_latency, by_response_time


def estimate_bandwidth_hz(record: JointRecord) -> float | None:
    """Estimate the bandwidth of a joint's servo: the lowest frequency with a gain below -3 dB from target to angle.

    The gain is the averaged cross spectrum of angle and target divided by the averaged power of the target (Welch).

    Args:
        record: Motion of the joint.

    Returns:
        The bandwidth in Hz; None if the gain is above -3 dB at all frequencies at which the joint was excited.
    """
    segment_length = min(len(record.angle_rad), round(SPECTRUM_SEGMENT_S / record.period_s))
    starts = range(0, len(record.angle_rad) - segment_length + 1, max(segment_length // 2, 1))
    cross_spectrum = np.zeros(segment_length // 2 + 1, dtype=np.complex128)
    target_power = np.zeros(segment_length // 2 + 1)
    for start in starts:
        target_spectrum = _compute_spectrum(record.target_rad[start : start + segment_length])
        angle_spectrum = _compute_spectrum(record.angle_rad[start : start + segment_length])
        cross_spectrum += angle_spectrum * target_spectrum.conj()
        target_power += np.abs(target_spectrum) ** 2
    frequencies_hz = np.fft.rfftfreq(segment_length, record.period_s)
    is_excited = (target_power > MIN_EXCITATION * target_power.max()) & (frequencies_hz > 0)
    is_below_3_db = is_excited & (np.abs(cross_spectrum) < np.sqrt(0.5) * target_power)
    if not is_below_3_db.any():
        return None
    return float(frequencies_hz[is_below_3_db][0])


def _compute_spectrum(segment: Floats) -> NDArray[np.complex128]:
    return np.fft.rfft(np.hanning(len(segment)) * (segment - segment.mean()))


def _fuse_angles(record: JointRecord) -> Floats:
    """Return angles from the velocities within `ENCODER_SMOOTHING_S`, and from the encoder beyond, (ticks,).

    The encoder's noise alone would look like a lag of the servo.
    """
    steps_rad = (record.velocity_rad_s[1:] + record.velocity_rad_s[:-1]) * record.period_s / 2
    integral_rad = np.concatenate(([0.0], np.cumsum(steps_rad)))
    half_window = max(round(ENCODER_SMOOTHING_S / record.period_s), 1)
    window = np.hanning(2 * half_window + 1)
    drift_rad: Floats = np.pad(
        record.angle_rad - integral_rad, half_window, mode="reflect", reflect_type="odd"
    )
    return integral_rad + filter_columns(drift_rad, window / window.sum())


def _sample_at_ticks(fine: Floats) -> Floats:
    """Return the value just before each tick's sample, from one value for each step of the servo model."""
    at_end_of_tick = fine[STEPS_PER_TICK - 1 :: STEPS_PER_TICK]
    before_first_tick = np.zeros((1, *fine.shape[1:]))
    return np.concatenate((before_first_tick, at_end_of_tick[:-1]))


def _mean_around_samples(fine: Floats) -> Floats:
    """Return the mean over one tick around each sample, minus the sample, (ticks,)."""
    trapezoid = np.ones(STEPS_PER_TICK + 1)
    trapezoid[0] = 0.5
    trapezoid[-1] = 0.5
    return _sample_at_ticks(np.convolve(fine, trapezoid / STEPS_PER_TICK, "same") - fine)
