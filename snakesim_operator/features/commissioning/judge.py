"""Judges each joint of a joint check: whether its mounting matches the robot file. Pure.

Five properties of a joint are judged, each from its own evidence, and each is confirmed, wrong or unknown:

    drive   it follows its targets, and measures no torque that brakes while it drives
    order   the links on both sides of it turn, and not those of a joint whose module may be exchanged with its own
    sign    they turn in the direction in which its encoder counts
    gear    they turn as far as its encoder counts, and lose nothing when the load reverses
    zero    its angle agrees with gravity, or is 0 on a robot that was laid straight

A property without evidence is unknown, with a sentence on how it could be confirmed. It never counts as confirmed.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from snakesim_hal.model.checked import PROPERTIES, JointProperty
from snakesim_hal.model.joints import Drive
from snakesim_operator.features.commissioning.link_shares import (
    MIN_RATE_RAD_S,
    LinkShares,
    Order,
    find_order,
    measure_link_shares,
    swap_candidates,
)
from snakesim_operator.features.commissioning.lost_motion import LostMotion, find_lost_motion
from snakesim_operator.features.commissioning.measured import CheckMeasurements, Select
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD

AS_IN_FILE = "matches the robot file"
MIN_MOVED_RAD = 0.012  # a fifth of the default motion to one side
MIN_FOLLOWED_FRACTION = 0.3  # of its target's range and time; other joints move one without current at times
MAX_RATIO_ERROR = 0.12  # between the fraction of the motion that the links made and the expected one
MIN_TORQUE_NM = 0.1  # mean along the motion; a light link's inertia may be a tenth of it against the motion
STRAIGHT_RAD = 0.08  # a robot that was laid straight by hand is straight within that
LEVEL_RAD = 0.05  # accuracy of an angle from the direction of gravity
MIN_GRAVITY_M_S2 = 5.0  # across the axis of a joint; with less, gravity does not give its angle
State = Literal["confirmed", "wrong", "unknown"]


@dataclass(frozen=True)
class PropertyFinding:
    """Whether one property of a joint matches the robot file."""

    state: State
    reason: str = ""  # what is wrong and what to write, or why it is unknown and how it could be confirmed
    by_hand: bool = False  # confirmed by a person


CONFIRMED = PropertyFinding("confirmed")
NO_MOTION = "it did not move; correct its drive, and run the check again"
NO_END = "its motion did not come: the run ended before; run the check again with a longer --duration"
NO_LINK_TURNS = "no link turns with it; correct its gear, and run the check again"
NO_LINK = "the links on both sides need an IMU or motion capture, at 30 Hz or more; or "
BY_DIRECTION = NO_LINK + "turn it with `snakesim robot calibrate direction`, then add --by-hand"
BY_GEAR = NO_LINK + "measure it with `snakesim robot calibrate gear`, then add --gear-by-hand"
NO_REST = "the robot did not rest before the first motion; run the check again"
NOT_STRAIGHT = "lay the robot straight, run the check again, and add --straight"


@dataclass(frozen=True)
class JointVerdict:
    """The findings on one joint."""

    joint: str
    findings: Mapping[JointProperty, PropertyFinding]
    moved_rad: float | None = None  # by its encoder; None: it was not moved
    turned: float | None = None  # fraction of that which the links made at this joint; None: unknown
    torque_nm: float | None = None  # mean along the motion; None: not measured

    def properties(self, state: State) -> list[JointProperty]:
        """Return the properties in this state."""
        return [name for name in PROPERTIES if self.findings[name].state == state]

    @property
    def all_confirmed(self) -> bool:
        """Whether every property was confirmed."""
        return len(self.properties("confirmed")) == len(PROPERTIES)

    @property
    def summary(self) -> str:
        """What is wrong; otherwise what is unknown; otherwise that it matches the file."""
        wrong = self.properties("wrong")
        if wrong:
            return "; ".join(self.findings[name].reason for name in wrong)
        unknown = self.properties("unknown")
        if unknown:
            return f"unknown: {', '.join(unknown)}"
        return AS_IN_FILE

    def confirmed_by_hand(self, properties: Iterable[JointProperty]) -> "JointVerdict":
        """Return the same with those of its unknown properties confirmed by a person. What is wrong stays wrong."""
        findings = dict(self.findings)
        for name in properties:
            if findings[name].state == "unknown":
                findings[name] = PropertyFinding("confirmed", by_hand=True)
        return replace(self, findings=findings)


def judge_joints(
    run: CheckMeasurements, *, straight: bool = False, allowed_backlash_rad: float = ALLOWED_BACKLASH_RAD
) -> list[JointVerdict]:
    """Judge every joint, tail to head.

    Args:
        run: the measurements of a joint check.
        straight: the robot lay straight at the start, so that all angles should have been zero.
        allowed_backlash_rad: motion that may be lost in a gear when its load reverses.
    """
    judge = _JointJudge(run, straight=straight, allowed_backlash_rad=allowed_backlash_rad)
    return [judge.judge(joint) for joint in range(len(run.names))]


class _JointJudge:
    """Judges the joints of one run, with what all of their motions tell together."""

    def __init__(self, run: CheckMeasurements, *, straight: bool, allowed_backlash_rad: float) -> None:
        """Measure the motion of the links for each joint, and find modules whose ids are swapped.

        Args:
            run: measurements of the joint check.
            straight: whether a person states that the robot lay straight at the start.
            allowed_backlash_rad: largest backlash that is not judged as wrong.
        """
        self._run = run
        self._straight = straight
        self._allowed_backlash_rad = allowed_backlash_rad
        # A joint that brakes while it drives moves all the same, so its links can be judged.
        self._motions: list[LinkShares | None] = [
            measure_link_shares(run, joint) if _followed_target(run, joint) else None for joint in range(len(run.names))
        ]
        self._order: Order = find_order(self._motions)
        links = [0, *(self._order + 1)]
        self._run_in_place = replace(  # every IMU on the link on which its module really is
            run, link_rate_rad_s=run.link_rate_rad_s[:, links], link_force_m_s2=run.link_force_m_s2[:, links]
        )

    def judge(self, joint: int) -> JointVerdict:
        """Judge all properties of a joint."""
        run = self._run
        torque_nm = _mean_driving_torque(run, joint)
        turned = self._fraction_turned(joint)
        moved_rad = None
        if run.moved_by_target(joint).any():
            moved_rad = run.moved_rad(joint)
        return JointVerdict(
            joint=run.names[joint],
            findings={"drive": _judge_drive(run, joint, torque_nm), **self._judge_mounting(joint, turned)},
            moved_rad=moved_rad,
            turned=None if np.isnan(turned) else turned,
            torque_nm=torque_nm,
        )

    def _fraction_turned(self, joint: int) -> float:
        """Return the fraction of a joint's motion that its links made; NaN if it is unknown."""
        motion = self._motions[joint]
        if motion is None or self._order[joint] != joint:
            return float("nan")
        return float(motion.with_modules(self._order).motion_at_joints()[joint])

    def _judge_mounting(self, joint: int, turned: float) -> dict[JointProperty, PropertyFinding]:
        """Judge how the module of a joint is mounted: its order, sign, gear and zero.

        Args:
            joint: Index of the joint.
            turned: Motion of the links divided by the motion that the encoder measured, with its sign; NaN if unknown.
        """
        if self._order[joint] != joint:
            return self._findings_on_swapped(joint)
        zero = _judge_zero(self._run_in_place, joint, straight=self._straight)
        if self._motions[joint] is None:
            was_commanded = self._run.moved_by_target(joint).any()
            unknown = PropertyFinding("unknown", NO_MOTION if was_commanded else NO_END)
            return {"order": unknown, "sign": unknown, "gear": unknown, "zero": zero}
        drive = self._run.drives[joint]
        candidates = [self._run.names[other] for other in swap_candidates(self._motions, self._order, joint)]
        lost = find_lost_motion(self._run_in_place, joint)
        return {
            "order": _judge_order(turned, candidates),
            "sign": _judge_sign(turned, drive),
            "gear": _judge_gear(turned, lost, drive, self._allowed_backlash_rad),
            "zero": zero,
        }

    def _findings_on_swapped(self, joint: int) -> dict[JointProperty, PropertyFinding]:
        """Return the findings on a joint whose module is in another joint's place."""
        names = self._run.names
        other = names[int(self._order[joint])]
        unknown = PropertyFinding(
            "unknown", f"judged once the ids of {names[joint]} and {other} are right; run the check again then"
        )
        return {
            "order": PropertyFinding("wrong", f"moves the link of {other}: their ids or cables are swapped"),
            "sign": unknown,
            "gear": unknown,
            "zero": unknown,
        }


def _followed_target(run: CheckMeasurements, joint: int) -> bool:
    """Return whether a joint's encoder followed its target."""
    commanded = run.moved_by_target(joint)
    if not commanded.any():
        return False
    target_range_rad = float(np.ptp(run.target_rad[commanded, joint]))
    is_moving = np.abs(run.velocity_rad_s[commanded, joint]) > MIN_RATE_RAD_S
    moved_far_enough = run.moved_rad(joint) >= max(MIN_MOVED_RAD, MIN_FOLLOWED_FRACTION * target_range_rad)
    moved_long_enough = bool(np.mean(is_moving) >= MIN_FOLLOWED_FRACTION)
    return moved_far_enough and moved_long_enough


def _mean_driving_torque(run: CheckMeasurements, joint: int) -> float | None:
    """Return the mean of a joint's torque, positive where it drives; None if it is not measured."""
    velocity = run.velocity_rad_s[:, joint]
    is_moving = run.moved_by_target(joint) & (np.abs(velocity) > MIN_RATE_RAD_S)
    if "torque" not in run.drives[joint].measures or not is_moving.any():
        return None
    return float(np.mean(run.torque_nm[is_moving, joint] * np.sign(velocity[is_moving])))


def _judge_drive(run: CheckMeasurements, joint: int, torque_nm: float | None) -> PropertyFinding:
    """Judge whether a joint's drive moves it. torque_nm: mean along the motion; None: not measured."""
    if not run.moved_by_target(joint).any():
        return PropertyFinding("unknown", NO_END)
    if not _followed_target(run, joint):
        return PropertyFinding("wrong", "did not move: motor, brake, power, or a link that is held")
    if torque_nm is not None and torque_nm < -MIN_TORQUE_NM:
        return PropertyFinding("wrong", "its torque has the wrong sign: it measures a brake while it drives")
    return CONFIRMED


def _judge_order(turned: float, candidates: Sequence[str]) -> PropertyFinding:
    """Judge whether a joint's module is in its place. candidates: joints whose modules may be there instead."""
    if abs(turned) < MAX_RATIO_ERROR:
        return PropertyFinding("unknown", NO_LINK_TURNS)
    if candidates:
        return PropertyFinding(
            "unknown", f"its module may be exchanged with that of {', '.join(candidates)}: {BY_DIRECTION}"
        )
    return CONFIRMED


def _judge_sign(turned: float, drive: Drive) -> PropertyFinding:
    """Judge whether a joint's links turn in the direction in which its encoder counts."""
    if np.isnan(turned):
        return PropertyFinding("unknown", BY_DIRECTION)
    if abs(turned) < MAX_RATIO_ERROR:
        return PropertyFinding("unknown", NO_LINK_TURNS)
    if turned < 0:
        return PropertyFinding("wrong", f"turns the other way: sign = {-drive.sign}")
    return CONFIRMED


def _judge_gear(turned: float, lost: LostMotion | None, drive: Drive, allowed_backlash_rad: float) -> PropertyFinding:
    """Judge whether a joint's links turn as far as its encoder measures.

    Args:
        turned: Motion of the links divided by the motion that the encoder measured, with its sign; NaN if unknown.
        lost: Backlash of the joint; None if it is not known.
        drive: The drive as the robot file has it.
        allowed_backlash_rad: Largest backlash that is not judged as wrong.
    """
    if np.isnan(turned):
        return PropertyFinding("unknown", BY_GEAR)
    ratio = abs(turned)
    if ratio < MAX_RATIO_ERROR:
        return PropertyFinding("wrong", "its drive turns and no link does: coupling, a gear that slips, or backlash")
    reasons: list[str] = []
    if lost is not None and lost.lost_rad > max(allowed_backlash_rad, lost.noise_rad):
        ratio = abs(lost.ratio)  # not reduced by the backlash
        backlash = f"{lost.lost_rad:.3f} rad ({np.rad2deg(lost.lost_rad):.1f} degrees)"
        reasons.append(
            f"backlash of {backlash}: its drive turns that much further than its link when the load reverses, "
            f"{allowed_backlash_rad:g} rad are allowed; repair the gear, or allow more with --allow-backlash"
        )
    if abs(ratio - 1) >= MAX_RATIO_ERROR:
        other_cause = ""
        if lost is None:
            other_cause = ", or backlash, as it moved to one side only or its gyros are noisy"
        reasons.append(f"turns {ratio:.2f} as far as its drive measures: gear = {drive.gear / ratio:.3g}{other_cause}")
    if reasons:
        return PropertyFinding("wrong", "; ".join(reasons))
    return CONFIRMED


def _judge_zero(run: CheckMeasurements, joint: int, *, straight: bool) -> PropertyFinding:
    """Judge whether the zero of a joint's angle in the robot file is right.

    If accelerometers measure the joint's angle by gravity, the encoder is compared with it. Otherwise it is compared
    with zero, if the robot was laid straight.

    Args:
        run: Measurements of the check.
        joint: Index of the joint.
        straight: Whether a person states that the robot lay straight at the start.

    Returns:
        Confirmed, wrong with the zero to write into the robot file, or unknown with the reason.
    """
    at_rest = run.at_rest()
    before_motion = run.before_motion()
    angle_by_gravity_rad = None
    if run.axes[joint] == "pitch":
        angle_by_gravity_rad = _angle_by_gravity(run, joint, at_rest)
    if angle_by_gravity_rad is not None:
        error_rad = float(np.mean(run.angle_rad[at_rest, joint])) - angle_by_gravity_rad
        allowed_rad = LEVEL_RAD
    elif not straight:
        return PropertyFinding("unknown", NOT_STRAIGHT)
    elif not before_motion.any():
        return PropertyFinding("unknown", NO_REST)
    else:
        error_rad = float(np.mean(run.angle_rad[before_motion, joint]))
        allowed_rad = STRAIGHT_RAD
    if abs(error_rad) <= allowed_rad:
        return CONFIRMED
    drive = run.drives[joint]
    zero_rad = drive.zero_rad + drive.sign * drive.gear * error_rad
    return PropertyFinding("wrong", f"its zero is off by {error_rad:+.3f} rad: zero_rad = {zero_rad:.3f}")


def _angle_by_gravity(run: CheckMeasurements, joint: int, at_rest: Select) -> float | None:
    """Return a pitch joint's angle from the direction of gravity in both of its links; None if that is not known."""
    tilts_rad: list[float] = []
    for link in (joint, joint + 1):
        forces = run.link_force_m_s2[at_rest, link]
        known = forces[~np.isnan(forces[:, 0])]
        if not len(known):
            return None
        x, _, z = np.mean(known, axis=0)
        if np.hypot(x, z) <= MIN_GRAVITY_M_S2:
            return None
        tilts_rad.append(float(np.arctan2(x, z)))
    difference_rad = tilts_rad[0] - tilts_rad[1]
    return float(np.arctan2(np.sin(difference_rad), np.cos(difference_rad)))
