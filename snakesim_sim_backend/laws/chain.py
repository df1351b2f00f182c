"""Forces on the links of a simulated snake: collected, and added to MuJoCo's passive forces at once."""

from collections.abc import Sequence

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.quantities import Vector

FREE_DOFS = 6  # degrees of freedom of the base


class LinkChain:
    """The links of one simulation, tail to head.

    A wrench is a moment about the snake's center of mass, in N·m, followed by a force, in N; world frame. The
    wrenches of all links from a joint to the head act on that joint, and those of all links act on the base:

        generalized force of a degree of freedom = its axis of motion . sum of these wrenches
    """

    def __init__(self, data: mujoco.MjData, first_body: int, link_count: int) -> None:
        dofs = FREE_DOFS + link_count - 1
        self._first_body = first_body
        self._link_count = link_count
        self._wrenches: Floats | None = None  # (6, n_links), collected in this step

        # Views of MuJoCo's arrays.
        # The point about which MuJoCo takes moments.
        self._reference_w = data.subtree_com[first_body]
        self._base_axes = data.cdof[:FREE_DOFS]
        self._joint_axes = data.cdof[FREE_DOFS:dofs]
        self._base_forces = data.qfrc_passive[:FREE_DOFS]
        self._joint_forces = data.qfrc_passive[FREE_DOFS:dofs]

        # Sums of wrenches from the head to each link, head first, and views of them.
        self._sums = np.empty((link_count, 6))
        self._sum_of_all = self._sums[-1]
        self._sums_beyond_joints = self._sums[-2::-1]  # tail to head

    def push(
        self, forces_w: Sequence[Vector], points_w: Sequence[Vector], bodies: Sequence[int]
    ) -> None:
        """Collect forces, in N, that act at points on the links with these body numbers."""
        sums = [0.0] * (6 * self._link_count)
        cx, cy, cz = self._reference_w.tolist()
        for (fx, fy, fz), (x, y, z), body in zip(forces_w, points_w, bodies, strict=True):
            x, y, z = x - cx, y - cy, z - cz
            start = 6 * (body - self._first_body)
            sums[start] += y * fz - z * fy
            sums[start + 1] += z * fx - x * fz
            sums[start + 2] += x * fy - y * fx
            sums[start + 3] += fx
            sums[start + 4] += fy
            sums[start + 5] += fz
        self.add_link_wrenches(np.array(sums).reshape(-1, 6).T)

    def add_link_wrenches(self, wrenches: Floats) -> None:
        """Collect one wrench per link, (6, n_links)."""
        if self._wrenches is None:
            self._wrenches = wrenches
        else:
            self._wrenches = self._wrenches + wrenches

    def apply(self) -> None:
        """Add the generalized forces of the collected wrenches to MuJoCo's passive forces."""
        if self._wrenches is None:
            return
        np.add.accumulate(self._wrenches.T[::-1], 0, None, self._sums)
        # The products are added one by one: `np.vecdot` rounds in another way on each kind of processor.
        self._base_forces += np.add.reduce(self._base_axes * self._sum_of_all, 1)
        self._joint_forces += np.add.reduce(self._joint_axes * self._sums_beyond_joints, 1)
        self._wrenches = None
