"""Identifies a robot as `snakesim robot identify` does."""

import time
from collections.abc import Mapping

from snakesim_hal.base.arrays import Floats
from snakesim_operator.features.commissioning.system_identification.identification import (
    JointIdentification,
    identify_joints,
)
from verification.identification_trials import HiddenRobot, find_joints_with_backlash
from verification.sysid.estimates import PARAMETERS, Estimate, IdentificationResult, get_truth


def identify_by_equations(
    robot: HiddenRobot, columns: Mapping[str, Floats], link_rates: Floats | None
) -> IdentificationResult:
    """Identify a robot as `snakesim robot identify` does.

    Args:
        robot: The robot. Its hidden parameters serve only as the truth in the result.
        columns: The record of its motion, by signal.
        link_rates: Rates that the gyros of the links measured; None for links without IMUs.
    """
    start_s = time.process_time()
    joints = identify_joints(robot.config, columns, link_rates)
    cpu_s = time.process_time() - start_s
    estimates = [
        _make_estimate(robot, i, joint, parameter)
        for i, joint in enumerate(joints)
        for parameter in PARAMETERS
    ]
    named_joints = find_joints_with_backlash(joints)
    return IdentificationResult(
        estimates,
        cpu_s,
        warns=any(joint.fails or not joint.complete for joint in joints),  # exit code 1
        suspect=named_joints[0] if named_joints else None,
    )


def _make_estimate(
    robot: HiddenRobot, joint_index: int, joint: JointIdentification, parameter: str
) -> Estimate:
    """Return an estimate, without a value if `--write` would not write it into the robot file."""
    truth = get_truth(robot, joint_index, parameter)
    value = None if joint.fails else joint.fields.get(parameter)
    if value is None:
        return Estimate(joint_index, parameter, None, 0.0, truth)
    return Estimate(joint_index, parameter, value.value, value.half_width, truth)
