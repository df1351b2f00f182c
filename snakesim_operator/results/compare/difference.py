"""How two runs differ, in numbers: B - A throughout. No file, no network, no clock."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.run_log.host_record import BLACK_BOX
from snakesim_hal.wire.messages import Mode
from snakesim_operator.results.compare.alignment import SAME_INSTANT_S, Aligned, Joints, align
from snakesim_operator.results.compare.following import Following, following
from snakesim_operator.results.compare.settings import Setting, differences, drives_in_words, identity
from snakesim_operator.results.metrics.propulsion import Propulsion, propulsion_periods
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.timeline import Series, distance, reported_distance

APART_RAD = 0.05  # three degrees: a hundred times the noise of a joint's sensor, a fifth of a strong bend
NAMED = 12  # hand-overs, one after the other
STOOD_M = 0.001  # who moved less did not move: no percentage is made of that
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
    correlation: float | None  # over all joints and instants; None when one of them never changes
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
        """B - A in per cent of A. Two that stood still are equal; None when only A stood still."""
        if abs(self.a_m) < STOOD_M:
            return 0.0 if abs(self.difference_m) < STOOD_M else None
        return 100 * self.difference_m / abs(self.a_m)


@dataclass(frozen=True)
class FirstDivergence:
    """The first tick at which a joint's angles were further apart than a limit."""

    time_s: float
    joint: int


@dataclass(frozen=True)
class HandOvers:
    """Which joints propelled, in order, in either run."""

    a: list[Propulsion]
    b: list[Propulsion]
    unknown: str = ""  # why they cannot be compared

    @property
    def agreed(self) -> int:
        """So many of the first hand-overs went to the same joint."""
        pairs = zip(self.a, self.b, strict=False)
        return len(list(takewhile(lambda pair: pair[0].joint == pair[1].joint, pairs)))

    @property
    def later_s(self) -> list[float]:
        """By how much B was later, for each hand-over that agrees."""
        return [b.start_s - a.start_s for a, b in list(zip(self.a, self.b, strict=False))[: self.agreed]]

    @property
    def same_order(self) -> bool:
        """Whether all of them agree."""
        return self.agreed == len(self.a) == len(self.b)


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
    parted: FirstDivergence | None

    @property
    def identical(self) -> bool:
        """Whether all that was measured, commanded and reported is the same for all of the common time."""
        both = self.hand_overs
        if not both.unknown and (not both.same_order or any(abs(later) > SAME_INSTANT_S for later in both.later_s)):
            return False
        if self.advance is not None and abs(self.advance.difference_m) >= STOOD_M:
            return False
        return self.other_mode == 0 and all(gap.same for gap in self.gaps)

    @property
    def gaps(self) -> list[Gap]:
        """What is compared joint by joint."""
        return [self.angle, self.speed, self.torque, *self.targets]


def differ(a: RunRecord, b: RunRecord) -> Difference:
    """Compare two runs of robots with the same joints. Raises ConfigError when they cannot be compared."""
    _check(a, b)
    aligned = align(a, b)
    on_a, on_b, time_s = aligned.a, aligned.b, aligned.time_s
    until_s = float(time_s[-1])
    same_mode = on_a.mode == on_b.mode
    targets: list[Gap] = []
    for mode, what, unit in TARGETS:
        both = same_mode & (on_a.mode == mode)
        if both.any():
            a_target, b_target = (np.where(both, joints.target, np.nan) for joints in (on_a, on_b))
            targets.append(_gap(what, unit, time_s, a_target, b_target, both))
    angle = _gap("angle", "rad", time_s, on_a.angle_rad, on_b.angle_rad)
    return Difference(
        a=a,
        b=b,
        joints=[joint.name for joint in a.description.joints],
        aligned=aligned,
        compared=identity(a, b),
        settings=differences(a, b),
        drives=drives_in_words(a, b),
        advance=_advance(a, b, until_s),
        following=[following(time_s, *pair) for pair in zip(on_a.angle_rad.T, on_b.angle_rad.T, strict=True)],
        angle=angle,
        speed=_gap("speed", "rad/s", time_s, on_a.velocity_rad_s, on_b.velocity_rad_s),
        torque=_gap("torque", "N·m", time_s, on_a.torque_nm, on_b.torque_nm),
        targets=targets,
        other_mode=float(1 - same_mode.mean()),
        tracking_rad=(_tracking_rad(on_a), _tracking_rad(on_b)),
        hand_overs=HandOvers(_hand_overs(a, until_s), _hand_overs(b, until_s), _unreported(a, b)),
        parted=_parted(time_s, angle.difference),
    )


def _check(a: RunRecord, b: RunRecord) -> None:
    for record in (a, b):
        if not len(record.time_s):
            raise ConfigError(
                f"{record.folder / BLACK_BOX}: holds no tick, because the robot was never armed ({record.host.why}); "
                f"{record.folder / 'host.log'} may say more. Run it again, until the summary has a time"
            )
    if a.description.layout != b.description.layout:
        robots = [f"{r.folder} has {r.description.robot} with {len(r.description.joints)} joints" for r in (a, b)]
        raise ConfigError(
            f"{', '.join(robots)}: their names, order or axes are not the same, so there is no joint to compare with "
            "which. Compare runs of one robot file"
        )
    for record in (a, b):
        _check_shapes(record)


def _check_shapes(record: RunRecord) -> None:
    """A black box from anywhere may hold any arrays."""
    ticks, joints = len(record.time_s), len(record.description.joints)
    shapes = {"time_s": (ticks,), "position_w": (ticks, 3), "orientation_wxyz": (ticks, 4)}
    for name in ("angle_rad", "velocity_rad_s", "torque_nm", "mode", "target"):
        shapes[name] = (ticks, joints)
    for name, shape in shapes.items():
        array: NDArray[np.generic] = getattr(record, name)
        if array.shape != shape or array.dtype.kind not in "fiu":
            raise ConfigError(
                f"{record.folder / BLACK_BOX}: `{name}` holds {array.dtype} {array.shape}, wanted are numbers {shape}: "
                f"{ticks} ticks, {joints} joints. It is damaged, or not of this run; repeat the run"
            )
    if not np.isfinite(record.time_s).all() or (np.diff(record.time_s) <= 0).any():
        raise ConfigError(f"{record.folder / BLACK_BOX}: `time_s` does not grow from tick to tick; repeat the run")


def _gap(what: str, unit: str, time_s: Floats, a: Floats, b: Floats, compared: NDArray[np.bool_] | None = None) -> Gap:
    with np.errstate(invalid="ignore"):  # infinity less infinity is unknown too
        difference = b - a
    known = np.isfinite(difference)
    wanted = known.size if compared is None else int(compared.sum())
    unknown_fraction = 1 - known.sum() / wanted if wanted else 0.0
    squares = np.where(known, difference, 0.0) ** 2
    count = known.sum(axis=0)
    joint_rms = np.sqrt(np.where(count > 0, squares.sum(axis=0) / np.maximum(count, 1), np.nan))
    joint_worst: list[MaxDifference | None] = []
    for joint in range(difference.shape[1]):
        row = int(np.argmax(np.where(known[:, joint], squares[:, joint], -1.0)))
        worst = MaxDifference(joint, float(time_s[row]), float(a[row, joint]), float(b[row, joint]))
        joint_worst.append(worst if count[joint] else None)
    worst = max((one for one in joint_worst if one is not None), key=lambda one: abs(one.difference), default=None)
    rms = float(np.sqrt(squares.sum() / known.sum())) if known.any() else None
    correlation = _correlation(a[known], b[known])
    return Gap(what, unit, difference, joint_rms, joint_worst, rms, worst, correlation, float(unknown_fraction))


def _correlation(a: Floats, b: Floats) -> float | None:
    if len(a) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    return float(np.corrcoef(a, b)[0, 1])


def _tracking_rad(joints: Joints) -> float | None:
    errors = (joints.angle_rad - joints.target)[joints.mode == Mode.POSITION]
    errors = errors[np.isfinite(errors)]
    return float(np.sqrt(np.mean(errors**2))) if len(errors) else None


def _advance(a: RunRecord, b: RunRecord, at_s: float) -> Advance | None:
    """By the same measure in both, or not at all: along the route, else as both controllers knew it."""
    for measure in (distance, reported_distance):
        of_a, of_b = measure(a), measure(b)
        if of_a is not None and of_b is not None and of_a.what == of_b.what:
            ends = (float(np.interp(at_s, series.time_s, series.value)) for series in (of_a, of_b))
            return Advance(of_a.what, of_a, of_b, at_s, *ends)
    return None


def _unreported(a: RunRecord, b: RunRecord) -> str:
    silent = [run for run, record in (("A", a), ("B", b)) if not record.control]
    return f"unknown, because nothing that control reported in {' and '.join(silent)} was recorded" if silent else ""


def _hand_overs(record: RunRecord, until_s: float) -> list[Propulsion]:
    """Within the common time."""
    return [one for one in propulsion_periods(record) if one.start_s <= until_s + SAME_INSTANT_S]


def _parted(time_s: Floats, difference_rad: Floats) -> FirstDivergence | None:
    sizes = np.abs(np.nan_to_num(difference_rad))
    beyond = np.flatnonzero((sizes > APART_RAD).any(axis=1))
    if not len(beyond):
        return None
    row = int(beyond[0])
    return FirstDivergence(float(time_s[row]), int(np.argmax(sizes[row])))


def order(names: Sequence[str], turns: Sequence[Propulsion]) -> str:
    """Hand-overs in words."""
    shown = " → ".join(names[one.joint] for one in turns[:NAMED])
    return (shown + (" → …" if len(turns) > NAMED else "")) or "none"
