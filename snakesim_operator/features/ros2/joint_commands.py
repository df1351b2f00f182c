"""Turns sensor_msgs/JointState on joint_commands into setpoints for every joint of the robot.

A message names any of the joints. Each named joint follows its target for TARGET_LIFETIME_NS of robot time after the
message was sent; then it holds the angle that it has. A joint without a target since the robot was armed holds its
angle as well. Targets that arrive while the robot is not armed are dropped.
"""

import math
from dataclasses import dataclass
from typing import Any

from rosbags.serde import SerdeError

from snakesim_hal.wire.messages import Clock, JointMode, JointState, RobotDescription
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_operator.features.ros2.message_age import explain_stale_message
from snakesim_operator.features.ros2.messages import JOINT_STATE, TYPE_STORE

TARGET_LIFETIME_NS = 500_000_000  # of a joint's target in robot time
MODE_FIELDS = (
    (JointMode.POSITION, "position"),
    (JointMode.VELOCITY, "velocity"),
    (JointMode.TORQUE, "effort"),
)
MAX_NAME_SHOWN = 40  # characters of an unknown joint name in a message to the user


class _RefusedMessageError(Exception):
    """A message cannot be followed; its text is the reason."""


@dataclass(frozen=True)
class _FollowableCommand:
    """A message that can be followed."""

    mode: JointMode
    targets: dict[int, float]  # by joint index; in rad, rad/s or N m, as the mode requires
    timestamp_ns: int  # in its header, in ROS time; 0: none


@dataclass(frozen=True)
class _JointTarget:
    """The newest target of one joint."""

    mode: JointMode
    target: float
    valid_until_ns: int  # robot time


class RosJointTargets:
    """Keeps the newest target of each joint, and makes the setpoints of each control cycle from them."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._joint_indices = {joint.name: i for i, joint in enumerate(robot.joints)}
        self._torque_limits_nm = [joint.torque_limit_nm for joint in robot.joints]
        self._targets: list[_JointTarget | None] = [None] * len(robot.joints)
        # None: not holding yet.
        self._held_angles_rad: list[float | None] = [None] * len(robot.joints)
        self.rejected_count = 0  # messages
        self.reason = ""  # for the newest rejection

    def accept_message(
        self, payload: bytes, now_ns: int, ros_now_ns: int | None = None, age_ns: int = 0
    ) -> bool:
        """Accept the targets of a message as the newest ones of their joints: either all of them or none.

        Args:
            payload: The message in CDR.
            now_ns: Current robot time.
            ros_now_ns: Current time in ROS, to compare with the timestamp of a header; None for robot time.
            age_ns: Age of the message since it was sent, for a message without a timestamp.

        Returns:
            Whether the message was accepted. If not, `reason` explains it.
        """
        if ros_now_ns is None:
            ros_now_ns = now_ns
        try:
            command = self._decode_command(payload)
            age_ns = _determine_age_ns(command, age_ns, ros_now_ns)
        except _RefusedMessageError as error:
            self.rejected_count += 1
            self.reason = str(error)
            return False
        until_ns = now_ns - max(age_ns, 0) + TARGET_LIFETIME_NS
        for i, target in command.targets.items():
            self._targets[i] = _JointTarget(command.mode, target, until_ns)
            self._held_angles_rad[i] = None
        return True

    def make_setpoints(self, clock: Clock, joints: JointState) -> RequestedSetpoints:
        """Return the setpoints of this control cycle. While the robot is not armed, all targets are forgotten."""
        joint_count = len(self._robot.joints)
        if clock.lifecycle != "armed":
            self._targets = [None] * joint_count
            self._held_angles_rad = [None] * joint_count
        modes = [JointMode.POSITION] * joint_count
        targets = [0.0] * joint_count
        for i in range(joint_count):
            target = self._targets[i]
            if target is not None and clock.timestamp_ns <= target.valid_until_ns:
                modes[i] = target.mode
                targets[i] = target.target
                continue
            self._targets[i] = None
            targets[i] = self._hold_angle_rad(i, joints)
        return RequestedSetpoints(modes, targets, self._torque_limits_nm)

    def _hold_angle_rad(self, joint_index: int, joints: JointState) -> float:
        """Return the angle in rad that a joint had when it began to hold.

        The angle stays, because a joint that held its present angle in each cycle would sink under its load.
        """
        held_rad = self._held_angles_rad[joint_index]
        if held_rad is None:
            held_rad = joints.angle_rad[joint_index]
            self._held_angles_rad[joint_index] = held_rad
        return held_rad

    def _decode_command(self, payload: bytes) -> _FollowableCommand:
        """Decode mode, targets and timestamp of a sensor_msgs/JointState that commands joints.

        Args:
            payload: The message in CDR.

        Raises:
            _RefusedMessageError: The message is malformed, or a target is not allowed.
        """
        try:
            message: Any = TYPE_STORE.deserialize_cdr(payload, JOINT_STATE.name)
        except SerdeError as error:
            raise _RefusedMessageError(f"is no sensor_msgs/JointState: {error}") from None
        mode, field = _find_commanded_mode(message)
        values = [float(value) for value in getattr(message, field)]
        has_duplicates = len(set(message.name)) != len(message.name)
        if len(values) != len(message.name) or has_duplicates:
            raise _RefusedMessageError(
                f"has {len(values)} numbers in {field} for {len(message.name)} names, must have one for each joint"
            )
        targets: dict[int, float] = {}
        for name, value in zip(message.name, values, strict=True):
            self._validate_target(name, mode, field, value)
            targets[self._joint_indices[name]] = value
        ros_time = message.header.stamp
        timestamp_ns = ros_time.sec * 1_000_000_000 + ros_time.nanosec
        return _FollowableCommand(mode, targets, timestamp_ns)

    def _validate_target(self, name: str, mode: JointMode, field: str, value: float) -> None:
        """Raise _RefusedMessageError for a target that this robot's joint cannot follow."""
        if name not in self._joint_indices:
            known_names = ", ".join(self._joint_indices)
            raise _RefusedMessageError(
                f"names {name[:MAX_NAME_SHOWN]!r}; {self._robot.robot} has {known_names}"
            )
        if not math.isfinite(value):
            raise _RefusedMessageError(f"has {field} {value} for {name}, must be finite")
        joint = self._robot.joints[self._joint_indices[name]]
        if not joint.supports_mode(mode):
            supported = ", ".join(supported_mode.name.lower() for supported_mode in joint.modes)
            raise _RefusedMessageError(f"has {field} for {name}, whose drive takes {supported}")


def _determine_age_ns(command: _FollowableCommand, age_ns: int, ros_now_ns: int) -> int:
    """Determine the age of a command in ns, and refuse a command that is too old.

    Args:
        command: The command; its age follows from the timestamp of its header, if it has one.
        age_ns: Age of the command by the times of its sender's messages, for a command without a timestamp.
        ros_now_ns: Current time in ROS.

    Raises:
        _RefusedMessageError: The command is too old, or comes from the future.
    """
    source = "the times of its sender's messages"
    if command.timestamp_ns:
        age_ns = ros_now_ns - command.timestamp_ns
        source = "the stamp of its header"
    refusal = explain_stale_message(age_ns, source)
    if refusal:
        raise _RefusedMessageError(refusal)
    return age_ns


def _find_commanded_mode(message: Any) -> tuple[JointMode, str]:
    """Return the mode that a message commands, and the name of its field: the first field that is not empty counts.

    Raises _RefusedMessageError.
    """
    for mode, field in MODE_FIELDS:
        if len(getattr(message, field)) > 0:
            return mode, field
    raise _RefusedMessageError("has no position, velocity or effort")
