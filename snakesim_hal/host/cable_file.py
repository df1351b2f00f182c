"""Where the counted angles of joints without end stops are kept, so that they outlive the host: see `safety.cables`.

They lie beside the latched emergency stop, with whose they are: drive, sign and zero of each joint, and when its cable
was last declared unwound. What is of another is not known. A thread writes, so that no joint waits for a disk.
"""

import time
from collections.abc import Mapping, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path

import msgspec

from snakesim_hal.base.atomic_write import write_whole
from snakesim_hal.host.outbox import Sender
from snakesim_hal.model.joints import Joint
from snakesim_hal.safety.cables import TURN_RAD, CableJoint, Cables
from snakesim_hal.wire.codec import UNDECODABLE
from snakesim_hal.wire.messages import Description, JointState

CABLES = "cables.json"
FRESH_S = 3600.0  # that `cable_unwound` of a robot file counts for a host that has not kept it
AHEAD_S = 60.0  # that the clock of who declared it may be ahead
END_STOP_RAD = 0.1  # that end stops take of a turn, at least
WAY_OUT = "with its cable unwound and the robot straight, `snakesim joints zero`, then restart the host within an hour"

NO_STOPS = (
    "its limits of {:.3f} to {:.3f} rad leave no room for end stops: give `cable_turns`, that its cable bears to "
    f"either side, or limits that are {END_STOP_RAD:g} rad less than a turn apart"
)


class KeptCable(msgspec.Struct, frozen=True, kw_only=True):
    """One joint as it was last seen."""

    angle_rad: float  # counted
    drive: str  # whose: serial number, sign, zero
    unwound: str  # `cable_unwound` since which it is counted


class CableFile:
    """Of one robot. `cables` has what is counted."""

    def __init__(self, folder: Path, joints: Sequence[Joint], robot: Description, now_s: float) -> None:
        """joints: of the robot file; now_s: Unix time."""
        self._path = folder / CABLES
        self._owners: dict[str, tuple[str, str]] = {}
        wanted: list[CableJoint] = []
        seen_rad: dict[str, float] = {}
        unknown: dict[str, str] = {}
        kept = self._read()
        for i, joint in enumerate(joints):
            if (turns := joint.limits.cable_turns) is None:
                if _goes_round(joint):
                    unknown[joint.name] = NO_STOPS.format(joint.limits.lower_rad, joint.limits.upper_rad)
                continue
            described = robot.joints[i]
            wanted.append(CableJoint(joint.name, i, described.angle_min_rad, described.angle_max_rad, turns))
            owner = f"{described.serial} {joint.drive.sign:+d} {joint.drive.zero_rad:.6g}".strip()
            self._owners[joint.name] = owner, joint.limits.cable_unwound
            found = _seen(kept, joint, owner, now_s)
            if isinstance(found, str):
                unknown[joint.name] = f"how far its cable is wound is not known: {found}; {WAY_OUT}"
            else:
                seen_rad[joint.name] = found
        self.cables = Cables(wanted, seen_rad, unknown)
        self._writer = Sender("cables")

    def take(self, joints: JointState) -> None:
        """Follow a sample, and keep it when that is due."""
        self.cables.take(joints)
        self._keep(self.cables.to_keep())

    def close(self) -> None:
        """Keep where they are now, unless the disk hangs."""
        self._keep(self.cables.to_keep(all_of_it=True))
        self._writer.close()

    def _keep(self, angles_rad: dict[str, float] | None) -> None:
        if angles_rad is not None:
            self._writer.do(partial(self._write, angles_rad))

    def _write(self, angles_rad: dict[str, float]) -> None:
        content = {
            name: KeptCable(angle_rad=round(angle_rad, 4), drive=owner, unwound=unwound)
            for name, (owner, unwound) in self._owners.items()
            if (angle_rad := angles_rad.get(name)) is not None
        }
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(self._path, msgspec.json.encode(content), durable=True)
            self.cables.not_kept = ""
        except OSError as error:
            self.cables.not_kept = f"{self._path}: {error.strerror}: the turns of its joints would be lost"

    def _read(self) -> Mapping[str, KeptCable] | str:
        try:
            return msgspec.json.decode(self._path.read_bytes(), type=dict[str, KeptCable])
        except FileNotFoundError:
            return f"no host before this one has kept it in {self._path}"
        except (OSError, *UNDECODABLE):
            return f"{self._path} cannot be read"


def kept_at(folder: Path, joints: Sequence[Joint], robot: Description) -> CableFile | None:
    """None: the robot has no such joints, or nothing real moves."""
    if robot.emulated or all(joint.limits.cable_turns is None and not _goes_round(joint) for joint in joints):
        return None
    return CableFile(folder, joints, robot, time.time())


def _goes_round(joint: Joint) -> bool:
    return joint.limits.upper_rad - joint.limits.lower_rad > TURN_RAD - END_STOP_RAD


def _seen(kept: Mapping[str, KeptCable] | str, joint: Joint, owner: str, now_s: float) -> float | str:
    """The angle at which a joint was last seen, or why that is not known."""
    declared = joint.limits.cable_unwound
    why = kept if isinstance(kept, str) else "no host has kept it"
    if not isinstance(kept, str) and (last := kept.get(joint.name)) is not None:
        if (last.drive, last.unwound) == (owner, declared):
            return last.angle_rad
        why = f"what is kept is of another drive, sign or zero ({last.drive}, now {owner})"
    if not declared:
        return why
    try:
        age_s = now_s - datetime.fromisoformat(declared).timestamp()
    except ValueError:
        return f"{why}, and `cable_unwound` = {declared!r} is no time such as 2026-11-25T02:40:12+00:00"
    if -AHEAD_S <= age_s <= FRESH_S:
        return 0.0
    return f"{why}, and it was declared unwound at {declared}, {age_s / 3600:.1f} h ago"
