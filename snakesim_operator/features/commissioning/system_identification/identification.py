"""Identifies every joint from the record of a run of the controller `identify`. Pure.

The links ahead of a joint load it with the motion that they really make. So a joint whose links do not move as the
encoders measure makes the values of its neighbors wrong, too: they are withheld.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.joints import Joint, JointDrive
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig
from snakesim_operator.features.commissioning.system_identification.followed_links import (
    find_link_mismatch,
)
from snakesim_operator.features.commissioning.system_identification.least_squares import (
    IntervalEstimate,
)
from snakesim_operator.features.commissioning.system_identification.servo_response import (
    ServoResponse,
    estimate_bandwidth_hz,
    fit_servo,
)
from snakesim_operator.features.commissioning.system_identification.smoothing import (
    smooth,
    smooth_derivative,
    smooth_second_derivative,
)
from snakesim_operator.features.commissioning.system_identification.suspended_load import (
    compute_link_loads_nm,
)
from snakesim_operator.features.commissioning.system_identification.torque_balance import (
    JointRecord,
    TorqueBalance,
    fit_torque_balance,
)

# Half of an interval, of its value; a torque constant that is less certain is unknown.
MAX_RELATIVE_WIDTH = 0.3
# Of the torque constant in the file. An error that surely exceeds it is reported.
MAX_CONSTANT_ERROR = 0.1
# Fraction of the torque; below, the robot was not suspended as it is supposed to be.
MIN_EXPLAINED = 0.8
TOO_LIGHT = "what it carries is too light to tell"
BALANCE_LABELS = {  # fields of a robot file that come from the torque balance -> their names
    "friction_nm": "dry friction",
    "viscous_nm_s_per_rad": "viscous friction",
    "armature_kg_m2": "rotor inertia",
}
MISFIT = "the links do not move as the encoders measure, or not under the torques that they need"


@dataclass(frozen=True)
class JointIdentification:
    """What was identified of one joint."""

    joint: str
    # Fields of the robot file; those that could not be identified are missing.
    fields: Mapping[str, IntervalEstimate]
    unknown: Sequence[str]  # why fields are missing
    wrong: Sequence[str] = ()  # what the robot file has wrong
    bandwidth_hz: float | None = None
    balance: TorqueBalance | None = None
    servo: ServoResponse | None = None
    complete: bool = True  # every value was identified that the robot file needs

    @property
    def explained(self) -> float | None:
        """The explained fraction of the torque's variance: of balance and servo, the smaller one."""
        if self.balance is None or self.servo is None:
            return None
        return min(self.balance.explained, self.servo.explained)

    @property
    def fails(self) -> bool:
        """Whether the joint does not move as a suspended robot does, so that its neighbors are uncertain, too."""
        return self.explained is None or self.explained < MIN_EXPLAINED

    def without_values(self, reason: str) -> "JointIdentification":
        """Return this result without its values, which would be wrong, and with the reason."""
        return replace(self, fields={}, unknown=[f"everything: {reason}"], wrong=(), complete=False)


def identify_joints(
    config: RunConfig, columns: Mapping[str, Floats], link_rate_rad_s: Floats | None = None
) -> list[JointIdentification]:
    """Identify the parameters of every joint from the measurements of a run.

    If the model of one joint fails, results of other joints that depend on it are withheld.

    Args:
        config: Configuration of the run.
        columns: Recorded signals by name: `angle_rad`, `velocity_rad_s`, `torque_nm` and `target`, each (ticks,
            joints).
        link_rate_rad_s: Angular rates by the gyros of the links, (ticks, links, 3), in the links' frames; NaN where
            no gyro reported. None if the links have no gyros.

    Returns:
        One result for each joint, tail to head.
    """
    period_s = config.period_ns * 1e-9
    joints = config.robot.joint_table
    loads, loads_by_angle = _compute_link_loads(config.robot, period_s, columns)
    results: list[JointIdentification] = []
    failing_joints: dict[int, str] = {}  # index -> name
    for joint_index, joint in enumerate(joints):
        record = JointRecord(
            period_s=period_s,
            angle_rad=columns["angle_rad"][:, joint_index],
            velocity_rad_s=columns["velocity_rad_s"][:, joint_index],
            torque_nm=columns["torque_nm"][:, joint_index],
            target_rad=columns["target"][:, joint_index],
            torque_limit_nm=joint.limits.torque_nm,
        )
        result = _try_identify_joint(
            joint, record, loads[:, joint_index], loads_by_angle[:, joint_index]
        )
        results.append(result)
        if _has_model_misfit(result, joint.drive):
            failing_joints[joint_index] = result.joint
    if link_rate_rad_s is not None:
        mismatch = find_link_mismatch(
            config.robot, period_s, columns["angle_rad"], columns["velocity_rad_s"], link_rate_rad_s
        )
        if mismatch is not None:
            result = results[mismatch.joint_index]
            failing_joints[mismatch.joint_index] = result.joint
            results[mismatch.joint_index] = result.without_values(mismatch.reason)
    return [
        _withhold_if_neighbor_fails(result, joint_index, failing_joints)
        for joint_index, result in enumerate(results)
    ]


def _compute_link_loads(
    robot: RobotFile, period_s: float, columns: Mapping[str, Floats]
) -> tuple[Floats, Floats]:
    """Return the torque that the links need: with the measured velocities, and with those derived from the angles.

    Both are (ticks - 2 HALF_WINDOW_TICKS, joints).
    """
    angle_rad = columns["angle_rad"]
    velocity_rad_s = columns["velocity_rad_s"]
    smooth_angle_rad = smooth(angle_rad)
    by_velocity = compute_link_loads_nm(
        robot, smooth_angle_rad, smooth(velocity_rad_s), smooth_derivative(velocity_rad_s, period_s)
    )
    by_angle = compute_link_loads_nm(
        robot,
        smooth_angle_rad,
        smooth_derivative(angle_rad, period_s),
        smooth_second_derivative(angle_rad, period_s),
    )
    return by_velocity, by_angle


def _try_identify_joint(
    joint: Joint, record: JointRecord, load_nm: Floats, load_by_angle_nm: Floats
) -> JointIdentification:
    """Identify one joint; if that is not possible, return a result without values that holds the reason."""
    if "torque" not in joint.drive.measures:
        return JointIdentification(
            joint.name, {}, ["everything: it does not measure torque"], complete=False
        )
    try:
        return _identify_joint(
            joint.name, record, load_nm, load_by_angle_nm, joint.motor.torque_constant_nm_per_a
        )
    except ValueError as error:
        return JointIdentification(joint.name, {}, [f"everything: {error}"], complete=False)


def _has_model_misfit(result: JointIdentification, drive: JointDrive) -> bool:
    return "torque" in drive.measures and result.fails


def _withhold_if_neighbor_fails(
    result: JointIdentification, joint_index: int, failing_joints: Mapping[int, str]
) -> JointIdentification:
    """Withhold the values of a joint next to one that fails: they depend on the motion of that joint's links."""
    if joint_index in failing_joints:
        return result
    neighbors = [
        failing_joints[neighbor]
        for neighbor in (joint_index - 1, joint_index + 1)
        if neighbor in failing_joints
    ]
    if not neighbors:
        return result
    return result.without_values(
        f"{' and '.join(neighbors)} beside it fails; correct that first, and identify again"
    )


def _identify_joint(
    name: str,
    record: JointRecord,
    load_nm: Floats,
    load_by_angle_nm: Floats,
    torque_constant_nm_per_a: float | None,
) -> JointIdentification:
    """Fit the servo response and the torque balance of one joint, and drop the values that are too uncertain.

    Args:
        name: Name of the joint.
        record: Motion and torque of the joint.
        load_nm: Torque that the links need,  from smoothed signals, (ticks - 2 HALF_WINDOW_TICKS,).
        load_by_angle_nm: The same torque, with velocities derived from the angles.
        torque_constant_nm_per_a: Torque constant in the robot file; None if the file has none. Then the torque is taken
            as it is measured.

    Raises:
        ValueError: The joint moved too little.
    """
    unknown: list[str] = []
    # Values that are unknown because the torque does not fit the motion.
    unknown_by_misfit: list[str] = []
    complete = True
    servo = fit_servo(record)
    balance = fit_torque_balance(
        record,
        servo.between_nm,
        load_nm,
        load_by_angle_nm,
        fit_scale=torque_constant_nm_per_a is not None,
    )
    if torque_constant_nm_per_a is None:
        unknown.append(
            "torque constant: the file has none, so its torque is taken as it is measured"
        )
    elif not balance.torque_scale.half_width < MAX_RELATIVE_WIDTH * balance.torque_scale.value:
        if balance.misfit > 0:
            unknown_by_misfit.append("torque constant")
        else:
            unknown.append(f"torque constant: {TOO_LIGHT}; its torque is taken as it is measured")
        complete = False
        torque_constant_nm_per_a = None
        balance = fit_torque_balance(
            record, servo.between_nm, load_nm, load_by_angle_nm, fit_scale=False
        )
    fields = _collect_robot_file_fields(balance, servo, torque_constant_nm_per_a)
    for field, label in BALANCE_LABELS.items():
        value = fields[field]
        # Without a misfit the interval is that of noise, and a friction near 0 may be as uncertain as it is small.
        if balance.misfit > 0 and not value.half_width < MAX_RELATIVE_WIDTH * abs(value.value):
            del fields[field]
            unknown_by_misfit.append(label)
            complete = False
    if unknown_by_misfit:
        unknown.append(f"{', '.join(unknown_by_misfit)}: {MISFIT}")
    return JointIdentification(
        joint=name,
        fields=fields,
        unknown=unknown,
        wrong=_describe_wrong_constant(balance.torque_scale, torque_constant_nm_per_a),
        bandwidth_hz=estimate_bandwidth_hz(record),
        balance=balance,
        servo=servo,
        complete=complete,
    )


def _describe_wrong_constant(
    scale: IntervalEstimate, torque_constant_nm_per_a: float | None
) -> list[str]:
    """Return what is wrong with the torque constant in the file; nothing if it may be right.

    Args:
        scale: Real torque divided by measured torque.
        torque_constant_nm_per_a: Torque constant in the robot file; None if the real torque is unknown.
    """
    if torque_constant_nm_per_a is None:
        return []
    if abs(scale.value - 1) - scale.half_width <= MAX_CONSTANT_ERROR:
        return []
    true_nm_per_a = scale.value * torque_constant_nm_per_a
    return [
        f"torque constant: {true_nm_per_a:.3g} N·m/A, and the file has {torque_constant_nm_per_a:.3g}; the real "
        f"torque is {scale.value:.2f} of the measured one"
    ]


def _collect_robot_file_fields(
    balance: TorqueBalance, servo: ServoResponse, torque_constant_nm_per_a: float | None
) -> dict[str, IntervalEstimate]:
    """Return the fields of the robot file, in real torque: the measured torque times the fitted scale."""
    scale = balance.torque_scale
    fields = {
        "friction_nm": balance.dry_nm,
        "viscous_nm_s_per_rad": balance.viscous_nm_s_per_rad,
        "armature_kg_m2": balance.armature_kg_m2,
        "stiffness_nm_per_rad": servo.stiffness_nm_per_rad.multiply_by(scale),
        "damping_nm_s_per_rad": servo.damping_nm_s_per_rad.multiply_by(scale),
        "response_time_s": servo.response_time_s,
        "latency_s": servo.latency_s,
    }
    if torque_constant_nm_per_a is not None:
        fields["torque_constant_nm_per_a"] = scale.scale_by(torque_constant_nm_per_a)
    return fields
