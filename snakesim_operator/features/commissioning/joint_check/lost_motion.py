"""Measures how much motion is lost between a drive and its link, by the gyros of the links. Pure.

Backlash is measured while the joint moves:

    rate of the link = ratio * rate of the drive       while the teeth of the gear touch

A gear of another ratio loses a fraction of every motion: the link's rate is proportional to the drive's all the time.
Backlash loses the same angle at each reversal, however long the motion: the rates are proportional except while the
drive crosses the backlash. So the ratio is the one that more samples agree on than on any other. With that ratio, the
range of the drive angle minus the link angle is the backlash. A delay between IMU and encoder is estimated along with
the ratio. Noisy rates give an inaccurate ratio, which looks like backlash. The angles give an accurate one, but only
without backlash. With the wrong one of the two, more motion seems to be lost, so the other one counts.

A coupling that slips may carry one link, but not several. At an end of the robot, it then follows its own motion, and
slips while its drive holds still and another joint moves. So the motion of held joints is measured as well.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.joint_check.link_shares import MIN_SAMPLES
from snakesim_operator.features.commissioning.joint_check.measurements import CheckMeasurements

# Rates are slopes over that time to either side, so that noisy angles give no noisy rates.
SLOPE_HALF_WINDOW_S = 0.04
MOTION_MARGIN_S = 0.1  # before and after a joint's motion
FAST_FRACTION = 0.3  # of the highest rate; slower samples tell no ratio
# Of the highest rate; a sample that is nearer to a ratio agrees with it.
MAX_DISAGREEMENT_FRACTION = 0.06
# A link behind a slower gear has slower rates, so the agreement scales with the ratio.
MIN_ASSUMED_RATIO = 0.5
MAX_RATIO = 4.0
MIN_RATIO = 0.12  # of a link that turns at all
RATIO_STEP = 0.01
MIN_AGREEING_FRACTION = 0.2  # fraction of the fast samples
MAX_DELAY_S = 0.03  # between IMU and encoder
NOISE_FACTOR = 4.0  # standard deviations; less lost motion may be noise
# Standard deviations. A held joint is measured once for each other joint, so false alarms add up.
HELD_NOISE_FACTOR = 6.0
MAX_GYRO_GAP_S = 0.3  # between two samples; a gyro that is silent for longer is not used
MAX_GYRO_SCALE_ERROR = 0.03  # of the rotation of a link; two gyros may differ by that much
MIN_SMALL_MOTION_RAD = (
    0.002  # range of a drive in its small motion; with less, its link shows nothing
)
MEDIAN_ERROR_FACTOR = 1.25  # standard deviation of a median, of that of a mean
MAD_TO_SD = 1.4826  # standard deviation of a normal distribution, of its median absolute deviation


@dataclass(frozen=True)
class LostMotion:
    """The motion that was lost between a joint's drive and its link."""

    lost_rad: float  # by which the drive turned further than the link, from end to end
    # That much would be measured without any backlash, by the noise of gyros and encoder.
    noise_rad: float
    ratio: float  # of the link's rate to the drive's, while the teeth touch


@dataclass(frozen=True)
class HeldMotion:
    """The motion of a joint's links against each other while its drive held still, and another joint moved."""

    turned_rad: float  # by which the links turned against each other, from end to end
    noise_rad: float  # that much may be measured with a sound gear

    @property
    def is_certain(self) -> bool:
        """Whether it is surely a motion, and not noise."""
        return self.turned_rad > self.noise_rad


@dataclass(frozen=True)
class GyroNoise:
    """The noise of a gyro, or of the difference of two."""

    random_walk_rad_per_sqrt_s: float  # of its angle, standard deviation after one second
    bias_error_rad_s: float  # standard deviation of its bias, which was measured at rest

    def combine(self, other: "GyroNoise") -> "GyroNoise":
        """Return the noise of the difference of two gyros."""
        return GyroNoise(
            float(np.hypot(self.random_walk_rad_per_sqrt_s, other.random_walk_rad_per_sqrt_s)),
            float(np.hypot(self.bias_error_rad_s, other.bias_error_rad_s)),
        )

    def compute_drift_rad(self, duration_s: float) -> float:
        """Return the standard deviation by which the integrated angle drifts in a time."""
        random_walk_rad = self.random_walk_rad_per_sqrt_s * np.sqrt(duration_s)
        return float(np.hypot(random_walk_rad, self.bias_error_rad_s * duration_s))


def measure_lost_motion(measurements: CheckMeasurements, joint_index: int) -> LostMotion | None:
    """Measure the backlash of a joint that moved back and forth.

    Fits the ratio of the link's rate to the drive's rate and the delay between their sensors. The backlash is the range
    of the drive angle minus the link angle divided by that ratio.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint.

    Returns:
        The backlash and its noise; None if the joint moved too little, no gyro measured its link, or the rates of link
        and drive agree on no ratio.
    """
    moved_rows = np.flatnonzero(measurements.is_in_large_motion(joint_index))
    link_angle = _integrate_link_angle(measurements, joint_index)
    if link_angle is None or len(moved_rows) < MIN_SAMPLES:
        return None
    link_rad, gyro_noise = link_angle
    encoder_rad = measurements.angle_rad[:, joint_index]

    # The part of the record in which the joint moved, where the slopes are valid.
    half_window = max(round(SLOPE_HALF_WINDOW_S / measurements.period_s), 1)
    margin = round(MOTION_MARGIN_S / measurements.period_s)
    start = max(moved_rows[0] - margin, 2 * half_window)
    end = min(moved_rows[-1] + margin, len(encoder_rad) - 2 * half_window)
    window = slice(start, end)

    # Ratio and delay.
    all_drive_rates = _compute_slopes(encoder_rad, half_window, measurements.period_s)
    drive_rate = all_drive_rates[window]
    acceleration = _compute_slopes(all_drive_rates, half_window, measurements.period_s)[window]
    link_rate = _compute_slopes(link_rad, half_window, measurements.period_s)[window]
    approximate_ratio = _find_ratio(drive_rate, link_rate)
    if approximate_ratio is None:
        return None
    ratio_by_rates, delay_s = _refine_ratio(approximate_ratio, drive_rate, link_rate, acceleration)

    # Lost motion with the ratio of the rates, or with that of the angles if less motion is lost with it.
    delayed_drive_rad = encoder_rad[window] - delay_s * drive_rate
    ratios = [ratio_by_rates]
    ratio_by_angles = _fit_ratio_of_angles(delayed_drive_rad, link_rad[window])
    if abs(ratio_by_angles) >= MIN_RATIO:
        ratios.append(ratio_by_angles)
    lost_rad, ratio = min(
        (float(np.ptp(_smooth(delayed_drive_rad - link_rad[window] / ratio, half_window))), ratio)
        for ratio in ratios
    )

    # Its noise.
    duration_s = len(delayed_drive_rad) * measurements.period_s
    gyro_drift_rad = gyro_noise.compute_drift_rad(duration_s) / abs(ratio)
    encoder_noise_rad = _measure_encoder_noise(measurements, joint_index) / np.sqrt(half_window)
    noise_rad = NOISE_FACTOR * float(np.hypot(gyro_drift_rad, encoder_noise_rad))
    return LostMotion(lost_rad, noise_rad, ratio)


def measure_small_motion_ratio(measurements: CheckMeasurements, joint_index: int) -> float | None:
    """Return the motion of a joint's links divided by that of its drive, in the second cycle of its small motion.

    Returns:
        The ratio, which is near 0 within backlash; None if the drive did not make the small motion, or a link was not
        measured.
    """
    small = measurements.find_second_small_cycle(joint_index)
    link_angle = _integrate_link_angle(measurements, joint_index)
    if small is None or link_angle is None:
        return None
    link_rad = link_angle[0][small]
    drive_rad = measurements.angle_rad[small, joint_index]
    if float(np.ptp(drive_rad)) < MIN_SMALL_MOTION_RAD:
        return None
    centered_rad = drive_rad - np.mean(drive_rad)
    return float(link_rad @ centered_rad / (centered_rad @ centered_rad))


def measure_held_motions(
    measurements: CheckMeasurements, joint_index: int, ratio: float
) -> list[HeldMotion]:
    """Measure how far the links of a joint turned against each other while its drive held still.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint.
        ratio: Ratio of the link's rate to the drive's. The drive hardly moves, so it need not be exact.

    Returns:
        A motion for each other joint that moved meanwhile; empty if no gyro measured the joint's link.
    """
    link_angle = _integrate_link_angle(measurements, joint_index)
    coarse_link_angle = _integrate_link_angle(measurements, joint_index, sample_step=2)
    gyro_ahead = _read_gyro(
        measurements, joint_index + 1, measurements.find_axis_component(joint_index)
    )
    if link_angle is None or coarse_link_angle is None or gyro_ahead is None:
        return []
    link_rad, gyro_noise = link_angle
    # The drive yields a little to its load, and its link with it.
    difference_rad = link_rad - ratio * measurements.angle_rad[:, joint_index]
    # A drive that jerks turns the links in less time than a gyro needs from one sample to the next.
    sampling_error_rad = link_rad - coarse_link_angle[0]
    link_ahead_rad = _integrate_rate(gyro_ahead[0], measurements.period_s)
    half_window = max(round(SLOPE_HALF_WINDOW_S / measurements.period_s), 1)
    encoder_noise_rad = (
        abs(ratio) * _measure_encoder_noise(measurements, joint_index) / np.sqrt(half_window)
    )

    held_motions: list[HeldMotion] = []
    for window in _list_held_windows(measurements, joint_index):
        duration_s = len(difference_rad[window]) * measurements.period_s
        gyro_drift_rad = gyro_noise.compute_drift_rad(duration_s)
        scale_error_rad = MAX_GYRO_SCALE_ERROR * float(np.ptp(link_ahead_rad[window]))
        random_error_rad = HELD_NOISE_FACTOR * float(np.hypot(gyro_drift_rad, encoder_noise_rad))
        noise_rad = random_error_rad + scale_error_rad + float(np.ptp(sampling_error_rad[window]))
        turned_rad = float(np.ptp(_smooth(difference_rad[window], half_window)))
        held_motions.append(HeldMotion(turned_rad, noise_rad))
    return held_motions


def _list_held_windows(measurements: CheckMeasurements, joint_index: int) -> list[slice]:
    """Return the ticks of the motions of each other joint, if the joint itself did not move meanwhile."""
    own_motion = measurements.is_moved_by_target(joint_index)
    windows: list[slice] = []
    for other in range(len(measurements.joint_names)):
        moved_rows = np.flatnonzero(measurements.is_moved_by_target(other))
        if len(moved_rows) < MIN_SAMPLES:
            continue
        window = slice(moved_rows[0], moved_rows[-1] + 1)
        if not own_motion[window].any():
            windows.append(window)
    return windows


def _measure_encoder_noise(measurements: CheckMeasurements, joint_index: int) -> float:
    """Return the standard deviation of the noise of a joint's encoder in rad, measured while the robot was at rest."""
    at_rest = measurements.is_at_rest()
    both_at_rest = at_rest[1:] & at_rest[:-1]  # not from one rest to the next
    differences_rad = np.diff(measurements.angle_rad[:, joint_index])[both_at_rest]
    return float(np.std(differences_rad)) / np.sqrt(2)


def _find_ratio(drive_rate: Floats, link_rate: Floats) -> float | None:
    """Return the ratio on which most of the fast samples agree; None if too few do."""
    max_rate = float(np.max(np.abs(drive_rate)))
    is_fast = np.abs(drive_rate) > FAST_FRACTION * max_rate
    if not is_fast.any():
        return None
    magnitudes = np.arange(MIN_RATIO, MAX_RATIO, RATIO_STEP)
    candidates = np.concatenate((magnitudes, -magnitudes))
    # (samples, candidates).
    distances = np.abs(link_rate[is_fast, None] - candidates * drive_rate[is_fast, None])
    max_distances = (
        MAX_DISAGREEMENT_FRACTION * max_rate * np.maximum(np.abs(candidates), MIN_ASSUMED_RATIO)
    )
    agreeing_fractions = np.mean(distances < max_distances, axis=0)
    best_index = int(np.argmax(agreeing_fractions))
    if agreeing_fractions[best_index] < MIN_AGREEING_FRACTION:
        return None
    return float(candidates[best_index])


def _refine_ratio(
    ratio: float, drive_rate: Floats, link_rate: Floats, acceleration: Floats
) -> tuple[float, float]:
    """Return the ratio by least squares over the samples that agree with it, and the link's delay in seconds.

    link rate = ratio * (drive rate - delay * acceleration)
    """
    max_rate = float(np.max(np.abs(drive_rate)))
    distances = np.abs(link_rate - ratio * drive_rate)
    # The first ratio is one of a grid, so more samples are accepted than for the grid.
    agrees = distances < 1.5 * MAX_DISAGREEMENT_FRACTION * max_rate * max(
        abs(ratio), MIN_ASSUMED_RATIO
    )
    regressors = np.column_stack((drive_rate[agrees], acceleration[agrees]))
    coefficients = np.linalg.lstsq(regressors, link_rate[agrees], rcond=None)[0]
    delay_s = float(np.clip(-coefficients[1] / coefficients[0], -MAX_DELAY_S, MAX_DELAY_S))
    return float(coefficients[0]), delay_s


def _fit_ratio_of_angles(drive_rad: Floats, link_rad: Floats) -> float:
    """Return the ratio of the angles of link and drive by least squares, 0 if the drive does not move."""
    centered_rad = drive_rad - np.mean(drive_rad)
    variance = float(centered_rad @ centered_rad)
    return float(centered_rad @ link_rad) / variance if variance > 0.0 else 0.0


def _integrate_link_angle(
    measurements: CheckMeasurements, joint_index: int, sample_step: int = 1
) -> tuple[Floats, GyroNoise] | None:
    """Return a joint's angle by the gyros of its two links, and the gyros' noise.

    For the joint at the tail, motion capture may replace a missing gyro on the tail link.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint.
        sample_step: Every how many samples of the gyros are used, to see whether they are frequent enough.

    Returns:
        (ticks,) angle in rad up to a constant, and its noise; None if a link was not measured.
    """
    component = measurements.find_axis_component(joint_index)
    gyro_behind = _read_gyro(measurements, joint_index, component, sample_step)
    gyro_ahead = _read_gyro(measurements, joint_index + 1, component, sample_step)
    if gyro_ahead is None:
        return None
    rate_ahead, noise_ahead = gyro_ahead
    if gyro_behind is not None:
        rate_behind, noise_behind = gyro_behind
        angle_rad = _integrate_rate(rate_ahead - rate_behind, measurements.period_s)
        return angle_rad, noise_ahead.combine(noise_behind)
    base_rad = measurements.base_rotation_rad[:, component]
    if joint_index == 0 and not np.isnan(base_rad).all():
        known_rows = np.flatnonzero(~np.isnan(base_rad))
        base_rad = np.interp(np.arange(len(base_rad)), known_rows, base_rad[known_rows])
        return _integrate_rate(rate_ahead, measurements.period_s) - base_rad, noise_ahead
    return None


def _read_gyro(
    measurements: CheckMeasurements, link_index: int, component: int, sample_step: int = 1
) -> tuple[Floats, GyroNoise] | None:
    """Return a link's rate at every tick, (n,), without its bias, and its noise.

    None if there is no gyro, or if it was silent for some time.
    """
    rate = measurements.link_rate_rad_s[:, link_index, component]
    known = np.flatnonzero(~np.isnan(rate))
    gaps = np.diff(np.concatenate(([0], known, [len(rate) - 1])))
    if np.max(gaps) * measurements.period_s > MAX_GYRO_GAP_S:
        return None
    at_rest = known[measurements.is_at_rest()[known]]
    if len(at_rest) < MIN_SAMPLES:
        return None
    bias = np.median(rate[at_rest])
    noise = MAD_TO_SD * np.median(np.abs(rate[at_rest] - bias))  # a few outliers do not change it
    sample_period_s = float(np.median(np.diff(known))) * measurements.period_s
    used = known[::sample_step]
    rate_at_ticks = np.interp(np.arange(len(rate)), used, rate[used] - bias)
    bias_error_rad_s = MEDIAN_ERROR_FACTOR * noise / np.sqrt(len(at_rest))
    return rate_at_ticks, GyroNoise(
        random_walk_rad_per_sqrt_s=float(noise * np.sqrt(sample_period_s)),
        bias_error_rad_s=float(bias_error_rad_s),
    )


def _integrate_rate(rate: Floats, period_s: float) -> Floats:
    """Return the integral of a rate from the first tick, by trapezoids, (n,)."""
    steps = (rate[1:] + rate[:-1]) * period_s / 2
    return np.concatenate(([0.0], np.cumsum(steps)))


def _smooth(signal: Floats, half_window: int) -> Floats:
    """Return the moving average of a signal, without the ends at which it is not complete."""
    mean_window = np.full(2 * half_window - 1, 1 / (2 * half_window - 1))
    return np.convolve(signal, mean_window, "valid")


def _compute_slopes(signal: Floats, half_window: int, period_s: float) -> Floats:
    """Return the slope of the line through the samples around each sample, (n,); not valid near the ends.

    slope = sum(k * signal[i + k]) / sum(k^2) / period       for k from -half_window to half_window
    """
    offsets = np.arange(-half_window, half_window + 1)
    kernel = offsets / (offsets @ offsets) / period_s
    return np.convolve(signal, kernel[::-1], "same")
