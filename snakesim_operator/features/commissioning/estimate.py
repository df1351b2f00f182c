"""What a joint is, from a record in which it was moved: least squares, each value with a 95 % interval. Pure.

    torque(t + late) = (load + armature * acceleration + viscous * speed + dry * sign(speed) + offset) / scale

`load` is what the links need (`hanging`), from the robot file's masses; `scale` is the real torque in what is measured.
All signals pass one short window, so that no noisy signal is differentiated. Noise that is left in a regressor would
shrink its value; so what the speeds say is weighed by what the angles say, whose noise is another one: instruments, as
Durbin (1954) has them.

    torque = response time behind  stiffness * (target(t - latency) - angle) - damping * speed

is fitted to the measured torque (Gauss and Newton over latency and response time). Residuals hang together from instant
to instant; so intervals come from how the values scatter when one block of the record after the other is left out
(Tukey's jackknife), times `WIDER`. How long a drive holds what it measures is not known; up to `LOOP_S` of it is in the
intervals. A motion that is not that of the model, as behind a gear with backlash, is wrong in all blocks alike; so what
the torque balance does not explain widens the intervals further.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

HALF = 5  # ticks of the window on either side
STILL_RAD_S = 0.2  # slower, dry friction is not what it is in motion
STILL_SHARE = 0.1  # of a window that may be as slow
BLOCK_S = 1.0
SPECTRUM_S = 4.0  # of a piece for a spectrum
SHAKEN = 1e-4  # of the strongest: less power in a target tells nothing
LOOP_S = 0.001  # of a drive's own loop
WIDER = 1.7  # than the jackknife's: on drives with hidden parameters, seeds 0 to 19, 67 to 96 % of those covered
STEPS = 10  # of the servo's model in a tick
SLOW_S = 0.2  # of angles against the speeds
FULL = 0.95  # of the torque limit: beyond, the motor does not do what its servo wants
MODEL_MISFIT = 0.04  # of the torque, rms: that much the balance does not explain of sound joints, by their ticks
# What the balance leaves unexplained beyond that may have been absorbed by the values, too: as much of it, times this.
# On drives with 10 to 45 mrad of backlash somewhere in the body, 1.5 covers the truth of all values.
ABSORBED = 2.0
Select = NDArray[np.bool_]
Misfit = Callable[[float, float], float]  # of latency and response time


@dataclass(frozen=True)
class Value:
    """An estimate, and how far it may be off to either side: 95 % of such intervals cover the truth."""

    value: float
    within: float

    def covers(self, truth: float) -> bool:
        """Whether the truth is inside the interval."""
        return abs(truth - self.value) <= self.within

    def scaled(self, by: float) -> "Value":
        """In another unit."""
        return Value(self.value * by, self.within * abs(by))


@dataclass(frozen=True)
class Moved:
    """The record of one joint, every `period_s`; torque as it is measured, load as the links need it."""

    period_s: float
    angle_rad: Floats
    velocity_rad_s: Floats
    torque_nm: Floats
    target_rad: Floats
    torque_limit_nm: float


@dataclass(frozen=True)
class Friction:
    """Both sides of the torque balance."""

    dry_nm: Value
    viscous_nm_s_per_rad: Value
    armature_kg_m2: Value
    torque_scale: Value  # real torque, in what is measured
    explained: float  # share of the variance of the torque
    misfit: float  # share of the torque, rms, that is unexplained and no shortcoming of the model; 0: none
    torque_nm: Floats  # (ticks - 2 HALF, 2) windowed: as measured; by the balance, NaN where it was not judged


@dataclass(frozen=True)
class Servo:
    """The response of a position servo, in torque as it is measured."""

    stiffness_nm_per_rad: Value
    damping_nm_s_per_rad: Value
    response_time_s: Value
    latency_s: Value
    explained: float  # share of the variance of the torque
    torque_nm: Floats  # (ticks,) by this servo, as measured
    between_nm: Floats  # (ticks,) mean torque around each sample, less the sample: a target's step bends it in a tick


def windowed(values: Floats) -> Floats:
    """Smoothed along the first axis by a bell of `2 HALF + 1` ticks; shorter by `2 HALF`."""
    return _filtered(values, _bell())


def slope(values: Floats, period_s: float) -> Floats:
    """The derivative of what `windowed` gives."""
    return _filtered(values, _bell(1) / period_s)


def curvature(values: Floats, period_s: float) -> Floats:
    """The second derivative of what `windowed` gives."""
    return _filtered(values, _bell(2) / period_s**2)


def friction(moved: Moved, between_nm: Floats, load_nm: Floats, load_by_angle_nm: Floats, *, scaled: bool) -> Friction:
    """The torque balance. Raises ValueError when too little moved.

    between_nm: `Servo.between_nm`. load_nm: of the links, from windowed signals, (ticks - 2 HALF,).
    load_by_angle_nm: the same, with speeds from the angles.
    scaled: whether the scale is to be found; otherwise torque is what is measured.
    """
    period_s, torque = moved.period_s, windowed(moved.torque_nm + between_nm)
    constant, sign = np.ones(len(torque)), windowed(_sign(moved.velocity_rad_s))
    speeds, more = windowed(moved.velocity_rad_s), slope(moved.velocity_rad_s, period_s)
    rows = np.column_stack((sign, speeds, more, constant, slope(moved.torque_nm, period_s), load_nm))
    angles, bends = slope(moved.angle_rad, period_s), curvature(moved.angle_rad, period_s)
    pull = slope(moved.target_rad - moved.angle_rad, period_s)
    instruments = np.column_stack((sign, angles, bends, constant, pull, load_by_angle_nm))
    still = windowed((np.abs(_light(moved.velocity_rad_s)) < STILL_RAD_S).astype(float))
    used = (still < STILL_SHARE) & _unlimited(moved)[HALF:-HALF]
    wanted, blocks = torque[used], _blocks(used, period_s)
    if not scaled:
        rows, instruments, wanted = rows[:, :5], instruments[:, :5], wanted - load_nm[used]
    found = _solved(rows[used], wanted, instruments[used], blocks)
    explained = 1 - float(np.var(found.left) / np.var(torque[used]))
    misfit = max(1 - explained - MODEL_MISFIT**2, 0.0) ** 0.5
    found = found.with_bias(ABSORBED * misfit * float(np.std(torque[used])) / _separate(rows[used]))
    scale = Value(1.0, 0.0)
    if scaled:
        share = found.values[5]
        scale = Value(float(1 / share), float(found.within[5] / share**2))
        found = found.divided_by(5)
    dry, viscous, armature, *_ = found.known
    shown = np.column_stack((torque, np.full(len(torque), np.nan)))
    shown[used, 1] = torque[used] - found.left
    return Friction(dry, viscous, armature, scale, explained, misfit, shown)


def _separate(rows: Floats) -> Floats:
    """Return how large a part of each column, rms, no combination of the other columns makes up."""
    sizes: list[float] = []
    for column in range(rows.shape[1]):
        others = np.delete(rows, column, axis=1)
        rest = rows[:, column] - others @ np.linalg.lstsq(others, rows[:, column], rcond=None)[0]
        sizes.append(float(np.sqrt(np.mean(rest**2))))
    return np.maximum(np.array(sizes), 1e-12)


def servo(moved: Moved) -> Servo:
    """The position servo. Raises ValueError when too little moved."""
    used = _unlimited(moved)[2:]
    blocks = _blocks(used, moved.period_s)
    torque, fused = moved.torque_nm[2:][used], _fused(moved)

    def rows(late_s: float, lag_s: float) -> Floats:
        return np.column_stack((_sampled(_behind(moved, fused, late_s, lag_s))[2:][used], np.ones(len(torque))))

    def misfit(late_s: float, lag_s: float) -> float:
        of = rows(late_s, lag_s)
        return float(np.sum((torque - of @ np.linalg.lstsq(of, torque, rcond=None)[0]) ** 2))

    period_s = moved.period_s
    start = min(
        ((late * period_s, lag * period_s) for late in (0, 1, 2, 3) for lag in (0.3, 1, 3)),
        key=lambda pair: misfit(*pair),
    )
    late_s, lag_s = _descend(misfit, start, period_s)
    step_s = period_s / STEPS
    of = rows(late_s, lag_s)
    gains = np.linalg.lstsq(of, torque, rcond=None)[0]
    by_late = (rows(late_s + step_s, lag_s) - rows(max(late_s - step_s, 0.0), lag_s)) @ gains
    by_late /= late_s + step_s - max(late_s - step_s, 0.0)
    nearer_s, further_s = 0.8 * lag_s, 1.2 * lag_s
    by_lag = (rows(late_s, further_s) - rows(late_s, nearer_s)) @ gains / (further_s - nearer_s)
    every = np.column_stack((of, by_late, by_lag))
    left = torque - of @ gains
    found = _solved(every, left, every, blocks)
    changed = replace(found, values=np.concatenate((gains, (late_s, lag_s))) + found.values)
    stiffness, damping, offset, late, lag = changed.known
    fine = _behind(moved, fused, max(late.value, 0.0), max(lag.value, 0.0)) @ changed.values[:2]
    return Servo(
        stiffness,
        _wider(damping, stiffness.value * LOOP_S / 2),
        lag,
        _wider(late, LOOP_S / 2),
        1 - float(np.var(found.left) / np.var(torque)),
        _sampled(fine) + offset.value,
        _between(fine),
    )


def _wider(value: Value, by: float) -> Value:
    return Value(value.value, float(np.hypot(value.within, by)))


def bandwidth_hz(moved: Moved) -> float | None:
    """Where the angle first has 0.7 of its target's size, by their spectra; None: not within what it was shaken at."""
    span = min(len(moved.angle_rad), round(SPECTRUM_S / moved.period_s))
    starts = range(0, len(moved.angle_rad) - span + 1, max(span // 2, 1))
    bell = np.hanning(span)
    cross, power = np.zeros(span // 2 + 1, dtype=np.complex128), np.zeros(span // 2 + 1)
    for at in starts:
        target, angle = (
            np.fft.rfft(bell * (part - part.mean()))
            for part in (moved.target_rad[at : at + span], moved.angle_rad[at : at + span])
        )
        cross += angle * target.conj()
        power += np.abs(target) ** 2
    hz = np.fft.rfftfreq(span, moved.period_s)
    shaken = (power > SHAKEN * power.max()) & (hz > 0)
    low = shaken & (np.abs(cross) < np.sqrt(0.5) * power)
    return float(hz[low][0]) if low.any() else None


def _fused(moved: Moved) -> Floats:
    """Angles by the speeds within `SLOW_S`, and by the encoder beyond: noise would pass for lag."""
    turns = (moved.velocity_rad_s[1:] + moved.velocity_rad_s[:-1]) * moved.period_s / 2
    turned = np.concatenate(([0.0], np.cumsum(turns)))
    half = max(round(SLOW_S / moved.period_s), 1)
    bell = np.hanning(2 * half + 1)
    apart: Floats = np.pad(moved.angle_rad - turned, half, mode="reflect", reflect_type="odd")
    return turned + _filtered(apart, bell / bell.sum())


def _behind(moved: Moved, angle_rad: Floats, late_s: float, lag_s: float) -> Floats:
    """Targets minus angles, and minus speeds, as the lagging motor follows them: (ticks * STEPS, 2), each step's end.

    A target is given at its tick, and holds until the next.
    """
    ticks, step_s = len(angle_rad), moved.period_s / STEPS
    fine = np.arange(ticks * STEPS) * step_s
    coarse = np.arange(ticks) * moved.period_s
    angle, speed = (np.interp(fine, coarse, series) for series in (angle_rad, moved.velocity_rad_s))
    whole, part = divmod(late_s / step_s, 1.0)
    held = np.repeat(moved.target_rad, STEPS)
    first = np.clip(np.arange(len(fine)) - int(whole), 0, None)
    target = (1 - part) * held[first] + part * held[np.clip(first - 1, 0, None)]
    inputs = np.column_stack((target - angle, -speed))
    keep = np.exp(-step_s / max(lag_s, 1e-6))
    reach = min(int(np.ceil(12 * lag_s / step_s)) + 1, len(fine))
    kernel = (1 - keep) * keep ** np.arange(reach)
    return np.column_stack([np.convolve(column, kernel)[: len(fine)] for column in inputs.T])


def _sampled(fine: Floats) -> Floats:
    """What came until just before each tick's sample."""
    return np.concatenate((np.zeros((1, *fine.shape[1:])), fine[STEPS - 1 :: STEPS][:-1]))


def _between(fine: Floats) -> Floats:
    around = np.ones(STEPS + 1)
    around[0] = around[-1] = 0.5
    return _sampled(np.convolve(fine, around / STEPS, "same") - fine)


def _descend(misfit: Misfit, start: tuple[float, float], period_s: float) -> tuple[float, float]:
    """Coordinate by coordinate, by ever smaller steps."""
    best, least, size = start, misfit(*start), period_s / 2
    while size > period_s / 200:
        late_s, lag_s = best
        around = [(late_s + a * size, lag_s + b * size) for a in (-1, 0, 1) for b in (-1, 0, 1) if a or b]
        tried = [(misfit(*pair), pair) for pair in around if pair[0] >= 0 and pair[1] >= period_s / 100]
        found, pair = min(tried)
        if found < least:
            least, best = found, pair
        else:
            size /= 2
    return best


@dataclass(frozen=True)
class Solved:
    """Values, how far each may be off, how they spread together, and what is left."""

    values: Floats
    spread: Floats  # covariance
    freedom: int
    left: Floats
    bias: Floats | None = None  # to either side, besides; None: none

    @property
    def within(self) -> Floats:
        """Half-widths of their 95 % intervals."""
        scattered: Floats = WIDER * student_95(self.freedom) * np.sqrt(np.diag(self.spread))
        return scattered if self.bias is None else scattered + self.bias

    def with_bias(self, bias: Floats) -> "Solved":
        """Return the same with intervals that are wider by this to either side."""
        return replace(self, bias=bias)

    @property
    def known(self) -> list[Value]:
        """Each with its interval."""
        return [Value(float(v), float(w)) for v, w in zip(self.values, self.within, strict=True)]

    def divided_by(self, last: int) -> "Solved":
        """Every value divided by one of them, with the spread to first order."""
        by = self.values[last]
        values = self.values / by
        change = np.eye(len(values)) / by
        change[:, last] -= values / by
        bias = None if self.bias is None else np.abs(change) @ self.bias
        return Solved(values, change @ self.spread @ change.T, self.freedom, self.left, bias)


def _solved(rows: Floats, wanted: Floats, instruments: Floats, block: NDArray[np.int64]) -> Solved:
    """By least squares with instruments; block: number of each row's. Raises ValueError."""
    count, size = len(np.unique(block)), rows.shape[1]
    if count < 2 * size:
        raise ValueError("too little motion is left to judge; let it run longer, with larger motion")
    square = instruments.T @ rows
    if np.linalg.cond(square / np.outer(*(np.linalg.norm(m, axis=0) + 1e-300 for m in (instruments, rows)))) > 1e8:
        raise ValueError("its motion does not tell the values apart; was it moved at all?")
    weighed = instruments.T @ wanted
    values: Floats = np.linalg.solve(square, weighed).astype(np.float64)
    apart: list[Floats] = []  # from the values without one block
    for one in np.unique(block):
        out = block == one
        less = square - instruments[out].T @ rows[out]
        apart.append(np.linalg.solve(less, weighed - instruments[out].T @ wanted[out]) - values)
    spread: Floats = (np.array(apart).T @ np.array(apart) * ((count - 1) / count)).astype(np.float64)
    return Solved(values, spread, count - size, wanted - rows @ values)


def student_95(freedom: int) -> float:
    """Two-sided 95 % quantile of Student's t, by its expansion in 1 / freedom (Fisher and Cornish)."""
    z = 1.959964
    return z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)


def _bell(derivative: int = 0) -> Floats:
    """The fourth power of a cosine over `2 HALF` ticks, of sum 1; its derivatives in closed form, by ticks.

    Differences of neighbors instead would make accelerations too small, and so rotors too heavy.
    """
    turn = np.arange(-HALF, HALF + 1) * np.pi / (2 * HALF)
    cos, sin, size = np.cos(turn), np.sin(turn), np.pi / (2 * HALF)
    shapes = (cos**4, -4 * cos**3 * sin * size, (12 * cos**2 * sin**2 - 4 * cos**4) * size**2)
    return shapes[derivative] / np.sum(cos**4)


def _filtered(values: Floats, kernel: Floats) -> Floats:
    return np.apply_along_axis(lambda column: np.convolve(column, kernel, "valid"), 0, values)


def _light(values: Floats) -> Floats:
    """The mean of three."""
    padded = np.pad(values, 1, mode="edge")
    return (padded[:-2] + padded[1:-1] + padded[2:]) / 3


def _sign(velocity_rad_s: Floats) -> Floats:
    """The share of each tick that goes forwards, less that which goes backwards."""
    now = _light(velocity_rad_s)
    before, after = np.roll(now, 1), np.roll(now, -1)
    before[0], after[-1] = now[0], now[-1]
    most = np.maximum(np.abs(after - before) / 2, 1e-9)
    return np.clip(2 * now / most, -1.0, 1.0)


def _unlimited(moved: Moved) -> Select:
    return np.abs(moved.torque_nm) < FULL * moved.torque_limit_nm


def _blocks(used: Select, period_s: float) -> NDArray[np.int64]:
    numbers = (np.arange(len(used)) * period_s / BLOCK_S).astype(np.int64)
    return numbers[used]
