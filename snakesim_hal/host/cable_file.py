"""Stores the counted angles of joints without end stops, so that they outlive the host: see `safety.cables`.

The file is in the folder of the latched emergency stop. With each angle it has the drive, sign and zero of the joint,
and when its cable was last declared unwound. If one of these has changed, the angle counts as unknown.

Threads: the host's thread makes every call; a `SerialWorker` thread writes, so that no joint waits for a disk.
"""

import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import NamedTuple

import msgspec

from snakesim_hal.base.atomic_write import write_atomically
from snakesim_hal.host.outbox import SerialWorker
from snakesim_hal.model.robot_file.joints import Joint
from snakesim_hal.safety.cables import REVOLUTION_RAD, CableJoint, CableTracker
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import JointState, RobotDescription

CABLE_FILENAME = "cables.json"
# Maximum age of `cable_unwound` in a robot file, for a host that has no stored angle.
MAX_DECLARATION_AGE_S = 3600.0
MAX_CLOCK_SKEW_S = 60.0  # by which the clock of the computer that declared it may be ahead
MIN_END_STOP_RAD = 0.1  # minimum part of a revolution that end stops take
WAY_OUT = (
    "with its cable unwound and the robot straight, `snakesim robot calibrate zero`, then restart the host within an "
    "hour"
)

NO_END_STOPS_MESSAGE = (
    "its limits of {:.3f} to {:.3f} rad leave no room for end stops: give `cable_turns`, that its cable bears to "
    f"either side, or limits that are {MIN_END_STOP_RAD:g} rad less than a turn apart"
)


class StoredCable(msgspec.Struct, frozen=True, kw_only=True):
    """The stored state of one joint."""

    angle_rad: float  # counted
    drive: str  # serial number, sign and zero
    unwound: str  # `cable_unwound` since which it is counted


class _FileContent(NamedTuple):
    """What the file of a robot has, or why it has nothing."""

    cables: Mapping[str, StoredCable]  # by the name of the joint
    missing_reason: str  # why there is no entry for a joint that is not in `cables`


class _LastAngle(NamedTuple):
    """The last known angle of a joint."""

    angle_rad: float | None  # None: not known
    unknown_reason: str = ""  # why it is not known


class CableFile:
    """The file of one robot. `cables` counts the angles."""

    def __init__(
        self, folder: Path, joints: Sequence[Joint], robot: RobotDescription, now_s: float
    ) -> None:
        """Read the stored angles of the joints with cables, and start to count from them.

        Args:
            folder: Folder of the robot's state, with the cable file.
            joints: Joints of the robot file.
            robot: Description of the robot, with the same joints in the same order.
            now_s: Wall time in s since the epoch.
        """
        self._path = folder / CABLE_FILENAME
        # Joint name -> its drive with sign and zero, and the time at which its cable was declared unwound.
        self._drive_by_joint: dict[str, tuple[str, str]] = {}
        cable_joints: list[CableJoint] = []
        last_angles_rad: dict[str, float] = {}
        unknown_reasons: dict[str, str] = {}
        file_content = self._read()
        for i, joint in enumerate(joints):
            cable_turns = joint.limits.cable_turns
            if cable_turns is None:
                if _lacks_end_stop_room(joint):
                    limits = joint.limits
                    unknown_reasons[joint.name] = NO_END_STOPS_MESSAGE.format(
                        limits.lower_rad, limits.upper_rad
                    )
                continue
            described = robot.joints[i]
            cable_joints.append(
                CableJoint(
                    joint.name, i, described.angle_min_rad, described.angle_max_rad, cable_turns
                )
            )
            drive = f"{described.serial} {joint.drive.sign:+d} {joint.drive.zero_rad:.6g}".strip()
            self._drive_by_joint[joint.name] = (drive, joint.limits.cable_unwound)
            last_angle = _find_last_known_angle(file_content, joint, drive, now_s)
            if last_angle.angle_rad is None:
                unknown_reasons[joint.name] = (
                    f"how far its cable is wound is not known: {last_angle.unknown_reason}; {WAY_OUT}"
                )
            else:
                last_angles_rad[joint.name] = last_angle.angle_rad
        self.tracker = CableTracker(cable_joints, last_angles_rad, unknown_reasons)
        self._writer = SerialWorker("cables")

    def update(self, joints: JointState) -> None:
        """Update the counted angles from a joint state, and store them if a joint has turned far enough."""
        self.tracker.update_angles(joints)
        self._queue_writing(self.tracker.pop_angles_to_save())

    def close(self) -> None:
        """Store the current angles, and wait for the disk unless it hangs."""
        self._queue_writing(self.tracker.pop_angles_to_save(should_force=True))
        self._writer.close()

    def _queue_writing(self, angles_rad: dict[str, float] | None) -> None:
        if angles_rad is not None:
            self._writer.submit(partial(self._write, angles_rad))

    def _write(self, angles_rad: dict[str, float]) -> None:
        """Write the file, in the thread of `SerialWorker`."""
        content: dict[str, StoredCable] = {}
        for name, (drive, unwound) in self._drive_by_joint.items():
            angle_rad = angles_rad.get(name)
            if angle_rad is not None:
                content[name] = StoredCable(
                    angle_rad=round(angle_rad, 4), drive=drive, unwound=unwound
                )
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(self._path, msgspec.json.encode(content), durable=True)
            self.tracker.save_problem = ""
        except OSError as error:
            self.tracker.save_problem = (
                f"{self._path}: {error.strerror}: the turns of its joints would be lost"
            )

    def _read(self) -> "_FileContent":
        """Read the file, if there is one."""
        try:
            cables = msgspec.json.decode(self._path.read_bytes(), type=dict[str, StoredCable])
        except FileNotFoundError:
            return _FileContent({}, f"no host before this one has stored it in {self._path}")
        except (OSError, *UNDECODABLE):
            return _FileContent({}, f"{self._path} cannot be read")
        return _FileContent(cables, "no host has stored it")


def open_cable_file(
    folder: Path, joints: Sequence[Joint], robot: RobotDescription
) -> CableFile | None:
    """Return the cable file of a robot; None if it is emulated, or if each of its joints has end stops."""
    if robot.emulated or all(
        joint.limits.cable_turns is None and not _lacks_end_stop_room(joint) for joint in joints
    ):
        return None
    return CableFile(folder, joints, robot, time.time())


def _lacks_end_stop_room(joint: Joint) -> bool:
    """Return whether a joint's limits leave no room for end stops within a revolution."""
    return joint.limits.upper_rad - joint.limits.lower_rad > REVOLUTION_RAD - MIN_END_STOP_RAD


def _find_last_known_angle(
    file_content: _FileContent, joint: Joint, drive: str, now_s: float
) -> _LastAngle:
    """Find the angle from which the turns of a joint are counted on: the last one that is known to be right.

    It is the stored angle if that belongs to the same drive, and to the same declaration that the cable is unwound.
    Otherwise it is 0 if a person has declared within the last hour, in the robot file, that the cable is unwound.

    Args:
        file_content: Content of the cable file.
        joint: Joint in the robot file.
        drive: Serial number, sign and zero of the joint's drive now.
        now_s: Wall time in s since the epoch.

    Returns:
        The angle in rad, or the reason why it is not known.
    """
    declaration_time = joint.limits.cable_unwound  # ISO 8601; empty if it was not declared
    stored = file_content.cables.get(joint.name)
    if stored is None:
        reason = file_content.missing_reason
    elif stored.drive == drive and stored.unwound == declaration_time:
        return _LastAngle(stored.angle_rad)
    else:
        reason = f"the stored angle is of another drive, sign or zero ({stored.drive}, now {drive})"
    if not declaration_time:
        return _LastAngle(None, reason)
    try:
        age_s = now_s - datetime.fromisoformat(declaration_time).timestamp()
    except ValueError:
        return _LastAngle(
            None,
            f"{reason}, and `cable_unwound` = {declaration_time!r} is no time such as 2026-11-25T02:40:12+00:00",
        )
    if -MAX_CLOCK_SKEW_S <= age_s <= MAX_DECLARATION_AGE_S:
        return _LastAngle(0.0)
    return _LastAngle(
        None,
        f"{reason}, and it was declared unwound at {declaration_time}, {age_s / 3600:.1f} h ago",
    )
