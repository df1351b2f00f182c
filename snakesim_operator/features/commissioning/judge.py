"""Judges each joint of a joint check: whether it is mounted as the robot file says. Pure.

Five properties of a joint are judged, each from its own evidence, and each is confirmed, wrong or unknown:

    drive   it follows its targets, and measures no torque that brakes while it drives
    order   the links on both sides of it turn, and not those of a joint whose module may be exchanged with its own
    sign    they turn in the direction in which its encoder counts
    gear    they turn as far as its encoder counts, and lose nothing when the load reverses
    zero    its angle is what gravity says, or 0 on a robot that was laid straight

What no evidence was found for is unknown, with a sentence on how it could be confirmed. It never counts as confirmed.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from snakesim_hal.model.checked import PROPERTIES, JointProperty
from snakesim_hal.model.joints import Drive
from snakesim_operator.features.commissioning.link_shares import (
    MOVES_RAD_S,
    find_order,
    link_shares,
    swap_candidates,
)
from snakesim_operator.features.commissioning.lost_motion import LostMotion, find_lost_motion
from snakesim_operator.features.commissioning.measured import Measured, Select
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD

AS_TOLD = "as the robot file says"
LEAST_MOVED_RAD = 0.012  # a fifth of the default way to one side
FOLLOWED = 0.3  # of its target's way, and of its target's time; a joint without current is moved by others, at times
NEAR = 0.12  # of a share, to the expected one
LEAST_TORQUE_NM = 0.1  # mean along the motion; a light link's inertia may be a tenth of it against the motion
STRAIGHT_RAD = 0.08  # a robot that was laid straight by hand is straight within that
LEVEL_RAD = 0.05  # gravity tells angles to that
LEAST_GRAVITY_M_S2 = 5.0  # across the axis of a joint, to tell its angle
State = Literal["confirmed", "wrong", "unknown"]


@dataclass(frozen=True)
class Finding:
    """What was found of one property of a joint."""

    state: State
    reason: str = ""  # what is wrong and what to write, or why it is unknown and how it could be confirmed
    by_hand: bool = False  # confirmed by a person


CONFIRMED = Finding("confirmed")
NO_MOTION = "it did not move; correct its drive, and run the check again"
NO_END = "its motion did not come: the run ended before; run the check again with a longer --duration"
NO_LINK_TURNS = "no link turns with it; correct its gear, and run the check again"
NO_LINK = "the links on both sides need an IMU or motion capture, at 30 Hz or more; or "
BY_DIRECTION = NO_LINK + "turn it with `snakesim joints direction`, then add --by-hand"
BY_GEAR = NO_LINK + "measure it with `snakesim joints gear`, then add --gear-by-hand"
NO_REST = "the robot did not rest before the first motion; run the check again"
NOT_STRAIGHT = "lay the robot straight, run the check again, and add --straight"


@dataclass(frozen=True)
class Judged:
    """What was found of one joint."""

    joint: str
    findings: Mapping[JointProperty, Finding]
    moved_rad: float | None = None  # by its encoder; None: its motion did not come
    turned: float | None = None  # share of that which turned up at this joint, without its drive; None: unknown
    torque_nm: float | None = None  # mean along the motion; None: not measured

    def properties(self, state: State) -> list[JointProperty]:
        """Return the properties that were found to be so."""
        return [name for name in PROPERTIES if self.findings[name].state == state]

    @property
    def as_told(self) -> bool:
        """Whether every property was confirmed."""
        return len(self.properties("confirmed")) == len(PROPERTIES)

    @property
    def verdict(self) -> str:
        """What is wrong; otherwise what is unknown; otherwise that it is as the file says."""
        if wrong := self.properties("wrong"):
            return "; ".join(self.findings[name].reason for name in wrong)
        if unknown := self.properties("unknown"):
            return f"unknown: {', '.join(unknown)}"
        return AS_TOLD

    def confirmed_by_hand(self, properties: Iterable[JointProperty]) -> "Judged":
        """Return the same with those of its unknown properties confirmed by a person. What is wrong stays wrong."""
        findings = dict(self.findings)
        for name in properties:
            if findings[name].state == "unknown":
                findings[name] = Finding("confirmed", by_hand=True)
        return replace(self, findings=findings)


def judged(
    run: Measured, *, straight: bool = False, allowed_backlash_rad: float = ALLOWED_BACKLASH_RAD
) -> list[Judged]:
    """Return what was found of every joint, tail to head.

    Args:
        run: the measurements of a joint check.
        straight: the robot lay straight at the start, so that all angles should have been zero.
        allowed_backlash_rad: as much may be lost in a gear when its load reverses.
    """
    joints = range(len(run.names))
    # A joint that brakes while it drives moves all the same, so that its links can be judged.
    motions = [link_shares(run, joint) if _followed(run, joint) else None for joint in joints]
    order = find_order(motions)
    links = [0, *(order + 1)]
    in_place = replace(
        run, link_rate_rad_s=run.link_rate_rad_s[:, links], link_force_m_s2=run.link_force_m_s2[:, links]
    )
    rows: list[Judged] = []
    for joint in joints:
        motion = motions[joint]
        torque_nm = _torque_along_motion(run, joint)
        turned = float("nan")
        findings: dict[JointProperty, Finding] = {"drive": _judge_drive(run, joint, torque_nm)}
        if order[joint] != joint:
            other = run.names[int(order[joint])]
            findings["order"] = Finding("wrong", f"moves the link of {other}: their ids or cables are swapped")
            after = f"judged once the ids of {run.names[joint]} and {other} are right; run the check again then"
            findings |= dict.fromkeys(("sign", "gear", "zero"), Finding("unknown", after))
        elif motion is None:
            why = NO_MOTION if run.moved_by_target(joint).any() else NO_END
            findings |= dict.fromkeys(("order", "sign", "gear"), Finding("unknown", why))
            findings["zero"] = _judge_zero(in_place, joint, straight=straight)
        else:
            turned = float(motion.with_modules(order).turned()[joint])
            candidates = [run.names[other] for other in swap_candidates(motions, order, joint)]
            lost = find_lost_motion(in_place, joint)
            findings["order"] = _judge_order(turned, candidates)
            findings["sign"] = _judge_sign(turned, run.drives[joint])
            findings["gear"] = _judge_gear(turned, lost, run.drives[joint], allowed_backlash_rad)
            findings["zero"] = _judge_zero(in_place, joint, straight=straight)
        rows.append(
            Judged(
                joint=run.names[joint],
                findings=findings,
                moved_rad=run.moved_rad(joint) if run.moved_by_target(joint).any() else None,
                turned=None if np.isnan(turned) else turned,
                torque_nm=torque_nm,
            )
        )
    return rows


def _followed(run: Measured, joint: int) -> bool:
    """Return whether a joint's encoder followed its target."""
    moved = run.moved_by_target(joint)
    if not moved.any():
        return False
    way_rad = float(np.ptp(run.target_rad[moved, joint]))
    moves = np.abs(run.velocity_rad_s[moved, joint]) > MOVES_RAD_S
    return run.moved_rad(joint) >= max(LEAST_MOVED_RAD, FOLLOWED * way_rad) and bool(np.mean(moves) >= FOLLOWED)


def _torque_along_motion(run: Measured, joint: int) -> float | None:
    """Return the mean of a joint's torque, positive where it drives; None where it is not measured."""
    moves = run.moved_by_target(joint) & (np.abs(run.velocity_rad_s[:, joint]) > MOVES_RAD_S)
    if "torque" not in run.drives[joint].measures or not moves.any():
        return None
    return float(np.mean(run.torque_nm[moves, joint] * np.sign(run.velocity_rad_s[moves, joint])))


def _judge_drive(run: Measured, joint: int, torque_nm: float | None) -> Finding:
    if not run.moved_by_target(joint).any():
        return Finding("unknown", NO_END)
    if not _followed(run, joint):
        return Finding("wrong", "did not move: motor, brake, power, or a link that is held")
    if torque_nm is not None and torque_nm < -LEAST_TORQUE_NM:
        return Finding("wrong", "its torque has the wrong sign: it measures a brake while it drives")
    return CONFIRMED


def _judge_order(turned: float, candidates: Sequence[str]) -> Finding:
    """Judge whether a joint's module is in its place. candidates: joints whose modules may be there instead."""
    if abs(turned) < NEAR:
        return Finding("unknown", NO_LINK_TURNS)
    if candidates:
        return Finding("unknown", f"its module may be exchanged with that of {', '.join(candidates)}: {BY_DIRECTION}")
    return CONFIRMED


def _judge_sign(turned: float, drive: Drive) -> Finding:
    if np.isnan(turned):
        return Finding("unknown", BY_DIRECTION)
    if abs(turned) < NEAR:
        return Finding("unknown", NO_LINK_TURNS)
    if turned < 0:
        return Finding("wrong", f"turns the other way: sign = {-drive.sign}")
    return CONFIRMED


def _judge_gear(turned: float, lost: LostMotion | None, drive: Drive, allowed_backlash_rad: float) -> Finding:
    if np.isnan(turned):
        return Finding("unknown", BY_GEAR)
    if abs(turned) < NEAR:
        return Finding("wrong", "its drive turns and no link does: coupling, a gear that slips, or backlash")
    ratio = abs(turned)
    reasons: list[str] = []
    if lost is not None and lost.lost_rad > max(allowed_backlash_rad, lost.noise_rad):
        ratio = abs(lost.ratio)
        found = f"{lost.lost_rad:.3f} rad ({np.rad2deg(lost.lost_rad):.1f} degrees)"
        reasons.append(
            f"backlash of {found}: its drive turns that much further than its link when the load reverses, "
            f"{allowed_backlash_rad:g} rad are allowed; repair the gear, or allow more with --allow-backlash"
        )
    if abs(ratio - 1) >= NEAR:
        backlash = ", or backlash, as it moved to one side only or its gyros are noisy" if lost is None else ""
        reasons.append(f"turns {ratio:.2f} as far as its drive says: gear = {drive.gear / ratio:.3g}{backlash}")
    return Finding("wrong", "; ".join(reasons)) if reasons else CONFIRMED


def _judge_zero(run: Measured, joint: int, *, straight: bool) -> Finding:
    """Judge a joint's zero by gravity if that tells its angle, otherwise by the pose in which the robot was laid."""
    at_rest = run.at_rest()
    by_gravity_rad = _angle_by_gravity(run, joint, at_rest) if run.axes[joint] == "pitch" else None
    if by_gravity_rad is not None:
        off_rad = float(np.mean(run.angle_rad[at_rest, joint])) - by_gravity_rad
        allowed_rad = LEVEL_RAD
    elif not straight:
        return Finding("unknown", NOT_STRAIGHT)
    elif not run.before_motion().any():
        return Finding("unknown", NO_REST)
    else:
        off_rad = float(np.mean(run.angle_rad[run.before_motion(), joint]))
        allowed_rad = STRAIGHT_RAD
    if abs(off_rad) <= allowed_rad:
        return CONFIRMED
    drive = run.drives[joint]
    zero_rad = drive.zero_rad + drive.sign * drive.gear * off_rad
    return Finding("wrong", f"its zero is off by {off_rad:+.3f} rad: zero_rad = {zero_rad:.3f}")


def _angle_by_gravity(run: Measured, joint: int, at_rest: Select) -> float | None:
    """Return a pitch joint's angle from the direction of gravity in both of its links; None where that is not known."""
    tilts: list[float] = []
    for link in (joint, joint + 1):
        forces = run.link_force_m_s2[at_rest, link]
        known = forces[~np.isnan(forces[:, 0])]
        if not len(known):
            return None
        x, _, z = np.mean(known, axis=0)
        if np.hypot(x, z) <= LEAST_GRAVITY_M_S2:
            return None
        tilts.append(float(np.arctan2(x, z)))
    difference_rad = tilts[0] - tilts[1]
    return float(np.arctan2(np.sin(difference_rad), np.cos(difference_rad)))
