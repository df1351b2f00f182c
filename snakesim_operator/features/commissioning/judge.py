"""Judges each joint of a joint check: whether its mounting matches the robot file. Pure.

Five properties of a joint are judged, each from its own evidence, and each is confirmed, wrong or unknown:

    drive   it follows its targets, its encoder does not stick, and it measures no torque that brakes while it drives
    order   the links on both sides of it turn, and not those of a joint whose module may be exchanged with its own
    sign    they turn in the direction in which its encoder counts
    gear    they turn as far as its encoder counts, and lose nothing when the load reverses; without IMUs, the torque
            shows backlash and a coupling that slips, but not the ratio
    zero    its angle agrees with gravity, or is 0 on a robot that was laid straight

A property without evidence is unknown, with a sentence on how it could be confirmed. It never counts as confirmed.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from snakesim_hal.model.checked import PROPERTIES, JointProperty
from snakesim_hal.model.joints import JointDrive
from snakesim_operator.features.commissioning.encoder_dead_zone import find_dead_zone_rad
from snakesim_operator.features.commissioning.gear_play import GearPlay, judge_gear_plays
from snakesim_operator.features.commissioning.link_shares import (
    MIN_RATE_RAD_S,
    LinkMotionFractions,
    ModuleOrder,
    find_module_order,
    find_swap_candidates,
    measure_link_motion_fractions,
)
from snakesim_operator.features.commissioning.load_response import measure_load_response
from snakesim_operator.features.commissioning.lost_motion import (
    LostMotion,
    measure_lost_motion,
    measure_small_motion_ratio,
)
from snakesim_operator.features.commissioning.measured import CheckMeasurements, Mask
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD

MATCHES_FILE = "matches the robot file"
MIN_MOVED_RAD = 0.012  # a fifth of the default motion to one side
# Of its target's range and time; other joints move one without current at times.
MIN_FOLLOWED_FRACTION = 0.3
# Between the fraction of the motion that the links made and the expected one.
MAX_RATIO_ERROR = 0.12
MIN_SLIPPING_RATIO = 0.5  # of link and drive in the small motion; within backlash it is near 0
# Mean along the motion; a light link's inertia may be a tenth of it against the motion.
MIN_TORQUE_NM = 0.1
MAX_STRAIGHT_ERROR_RAD = 0.08  # a robot that was laid straight by hand is straight within that
MAX_GRAVITY_ERROR_RAD = 0.05  # accuracy of an angle from the direction of gravity
MIN_GRAVITY_M_S2 = 5.0  # across the axis of a joint; with less, gravity does not give its angle
PropertyState = Literal["confirmed", "wrong", "unknown"]


@dataclass(frozen=True)
class PropertyFinding:
    """Whether one property of a joint matches the robot file."""

    state: PropertyState
    # What is wrong and what to write, or why it is unknown and how it could be confirmed.
    reason: str = ""
    by_hand: bool = False  # confirmed by a person
    by_shape: bool = False  # confirmed by drawn shapes
    # False: unknown because of backlash, which drawn shapes do not show.
    shapes_suffice: bool = True


CONFIRMED = PropertyFinding("confirmed")
NO_MOTION = "it did not move; correct its drive, and run the check again"
NO_END = (
    "its motion did not come: the run ended before; run the check again with a longer --duration"
)
NO_LINK_TURNS = "no link turns with it; correct its gear, and run the check again"
NO_LINK = (
    "the links on both sides need an IMU or motion capture, at 30 Hz or more; or check the robot with "
    "`snakesim robot shape check`; or "
)
CONFIRM_DIRECTION_BY_HAND = (
    NO_LINK + "turn it with `snakesim robot calibrate direction`, then add --by-hand"
)
CONFIRM_GEAR_BY_HAND = (
    NO_LINK
    + "measure it with `snakesim robot calibrate gear`, shake the link, then add --gear-by-hand"
)
NO_BACKLASH = "no backlash found"
ENCODER_STICKS = "its encoder has a dead zone; correct it, and run the check again"
NO_REST = "the robot did not rest before the first motion; run the check again"
NOT_STRAIGHT = "lay the robot straight, run the check again, and add --straight"


@dataclass(frozen=True)
class JointVerdict:
    """The findings on one joint."""

    joint: str
    findings: Mapping[JointProperty, PropertyFinding]
    moved_rad: float | None = None  # by its encoder; None if it was not moved
    turned: float | None = None  # motion of the links divided by it; None if unknown
    torque_nm: float | None = None  # mean along the motion; None if not measured

    def list_properties(self, state: PropertyState) -> list[JointProperty]:
        """Return the properties in this state."""
        return [name for name in PROPERTIES if self.findings[name].state == state]

    @property
    def all_confirmed(self) -> bool:
        """Whether every property was confirmed."""
        return len(self.list_properties("confirmed")) == len(PROPERTIES)

    @property
    def summary(self) -> str:
        """What is wrong; otherwise what is unknown; otherwise that it matches the file."""
        wrong = self.list_properties("wrong")
        if wrong:
            return "; ".join(self.findings[name].reason for name in wrong)
        unknown = self.list_properties("unknown")
        if unknown:
            return f"unknown: {', '.join(unknown)}"
        return MATCHES_FILE

    def confirm_by_hand(self, properties: Iterable[JointProperty]) -> "JointVerdict":
        """Return a copy in which a person has confirmed those of the properties that were unknown.

        Args:
            properties: The properties that the person confirms; a property that was judged wrong stays wrong.
        """
        return self._confirm_unknown(properties, PropertyFinding("confirmed", by_hand=True))

    def confirm_by_shape(self, properties: Iterable[JointProperty]) -> "JointVerdict":
        """Return a copy in which drawn shapes have confirmed those of the properties that were unknown.

        A gear whose backlash is unknown stays unknown, because drawn shapes show only its ratio.
        """
        visible: list[JointProperty] = [
            name for name in properties if self.findings[name].shapes_suffice
        ]
        return self._confirm_unknown(visible, PropertyFinding("confirmed", by_shape=True))

    def _confirm_unknown(
        self, properties: Iterable[JointProperty], finding: PropertyFinding
    ) -> "JointVerdict":
        findings = dict(self.findings)
        for name in properties:
            if findings[name].state == "unknown":
                findings[name] = finding
        return replace(self, findings=findings)


def judge_joints(
    run: CheckMeasurements,
    *,
    was_laid_straight: bool = False,
    allowed_backlash_rad: float = ALLOWED_BACKLASH_RAD,
) -> list[JointVerdict]:
    """Judge every joint, tail to head.

    Args:
        run: Measurements of the joint check.
        was_laid_straight: Whether the robot lay straight at the start, so that all angles should have been zero.
        allowed_backlash_rad: Motion that may be lost in a gear when its load reverses.
    """
    evaluator = _JointEvaluator(
        run, was_laid_straight=was_laid_straight, allowed_backlash_rad=allowed_backlash_rad
    )
    return [evaluator.check_joint(joint) for joint in range(len(run.joint_names))]


class _JointEvaluator:
    """Judges the joints of one run, with what all of their motions tell together."""

    def __init__(
        self,
        measurements: CheckMeasurements,
        *,
        was_laid_straight: bool,
        allowed_backlash_rad: float,
    ) -> None:
        """Measure the motion of the links for each joint, and find modules whose ids are swapped.

        Args:
            measurements: Measurements of the joint check.
            was_laid_straight: Whether a person states that the robot lay straight at the start.
            allowed_backlash_rad: Largest backlash that is not judged as wrong.
        """
        self._measurements = measurements
        self._was_laid_straight = was_laid_straight
        self._allowed_backlash_rad = allowed_backlash_rad
        joints = range(len(measurements.joint_names))
        self._dead_zones_rad = [find_dead_zone_rad(measurements, joint) for joint in joints]
        self._load_responses = [measure_load_response(measurements, joint) for joint in joints]
        self._gear_plays = judge_gear_plays(self._load_responses, measurements.axes)
        # A joint that brakes while it drives moves all the same, so its links can be judged.
        self._motion_fractions: list[LinkMotionFractions | None] = [
            measure_link_motion_fractions(measurements, joint)
            if self._dead_zones_rad[joint] is None and _has_followed_target(measurements, joint)
            else None
            for joint in joints
        ]
        self._module_order: ModuleOrder = find_module_order(self._motion_fractions)
        link_order = [0, *(self._module_order + 1)]
        self._reordered_measurements = (
            replace(  # every IMU on the link on which its module really is
                measurements,
                link_rate_rad_s=measurements.link_rate_rad_s[:, link_order],
                link_force_m_s2=measurements.link_force_m_s2[:, link_order],
            )
        )

    def check_joint(self, joint_index: int) -> JointVerdict:
        """Check the drive of a joint and how it is mounted: its order, sign, gear ratio and zero offset.

        Args:
            joint_index: Index of the joint.

        Returns:
            A finding for each of these properties, and the measured range of motion (rad), ratio of the motions of link
            and drive, and torque (N·m); a measurement is None if it could not be made.
        """
        measurements = self._measurements
        torque_nm = _compute_mean_driving_torque_nm(measurements, joint_index)
        motion_ratio = self._measure_motion_ratio(joint_index)
        motion_range_rad = None
        if measurements.is_in_large_motion(joint_index).any():
            motion_range_rad = measurements.measure_motion_range_rad(joint_index)
        return JointVerdict(
            joint=measurements.joint_names[joint_index],
            findings={
                "drive": _judge_drive(
                    measurements, joint_index, torque_nm, self._dead_zones_rad[joint_index]
                ),
                **self._judge_mounting(joint_index, motion_ratio),
            },
            moved_rad=motion_range_rad,
            turned=None if np.isnan(motion_ratio) else motion_ratio,
            torque_nm=torque_nm,
        )

    def _measure_motion_ratio(self, joint_index: int) -> float:
        """Return the motion of a joint's links divided by the motion that its encoder measured; NaN if unknown."""
        motion = self._motion_fractions[joint_index]
        if motion is None or self._module_order[joint_index] != joint_index:
            return float("nan")
        return float(
            motion.reorder_modules(self._module_order).compute_joint_motions()[joint_index]
        )

    def _judge_mounting(
        self, joint_index: int, motion_ratio: float
    ) -> dict[JointProperty, PropertyFinding]:
        """Judge how the module of a joint is mounted: its order, sign, gear and zero.

        Args:
            joint_index: Index of the joint.
            motion_ratio: Motion of the links divided by the motion by the encoder, with its sign; NaN if unknown.
        """
        if self._module_order[joint_index] != joint_index:
            return self._make_swapped_findings(joint_index)
        zero = _judge_zero(
            self._reordered_measurements, joint_index, was_laid_straight=self._was_laid_straight
        )
        if self._motion_fractions[joint_index] is None:
            unknown = PropertyFinding("unknown", self._explain_missing_motion(joint_index))
            return {"order": unknown, "sign": unknown, "gear": unknown, "zero": zero}
        candidates = [
            self._measurements.joint_names[other]
            for other in find_swap_candidates(
                self._motion_fractions, self._module_order, joint_index
            )
        ]
        lost_motion = measure_lost_motion(self._reordered_measurements, joint_index)
        return {
            "order": _judge_order(motion_ratio, candidates),
            "sign": _judge_sign(motion_ratio, self._measurements.drives[joint_index]),
            "gear": self._judge_gear(joint_index, motion_ratio, lost_motion),
            "zero": zero,
        }

    def _explain_missing_motion(self, joint_index: int) -> str:
        """Return why the motion of a joint does not show how it is mounted."""
        if self._dead_zones_rad[joint_index] is not None:
            return ENCODER_STICKS
        if self._measurements.is_in_large_motion(joint_index).any():
            return NO_MOTION
        return NO_END

    def _judge_gear(
        self, joint_index: int, motion_ratio: float, lost_motion: LostMotion | None
    ) -> PropertyFinding:
        """Judge the gear of a joint: from the links if they were measured, otherwise from its torque."""
        if not np.isnan(motion_ratio):
            drive = self._measurements.drives[joint_index]
            small_motion_ratio = measure_small_motion_ratio(
                self._reordered_measurements, joint_index
            )
            return _judge_gear(
                motion_ratio, lost_motion, small_motion_ratio, drive, self._allowed_backlash_rad
            )
        response = self._load_responses[joint_index]
        small_motion_rad = 0.0 if response is None else response.small_motion_rad
        return _judge_gear_by_torque(
            self._gear_plays[joint_index], small_motion_rad, self._allowed_backlash_rad
        )

    def _make_swapped_findings(self, joint_index: int) -> dict[JointProperty, PropertyFinding]:
        """Return the findings on a joint whose module is swapped with that of another joint: the order is wrong."""
        names = self._measurements.joint_names
        other = names[int(self._module_order[joint_index])]
        unknown = PropertyFinding(
            "unknown",
            f"judged once the ids of {names[joint_index]} and {other} are right; run the check again then",
        )
        return {
            "order": PropertyFinding(
                "wrong", f"moves the link of {other}: their ids or cables are swapped"
            ),
            "sign": unknown,
            "gear": unknown,
            "zero": unknown,
        }


def _has_followed_target(measurements: CheckMeasurements, joint_index: int) -> bool:
    """Return whether a joint's encoder followed its target."""
    commanded = measurements.is_in_large_motion(joint_index)
    if not commanded.any():
        return False
    target_range_rad = float(np.ptp(measurements.target_rad[commanded, joint_index]))
    is_moving = np.abs(measurements.velocity_rad_s[commanded, joint_index]) > MIN_RATE_RAD_S
    moved_far_enough = measurements.measure_motion_range_rad(joint_index) >= max(
        MIN_MOVED_RAD, MIN_FOLLOWED_FRACTION * target_range_rad
    )
    moved_long_enough = bool(np.mean(is_moving) >= MIN_FOLLOWED_FRACTION)
    return moved_far_enough and moved_long_enough


def _compute_mean_driving_torque_nm(
    measurements: CheckMeasurements, joint_index: int
) -> float | None:
    """Return the mean of a joint's torque, positive where it drives; None if it is not measured."""
    velocity = measurements.velocity_rad_s[:, joint_index]
    is_moving = measurements.is_in_large_motion(joint_index) & (np.abs(velocity) > MIN_RATE_RAD_S)
    if "torque" not in measurements.drives[joint_index].measures or not is_moving.any():
        return None
    return float(
        np.mean(measurements.torque_nm[is_moving, joint_index] * np.sign(velocity[is_moving]))
    )


def _judge_drive(
    measurements: CheckMeasurements,
    joint_index: int,
    torque_nm: float | None,
    dead_zone_rad: float | None,
) -> PropertyFinding:
    """Judge whether a joint's drive moves it, and measures its angle.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint.
        torque_nm: Mean torque along the motion; None if it is not measured.
        dead_zone_rad: Dead zone of its encoder; None if it has none.
    """
    if not measurements.is_in_large_motion(joint_index).any():
        return PropertyFinding("unknown", NO_END)
    if dead_zone_rad is not None:
        return PropertyFinding(
            "wrong",
            f"its encoder has a dead zone: its angle sticks, and then jumps by {dead_zone_rad:.3f} rad "
            f"({np.rad2deg(dead_zone_rad):.1f} degrees); fasten the encoder and its magnet, or replace it",
        )
    if not _has_followed_target(measurements, joint_index):
        return PropertyFinding("wrong", "did not move: motor, brake, power, or a link that is held")
    if torque_nm is not None and torque_nm < -MIN_TORQUE_NM:
        return PropertyFinding(
            "wrong", "its torque has the wrong sign: it measures a brake while it drives"
        )
    return CONFIRMED


def _judge_order(motion_ratio: float, candidates: Sequence[str]) -> PropertyFinding:
    """Judge whether a joint's module is in its place. `candidates` are joints whose modules may be there instead."""
    if abs(motion_ratio) < MAX_RATIO_ERROR:
        return PropertyFinding("unknown", NO_LINK_TURNS)
    if candidates:
        return PropertyFinding(
            "unknown",
            f"its module may be exchanged with that of {', '.join(candidates)}: {CONFIRM_DIRECTION_BY_HAND}",
        )
    return CONFIRMED


def _judge_sign(motion_ratio: float, drive: JointDrive) -> PropertyFinding:
    """Judge whether a joint's links turn in the direction in which its encoder counts."""
    if np.isnan(motion_ratio):
        return PropertyFinding("unknown", CONFIRM_DIRECTION_BY_HAND)
    if abs(motion_ratio) < MAX_RATIO_ERROR:
        return PropertyFinding("unknown", NO_LINK_TURNS)
    if motion_ratio < 0:
        return PropertyFinding("wrong", f"turns the other way: sign = {-drive.sign}")
    return CONFIRMED


def _judge_gear(
    motion_ratio: float,
    lost_motion: LostMotion | None,
    small_motion_ratio: float | None,
    drive: JointDrive,
    allowed_backlash_rad: float,
) -> PropertyFinding:
    """Judge whether a joint's links turn as far as its encoder measures.

    Args:
        motion_ratio: Motion of the links divided by the motion by the encoder, with its sign.
        lost_motion: Backlash of the joint; None if it is not known.
        small_motion_ratio: The same ratio as `motion_ratio` in the small motion; None if it is not known.
        drive: The drive as the robot file has it.
        allowed_backlash_rad: Largest backlash that is not judged as wrong.
    """
    ratio = abs(motion_ratio)
    if ratio < MAX_RATIO_ERROR:
        return PropertyFinding(
            "wrong",
            "its coupling slips: its drive turns and no link does; fasten the coupling, and check the gear",
        )
    reasons: list[str] = []
    if lost_motion is not None and lost_motion.lost_rad > max(
        allowed_backlash_rad, lost_motion.noise_rad
    ):
        # Within backlash a link does not move at all, so it does not follow a small motion either.
        if small_motion_ratio is not None and abs(small_motion_ratio) > MIN_SLIPPING_RATIO:
            return PropertyFinding(
                "wrong",
                f"its coupling slips: its link follows a small motion, and stays behind by {lost_motion.lost_rad:.3f} "
                "rad in a large one; fasten the coupling, and check the gear",
            )
        ratio = abs(lost_motion.ratio)  # not reduced by the backlash
        backlash = (
            f"{lost_motion.lost_rad:.3f} rad ({np.rad2deg(lost_motion.lost_rad):.1f} degrees)"
        )
        reasons.append(
            f"backlash of {backlash}: its drive turns that much further than its link when the load reverses, "
            f"{allowed_backlash_rad:g} rad are allowed; repair the gear, or allow more with --allow-backlash"
        )
    if abs(ratio - 1) >= MAX_RATIO_ERROR:
        other_cause = ""
        if lost_motion is None:
            other_cause = ", or backlash, as it moved to one side only or its gyros are noisy"
        reasons.append(
            f"turns {ratio:.2f} as far as its drive measures: gear = {drive.gear / ratio:.3g}{other_cause}"
        )
    if reasons:
        return PropertyFinding("wrong", "; ".join(reasons))
    return CONFIRMED


def _judge_gear_by_torque(
    play: GearPlay, small_motion_rad: float, allowed_backlash_rad: float
) -> PropertyFinding:
    """Judge a gear whose links were not measured. Its ratio stays unknown.

    Args:
        play: What the torques show.
        small_motion_rad: Range of the joint's small motion.
        allowed_backlash_rad: Largest backlash that is not judged as wrong.
    """
    match play.kind:
        case "backlash" if small_motion_rad > allowed_backlash_rad:
            return PropertyFinding(
                "wrong",
                f"backlash of {small_motion_rad:.3f} rad or more: within it, its drive turns without the load of its "
                f"link, {allowed_backlash_rad:g} rad are allowed; repair the gear, or allow more with --allow-backlash",
            )
        case "slipping":
            return PropertyFinding(
                "wrong",
                "its coupling slips: its torque stays low and does not follow its angle, unlike that of other joints; "
                "fasten the coupling, and check the gear",
            )
        case "loose":
            return PropertyFinding(
                "wrong", "its link is loose: coupling, a gear that slips, or backlash"
            )
        case "tight":
            return PropertyFinding(
                "unknown", f"{NO_BACKLASH}, ratio unknown: {CONFIRM_GEAR_BY_HAND}"
            )
        case "backlash":
            reason = f"backlash of {small_motion_rad:.3f} rad or more, and {allowed_backlash_rad:g} rad are allowed"
            return PropertyFinding(
                "unknown", f"{reason}: {CONFIRM_GEAR_BY_HAND}", shapes_suffice=False
            )
        case "unknown":
            return PropertyFinding(
                "unknown",
                f"backlash and ratio unknown, as {play.reason}: {CONFIRM_GEAR_BY_HAND}",
                shapes_suffice=False,
            )


def _judge_zero(
    measurements: CheckMeasurements, joint_index: int, *, was_laid_straight: bool
) -> PropertyFinding:
    """Judge whether the zero of a joint's angle in the robot file is right.

    If accelerometers measure the joint's angle by gravity, the encoder is compared with it. Otherwise it is compared
    with zero, if the robot was laid straight.

    Args:
        measurements: Measurements of the check.
        joint_index: Index of the joint.
        was_laid_straight: Whether a person states that the robot lay straight at the start.

    Returns:
        Confirmed, wrong with the zero to write into the robot file, or unknown with the reason.
    """
    at_rest = measurements.is_at_rest()
    before_motion = measurements.is_before_motion()
    angle_by_gravity_rad = None
    if measurements.axes[joint_index] == "pitch":
        angle_by_gravity_rad = _measure_angle_by_gravity_rad(measurements, joint_index, at_rest)
    if angle_by_gravity_rad is not None:
        error_rad = (
            float(np.mean(measurements.angle_rad[at_rest, joint_index])) - angle_by_gravity_rad
        )
        allowed_rad = MAX_GRAVITY_ERROR_RAD
    elif not was_laid_straight:
        return PropertyFinding("unknown", NOT_STRAIGHT)
    elif not before_motion.any():
        return PropertyFinding("unknown", NO_REST)
    else:
        error_rad = float(np.mean(measurements.angle_rad[before_motion, joint_index]))
        allowed_rad = MAX_STRAIGHT_ERROR_RAD
    if abs(error_rad) <= allowed_rad:
        return CONFIRMED
    drive = measurements.drives[joint_index]
    zero_rad = drive.zero_rad + drive.sign * drive.gear * error_rad
    return PropertyFinding(
        "wrong", f"its zero is off by {error_rad:+.3f} rad: zero_rad = {zero_rad:.3f}"
    )


def _measure_angle_by_gravity_rad(
    measurements: CheckMeasurements, joint_index: int, at_rest: Mask
) -> float | None:
    """Return a pitch joint's angle from the direction of gravity in both of its links; None if that is not known."""
    tilts_rad: list[float] = []
    for link in (joint_index, joint_index + 1):
        forces_m_s2 = measurements.link_force_m_s2[at_rest, link]
        known_forces_m_s2 = forces_m_s2[~np.isnan(forces_m_s2[:, 0])]
        if not len(known_forces_m_s2):
            return None
        x, _, z = np.mean(known_forces_m_s2, axis=0)
        if np.hypot(x, z) <= MIN_GRAVITY_M_S2:
            return None
        tilts_rad.append(float(np.arctan2(x, z)))
    difference_rad = tilts_rad[0] - tilts_rad[1]
    return float(np.arctan2(np.sin(difference_rad), np.cos(difference_rad)))
