"""Judges each joint of a joint check: whether the link ahead of it turns as its encoder says. Pure.

While joint j moves, every link is asked how far it turned, as a share of joint j's own motion by its encoder: by its
gyro, or by motion capture for the base, each at the instants of its own samples. The difference of the shares of the
links on both sides of joint k is what turned up at joint k. On a robot that is as its file says, that is 1 at k = j,
and elsewhere only what the encoder there saw, too, because held joints give way a little.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.arrays import Floats
from snakesim_hal.model.joints import Drive

LEAST_MOVED_RAD = 0.012  # a third of the default way
FOLLOWED = 0.3  # of its target's way, and of its target's time; a joint without current is moved by others, at times
MOVES_RAD_S = 0.02  # slower samples tell nothing
LEAST_SAMPLES = 8
NEAR = 0.12  # of a share, to the expected one
MISFIT = 0.1  # sum of squared shares that no IMU should have seen, from which two modules may have been swapped
BETTER = 0.25  # of the misfit is left, if they were
LEAST_TORQUE_NM = 0.1
STRAIGHT_RAD = 0.08  # a robot that was laid straight by hand is straight within that
LEVEL_RAD = 0.05  # gravity tells angles to that
LEAST_GRAVITY_M_S2 = 5.0  # across the axis of a joint, to tell its angle
UNKNOWN = "unknown: the links on both sides need an IMU or motion capture, at 30 Hz or more"


@dataclass(frozen=True)
class Measured:
    """A run of the joint check; rows are ticks."""

    names: Sequence[str]
    axes: Sequence[str]  # "yaw" or "pitch"
    drives: Sequence[Drive]  # as the robot file says
    angle_rad: Floats  # (n, joints)
    velocity_rad_s: Floats
    torque_nm: Floats
    target_rad: Floats
    link_rate_rad_s: Floats  # (n, links, 3), in the link's frame; NaN where no IMU reported
    link_force_m_s2: Floats  # (n, links, 3): specific force, in the link's frame; at rest 1 g upwards
    base_turn_rad: Floats  # (n, 3): of link 0 from its first known pose, in its frame; NaN without motion capture


@dataclass(frozen=True)
class Judged:
    """What is said of one joint."""

    joint: str
    verdict: str
    as_told: bool = False
    moved_rad: float | None = None  # by its encoder; None: it was not its turn
    turned: float | None = None  # share of that which turned up at this joint, without its drive; None: unknown

    @property
    def unknown(self) -> bool:
        """Whether nothing was found wrong, and nothing right."""
        return self.verdict == UNKNOWN


@dataclass(frozen=True)
class _Motion:
    """What was measured while one joint moved, as shares of that joint's motion by its encoder; NaN: unknown."""

    links: Floats  # (links, joints): of each link, about the axis of each joint
    seen: Floats  # (joints,): in each joint's encoder

    def turned(self) -> Floats:
        """(joints,): what turned up at each joint, from the links on both sides of it."""
        return np.diagonal(self.links[1:]) - np.diagonal(self.links)

    def with_modules(self, order: NDArray[np.intp]) -> "_Motion":
        """The module of joint order[i] in joint i's place: its encoder, and its IMU, on the link ahead of the joint."""
        return _Motion(self.links[[0, *(order + 1)]], self.seen[order])

    def misfit(self) -> float:
        """What the IMUs saw otherwise than the encoders."""
        return float(np.nansum((self.turned() - self.seen) ** 2))


def judged(run: Measured, *, straight: bool = False) -> list[Judged]:
    """Every joint, tail to head. straight: the robot lay straight at the start, so all angles should have been zero."""
    motions = [_motion(run, j) for j in range(len(run.names))]
    order = _order(motions)
    rows: list[Judged] = []
    for j, (motion, k) in enumerate(zip(motions, order.tolist(), strict=True)):
        if isinstance(motion, Judged):
            rows.append(motion)
        elif k != j:
            said = f"moves the link of {run.names[k]}: their ids or cables are swapped"
            rows.append(Judged(run.names[j], said, False, _moved_rad(run, j)))
        else:
            rows.append(_judge(run, j, motion.with_modules(order), straight=straight))
    return rows


def _judge(run: Measured, j: int, motion: _Motion, *, straight: bool) -> Judged:
    turned = float(motion.turned()[j])
    verdict = _verdict(turned, run.drives[j])
    if not verdict:
        verdict = _zero(run, j, straight=straight)
    known = None if np.isnan(turned) else turned
    return Judged(run.names[j], verdict or "as the robot file says", not verdict, _moved_rad(run, j), known)


def _motion(run: Measured, j: int) -> _Motion | Judged:
    """What links and encoders did while joint j moved, or why that says nothing."""
    name, turn, speed = run.names[j], _turn_of(run, j), run.velocity_rad_s[:, j]
    if not turn.any():
        return Judged(name, "its turn did not come: the run ended before")
    moved_rad, moves = _moved_rad(run, j), turn & (np.abs(speed) > MOVES_RAD_S)
    way_rad = float(np.ptp(run.target_rad[turn, j]))
    if moved_rad < max(LEAST_MOVED_RAD, FOLLOWED * way_rad) or np.mean(moves[turn]) < FOLLOWED:
        return Judged(name, "did not move: motor, brake, power, or a link that is held", moved_rad=moved_rad)
    if float(np.mean(run.torque_nm[moves, j] * np.sign(speed[moves]))) < -LEAST_TORQUE_NM:
        return Judged(name, "its torque has the wrong sign: it measures a brake while it drives", moved_rad=moved_rad)
    seen = np.array([_share(rate, speed, moves) for rate in run.velocity_rad_s.T])
    return _Motion(_link_shares(run, j, turn, moves), seen)


def _moved_rad(run: Measured, j: int) -> float:
    return float(np.ptp(run.angle_rad[_turn_of(run, j), j]))


def _turn_of(run: Measured, j: int) -> NDArray[np.bool_]:
    return np.abs(run.target_rad[:, j] - np.median(run.target_rad[:, j])) > 1e-6


def _link_shares(run: Measured, j: int, turn: NDArray[np.bool_], moves: NDArray[np.bool_]) -> Floats:
    """(links, joints): how much of joint j's motion each link made about the axis of each joint; NaN: unknown.

    A joint's axis is the same in both of its links' frames, so that their shares about it may be subtracted.
    """
    component = [2 if axis == "yaw" else 1 for axis in run.axes]
    speed, angle = run.velocity_rad_s[:, j], run.angle_rad[:, j]
    by_axis = {at: [_share(rate, speed, moves) for rate in run.link_rate_rad_s[:, :, at].T] for at in set(component)}
    shares = np.array([by_axis[at] for at in component]).T
    if np.isnan(shares[0]).all():
        shares[0] = [
            _share(_about_mean(run.base_turn_rad[:, at], turn), _about_mean(angle, turn), turn) for at in component
        ]
    return shares


def _about_mean(signal: Floats, where: NDArray[np.bool_]) -> Floats:
    return signal - np.mean(signal[where])


def _share(rate: Floats, speed: Floats, moves: NDArray[np.bool_]) -> float:
    """Least squares: how much of `speed` is in `rate`; NaN when too little was measured."""
    known = moves & ~np.isnan(rate)
    if known.sum() < LEAST_SAMPLES:
        return float("nan")
    return float(rate[known] @ speed[known] / (speed[known] @ speed[known]))


def _order(motions: Sequence[_Motion | Judged]) -> NDArray[np.intp]:
    """Whose module stands in the place of each joint's: swaps of two, as long as one makes the motions of both fit.

    Motions are asked together: one alone may tell little, when the floor lets few links turn.
    """
    order = np.arange(len(motions))
    pairs = [(j, k) for j in range(len(motions)) for k in range(j + 1, len(motions))]
    while pairs:
        fits = [_misfit(motions, _with_swap(order, *pair)) for pair in pairs]
        best = pairs[int(np.argmin(fits))]
        swapped, own = _with_swap(order, *best), [motions[j] for j in best]
        before = _misfit(own, order)
        if before < MISFIT or _misfit(own, swapped) > BETTER * before:
            break
        order = swapped
        pairs = [pair for pair in pairs if not {*pair} & {*best}]
    return order


def _misfit(motions: Sequence[_Motion | Judged], order: NDArray[np.intp]) -> float:
    return sum(motion.with_modules(order).misfit() for motion in motions if isinstance(motion, _Motion))


def _with_swap(order: NDArray[np.intp], j: int, k: int) -> NDArray[np.intp]:
    swapped = order.copy()
    swapped[[j, k]] = order[[k, j]]
    return swapped


def _verdict(turned: float, drive: Drive) -> str:
    """What is wrong with its sign or gear; empty: nothing."""
    if np.isnan(turned):
        return UNKNOWN
    if abs(turned - 1) < NEAR:
        return ""
    if abs(turned) < NEAR:
        return "its drive turns and no link does: coupling, or a gear that slips"
    way = "the other way" if turned < 0 else ""
    far = "" if abs(abs(turned) - 1) < NEAR else f"{abs(turned):.2f} as far as its drive says"
    sign = f"sign = {-drive.sign}" if way else ""
    gear = f"gear = {drive.gear / abs(turned):.3g}" if far else ""
    return f"turns {', '.join(filter(None, (way, far)))}: {', '.join(filter(None, (sign, gear)))}"


def _zero(run: Measured, j: int, *, straight: bool) -> str:
    """What is wrong with its zero; empty: nothing, or nothing that could be told."""
    at_rest = ~np.logical_or.reduce([_turn_of(run, k) for k in range(len(run.names))])
    drive, measured_rad = run.drives[j], float(np.mean(run.angle_rad[at_rest, j]))
    expected_rad = _by_gravity(run, j, at_rest) if run.axes[j] == "pitch" else None
    allowed_rad = LEVEL_RAD
    if expected_rad is None:
        if not straight:
            return ""
        expected_rad, allowed_rad = 0.0, STRAIGHT_RAD
    off_rad = measured_rad - expected_rad
    if abs(off_rad) <= allowed_rad:
        return ""
    return f"its zero is off by {off_rad:+.3f} rad: zero_rad = {drive.zero_rad + drive.sign * drive.gear * off_rad:.3f}"


def _by_gravity(run: Measured, j: int, at_rest: NDArray[np.bool_]) -> float | None:
    """A pitch joint's angle from the direction of gravity in both of its links; None where that is not known."""
    tilts: list[float] = []
    for link in (j, j + 1):
        x, _, z = _mean(run.link_force_m_s2[at_rest, link])
        if not np.hypot(x, z) > LEAST_GRAVITY_M_S2:
            return None
        tilts.append(float(np.arctan2(x, z)))
    return float(np.arctan2(np.sin(tilts[0] - tilts[1]), np.cos(tilts[0] - tilts[1])))


def _mean(rows: Floats) -> Floats:
    known = rows[~np.isnan(rows[:, 0])]
    return np.mean(known, axis=0) if len(known) else np.full(3, np.nan)
