"""Judges each joint of a joint check: whether its mounting matches the robot file. Pure.

Five properties of a joint are judged, each from its own evidence, and each is confirmed, wrong or unknown:

    drive   it follows its targets, its encoder does not stick, and it measures no torque that brakes while it drives
    order   the links on both sides of it turn, and not those of a joint whose module may be exchanged with its own
    sign    they turn in the direction in which its encoder counts
    gear    they turn as far as its encoder counts, also when the load reverses, and do not turn while its drive holds
            still; without IMUs, the torque shows backlash and a coupling that slips, but not the ratio
    zero    its angle agrees with gravity, or is 0 on a robot that was laid straight

A property without evidence is unknown, with a sentence on how it could be confirmed. It never counts as confirmed.

This module collects the evidence of each joint. The rules that turn it into findings are in `property_rules` and
`gear_rules`.
"""

from dataclasses import replace

import numpy as np

from snakesim_hal.model.robot_file.checked import JointProperty
from snakesim_operator.features.commissioning.joint_check.encoder_dead_zone import (
    find_dead_zone_rad,
)
from snakesim_operator.features.commissioning.joint_check.gear_play import (
    judge_gear_plays,
)
from snakesim_operator.features.commissioning.joint_check.gear_rules import (
    LinkMotions,
    judge_gear_by_links,
    judge_gear_by_torque,
)
from snakesim_operator.features.commissioning.joint_check.joint_verdict import (
    JointVerdict,
    PropertyFinding,
)
from snakesim_operator.features.commissioning.joint_check.link_shares import (
    LinkMotionFractions,
    ModuleOrder,
    find_module_order,
    find_swap_candidates,
    measure_link_motion_fractions,
)
from snakesim_operator.features.commissioning.joint_check.load_response import measure_load_response
from snakesim_operator.features.commissioning.joint_check.lost_motion import (
    measure_held_motions,
    measure_lost_motion,
    measure_small_motion_ratio,
)
from snakesim_operator.features.commissioning.joint_check.measurements import CheckMeasurements
from snakesim_operator.features.commissioning.joint_check.property_rules import (
    compute_mean_driving_torque_nm,
    has_followed_target,
    judge_drive,
    judge_order,
    judge_sign,
    judge_zero,
    make_swapped_findings,
    make_unmoved_finding,
)
from snakesim_operator.features.commissioning.joint_check.sliding_torque import (
    compute_sliding_torques_nm,
)
from snakesim_operator.features.commissioning.tolerances import ALLOWED_BACKLASH_RAD


def judge_joints(
    measurements: CheckMeasurements,
    *,
    was_laid_straight: bool = False,
    end_weights_kg: float = 0.0,
    allowed_backlash_rad: float = ALLOWED_BACKLASH_RAD,
) -> list[JointVerdict]:
    """Judge every joint, tail to head.

    Args:
        measurements: Measurements of the joint check.
        was_laid_straight: Whether the robot lay straight at the start, so that all angles should have been zero.
        end_weights_kg: Mass of the weight that lay on each of the first and the last link; 0 for none.
        allowed_backlash_rad: Motion that may be lost in a gear when its load reverses.
    """
    evaluator = _JointEvaluator(
        measurements,
        was_laid_straight=was_laid_straight,
        end_weights_kg=end_weights_kg,
        allowed_backlash_rad=allowed_backlash_rad,
    )
    return [evaluator.judge_joint(joint) for joint in range(len(measurements.joint_names))]


class _JointEvaluator:
    """Judges the joints of one run, with what all of their motions tell together."""

    def __init__(
        self,
        measurements: CheckMeasurements,
        *,
        was_laid_straight: bool,
        end_weights_kg: float,
        allowed_backlash_rad: float,
    ) -> None:
        """Measure the motion of the links for each joint, and find modules whose ids are swapped.

        Args:
            measurements: Measurements of the joint check.
            was_laid_straight: Whether a person states that the robot lay straight at the start.
            end_weights_kg: Mass of the weight on each of the first and the last link, as a person states.
            allowed_backlash_rad: Largest backlash that is not judged as wrong.
        """
        self._measurements = measurements
        self._was_laid_straight = was_laid_straight
        self._allowed_backlash_rad = allowed_backlash_rad
        joints = range(len(measurements.joint_names))
        self._dead_zones_rad = [find_dead_zone_rad(measurements, joint) for joint in joints]
        self._load_responses = [measure_load_response(measurements, joint) for joint in joints]
        sliding_torques_nm = compute_sliding_torques_nm(
            measurements.link_lengths_m, measurements.link_masses_kg, end_weights_kg
        )
        self._gear_plays = judge_gear_plays(
            self._load_responses, measurements.axes, sliding_torques_nm
        )
        # The verdict on the drive is no condition: a joint whose torque has the wrong sign moves all the same.
        self._motion_fractions: list[LinkMotionFractions | None] = [
            measure_link_motion_fractions(measurements, joint)
            if self._dead_zones_rad[joint] is None and has_followed_target(measurements, joint)
            else None
            for joint in joints
        ]
        self._module_order: ModuleOrder = find_module_order(self._motion_fractions)
        # Give every IMU to the link on which its module really is.
        link_order = [0, *(self._module_order + 1)]
        self._reordered_measurements = replace(
            measurements,
            link_rate_rad_s=measurements.link_rate_rad_s[:, link_order],
            link_force_m_s2=measurements.link_force_m_s2[:, link_order],
        )

    def judge_joint(self, joint_index: int) -> JointVerdict:
        """Judge the drive of a joint and how it is mounted: its order, sign, gear ratio and zero offset.

        Args:
            joint_index: Index of the joint.

        Returns:
            A finding for each of these properties, and the measured range of motion (rad), ratio of the motions of link
            and drive, and torque (N·m); a measurement is None if it could not be made.
        """
        measurements = self._measurements
        torque_nm = compute_mean_driving_torque_nm(measurements, joint_index)
        motion_ratio = self._measure_motion_ratio(joint_index)
        motion_range_rad = None
        if measurements.is_in_large_motion(joint_index).any():
            motion_range_rad = measurements.measure_motion_range_rad(joint_index)
        return JointVerdict(
            joint=measurements.joint_names[joint_index],
            findings={
                "drive": judge_drive(
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
            names = self._measurements.joint_names
            other = int(self._module_order[joint_index])
            return make_swapped_findings(names[joint_index], names[other])
        zero = judge_zero(
            self._reordered_measurements, joint_index, was_laid_straight=self._was_laid_straight
        )
        if self._motion_fractions[joint_index] is None:
            unknown = make_unmoved_finding(
                self._measurements, joint_index, self._dead_zones_rad[joint_index]
            )
            return {"order": unknown, "sign": unknown, "gear": unknown, "zero": zero}
        candidates = [
            self._measurements.joint_names[other]
            for other in find_swap_candidates(
                self._motion_fractions, self._module_order, joint_index
            )
        ]
        return {
            "order": judge_order(motion_ratio, candidates),
            "sign": judge_sign(motion_ratio, self._measurements.drives[joint_index]),
            "gear": self._judge_gear(joint_index, motion_ratio),
            "zero": zero,
        }

    def _judge_gear(self, joint_index: int, motion_ratio: float) -> PropertyFinding:
        """Judge the gear of a joint: from the links if they were measured, otherwise from its torque."""
        response = self._load_responses[joint_index]
        if not np.isnan(motion_ratio):
            lost_motion = measure_lost_motion(self._reordered_measurements, joint_index)
            ratio = motion_ratio if lost_motion is None else lost_motion.ratio
            motions = LinkMotions(
                motion_ratio=motion_ratio,
                lost_motion=lost_motion,
                held_motions=measure_held_motions(self._reordered_measurements, joint_index, ratio),
                small_motion_ratio=measure_small_motion_ratio(
                    self._reordered_measurements, joint_index
                ),
                passes_torque_on=response is not None and response.passed_in_all_motions.is_certain,
            )
            return judge_gear_by_links(
                motions, self._measurements.drives[joint_index], self._allowed_backlash_rad
            )
        return judge_gear_by_torque(self._gear_plays[joint_index], self._allowed_backlash_rad)
