"""How far the cables of joints without end stops are wound, over restarts of drives and host. Pure.

A drive that was off forgets whole turns: it wakes up within one. So each such joint is followed from where it was last
seen, by at most half a turn from one sample to the next. Its drive's angle has turns less or more than the counted one.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from snakesim_hal.wire.messages import JointState

TURN_RAD = 2 * math.pi
KEEP_AFTER_RAD = math.pi / 4  # of motion: what is kept is never further from the truth than this and a disk's delay


@dataclass(frozen=True)
class CableJoint:
    """A joint whose cable is wound when it turns."""

    name: str
    index: int  # tail to head
    lower_rad: float  # limits of its drive angle, which the limiter enforces
    upper_rad: float
    cable_turns: float  # that it bears to either side of zero


class Cables:
    """The joints that have such a cable."""

    def __init__(self, joints: Sequence[CableJoint], seen_rad: Mapping[str, float], unknown: Mapping[str, str]) -> None:
        """seen_rad: the angle at which each was last seen; unknown: of the others, why it is not known."""
        self._joints = joints
        self._unknown = dict(unknown)
        self._angles_rad = dict(seen_rad)
        self._drives_rad: dict[str, float] = {}
        self._kept_rad: dict[str, float] = {}
        self.not_kept = ""  # why what is counted would be lost with this host

    def take(self, joints: JointState) -> None:
        """Follow a sample."""
        for joint in self._joints:
            drive_rad = joints.angle_rad[joint.index]
            if joint.name in self._angles_rad and joints.valid[joint.index] and math.isfinite(drive_rad):
                turns = round((self._angles_rad[joint.name] - drive_rad) / TURN_RAD)
                self._angles_rad[joint.name] = drive_rad + turns * TURN_RAD
                self._drives_rad[joint.name] = drive_rad

    def to_keep(self, *, all_of_it: bool = False) -> dict[str, float] | None:
        """The angles, when they should be kept now, because one has changed enough; from then on they count as kept."""
        found = {name: angle for name, angle in self._angles_rad.items() if name in self._drives_rad}
        changed = any(abs(angle - self._kept_rad.get(name, math.inf)) > KEEP_AFTER_RAD for name, angle in found.items())
        if not found or not (changed or all_of_it):
            return None
        self._kept_rad = found
        return dict(found)

    def against_arming(self) -> list[str]:
        """Why it must not be armed: a turn is not known, or its limits would wind a cable too far."""
        found = [f"{name}: {why}" for name, why in self._unknown.items()]
        for joint in self._joints:
            if (drive_rad := self._drives_rad.get(joint.name)) is not None:
                found += filter(None, [_wound(joint, drive_rad, self._angles_rad[joint.name])])
        return [*found, self.not_kept] if self.not_kept else found


def _wound(joint: CableJoint, drive_rad: float, angle_rad: float) -> str:
    turns = round((angle_rad - drive_rad) / TURN_RAD)
    most = max(abs(joint.lower_rad / TURN_RAD + turns), abs(joint.upper_rad / TURN_RAD + turns))
    if most <= joint.cable_turns:
        return ""
    back = f"{abs(turns)} turn{'s' if abs(turns) > 1 else ''} to {'lower' if turns > 0 else 'higher'} angles"
    return (
        f"{joint.name}: its drive says {drive_rad:+.2f} rad, and counted over restarts it is at {angle_rad:+.2f} rad: "
        f"within its limits its cable would be wound by up to {most:.2f} turns, and `cable_turns` = "
        f"{joint.cable_turns:g}. Turn it by hand by {back}, then switch its drive off and on and restart the host; "
        f"or, if its cable is not wound, `snakesim joints zero`"
    )
