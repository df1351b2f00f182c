"""How far the cables of joints without end stops are wound, over restarts of drives and host. Pure.

A drive that was off loses the count of whole turns: it starts within one. So each such joint is followed from its
last measured angle, by at most half a turn from one sample to the next. The angle of its drive differs from the
counted one by whole turns.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from snakesim_hal.wire.messages import JointState

REVOLUTION_RAD = 2 * math.pi
# Motion after which the angles are saved again. What is saved differs from the truth by at most this angle, and by
# what the joint turns while the disk is busy.
SAVE_THRESHOLD_RAD = math.pi / 4


@dataclass(frozen=True)
class CableJoint:
    """A joint whose cable is wound when it turns."""

    name: str
    index: int  # tail to head
    lower_rad: float  # limits of its drive angle, which the limiter enforces
    upper_rad: float
    cable_turns: float  # maximum winding of the cable to either side of zero, in turns


class CableTracker:
    """The joints that have such a cable."""

    def __init__(
        self,
        joints: Sequence[CableJoint],
        last_angles_rad: Mapping[str, float],
        unknown_reasons: Mapping[str, str],
    ) -> None:
        """Start to track the angles of the joints.

        Args:
            joints: Joints whose cable is wound when they turn.
            last_angles_rad: Angle at which each joint was last measured, counted over all revolutions, by joint name.
            unknown_reasons: Reason why the angle of a joint is not known, by joint name.
        """
        self._joints = joints
        self._unknown_reasons = dict(unknown_reasons)
        self._angles_rad = dict(last_angles_rad)  # counted over restarts
        self._drive_angles_rad: dict[str, float] = {}  # as the drive measures it
        self._saved_angles_rad: dict[str, float] = {}
        # Why the counted angles would be lost with this host; empty if they are saved.
        self.save_problem = ""

    def update_angles(self, joints: JointState) -> None:
        """Update the counted angles from a joint state. A joint turns at most half a revolution between two samples."""
        for joint in self._joints:
            if joint.name not in self._angles_rad:
                continue
            drive_rad = joints.angle_rad[joint.index]
            if joints.valid[joint.index] and math.isfinite(drive_rad):
                turns = round((self._angles_rad[joint.name] - drive_rad) / REVOLUTION_RAD)
                self._angles_rad[joint.name] = drive_rad + turns * REVOLUTION_RAD
                self._drive_angles_rad[joint.name] = drive_rad

    def pop_angles_to_save(self, *, should_force: bool = False) -> dict[str, float] | None:
        """Return the counted angles if they should be saved now, and mark them as saved.

        Args:
            should_force: Whether to save the angles even if no joint has turned far enough since the last time.

        Returns:
            The angle in rad of each measured joint by name, or None if nothing should be saved.
        """
        angles_rad = {
            name: angle
            for name, angle in self._angles_rad.items()
            if name in self._drive_angles_rad
        }
        if not angles_rad:
            return None
        if not should_force and not self._have_angles_changed(angles_rad):
            return None
        self._saved_angles_rad = angles_rad
        return dict(angles_rad)

    def list_arming_obstacles(self) -> list[str]:
        """Return a text for each reason why the robot must not be armed.

        The number of revolutions of a joint is not known, a cable could be wound too far, or the angles cannot be
        saved.
        """
        reasons = [f"{name}: {reason}" for name, reason in self._unknown_reasons.items()]
        for joint in self._joints:
            drive_rad = self._drive_angles_rad.get(joint.name)
            if drive_rad is None:
                continue
            reason = _find_winding_problem(joint, drive_rad, self._angles_rad[joint.name])
            if reason is not None:
                reasons.append(reason)
        if self.save_problem:
            reasons.append(self.save_problem)
        return reasons

    def _have_angles_changed(self, angles_rad: Mapping[str, float]) -> bool:
        """Return whether a joint has turned far enough since its angle was saved, or its angle was never saved."""
        for name, angle_rad in angles_rad.items():
            if abs(angle_rad - self._saved_angles_rad.get(name, math.inf)) > SAVE_THRESHOLD_RAD:
                return True
        return False


def _find_winding_problem(joint: CableJoint, drive_rad: float, angle_rad: float) -> str | None:
    """Return the problem and the remedy if a joint could wind its cable too far within its limits; otherwise None."""
    turns = round((angle_rad - drive_rad) / REVOLUTION_RAD)
    max_turns = max(
        abs(joint.lower_rad / REVOLUTION_RAD + turns), abs(joint.upper_rad / REVOLUTION_RAD + turns)
    )
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
