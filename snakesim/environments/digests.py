"""The digests of many robots: hashes over every applied setpoint, as `BlackBox` computes them for one robot."""

import hashlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

MAX_PENDING_TICKS = 64  # hashing many ticks together costs little more than hashing one
Mask = NDArray[np.bool_]  # (robots,)


class _TickSetpoints(NamedTuple):
    """The setpoints of one tick. Arrays without another shape are (robots, joints)."""

    robots: Mask  # which robots got setpoints
    ticks: NDArray[np.int64]  # (robots,), number of the control cycle
    modes: NDArray[np.int8]
    target: Floats
    torque_limit_nm: Floats


class CommandDigests:
    """Computes a digest of all setpoints for each robot. Ticks are collected, and hashed together."""

    def __init__(self, robot_count: int, joint_count: int) -> None:
        self._hashes = [hashlib.sha256() for _ in range(robot_count)]
        self._pending_ticks: list[_TickSetpoints] = []
        # One tick in the layout of `BlackBox`, little-endian and without gaps.
        self._tick_dtype = np.dtype(
            [
                ("tick", "<i8"),
                ("mode", "i1", (joint_count,)),
                ("target", "<f8", (joint_count,)),
                ("torque_limit_nm", "<f8", (joint_count,)),
            ]
        )

    def restart(self, robot_index: int) -> None:
        """Start the digest of a new episode."""
        self._hash_pending_ticks()
        self._hashes[robot_index] = hashlib.sha256()

    def add(
        self,
        robots: Mask,
        ticks: NDArray[np.int64],
        modes: NDArray[np.int8],
        target: Floats,
        torque_limit_nm: Floats,
    ) -> None:
        """Add the setpoints of one tick to the digests. The arrays must not change afterwards.

        Args:
            robots: Which robots got setpoints in this tick, (robots,). The rows of all other robots are ignored.
            ticks: Number of the control cycle of each robot, (robots,).
            modes: Control mode of every joint, (robots, joints).
            target: Target of every joint, (robots, joints), in rad, rad/s or N·m depending on the mode.
            torque_limit_nm: Torque limit of every joint, (robots, joints).
        """
        self._pending_ticks.append(_TickSetpoints(robots, ticks, modes, target, torque_limit_nm))
        if len(self._pending_ticks) == MAX_PENDING_TICKS:
            self._hash_pending_ticks()

    def read(self, robot_index: int) -> str:
        """Return the digest of all setpoints of the current episode of a robot."""
        self._hash_pending_ticks()
        return self._hashes[robot_index].hexdigest()

    def _hash_pending_ticks(self) -> None:
        """Add the collected ticks to the digests, and drop the ticks."""
        if not self._pending_ticks:
            return
        ticks = self._pending_ticks
        robot_count = len(self._hashes)
        packed_ticks = np.empty((len(ticks), robot_count), dtype=self._tick_dtype)
        packed_ticks["tick"] = [tick.ticks for tick in ticks]
        # To concatenate many small arrays takes less time than to copy each of them into its place.
        per_joint = (len(ticks), robot_count, -1)
        packed_ticks["mode"] = np.concatenate([tick.modes for tick in ticks]).reshape(per_joint)
        packed_ticks["target"] = np.concatenate([tick.target for tick in ticks]).reshape(per_joint)
        packed_ticks["torque_limit_nm"] = np.concatenate(
            [tick.torque_limit_nm for tick in ticks]
        ).reshape(per_joint)
        got_setpoints = np.array([tick.robots for tick in ticks])  # (ticks, robots)
        self._pending_ticks = []
        for robot_index, robot_hash in enumerate(self._hashes):
            rows = packed_ticks[got_setpoints[:, robot_index], robot_index]
            robot_hash.update(rows.tobytes())
