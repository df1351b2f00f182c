"""Forces on the links of a simulated snake: collected, and added to MuJoCo's passive ones at once."""

from collections.abc import Sequence

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.quantities import Vector

FREE_DOFS = 6  # of the base


class Chain:
    """The links of one simulation, tail to head."""

    def __init__(self, data: mujoco.MjData, first_body: int, links: int) -> None:
        self._first, self._count = first_body, links
        dofs = FREE_DOFS + links - 1
        self._about, axes, out = data.subtree_com[first_body], data.cdof[:dofs], data.qfrc_passive[:dofs]
        self._base_axes, self._axes = axes[:FREE_DOFS], axes[FREE_DOFS:]
        self._base, self._joints = out[:FREE_DOFS], out[FREE_DOFS:]
        self._beyond = np.empty((links, 6))  # head to tail: a joint turns all that is nearer to the head
        self._whole, self._beyond_joint = self._beyond[-1], self._beyond[-2::-1]
        self._wrenches: Floats | None = None

    def push(self, forces_w: Sequence[Vector], places_w: Sequence[Vector], bodies: Sequence[int]) -> None:
        """Collect forces on bodies."""
        sums = [0.0] * (6 * self._count)
        cx, cy, cz = self._about.tolist()
        for (fx, fy, fz), (x, y, z), body in zip(forces_w, places_w, bodies, strict=True):
            x, y, z, at = x - cx, y - cy, z - cz, 6 * (body - self._first)
            sums[at] += y * fz - z * fy
            sums[at + 1] += z * fx - x * fz
            sums[at + 2] += x * fy - y * fx
            sums[at + 3] += fx
            sums[at + 4] += fy
            sums[at + 5] += fz
        self.push_links(np.array(sums).reshape(-1, 6).T)

    def push_links(self, wrenches: Floats) -> None:
        """Collect moments about the center of mass, and forces, (6, n_links)."""
        self._wrenches = wrenches if self._wrenches is None else self._wrenches + wrenches

    def apply(self) -> None:
        """Add what was collected."""
        if self._wrenches is None:
            return
        np.add.accumulate(self._wrenches.T[::-1], 0, None, self._beyond)
        self._base += np.vecdot(self._base_axes, self._whole)
        self._joints += np.vecdot(self._axes, self._beyond_joint)
        self._wrenches = None
