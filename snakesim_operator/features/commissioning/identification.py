"""Identifies every joint from the record of a run of the controller `identify`. Pure.

The links ahead of a joint load it with the motion that they really make. So a joint whose links do not move as the
encoders measure makes the values of its neighbors wrong, too: they are withheld.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.joints import Drive, Joint
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig
from snakesim_operator.features.commissioning.followed_links import find_unfollowed
from snakesim_operator.features.commissioning.least_squares import Estimate
from snakesim_operator.features.commissioning.servo_response import ServoResponse, bandwidth_hz, fit_servo
from snakesim_operator.features.commissioning.smoothing import smooth, smooth_derivative, smooth_second_derivative
from snakesim_operator.features.commissioning.suspended_load import load_nm
from snakesim_operator.features.commissioning.torque_balance import JointRecord, TorqueBalance, fit_torque_balance

MAX_RELATIVE_WIDTH = 0.3  # half of an interval, of its value; a torque constant that is less certain is unknown
MIN_EXPLAINED = 0.8  # fraction of the torque; below, the robot was not suspended as it is supposed to be
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
    fields: Mapping[str, Estimate]  # fields of the robot file; those that could not be identified are missing
    unknown: Sequence[str]  # why fields are missing
    latency_s: Estimate | None = None
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
        """Whether it does not move as the model of a suspended robot, so that its neighbors are not certain either."""
        return self.explained is None or self.explained < MIN_EXPLAINED

    def withheld(self, reason: str) -> "JointIdentification":
        """Return the same joint without its values, which would not be right."""
        return replace(self, fields={}, unknown=[f"everything: {reason}"], complete=False)


def identify_joints(
    config: RunConfig, columns: Mapping[str, Floats], link_rate_rad_s: Floats | None = None
) -> list[JointIdentification]:
    """Identify the parameters of every joint from the measurements of a run.

    If the model of one joint fails, results of other joints that depend on it are withheld.

    Args:
        config: Configuration of the run.
        columns: `angle_rad`, `velocity_rad_s`, `torque_nm` and `target`, each (ticks, joints).
        link_rate_rad_s: Angular rates by the gyros of the links, (ticks, links, 3), in the links' frames; NaN where
            no gyro reported; None: the links have no gyros.

    Returns:
        One result for each joint, tail to head.
    """
    period_s = config.period_ns * 1e-9
    joints = config.robot.joint_table
    loads, loads_by_angle = _link_loads(config.robot, period_s, columns)
    results: list[JointIdentification] = []
    failing_joints: dict[int, str] = {}  # index -> name
    for i, joint in enumerate(joints):
        record = JointRecord(
            period_s=period_s,
            angle_rad=columns["angle_rad"][:, i],
            velocity_rad_s=columns["velocity_rad_s"][:, i],
            torque_nm=columns["torque_nm"][:, i],
            target_rad=columns["target"][:, i],
            torque_limit_nm=joint.limits.torque_nm,
        )
        result = _identify_or_explain(joint, record, loads[:, i], loads_by_angle[:, i])
        results.append(result)
        if _is_judged_and_fails(result, joint.drive):
            failing_joints[i] = result.joint
    if link_rate_rad_s is not None:
        unfollowed = find_unfollowed(
            config.robot, period_s, columns["angle_rad"], columns["velocity_rad_s"], link_rate_rad_s
        )
        if unfollowed is not None:
            result = results[unfollowed.joint]
            failing_joints[unfollowed.joint] = result.joint
            results[unfollowed.joint] = result.withheld(unfollowed.reason)
    return [_withhold_beside_failing(result, i, failing_joints) for i, result in enumerate(results)]


def _link_loads(robot: RobotFile, period_s: float, columns: Mapping[str, Floats]) -> tuple[Floats, Floats]:
    """Return the torque that the links need: with the measured velocities, and with those derived from the angles.

    Both are (ticks - 2 HALF_WINDOW, joints).
    """
    angle = columns["angle_rad"]
    velocity = columns["velocity_rad_s"]
    smooth_angle = smooth(angle)
    by_velocity = load_nm(robot, smooth_angle, smooth(velocity), smooth_derivative(velocity, period_s))
    by_angle = load_nm(
        robot, smooth_angle, smooth_derivative(angle, period_s), smooth_second_derivative(angle, period_s)
    )
    return by_velocity, by_angle


def _identify_or_explain(joint: Joint, record: JointRecord, load: Floats, load_by_angle: Floats) -> JointIdentification:
    """Identify one joint, or return why nothing of it is known."""
    if "torque" not in joint.drive.measures:
        return JointIdentification(joint.name, {}, ["everything: it does not measure torque"], complete=False)
    try:
        return _identify(joint.name, record, load, load_by_angle, joint.motor.torque_constant_nm_per_a)
    except ValueError as error:
        return JointIdentification(joint.name, {}, [f"everything: {error}"], complete=False)


def _is_judged_and_fails(row: JointIdentification, drive: Drive) -> bool:
    return "torque" in drive.measures and row.fails


def _withhold_beside_failing(row: JointIdentification, joint: int, failing: Mapping[int, str]) -> JointIdentification:
    """Withhold the values of a joint next to one that fails: they depend on the motion of that joint's links."""
    if joint in failing:
        return row
    neighbors = [failing[neighbor] for neighbor in (joint - 1, joint + 1) if neighbor in failing]
    if not neighbors:
        return row
    return row.withheld(f"{' and '.join(neighbors)} beside it fails; correct that first, and identify again")


def _identify(
    name: str, record: JointRecord, load: Floats, load_by_angle: Floats, torque_constant: float | None
) -> JointIdentification:
    """Identify one joint.

    Args:
        name: of the joint.
        record: its motion.
        load: torque that the links need, from smoothed signals, (ticks - 2 HALF_WINDOW,).
        load_by_angle: the same with velocities derived from the angles.
        torque_constant: that of the robot file, N·m/A; None: the file has none, and torque is taken as measured.

    Raises:
        ValueError: the joint moved too little.
    """
    unknown: list[str] = []
    unknown_by_misfit: list[str] = []  # values that are unknown because the torque does not fit the motion
    complete = True
    servo = fit_servo(record)
    balance = fit_torque_balance(record, servo.between_nm, load, load_by_angle, fit_scale=torque_constant is not None)
    if torque_constant is None:
        unknown.append("torque constant: the file has none, so its torque is taken as it is measured")
    elif not balance.torque_scale.half_width < MAX_RELATIVE_WIDTH * balance.torque_scale.value:
        if balance.misfit > 0:
            unknown_by_misfit.append("torque constant")
        else:
            unknown.append(f"torque constant: {TOO_LIGHT}; its torque is taken as it is measured")
        complete = False
        torque_constant = None
        balance = fit_torque_balance(record, servo.between_nm, load, load_by_angle, fit_scale=False)
    fields = _robot_file_fields(balance, servo, torque_constant)
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
        latency_s=servo.latency_s,
        bandwidth_hz=bandwidth_hz(record),
        balance=balance,
        servo=servo,
        complete=complete,
    )


def _robot_file_fields(
    balance: TorqueBalance, servo: ServoResponse, torque_constant: float | None
) -> dict[str, Estimate]:
    """Return the fields of the robot file, in real torque: the measured torque times the fitted scale."""
    scale = balance.torque_scale
    fields = {
        "friction_nm": balance.dry_nm,
        "viscous_nm_s_per_rad": balance.viscous_nm_s_per_rad,
        "armature_kg_m2": balance.armature_kg_m2,
        "stiffness_nm_per_rad": servo.stiffness_nm_per_rad.times(scale),
        "damping_nm_s_per_rad": servo.damping_nm_s_per_rad.times(scale),
        "response_time_s": servo.response_time_s,
    }
    if torque_constant is not None:
        fields["torque_constant_nm_per_a"] = scale.scaled(torque_constant)
    return fields
