"""From sensor_msgs/JointState on joint_commands to setpoints for every joint. Pure except for its own state.

A message names any joints. Each of them follows what it was told for half a second of robot time, from when the message
was sent on, then stays where it is; so does every joint of which nothing was said since arming. What is said while the
robot is not armed is dropped.
"""

import math
from dataclasses import dataclass
from typing import Any

from rosbags.serde import SerdeError

from snakesim_hal.wire.messages import Clock, Description, JointState, Mode
from snakesim_hal.wire.setpoints import RequestedSetpoints
from snakesim_operator.features.ros2.message_age import why_too_old
from snakesim_operator.features.ros2.messages import JOINT_STATE, STORE

VALID_NS = 500_000_000  # of a joint's command in robot time
KINDS = ((Mode.POSITION, "position"), (Mode.VELOCITY, "velocity"), (Mode.TORQUE, "effort"))  # the first given counts


@dataclass(frozen=True)
class _Commanded:
    """A message that can be followed."""

    mode: Mode
    targets: dict[int, float]  # by joint
    timestamp_ns: int  # of its header, in ROS time; 0: none


class JointTargets:
    """What each joint was told last."""

    def __init__(self, robot: Description) -> None:
        self._robot = robot
        self._index = {joint.name: i for i, joint in enumerate(robot.joints)}
        self._limits_nm = [joint.torque_limit_nm for joint in robot.joints]
        self._told: list[tuple[Mode, float, int] | None] = [None] * len(robot.joints)  # mode, target, until when
        self._stays_rad: list[float | None] = [None] * len(robot.joints)
        self.rejected = 0  # messages
        self.why = ""  # the last one was

    def take(self, payload: bytes, now_ns: int, ros_now_ns: int | None = None, age_ns: int = 0) -> bool:
        """Take in a message, all of it or nothing; returns whether it was taken.

        Args:
            payload: The message in CDR.
            now_ns: Robot time.
            ros_now_ns: The time in ROS, with which a header's stamp is compared; None: robot time.
            age_ns: How long ago the message was sent, for one without a stamp.
        """
        commanded = self._read(payload)
        if isinstance(commanded, str):
            return self._reject(commanded)
        by = "the times of its sender's messages"
        if commanded.timestamp_ns:
            age_ns = (now_ns if ros_now_ns is None else ros_now_ns) - commanded.timestamp_ns
            by = "the stamp of its header"
        if why := why_too_old(age_ns, by):
            return self._reject(why)
        until_ns = now_ns - max(age_ns, 0) + VALID_NS
        for i, target in commanded.targets.items():
            self._told[i] = (commanded.mode, target, until_ns)
            self._stays_rad[i] = None
        return True

    def _reject(self, why: str) -> bool:
        self.rejected += 1
        self.why = why
        return False

    def setpoints(self, clock: Clock, joints: JointState) -> RequestedSetpoints:
        """For this tick. An arming begins with staying."""
        count = len(self._robot.joints)
        if clock.lifecycle != "armed":
            self._told, self._stays_rad = [None] * count, [None] * count
        modes, targets = [Mode.POSITION] * count, [0.0] * count
        for i in range(count):
            told = self._told[i]
            if told is not None and clock.timestamp_ns <= told[2]:
                modes[i], targets[i] = told[0], told[1]
                continue
            self._told[i] = None
            stays_rad = self._stays_rad[i]
            if stays_rad is None:  # where it is now, not where it sinks to
                self._stays_rad[i] = stays_rad = joints.angle_rad[i]
            targets[i] = stays_rad
        return RequestedSetpoints(modes, targets, self._limits_nm)

    def _read(self, payload: bytes) -> "_Commanded | str":
        """What a message commands; a text: what is wrong with it."""
        try:
            found: Any = STORE.deserialize_cdr(payload, JOINT_STATE.name)
        except SerdeError as error:
            return f"is no sensor_msgs/JointState: {error}"
        mode, word = next(((mode, word) for mode, word in KINDS if len(getattr(found, word))), (None, ""))
        if mode is None:
            return "has no position, velocity or effort"
        values = [float(value) for value in getattr(found, word)]
        if len(values) != len(found.name) or len(set(found.name)) != len(found.name):
            return f"has {len(values)} numbers in {word} for {len(found.name)} names, must have one for each joint"
        targets: dict[int, float] = {}
        for name, value in zip(found.name, values, strict=True):
            if name not in self._index:
                return f"names {name[:40]!r}; {self._robot.robot} has {', '.join(self._index)}"
            joint = self._robot.joints[self._index[name]]
            if not math.isfinite(value):
                return f"has {word} {value} for {name}, must be finite"
            if not joint.has(mode):
                return f"has {word} for {name}, whose drive takes {', '.join(one.name.lower() for one in joint.modes)}"
            targets[self._index[name]] = value
        timestamp_ns = found.header.stamp.sec * 1_000_000_000 + found.header.stamp.nanosec
        return _Commanded(mode, targets, timestamp_ns)
