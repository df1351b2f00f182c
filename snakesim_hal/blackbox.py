"""The black box: every tick of a run as the host saw it, kept in memory and written once at the end.

`command_digest` is a hash over every set-point as applied, so two runs with one digest drove the motors alike.

Rows come in blocks that are never moved: to copy a longer and longer table took 60 ms of a tick after three minutes at
100 Hz, and cost the controller its lease.
"""

import hashlib
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from snakesim_hal import keys
from snakesim_hal.authority import Decision
from snakesim_hal.backend import Samples
from snakesim_hal.messages import Contacts, Description, Pose

Floats = NDArray[np.float64]
BLOCK_ROWS = 1024


class BlackBox:
    """Grows as the run goes; a row a tick."""

    def __init__(self, description: Description) -> None:
        self._joints = len(description.joints)
        self._rows = 0
        self._numbers: list[Floats] = []  # block by block
        self._modes: list[NDArray[np.int8]] = []
        self._digest = hashlib.sha256()
        self._pack = struct.Struct(f"<q{self._joints}b{2 * self._joints}d").pack
        self._pose = [np.nan] * 7
        self._contact_peak_n = 0.0
        self._contact_count = 0

    def _width(self) -> int:
        return 1 + 5 * self._joints + 7 + 2

    def record(self, tick: int, stamp_ns: int, samples: Samples, decision: Decision) -> None:
        """Keep one tick."""
        row = self._rows % BLOCK_ROWS
        if row == 0:
            self._numbers.append(np.empty((BLOCK_ROWS, self._width())))
            self._modes.append(np.empty((BLOCK_ROWS, self._joints), dtype=np.int8))
        pose = samples.others.get(keys.POSE)
        if isinstance(pose, Pose):
            self._pose = [*pose.position_w, *pose.orientation_wxyz]
        contacts = samples.others.get(keys.CONTACTS)
        if isinstance(contacts, Contacts):
            squares = [f[0] * f[0] + f[1] * f[1] + f[2] * f[2] for f in (c.force_l for c in contacts.contacts)]
            self._contact_peak_n = max(squares, default=0.0) ** 0.5
            self._contact_count = len({c.obstacle for c in contacts.contacts})
        joints, points = samples.joints, decision.set_points
        self._numbers[-1][row] = [
            stamp_ns * 1e-9,
            *joints.angle_rad,
            *joints.velocity_rad_s,
            *joints.torque_nm,
            *points.target,
            *points.torque_limit_nm,
            *self._pose,
            self._contact_peak_n,
            self._contact_count,
        ]
        self._modes[-1][row] = points.mode
        self._rows += 1
        self._digest.update(self._pack(tick, *points.mode, *points.target, *points.torque_limit_nm))

    @property
    def ticks(self) -> int:
        """Rows kept."""
        return self._rows

    @property
    def command_digest(self) -> str:
        """Hash of every set-point applied so far."""
        return self._digest.hexdigest()

    def arrays(self) -> dict[str, Any]:
        """The columns: time_s (n,), angle_rad (n, joints), ..., position_w (n, 3), orientation_wxyz (n, 4)."""
        j = self._joints
        rows = np.concatenate([np.empty((0, self._width())), *self._numbers])[: self._rows]
        modes = np.concatenate([np.empty((0, j), dtype=np.int8), *self._modes])[: self._rows]
        names = ["angle_rad", "velocity_rad_s", "torque_nm", "target", "torque_limit_nm"]
        columns: dict[str, Any] = {"time_s": rows[:, 0], "mode": modes}
        for k, name in enumerate(names):
            columns[name] = rows[:, 1 + k * j : 1 + (k + 1) * j]
        rest = rows[:, 1 + 5 * j :]
        columns["position_w"] = rest[:, :3]
        columns["orientation_wxyz"] = rest[:, 3:7]
        columns["contact_peak_n"] = rest[:, 7]
        columns["contact_count"] = rest[:, 8]
        return columns

    def save(self, path: Path) -> None:
        """Write everything as a NumPy archive."""
        np.savez_compressed(path, allow_pickle=False, **self.arrays())
