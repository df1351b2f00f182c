"""How much motion of a drive is lost in its gear when its load reverses: backlash. Pure.

    rate of the link = ratio * rate of the drive       while the teeth of the gear touch

A gear of another ratio loses a share of every motion: the link's rate is proportional to the drive's all the time.
Backlash loses the same angle at each reversal, however long the motion: the rates are proportional but for the time in
which the drive crosses the backlash. So the ratio is the one that most samples agree on, and what the drive turned
further than the link, by that ratio, spans the backlash. A delay between IMU and encoder is estimated along with it.
"""

from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.link_shares import LEAST_SAMPLES
from snakesim_operator.features.commissioning.measured import Measured

SMOOTHED_S = 0.04  # to either side: rates are slopes over that time, so that noisy angles give no noisy rates
AROUND_S = 0.1  # before and after a joint's motion
FAST = 0.3  # of the highest rate: slower samples tell no ratio
AGREES = 0.06  # of the highest rate: such a sample agrees with a ratio
MAX_RATIO = 4.0
MIN_RATIO = 0.12  # of a link that turns at all
RATIO_STEP = 0.01
MIN_AGREEING = 0.2  # of the fast samples
MAX_DELAY_S = 0.03  # between IMU and encoder
SURE = 4.0  # standard deviations


@dataclass(frozen=True)
class LostMotion:
    """What was lost between a joint's drive and its link."""

    lost_rad: float  # by which the drive turned further than the link, from end to end
    noise_rad: float  # that much would be found without any backlash, by the noise of gyros and encoder
    ratio: float  # of the link's rate to the drive's, while the teeth touch


def find_lost_motion(run: Measured, joint: int) -> LostMotion | None:
    """Return the motion that is lost in a joint that moved to and fro; None where it is not known."""
    moved = np.flatnonzero(run.moved_by_target(joint))
    by_gyros = _link_angle(run, joint)
    if by_gyros is None or len(moved) < LEAST_SAMPLES:
        return None
    link_rad, drift = by_gyros
    encoder_rad = run.angle_rad[:, joint]
    half = max(round(SMOOTHED_S / run.period_s), 1)
    around = round(AROUND_S / run.period_s)
    window = slice(max(moved[0] - around, 2 * half), min(moved[-1] + around, len(encoder_rad) - 2 * half))
    drive_rate = _slope(encoder_rad, half, run.period_s)
    acceleration = _slope(drive_rate, half, run.period_s)[window]
    link_rate = _slope(link_rad, half, run.period_s)[window]
    drive_rate = drive_rate[window]
    ratio = _ratio(drive_rate, link_rate)
    if ratio is None:
        return None
    ratio, delay_s = _refined(ratio, drive_rate, link_rate, acceleration)
    behind_rad = encoder_rad[window] - delay_s * drive_rate - link_rad[window] / ratio
    behind_rad = np.convolve(behind_rad, np.full(2 * half - 1, 1 / (2 * half - 1)), "valid")
    duration_s = len(behind_rad) * run.period_s
    encoder_noise_rad = float(np.std(np.diff(encoder_rad[run.at_rest()]))) / np.sqrt(2)
    noise_rad = SURE * float(np.hypot(drift * np.sqrt(duration_s) / abs(ratio), encoder_noise_rad / np.sqrt(half)))
    return LostMotion(float(np.ptp(behind_rad)), noise_rad, ratio)


def _ratio(drive_rate: Floats, link_rate: Floats) -> float | None:
    """Return the ratio on which most of the fast samples agree; None where too few do."""
    highest = float(np.max(np.abs(drive_rate)))
    fast = np.abs(drive_rate) > FAST * highest
    magnitudes = np.arange(MIN_RATIO, MAX_RATIO, RATIO_STEP)
    candidates = np.concatenate((magnitudes, -magnitudes))
    apart = np.abs(link_rate[fast, None] - candidates * drive_rate[fast, None])
    # A link behind a slower gear has slower rates, and so must agree better.
    agreeing = np.mean(apart < AGREES * highest * np.maximum(np.abs(candidates), 0.5), axis=0)
    best = int(np.argmax(agreeing))
    return float(candidates[best]) if agreeing[best] >= MIN_AGREEING else None


def _refined(ratio: float, drive_rate: Floats, link_rate: Floats, acceleration: Floats) -> tuple[float, float]:
    """Return the ratio by least squares over the samples that agree with it, and the link's delay in seconds."""
    highest = float(np.max(np.abs(drive_rate)))
    agrees = np.abs(link_rate - ratio * drive_rate) < 1.5 * AGREES * highest * max(abs(ratio), 0.5)
    rows = np.column_stack((drive_rate[agrees], acceleration[agrees]))
    values = np.linalg.lstsq(rows, link_rate[agrees], rcond=None)[0]
    delay_s = float(np.clip(-values[1] / values[0], -MAX_DELAY_S, MAX_DELAY_S))
    return float(values[0]), delay_s


def _link_angle(run: Measured, joint: int) -> tuple[Floats, float] | None:
    """Return the joint's angle by the gyros of its links, (n,), up to a constant, and how it drifts by their noise.

    The drift is a standard deviation after one second; it grows with the square root of time. None without gyros.
    """
    component = run.component(joint)
    behind = _gyro(run, joint, component)
    ahead = _gyro(run, joint + 1, component)
    base_rad = run.base_turn_rad[:, component]
    if ahead is None:
        return None
    if behind is not None:
        rate = ahead[0] - behind[0]
        return _integrated(rate, run.period_s), float(np.hypot(ahead[1], behind[1]))
    if joint == 0 and not np.isnan(base_rad).all():
        known = np.flatnonzero(~np.isnan(base_rad))
        base_rad = np.interp(np.arange(len(base_rad)), known, base_rad[known])
        return _integrated(ahead[0], run.period_s) - base_rad, ahead[1]
    return None


def _gyro(run: Measured, link: int, component: int) -> tuple[Floats, float] | None:
    """Return a link's rate at every tick, (n,), without its bias, and its drift after a second; None without a gyro."""
    rate = run.link_rate_rad_s[:, link, component]
    known = np.flatnonzero(~np.isnan(rate))
    still = known[run.at_rest()[known]]
    if len(still) < LEAST_SAMPLES:
        return None
    bias = np.median(rate[still])
    noise = 1.4826 * np.median(np.abs(rate[still] - bias))  # a standard deviation, whatever a few samples did
    sample_period_s = float(np.median(np.diff(known))) * run.period_s
    return np.interp(np.arange(len(rate)), known, rate[known] - bias), float(noise * np.sqrt(sample_period_s))


def _integrated(rate: Floats, period_s: float) -> Floats:
    steps = (rate[1:] + rate[:-1]) * period_s / 2
    return np.concatenate(([0.0], np.cumsum(steps)))


def _slope(signal: Floats, half: int, period_s: float) -> Floats:
    """Return the slope of a line through `half` samples to either side, at every sample; not valid near the ends."""
    offsets = np.arange(-half, half + 1)
    kernel = offsets / (offsets @ offsets) / period_s
    return np.convolve(signal, kernel[::-1], "same")
