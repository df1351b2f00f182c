"""The digests of many robots: hashes over every applied setpoint, as `BlackBox` computes them for one robot."""

import hashlib
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats

TICKS_AT_ONCE = 64  # hashing many ticks together costs little more than hashing one
Mask = NDArray[np.bool_]  # (robots,)


class _Tick(NamedTuple):
    """The setpoints of one tick, (robots, joints)."""

    robots: Mask  # which robots got setpoints
    ticks: NDArray[np.int64]  # (robots,), number of the control cycle
    modes: NDArray[np.int8]
    target: Floats
    torque_limit_nm: Floats


class CommandDigests:
    """A hash for each robot. Ticks are collected, and hashed together."""

    def __init__(self, robots: int, joints: int) -> None:
        self._hashes = [hashlib.sha256() for _ in range(robots)]
        self._ticks: list[_Tick] = []
        # One tick in the layout of `BlackBox`, little-endian and without gaps.
        self._layout = np.dtype(
            [
                ("tick", "<i8"),
                ("mode", "i1", (joints,)),
                ("target", "<f8", (joints,)),
                ("torque_limit_nm", "<f8", (joints,)),
            ]
        )

    def restart(self, robot: int) -> None:
        """Start the digest of a new episode."""
        self._hash_ticks()
        self._hashes[robot] = hashlib.sha256()

    def add(
        self,
        robots: Mask,
        ticks: NDArray[np.int64],
        modes: NDArray[np.int8],
        target: Floats,
        torque_limit_nm: Floats,
    ) -> None:
        """Add the setpoints of a tick. The arrays must not change afterwards.

        Args:
            robots: (robots,), which robots got setpoints.
            ticks: (robots,), numbers of the control cycle.
            modes: (robots, joints).
            target: (robots, joints).
            torque_limit_nm: (robots, joints).
        """
        self._ticks.append(_Tick(robots, ticks, modes, target, torque_limit_nm))
        if len(self._ticks) == TICKS_AT_ONCE:
            self._hash_ticks()

    def read(self, robot: int) -> str:
        """Return the digest of all setpoints of the present episode of a robot."""
        self._hash_ticks()
        return self._hashes[robot].hexdigest()

    def _hash_ticks(self) -> None:
        """Hash the collected ticks."""
        if not self._ticks:
            return
        packed = np.empty((len(self._hashes), len(self._ticks)), dtype=self._layout)
        for i, tick in enumerate(self._ticks):
            packed["tick"][:, i] = tick.ticks
            packed["mode"][:, i] = tick.modes
            packed["target"][:, i] = tick.target
            packed["torque_limit_nm"][:, i] = tick.torque_limit_nm
        got_setpoints = np.stack([tick.robots for tick in self._ticks], axis=1)  # (robots, ticks)
        self._ticks = []
        for robot_hash, rows, mask in zip(self._hashes, packed, got_setpoints, strict=True):
            robot_hash.update(rows[mask].tobytes())
