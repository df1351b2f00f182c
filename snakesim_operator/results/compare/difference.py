"""Computes how two runs differ. All differences are B - A."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.run_log.host_record import BLACK_BOX
from snakesim_hal.wire.messages import JointMode
from snakesim_operator.results.compare.alignment import (
    TIME_TOLERANCE_S,
    AlignedRuns,
    JointSeries,
    align_runs,
)
from snakesim_operator.results.compare.following import LagAndGain, fit_lag_and_gain
from snakesim_operator.results.compare.settings import (
    SettingDifference,
    describe_drive_differences,
    find_differing_settings,
    list_identifying_settings,
)
from snakesim_operator.results.metrics.propulsion import PropulsionInterval, find_propulsion_periods
from snakesim_operator.results.report.timeline import (
    TimelineSeries,
    measure_distance,
    read_reported_distance,
)
from snakesim_operator.results.run_log import RunRecord

DIVERGENCE_THRESHOLD_RAD = 0.05  # three degrees: a hundred times the noise of an angle sensor
MAX_HAND_OVERS_NAMED = 12
# A run that moved less did not move; a percentage of that is meaningless.
STATIONARY_THRESHOLD_M = 0.001
TARGET_QUANTITIES = (
    (JointMode.POSITION, "angle target", "rad"),
    (JointMode.VELOCITY, "speed target", "rad/s"),
    (JointMode.TORQUE, "torque target", "N·m"),
)


@dataclass(frozen=True)
class MaxDifference:
    """The difference of largest magnitude, with its joint and time."""

    joint: int  # index, tail to head
    time_s: float  # on the common time axis
    a: float
    b: float

    @property
    def difference(self) -> float:
        """B - A."""
        return self.b - self.a


@dataclass(frozen=True)
class QuantityDifference:
    """Differences of one quantity of all joints over the common time. An unknown value is None or NaN."""

    quantity: str
    unit: str
    difference: Floats  # (n, joints), B - A; NaN where it is unknown
    rms_by_joint: Floats  # (joints,)
    max_difference_by_joint: list[MaxDifference | None]
    rms: float | None  # over all joints
    max_difference: MaxDifference | None
    # Pearson, over all joints and times; None if one of the runs is constant.
    correlation: float | None
    # Fraction of the compared values that are not finite in one of the runs, or in both.
    unknown_fraction: float

    @property
    def is_same(self) -> bool:
        """Whether every value is known in both runs, and equal."""
        return (
            self.unknown_fraction == 0
            and self.max_difference is not None
            and not self.max_difference.difference
        )


@dataclass(frozen=True)
class AdvanceComparison:
    """How far both runs advanced by the same measure, at the end of the common time."""

    measure: str
    a: TimelineSeries
    b: TimelineSeries
    at_s: float
    a_m: float
    b_m: float

    @property
    def difference_m(self) -> float:
        """B - A."""
        return self.b_m - self.a_m

    @property
    def percent(self) -> float | None:
        """B - A in percent of A: 0 if neither run moved, and None if only B moved."""
        if abs(self.a_m) < STATIONARY_THRESHOLD_M:
            neither_moved = abs(self.difference_m) < STATIONARY_THRESHOLD_M
            return 0.0 if neither_moved else None
        return 100 * self.difference_m / abs(self.a_m)


@dataclass(frozen=True)
class FirstDivergence:
    """The first time at which the angles of a joint differed by more than DIVERGENCE_THRESHOLD_RAD."""

    time_s: float
    joint: int


@dataclass(frozen=True)
class HandOvers:
    """The joints that propelled the robot, one after another, in the runs A and B.

    At any time at most one joint is the propulsion joint. A hand-over is the time at which another joint takes over.
    """

    a: list[PropulsionInterval]
    b: list[PropulsionInterval]
    unknown_reason: str = ""  # why the runs cannot be compared; empty if they can

    @property
    def common_count(self) -> int:
        """Number of hand-overs, counted from the start, that went to the same joints in both runs."""
        count = 0
        for in_a, in_b in zip(self.a, self.b, strict=False):
            if in_a.joint_index != in_b.joint_index:
                break
            count += 1
        return count

    @property
    def delays_s(self) -> list[float]:
        """Delay of B relative to A in s, for each common hand-over; negative if B was earlier."""
        common_count = self.common_count
        pairs = zip(self.a[:common_count], self.b[:common_count], strict=True)
        return [in_b.start_s - in_a.start_s for in_a, in_b in pairs]

    @property
    def has_same_order(self) -> bool:
        """Whether the runs have all hand-overs in common."""
        return self.common_count == len(self.a) == len(self.b)


@dataclass(frozen=True)
class RunDifference:
    """All results of the comparison of two runs."""

    a: RunRecord
    b: RunRecord
    joints: list[str]  # tail to head
    aligned: AlignedRuns
    identifying_settings: list[SettingDifference]
    differing_settings: list[SettingDifference]  # settings that differ
    drive_difference: str  # a sentence about drives that differ; empty if all drives are the same
    advance: AdvanceComparison | None
    # How the angle in B follows that in A; None if unknown.
    lag_and_gain_by_joint: list[LagAndGain | None]
    angle: QuantityDifference
    speed: QuantityDifference
    torque: QuantityDifference
    targets: list[QuantityDifference]  # one for each mode that was used in both at the same time
    other_mode_fraction: float  # fraction of ticks and joints whose modes differ
    # RMS of angle - target in position mode, in A and in B.
    tracking_errors_rad: tuple[float | None, float | None]
    hand_overs: HandOvers
    divergence: FirstDivergence | None

    @property
    def is_identical(self) -> bool:
        """Whether everything that was measured, commanded and reported is the same over the common time."""
        hand_overs = self.hand_overs
        if not hand_overs.unknown_reason:
            has_delays = any(abs(delay_s) > TIME_TOLERANCE_S for delay_s in hand_overs.delays_s)
            if not hand_overs.has_same_order or has_delays:
                return False
        if self.advance is not None and abs(self.advance.difference_m) >= STATIONARY_THRESHOLD_M:
            return False
        return self.other_mode_fraction == 0 and all(gap.is_same for gap in self.quantities)

    @property
    def quantities(self) -> list[QuantityDifference]:
        """The differences of all quantities that are compared joint by joint."""
        return [self.angle, self.speed, self.torque, *self.targets]


def compute_difference(a: RunRecord, b: RunRecord) -> RunDifference:
    """Compare two runs of robots with the same joints.

    Args:
        a: The first run.
        b: The second run. All differences are B - A.

    Returns:
        The comparison over the time that both runs have in common.

    Raises:
        ConfigError: The runs cannot be compared, because one has no tick or their joints differ.
    """
    _check_comparable(a, b)
    aligned = align_runs(a, b)
    joints_a = aligned.a
    joints_b = aligned.b
    time_s = aligned.time_s
    end_s = float(time_s[-1])
    same_mode = joints_a.mode == joints_b.mode  # (n, joints)
    angle = _compare_quantity("angle", "rad", time_s, joints_a.angle_rad, joints_b.angle_rad)
    speed = _compare_quantity(
        "speed", "rad/s", time_s, joints_a.velocity_rad_s, joints_b.velocity_rad_s
    )
    torque = _compare_quantity("torque", "N·m", time_s, joints_a.torque_nm, joints_b.torque_nm)
    angles_by_joint = zip(joints_a.angle_rad.T, joints_b.angle_rad.T, strict=True)
    lags_and_gains = [
        fit_lag_and_gain(time_s, angle_a, angle_b) for angle_a, angle_b in angles_by_joint
    ]
    hand_overs = HandOvers(
        _find_hand_overs_until(a, end_s),
        _find_hand_overs_until(b, end_s),
        _describe_unreported(a, b),
    )
    return RunDifference(
        a=a,
        b=b,
        joints=[joint.name for joint in a.description.joints],
        aligned=aligned,
        # What was requested.
        identifying_settings=list_identifying_settings(a, b),
        differing_settings=find_differing_settings(a, b),
        drive_difference=describe_drive_differences(a, b),
        # What was measured.
        advance=_compare_advance(a, b, end_s),
        lag_and_gain_by_joint=lags_and_gains,
        angle=angle,
        speed=speed,
        torque=torque,
        # What was commanded and reported.
        targets=_compare_targets(aligned, same_mode),
        other_mode_fraction=float(1 - same_mode.mean()),
        tracking_errors_rad=(
            _compute_tracking_error_rad(joints_a),
            _compute_tracking_error_rad(joints_b),
        ),
        hand_overs=hand_overs,
        divergence=_find_divergence(time_s, angle.difference),
    )


def _check_comparable(a: RunRecord, b: RunRecord) -> None:
    """Check that two runs have ticks, the same joints, and valid arrays.

    Args:
        a: The first run.
        b: The second run.

    Raises:
        ConfigError: A run has no tick, the joints differ, or an array is damaged.
    """
    for record in (a, b):
        if not len(record.time_s):
            raise ConfigError(
                f"{record.path / BLACK_BOX}: holds no tick, because the robot was never armed "
                f"({record.host.reason}); {record.path / 'host.log'} may explain it. "
                "Run it again, until the summary has a time",
                code="recording/never-armed",
            )
    if a.description.layout != b.description.layout:
        robots: list[str] = []
        for record in (a, b):
            joint_count = len(record.description.joints)
            robots.append(f"{record.path} has {record.description.robot} with {joint_count} joints")
        raise ConfigError(
            f"{', '.join(robots)}: their names, order or axes are not the same, so there is no joint to compare with "
            "which. Compare runs of one robot file",
            code="recording/not-comparable",
        )
    for record in (a, b):
        _check_array_shapes(record)


def _check_array_shapes(record: RunRecord) -> None:
    """Raise ConfigError for arrays of a wrong shape or type, which a damaged black box may hold."""
    tick_count = len(record.time_s)
    joint_count = len(record.description.joints)
    shapes = {
        "time_s": (tick_count,),
        "position_w_m": (tick_count, 3),
        "orientation_wxyz": (tick_count, 4),
    }
    for name in ("angle_rad", "velocity_rad_s", "torque_nm", "mode", "target"):
        shapes[name] = (tick_count, joint_count)
    for name, shape in shapes.items():
        array: NDArray[np.generic] = getattr(record, name)
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise ConfigError(
                f"{record.path / BLACK_BOX}: `{name}` holds {array.dtype} {array.shape}, not numbers {shape}: "
                f"{tick_count} ticks, {joint_count} joints. It is damaged, or not of this run; repeat the run",
                code="recording/not-readable",
            )
    if not np.isfinite(record.time_s).all() or (np.diff(record.time_s) <= 0).any():
        raise ConfigError(
            f"{record.path / BLACK_BOX}: `time_s` does not grow from tick to tick; repeat the run",
            code="recording/not-readable",
        )


def _compare_targets(
    aligned: AlignedRuns, same_mode: NDArray[np.bool_]
) -> list[QuantityDifference]:
    """Compare the targets of each mode that was used in both runs at the same time.

    Args:
        aligned: Both runs at common times.
        same_mode: (n, joints) whether the mode is the same in both runs.
    """
    gaps: list[QuantityDifference] = []
    for mode, what, unit in TARGET_QUANTITIES:
        both_in_mode = same_mode & (aligned.a.mode == mode)
        if both_in_mode.any():
            target_a = np.where(both_in_mode, aligned.a.target, np.nan)
            target_b = np.where(both_in_mode, aligned.b.target, np.nan)
            gaps.append(
                _compare_quantity(what, unit, aligned.time_s, target_a, target_b, both_in_mode)
            )
    return gaps


def _compare_quantity(
    what: str,
    unit: str,
    time_s: Floats,
    a: Floats,
    b: Floats,
    compared: NDArray[np.bool_] | None = None,
) -> QuantityDifference:
    """Compare one quantity of every joint, such as the angle, between two runs.

    A value that is not finite in one of the runs is unknown; it does not count in the RMS and the maximum.

    Args:
        what: Name of the quantity.
        unit: Unit of the quantity.
        time_s: (n,) common times, in s.
        a: (n, joints) values in A.
        b: (n, joints) values in B.
        compared: (n, joints) mask of the values that are compared; None to compare all.
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

    joint_worst = [
        _find_max_difference(joint, time_s, a, b, known) for joint in range(difference.shape[1])
    ]
    known_worst = [worst for worst in joint_worst if worst is not None]
    return QuantityDifference(
        quantity=what,
        unit=unit,
        difference=difference,
        rms_by_joint=joint_rms,
        max_difference_by_joint=joint_worst,
        rms=total_rms,
        max_difference=max(known_worst, key=lambda worst: abs(worst.difference), default=None),
        correlation=_compute_correlation(a[known], b[known]),
        unknown_fraction=float(unknown_fraction),
    )


def _find_max_difference(
    joint_index: int, time_s: Floats, a: Floats, b: Floats, known: NDArray[np.bool_]
) -> MaxDifference | None:
    """Find the largest difference of one joint; None if no value of the joint is known in both runs.

    Args:
        joint_index: Index of the joint.
        time_s: (n,) common times, in s.
        a: (n, joints) values in A.
        b: (n, joints) values in B.
        known: (n, joints) whether the value is known in both runs.
    """
    known_rows = np.flatnonzero(known[:, joint_index])
    if not len(known_rows):
        return None
    squares = (b[known_rows, joint_index] - a[known_rows, joint_index]) ** 2
    row = known_rows[np.argmax(squares)]
    return MaxDifference(
        joint_index, float(time_s[row]), float(a[row, joint_index]), float(b[row, joint_index])
    )


def _compute_correlation(a: Floats, b: Floats) -> float | None:
    """Compute Pearson's correlation, or None if one of the series is constant."""
    if len(a) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    return float(np.corrcoef(a, b)[0, 1])


def _compute_tracking_error_rad(joints: JointSeries) -> float | None:
    """Compute the RMS of angle - target over all joints in position mode; None if no value is known."""
    errors = (joints.angle_rad - joints.target)[joints.mode == JointMode.POSITION]
    errors = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else None


def _compare_advance(a: RunRecord, b: RunRecord, at_s: float) -> AdvanceComparison | None:
    """Compare the advance by a measure that both runs have; None if there is no such measure.

    The measure is the best available one of both runs if it is the same; otherwise the advance that both controllers
    reported.
    """
    for measure in (measure_distance, read_reported_distance):
        series_a = measure(a)
        series_b = measure(b)
        if series_a is None or series_b is None or series_a.label != series_b.label:
            continue
        a_m = float(np.interp(at_s, series_a.time_s, series_a.values))
        b_m = float(np.interp(at_s, series_b.time_s, series_b.values))
        return AdvanceComparison(series_a.label, series_a, series_b, at_s, a_m, b_m)
    return None


def _describe_unreported(a: RunRecord, b: RunRecord) -> str:
    """Describe why the hand-overs cannot be compared; empty if they can."""
    unreported_runs = [run for run, record in (("A", a), ("B", b)) if not record.control_states]
    if not unreported_runs:
        return ""
    return f"unknown, because nothing that control reported in {' and '.join(unreported_runs)} was recorded"


def _find_hand_overs_until(record: RunRecord, end_s: float) -> list[PropulsionInterval]:
    """Return the propulsion periods that begin within the common time."""
    return [
        period
        for period in find_propulsion_periods(record)
        if period.start_s <= end_s + TIME_TOLERANCE_S
    ]


def _find_divergence(time_s: Floats, difference_rad: Floats) -> FirstDivergence | None:
    """Find the first time at which the angles of a joint differ by more than DIVERGENCE_THRESHOLD_RAD."""
    magnitudes_rad = np.abs(np.nan_to_num(difference_rad))
    rows_beyond = np.flatnonzero((magnitudes_rad > DIVERGENCE_THRESHOLD_RAD).any(axis=1))
    if not len(rows_beyond):
        return None
    row = int(rows_beyond[0])
    return FirstDivergence(float(time_s[row]), int(np.argmax(magnitudes_rad[row])))


def format_joint_order(names: Sequence[str], periods: Sequence[PropulsionInterval]) -> str:
    """Format the names of the joints that propelled, one after another, with arrows between them."""
    if not periods:
        return "none"
    shown = " → ".join(names[period.joint_index] for period in periods[:MAX_HAND_OVERS_NAMED])
    if len(periods) > MAX_HAND_OVERS_NAMED:
        shown += " → …"
    return shown
