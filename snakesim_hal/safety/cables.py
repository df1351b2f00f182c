"""How far the cables of joints without end stops are wound, over restarts of drives and host. Pure.

A drive that was off loses the count of whole turns: it starts within one. So each such joint is followed from its
last measured angle, by at most half a turn from one sample to the next. The angle of its drive differs from the
counted one by whole turns.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from snakesim_hal.wire.messages import JointState

TURN_RAD = 2 * math.pi
# Motion after which the angles are saved again. What is saved differs from the truth by at most this angle, and by
# what the joint turns while the disk is busy.
KEEP_AFTER_RAD = math.pi / 4


@dataclass(frozen=True)
class CableJoint:
    """A joint whose cable is wound when it turns."""

    name: str
    index: int  # tail to head
    lower_rad: float  # limits of its drive angle, which the limiter enforces
    upper_rad: float
    cable_turns: float  # maximum winding of the cable to either side of zero, in turns


class Cables:
    """The joints that have such a cable."""

    def __init__(self, joints: Sequence[CableJoint], seen_rad: Mapping[str, float], unknown: Mapping[str, str]) -> None:
        """Start to follow the joints.

        Args:
            joints: the joints that have such a cable.
            seen_rad: the counted angle at which each joint was last measured, by name.
            unknown: why the angle of each other joint is not known, by name.
        """
        self._joints = joints
        self._unknown = dict(unknown)
        self._angles_rad = dict(seen_rad)  # counted over restarts
        self._drives_rad: dict[str, float] = {}  # as the drive measures it
        self._kept_rad: dict[str, float] = {}
        self.save_problem = ""  # why the counted angles would be lost with this host; empty if they are saved

    def follow(self, joints: JointState) -> None:
        """Follow a sample."""
        for joint in self._joints:
            if joint.name not in self._angles_rad:
                continue
            drive_rad = joints.angle_rad[joint.index]
            if joints.valid[joint.index] and math.isfinite(drive_rad):
                turns = round((self._angles_rad[joint.name] - drive_rad) / TURN_RAD)
                self._angles_rad[joint.name] = drive_rad + turns * TURN_RAD
                self._drives_rad[joint.name] = drive_rad

    def take_angles_to_save(self, *, all_of_it: bool = False) -> dict[str, float] | None:
        """Return the counted angles if they should be saved now; from then on they count as saved.

        Args:
            all_of_it: whether to save them even if no joint has turned far enough since the last time.
        """
        angles_rad = {name: angle for name, angle in self._angles_rad.items() if name in self._drives_rad}
        if not angles_rad:
            return None
        if not all_of_it and not self._have_changed(angles_rad):
            return None
        self._kept_rad = angles_rad
        return dict(angles_rad)

    def list_arming_obstacles(self) -> list[str]:
        """Return why the robot must not be armed: a turn is not known, or a cable could be wound too far."""
        reasons = [f"{name}: {why}" for name, why in self._unknown.items()]
        for joint in self._joints:
            drive_rad = self._drives_rad.get(joint.name)
            if drive_rad is None:
                continue
            reason = _explain_winding(joint, drive_rad, self._angles_rad[joint.name])
            if reason is not None:
                reasons.append(reason)
        if self.save_problem:
            reasons.append(self.save_problem)
        return reasons

    def _have_changed(self, angles_rad: Mapping[str, float]) -> bool:
        """Return whether a joint has turned far enough since its angle was saved, or it never was."""
        for name, angle_rad in angles_rad.items():
            if abs(angle_rad - self._kept_rad.get(name, math.inf)) > KEEP_AFTER_RAD:
                return True
        return False


def _explain_winding(joint: CableJoint, drive_rad: float, angle_rad: float) -> str | None:
    """Return what to do if the limits of a joint would let it wind its cable too far, or None."""
    turns = round((angle_rad - drive_rad) / TURN_RAD)
    max_turns = max(abs(joint.lower_rad / TURN_RAD + turns), abs(joint.upper_rad / TURN_RAD + turns))
    if max_turns <= joint.cable_turns:
        return None
    plural = "s" if abs(turns) > 1 else ""
    direction = "lower" if turns > 0 else "higher"
    return (
        f"{joint.name}: its drive reports {drive_rad:+.2f} rad, but it is at {angle_rad:+.2f} rad by the turns counted "
        f"over restarts: within its limits its cable would be wound by up to {max_turns:.2f} turns, and "
        f"`cable_turns` = {joint.cable_turns:g}. Turn it by hand by {abs(turns)} turn{plural} to {direction} "
        f"angles, then switch its drive off and on and restart the host; or, if its cable is not "
        f"wound, run `snakesim robot calibrate zero`"
    )
