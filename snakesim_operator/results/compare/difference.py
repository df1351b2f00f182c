"""How two runs differ, in numbers: B - A throughout. No file, no network, no clock."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.run_log.host_record import BLACK_BOX
from snakesim_hal.wire.messages import Mode
from snakesim_operator.results.compare.alignment import SAME_INSTANT_S, Aligned, Joints, align
from snakesim_operator.results.compare.following import Following, following
from snakesim_operator.results.compare.settings import Setting, differences, drives_in_words, identity
from snakesim_operator.results.metrics.propulsion import Propulsion, find_propulsion_periods
from snakesim_operator.results.report.timeline import Series, distance, reported_distance
from snakesim_operator.results.run_log import RunRecord

APART_RAD = 0.05  # three degrees: a hundred times the noise of a joint's sensor, a fifth of a strong bend
MAX_HAND_OVERS_NAMED = 12
STOOD_M = 0.001  # a run that moved less did not move: a percentage of that means nothing
TARGETS = (
    (Mode.POSITION, "angle target", "rad"),
    (Mode.VELOCITY, "speed target", "rad/s"),
    (Mode.TORQUE, "torque target", "N·m"),
)


@dataclass(frozen=True)
class MaxDifference:
    """The largest difference, and where and when it was."""

    joint: int
    time_s: float
    a: float
    b: float

    @property
    def difference(self) -> float:
        """B - A."""
        return self.b - self.a


@dataclass(frozen=True)
class Gap:
    """One quantity of every joint, compared over the common time. Unknown is None or NaN."""

    what: str
    unit: str
    difference: Floats  # (n, joints), B - A; NaN where it is unknown
    joint_rms: Floats  # (joints,)
    joint_worst: list[MaxDifference | None]
    rms: float | None  # over all joints
    worst: MaxDifference | None
    correlation: float | None  # over all joints and times; None when one of them never changes
    unknown_fraction: float  # share of what is compared that is not a number in one of the runs, or in both

    @property
    def same(self) -> bool:
        """Whether every value is known in both runs, and is the same."""
        return self.unknown_fraction == 0 and self.worst is not None and not self.worst.difference


@dataclass(frozen=True)
class Advance:
    """How far both came, by the same measure, at the end of the common time."""

    what: str
    a: Series
    b: Series
    at_s: float
    a_m: float
    b_m: float

    @property
    def difference_m(self) -> float:
        """B - A."""
        return self.b_m - self.a_m

    @property
    def percent(self) -> float | None:
        """B - A in percent of A. It is 0 if neither run moved, and None if only B moved."""
        if abs(self.a_m) < STOOD_M:
            both_stood = abs(self.difference_m) < STOOD_M
            return 0.0 if both_stood else None
        return 100 * self.difference_m / abs(self.a_m)


@dataclass(frozen=True)
class FirstDivergence:
    """The first tick at which a joint's angles were further apart than a limit."""

    time_s: float
    joint: int


@dataclass(frozen=True)
class HandOvers:
    """Which joints propelled the robot, in order, in the runs A and B.

    At any time one joint propels most. A hand-over is the time at which another joint takes that over.
    """

    a: list[Propulsion]
    b: list[Propulsion]
    unknown: str = ""  # why they cannot be compared

    @property
    def common_count(self) -> int:
        """The number of hand-overs, from the start on, that went to the same joints in both runs."""
        count = 0
        for in_a, in_b in zip(self.a, self.b, strict=False):
            if in_a.joint != in_b.joint:
                break
            count += 1
        return count

    @property
    def delays_s(self) -> list[float]:
        """The time in s by which B was later than A, for each hand-over that they have in common; below 0: earlier."""
        common_count = self.common_count
        pairs = zip(self.a[:common_count], self.b[:common_count], strict=True)
        return [in_b.start_s - in_a.start_s for in_a, in_b in pairs]

    @property
    def same_order(self) -> bool:
        """Whether the runs have all hand-overs in common."""
        return self.common_count == len(self.a) == len(self.b)


@dataclass(frozen=True)
class Difference:
    """Everything that is known about two runs."""

    a: RunRecord
    b: RunRecord
    joints: list[str]  # tail to head
    aligned: Aligned
    compared: list[Setting]
    settings: list[Setting]  # that differ
    drives: str  # in a sentence, whether they are the same; empty: they are
    advance: Advance | None
    following: list[Following | None]  # of every joint's angle in B, that in A
    angle: Gap
    speed: Gap
    torque: Gap
    targets: list[Gap]  # one for each mode that was used in both at the same time
    other_mode: float  # share of ticks and joints whose modes differ
    tracking_rad: tuple[float | None, float | None]  # RMS of angle - target in position mode, in A and in B
    hand_overs: HandOvers
    divergence: FirstDivergence | None

    @property
    def identical(self) -> bool:
        """Whether all that was measured, commanded and reported is the same for all of the common time."""
        hand_overs = self.hand_overs
        if not hand_overs.unknown:
            at_other_times = any(abs(later) > SAME_INSTANT_S for later in hand_overs.delays_s)
            if not hand_overs.same_order or at_other_times:
                return False
        if self.advance is not None and abs(self.advance.difference_m) >= STOOD_M:
            return False
        return self.other_mode == 0 and all(gap.same for gap in self.gaps)

    @property
    def gaps(self) -> list[Gap]:
        """The quantities that are compared joint by joint."""
        return [self.angle, self.speed, self.torque, *self.targets]


def differ(a: RunRecord, b: RunRecord) -> Difference:
    """Compare two runs of robots with the same joints.

    Args:
        a: The first run.
        b: The second run. All differences are B - A.

    Returns:
        The comparison over the time that both runs have in common.

    Raises:
        ConfigError: The runs cannot be compared.
    """
    _check_comparable(a, b)
    aligned = align(a, b)
    joints_a = aligned.a
    joints_b = aligned.b
    time_s = aligned.time_s
    until_s = float(time_s[-1])
    same_mode = joints_a.mode == joints_b.mode  # (n, joints)
    angle = _compare_quantity("angle", "rad", time_s, joints_a.angle_rad, joints_b.angle_rad)
    speed = _compare_quantity("speed", "rad/s", time_s, joints_a.velocity_rad_s, joints_b.velocity_rad_s)
    torque = _compare_quantity("torque", "N·m", time_s, joints_a.torque_nm, joints_b.torque_nm)
    angles_by_joint = zip(joints_a.angle_rad.T, joints_b.angle_rad.T, strict=True)
    lags_and_gains = [following(time_s, angle_a, angle_b) for angle_a, angle_b in angles_by_joint]
    hand_overs = HandOvers(_hand_overs_until(a, until_s), _hand_overs_until(b, until_s), _describe_unreported(a, b))
    return Difference(
        a=a,
        b=b,
        joints=[joint.name for joint in a.description.joints],
        aligned=aligned,
        # What was requested.
        compared=identity(a, b),
        settings=differences(a, b),
        drives=drives_in_words(a, b),
        # What was measured.
        advance=_compare_advance(a, b, until_s),
        following=lags_and_gains,
        angle=angle,
        speed=speed,
        torque=torque,
        # What was commanded and reported.
        targets=_compare_targets(aligned, same_mode),
        other_mode=float(1 - same_mode.mean()),
        tracking_rad=(_tracking_error_rad(joints_a), _tracking_error_rad(joints_b)),
        hand_overs=hand_overs,
        divergence=_find_divergence(time_s, angle.difference),
    )


def _check_comparable(a: RunRecord, b: RunRecord) -> None:
    """Check that two runs have ticks, the same joints, and arrays that fit to each other.

    Args:
        a: The first run.
        b: The second run.

    Raises:
        ConfigError: A run has no tick, the joints differ, or an array is damaged.
    """
    for record in (a, b):
        if not len(record.time_s):
            raise ConfigError(
                f"{record.folder / BLACK_BOX}: holds no tick, because the robot was never armed "
                f"({record.host.reason}); {record.folder / 'host.log'} may explain it. "
                "Run it again, until the summary has a time",
                code="recording/never-armed",
            )
    if a.description.layout != b.description.layout:
        robots: list[str] = []
        for record in (a, b):
            joint_count = len(record.description.joints)
            robots.append(f"{record.folder} has {record.description.robot} with {joint_count} joints")
        raise ConfigError(
            f"{', '.join(robots)}: their names, order or axes are not the same, so there is no joint to compare with "
            "which. Compare runs of one robot file",
            code="recording/not-comparable",
        )
    for record in (a, b):
        _check_shapes(record)


def _check_shapes(record: RunRecord) -> None:
    """Raise ConfigError for arrays of a wrong shape or type, which a damaged black box may hold."""
    ticks = len(record.time_s)
    joints = len(record.description.joints)
    shapes = {"time_s": (ticks,), "position_w_m": (ticks, 3), "orientation_wxyz": (ticks, 4)}
    for name in ("angle_rad", "velocity_rad_s", "torque_nm", "mode", "target"):
        shapes[name] = (ticks, joints)
    for name, shape in shapes.items():
        array: NDArray[np.generic] = getattr(record, name)
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise ConfigError(
                f"{record.folder / BLACK_BOX}: `{name}` holds {array.dtype} {array.shape}, not numbers {shape}: "
                f"{ticks} ticks, {joints} joints. It is damaged, or not of this run; repeat the run",
                code="recording/not-readable",
            )
    if not np.isfinite(record.time_s).all() or (np.diff(record.time_s) <= 0).any():
        raise ConfigError(
            f"{record.folder / BLACK_BOX}: `time_s` does not grow from tick to tick; repeat the run",
            code="recording/not-readable",
        )


def _compare_targets(aligned: Aligned, same_mode: NDArray[np.bool_]) -> list[Gap]:
    """Compare the targets of each mode that was used in both runs at the same time.

    Args:
        aligned: Both runs.
        same_mode: (n, joints) whether the mode is the same in both.
    """
    gaps: list[Gap] = []
    for mode, what, unit in TARGETS:
        both_in_mode = same_mode & (aligned.a.mode == mode)
        if both_in_mode.any():
            target_a = np.where(both_in_mode, aligned.a.target, np.nan)
            target_b = np.where(both_in_mode, aligned.b.target, np.nan)
            gaps.append(_compare_quantity(what, unit, aligned.time_s, target_a, target_b, both_in_mode))
    return gaps


def _compare_quantity(
    what: str, unit: str, time_s: Floats, a: Floats, b: Floats, compared: NDArray[np.bool_] | None = None
) -> Gap:
    """Compare one quantity of every joint, such as the angle, between two runs.

    A value that is not finite in one of the runs is unknown; it does not count in the RMS and the maximum.

    Args:
        what: Name of the quantity.
        unit: Unit of the quantity.
        time_s: (n,) the common times.
        a: (n, joints) values in A.
        b: (n, joints) values in B.
        compared: (n, joints) where a comparison makes sense; None: everywhere.
    """
    with np.errstate(invalid="ignore"):  # infinity minus infinity is unknown too
        difference = b - a
    known = np.isfinite(difference)
    compared_count = known.size if compared is None else int(compared.sum())
    unknown_fraction = 0.0
    if compared_count:
        unknown_fraction = 1 - known.sum() / compared_count

    squares = np.where(known, difference, 0.0) ** 2
    known_count = known.sum(axis=0)  # (joints,)
    mean_squares = squares.sum(axis=0) / np.maximum(known_count, 1)
    joint_rms = np.sqrt(np.where(known_count > 0, mean_squares, np.nan))
    total_rms = None
    if known.any():
        total_rms = float(np.sqrt(squares.sum() / known.sum()))

    joint_worst = [_find_max_difference(joint, time_s, a, b, known) for joint in range(difference.shape[1])]
    known_worst = [worst for worst in joint_worst if worst is not None]
    return Gap(
        what=what,
        unit=unit,
        difference=difference,
        joint_rms=joint_rms,
        joint_worst=joint_worst,
        rms=total_rms,
        worst=max(known_worst, key=lambda worst: abs(worst.difference), default=None),
        correlation=_correlation(a[known], b[known]),
        unknown_fraction=float(unknown_fraction),
    )


def _find_max_difference(
    joint: int, time_s: Floats, a: Floats, b: Floats, known: NDArray[np.bool_]
) -> MaxDifference | None:
    """Return the largest difference of one joint, or None if no value of the joint is known in both runs.

    Args:
        joint: Index of the joint.
        time_s: (n,) the common times.
        a: (n, joints) values in A.
        b: (n, joints) values in B.
        known: (n, joints) whether the value is known in both runs.
    """
    known_rows = np.flatnonzero(known[:, joint])
    if not len(known_rows):
        return None
    squares = (b[known_rows, joint] - a[known_rows, joint]) ** 2
    row = known_rows[np.argmax(squares)]
    return MaxDifference(joint, float(time_s[row]), float(a[row, joint]), float(b[row, joint]))


def _correlation(a: Floats, b: Floats) -> float | None:
    """Return Pearson's correlation, or None if one of both never changes."""
    if len(a) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    return float(np.corrcoef(a, b)[0, 1])


def _tracking_error_rad(joints: Joints) -> float | None:
    """Return the RMS of angle - target over all joints in position mode."""
    errors = (joints.angle_rad - joints.target)[joints.mode == Mode.POSITION]
    errors = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else None


def _compare_advance(a: RunRecord, b: RunRecord, at_s: float) -> Advance | None:
    """Compare the advance by a measure that both runs have, or return None.

    The measure is the distance along the route, else the one that both controllers reported.
    """
    for measure in (distance, reported_distance):
        series_a = measure(a)
        series_b = measure(b)
        if series_a is None or series_b is None or series_a.what != series_b.what:
            continue
        a_m = float(np.interp(at_s, series_a.time_s, series_a.value))
        b_m = float(np.interp(at_s, series_b.time_s, series_b.value))
        return Advance(series_a.what, series_a, series_b, at_s, a_m, b_m)
    return None


def _describe_unreported(a: RunRecord, b: RunRecord) -> str:
    """Return why the hand-overs cannot be compared; empty if they can."""
    silent = [run for run, record in (("A", a), ("B", b)) if not record.control]
    if not silent:
        return ""
    return f"unknown, because nothing that control reported in {' and '.join(silent)} was recorded"


def _hand_overs_until(record: RunRecord, until_s: float) -> list[Propulsion]:
    """Return the hand-overs within the common time."""
    return [period for period in find_propulsion_periods(record) if period.start_s <= until_s + SAME_INSTANT_S]


def _find_divergence(time_s: Floats, difference_rad: Floats) -> FirstDivergence | None:
    """Return the first tick at which a joint's angles are more than APART_RAD apart."""
    sizes = np.abs(np.nan_to_num(difference_rad))
    rows_beyond = np.flatnonzero((sizes > APART_RAD).any(axis=1))
    if not len(rows_beyond):
        return None
    row = int(rows_beyond[0])
    return FirstDivergence(float(time_s[row]), int(np.argmax(sizes[row])))


def order_in_words(names: Sequence[str], periods: Sequence[Propulsion]) -> str:
    """Return the joints that propelled, one after the other."""
    if not periods:
        return "none"
    shown = " → ".join(names[period.joint] for period in periods[:MAX_HAND_OVERS_NAMED])
    if len(periods) > MAX_HAND_OVERS_NAMED:
        shown += " → …"
    return shown
