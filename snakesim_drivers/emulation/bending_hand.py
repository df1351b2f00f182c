"""A hand that bends joints whose motors are off, as a person bends a robot during calibration.

A file has the pose: the angle of every joint in rad, tail to head, separated by spaces. When the file changes, the hand
turns the joints to these angles, and releases them. A joint whose motor drives it is not touched.
"""

from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import BackendError

HAND_SPEED_RAD_S = 1.5
MAX_PASSIVE_TORQUE_NM = 0.01  # of a motor that is off, whose torque decays
POLL_STEPS = 20  # steps of the physics model from one look at the file to the next


class BendingHand:
    """Bends the joints of one physics model."""

    def __init__(self, path: Path, joint_count: int) -> None:
        """Bend nothing until the file exists.

        Args:
            path: Path of the file with the pose. Replace the file atomically, so that no half of it is read.
            joint_count: Number of angles in it.
        """
        self._path = path
        self._joint_count = joint_count
        self._steps_until_poll = 0
        self._modified_ns = -1
        self._target_rad: Floats | None = None  # None: the hand has released the joints

    def bend_passive_joints(
        self, angle_rad: Floats, velocity_rad_s: Floats, torque_nm: Floats, step_s: float
    ) -> None:
        """Set the velocities of joints whose motors are off, so that one step turns them towards the pose.

        The pose is that of the file, which is read again when it has changed. Once the joints have reached it, the hand
        releases them.

        Args:
            angle_rad: Angles of the joints, (n_joints,).
            velocity_rad_s: Their velocities, (n_joints,). Changed in place.
            torque_nm: Torques of their motors, (n_joints,).
            step_s: Duration of the step.

        Raises:
            BackendError: The file has another number of angles, or text that is no number.
        """
        self._steps_until_poll -= 1
        if self._steps_until_poll <= 0:
            self._steps_until_poll = POLL_STEPS
            self._poll_file()
        if self._target_rad is None:
            return
        # A motor without torque is off: the hand can turn its joint. All arrays are (n_joints,).
        is_free = np.abs(torque_nm) < MAX_PASSIVE_TORQUE_NM
        remaining_rad = np.where(is_free, self._target_rad - angle_rad, 0.0)
        # The hand turns each joint at most this far in one step.
        max_turn_rad = HAND_SPEED_RAD_S * step_s
        turn_rad = np.clip(remaining_rad, -max_turn_rad, max_turn_rad)
        velocity_rad_s[is_free] = turn_rad[is_free] / step_s
        has_reached_pose = not turn_rad.any()
        if has_reached_pose:
            self._target_rad = None

    def _poll_file(self) -> None:
        """Read the pose if the file is new."""
        try:
            modified_ns = self._path.stat().st_mtime_ns
        except FileNotFoundError:
            return
        if modified_ns == self._modified_ns:
            return
        self._modified_ns = modified_ns
        text = self._path.read_text()
        try:
            target_rad = np.array([float(word) for word in text.split()])
        except ValueError:
            target_rad = np.full(1, np.nan)  # rejected below
        if len(target_rad) != self._joint_count or not np.isfinite(target_rad).all():
            raise BackendError(
                f"{self._path}: write {self._joint_count} angles in rad, separated by spaces; it has {text[:80]!r}",
                code="config/invalid-value",
            )
        self._target_rad = target_rad
