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
from snakesim_operator.features.commissioning.least_squares import Estimate, Fit, solve
from snakesim_operator.features.commissioning.smoothing import filter_columns
from snakesim_operator.features.commissioning.torque_balance import JointRecord, block_numbers

SPECTRUM_S = 4.0  # length of the pieces whose spectra are averaged
MIN_EXCITATION = 1e-4  # of the strongest power; with less power, a frequency is not evaluated
DRIVE_LOOP_S = 0.001  # period of a drive's own control loop
STEPS_PER_TICK = 10  # of the servo model
ENCODER_SMOOTHING_S = 0.2  # time scale beyond which angles come from the encoder, below it from the velocities
Gains = NDArray[np.floating[Any]]  # stiffness, damping, offset


@dataclass(frozen=True)
class ServoResponse:
    """The fitted response of a position servo, in torque as it is measured."""

    stiffness_nm_per_rad: Estimate
    damping_nm_s_per_rad: Estimate
    response_time_s: Estimate
    latency_s: Estimate
    explained: float  # fraction of the variance of the torque
    torque_nm: Floats  # (ticks,), by this servo
    between_nm: Floats  # (ticks,), mean torque around each sample minus the sample: a target's step bends it in a tick


def fit_servo(record: JointRecord) -> ServoResponse:
    """Fit stiffness, damping, response time and latency of a position servo; the equation is in the module's docstring.

    The torque is linear in the gains once latency and response time are chosen. So these two are searched first, then
    all four are refined by one Gauss-Newton step, which also gives their covariance.

    Raises:
        ValueError: the joint moved too little.
    """
    model = _ServoModel(record)
    latency_s, response_time_s = model.search_delays()
    regressors = model.regressors(latency_s, response_time_s)
    gains = np.linalg.lstsq(regressors, model.torque_nm, rcond=None)[0]
    by_latency, by_response_time = model.delay_derivatives(latency_s, response_time_s, gains)
    jacobian = np.column_stack((regressors, by_latency, by_response_time))
    residuals = model.torque_nm - regressors @ gains
    step = solve(jacobian, residuals, jacobian, model.blocks)
    fit = replace(step, values=np.concatenate((gains, (latency_s, response_time_s))) + step.values)
    return _servo_response(model, fit)


def _servo_response(model: "_ServoModel", fit: Fit) -> ServoResponse:
    """Return the fitted servo, and the torque that it would have had in this motion."""
    stiffness, damping, offset, latency, response_time = fit.estimates
    fine_inputs = model.lagged_inputs(max(latency.value, 0.0), max(response_time.value, 0.0))
    fine_torque_nm = fine_inputs @ fit.values[:2]
    return ServoResponse(
        stiffness_nm_per_rad=stiffness,
        damping_nm_s_per_rad=damping.widened(stiffness.value * DRIVE_LOOP_S / 2),
        response_time_s=response_time,
        latency_s=latency.widened(DRIVE_LOOP_S / 2),
        explained=1 - float(np.var(fit.residuals) / np.var(model.torque_nm)),
        torque_nm=_sample_ticks(fine_torque_nm) + offset.value,
        between_nm=_mean_around_samples(fine_torque_nm),
    )


class _ServoModel:
    """The torque of a position servo as a linear function of its gains, for any latency and response time."""

    FIRST_TICK = 2  # before it, the model has no past

    def __init__(self, record: JointRecord) -> None:
        used = record.is_below_torque_limit()[self.FIRST_TICK :]
        self._record = record
        self._angle_rad = _fuse_angles(record)
        self._used = used
        self.torque_nm = record.torque_nm[self.FIRST_TICK :][used]  # (rows,)
        self.blocks = block_numbers(used, record.period_s)  # (rows,)

    def regressors(self, latency_s: float, response_time_s: float) -> Floats:
        """Return what stiffness, damping and offset are multiplied with, (rows, 3)."""
        sampled = _sample_ticks(self.lagged_inputs(latency_s, response_time_s))
        return np.column_stack((sampled[self.FIRST_TICK :][self._used], np.ones(len(self.torque_nm))))

    def lagged_inputs(self, latency_s: float, response_time_s: float) -> Floats:
        """Return target minus angle, and minus velocity, both delayed and behind a first-order lag.

        A target begins at its tick, and holds until the next. Each row is at the end of its step.

        Args:
            latency_s: Delay from a target to its effect.
            response_time_s: Time constant of the lag.

        Returns:
            (ticks * STEPS_PER_TICK, 2).
        """
        record = self._record
        ticks = len(self._angle_rad)
        step_s = record.period_s / STEPS_PER_TICK
        step_times_s = np.arange(ticks * STEPS_PER_TICK) * step_s
        tick_times_s = np.arange(ticks) * record.period_s
        angle = np.interp(step_times_s, tick_times_s, self._angle_rad)
        velocity = np.interp(step_times_s, tick_times_s, record.velocity_rad_s)
        whole_steps, part_of_step = divmod(latency_s / step_s, 1.0)
        held_target = np.repeat(record.target_rad, STEPS_PER_TICK)
        delayed = np.clip(np.arange(len(step_times_s)) - int(whole_steps), 0, None)
        one_step_earlier = np.clip(delayed - 1, 0, None)
        target = (1 - part_of_step) * held_target[delayed] + part_of_step * held_target[one_step_earlier]
        inputs = np.column_stack((target - angle, -velocity))
        decay = np.exp(-step_s / max(response_time_s, 1e-6))
        kernel_steps = min(int(np.ceil(12 * response_time_s / step_s)) + 1, len(step_times_s))
        kernel = (1 - decay) * decay ** np.arange(kernel_steps)
        return np.column_stack([np.convolve(column, kernel)[: len(step_times_s)] for column in inputs.T])

    def squared_error(self, latency_s: float, response_time_s: float) -> float:
        """Return the sum of squared residuals with the best gains."""
        regressors = self.regressors(latency_s, response_time_s)
        gains = np.linalg.lstsq(regressors, self.torque_nm, rcond=None)[0]
        return float(np.sum((self.torque_nm - regressors @ gains) ** 2))

    def search_delays(self) -> tuple[float, float]:
        """Return latency and response time with the smallest squared error: a coarse grid, then pattern search."""
        period_s = self._record.period_s
        grid = [
            (latency_ticks * period_s, response_ticks * period_s)
            for latency_ticks in (0, 1, 2, 3)
            for response_ticks in (0.3, 1, 3)
        ]
        best = min(grid, key=lambda delays: self.squared_error(*delays))
        smallest_error = self.squared_error(*best)
        step_s = period_s / 2
        while step_s > period_s / 200:
            error, delays = min((self.squared_error(*pair), pair) for pair in self._neighbors(best, step_s))
            if error < smallest_error:
                smallest_error = error
                best = delays
            else:
                step_s /= 2
        return best

    def _neighbors(self, delays: tuple[float, float], step_s: float) -> list[tuple[float, float]]:
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

    def delay_derivatives(self, latency_s: float, response_time_s: float, gains: Gains) -> tuple[Floats, Floats]:
        """Return the derivatives of the torque with respect to latency and response time, (rows,) each, in N·m/s."""
        step_s = self._record.period_s / STEPS_PER_TICK
        shorter_s = max(latency_s - step_s, 0.0)
        later = self.regressors(latency_s + step_s, response_time_s)
        earlier = self.regressors(shorter_s, response_time_s)
        by_latency = (later - earlier) @ gains
        by_latency /= latency_s + step_s - shorter_s
        fast_s = 0.8 * response_time_s
        slow_s = 1.2 * response_time_s
        slower = self.regressors(latency_s, slow_s)
        faster = self.regressors(latency_s, fast_s)
        by_response_time = (slower - faster) @ gains / (slow_s - fast_s)
        return by_latency, by_response_time


def bandwidth_hz(record: JointRecord) -> float | None:
    """Return the lowest frequency at which the angle has less than -3 dB of its target, or None.

    The gain is the averaged cross spectrum of angle and target divided by the averaged power of the target (Welch).
    None means that the gain is above -3 dB at all frequencies at which the joint was shaken.
    """
    length = min(len(record.angle_rad), round(SPECTRUM_S / record.period_s))
    starts = range(0, len(record.angle_rad) - length + 1, max(length // 2, 1))
    cross = np.zeros(length // 2 + 1, dtype=np.complex128)
    power = np.zeros(length // 2 + 1)
    for start in starts:
        target = _spectrum(record.target_rad[start : start + length])
        angle = _spectrum(record.angle_rad[start : start + length])
        cross += angle * target.conj()
        power += np.abs(target) ** 2
    frequencies_hz = np.fft.rfftfreq(length, record.period_s)
    shaken = (power > MIN_EXCITATION * power.max()) & (frequencies_hz > 0)
    below = shaken & (np.abs(cross) < np.sqrt(0.5) * power)
    if not below.any():
        return None
    return float(frequencies_hz[below][0])


def _spectrum(piece: Floats) -> NDArray[np.complex128]:
    return np.fft.rfft(np.hanning(len(piece)) * (piece - piece.mean()))


def _fuse_angles(record: JointRecord) -> Floats:
    """Return angles from the velocities within `ENCODER_SMOOTHING_S`, and from the encoder beyond, (ticks,).

    The encoder's noise alone would look like a lag of the servo.
    """
    steps_rad = (record.velocity_rad_s[1:] + record.velocity_rad_s[:-1]) * record.period_s / 2
    integral_rad = np.concatenate(([0.0], np.cumsum(steps_rad)))
    half_window = max(round(ENCODER_SMOOTHING_S / record.period_s), 1)
    window = np.hanning(2 * half_window + 1)
    drift_rad: Floats = np.pad(record.angle_rad - integral_rad, half_window, mode="reflect", reflect_type="odd")
    return integral_rad + filter_columns(drift_rad, window / window.sum())


def _sample_ticks(fine: Floats) -> Floats:
    """Return the value just before each tick's sample, from one value for each step of the servo model."""
    at_end_of_tick = fine[STEPS_PER_TICK - 1 :: STEPS_PER_TICK]
    before_first_tick = np.zeros((1, *fine.shape[1:]))
    return np.concatenate((before_first_tick, at_end_of_tick[:-1]))


def _mean_around_samples(fine: Floats) -> Floats:
    """Return the mean over one tick around each sample, minus the sample, (ticks,)."""
    trapezoid = np.ones(STEPS_PER_TICK + 1)
    trapezoid[0] = 0.5
    trapezoid[-1] = 0.5
    return _sample_ticks(np.convolve(fine, trapezoid / STEPS_PER_TICK, "same") - fine)
