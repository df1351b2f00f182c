"""Flat ground under the feet: normal forces and dry friction by a law of our own, in every physics step.

MuJoCo solves normals and friction of all contacts in one relaxed problem. That is stable, but slip decays with a time
constant instead of being opposed by mu N, and loads that statics leaves open fall where the solver puts them. A
symmetric robot whose wave is mirrored then drifts the same way twice, by centimetres per second. Here instead:

- Every foot stands on a spring, as stiff as its share of the weight (half of each link that it ends), so a body that
  lies straight sinks in evenly and every foot bears its share.
- A foot sticks to the ground by a tangential spring from the point where it stuck (Cundall and Strack, 1979), which
  slips when it would pull harder than mu N. Slip is measured by how far the foot has really moved since the last step:
  velocities of the integrator belong to a moment half a step away, which at a curving foot is a force of its own.

What it remembers is in MuJoCo's `userdata`, so a saved state is whole.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.arrays import Floats
from snakesim_sim_backend.chain import Chain

SINK_M = 2e-4  # of a foot under its share of the weight
MAX_PHASE = 0.7  # of that spring's vibration in one physics step; long steps get softer ground
DAMPING = 0.5  # of critical
KEPT = 5  # numbers per foot in `userdata`: two of its slip, three of its position


@dataclass(frozen=True)
class Soles:
    """The feet of a model on flat ground."""

    geoms: NDArray[np.int64]  # tail to head, (feet,); one at the tail of each body, and one at the head of the last
    first_body: int
    shares_kg: Floats  # of the weight
    radius_m: float
    friction: float


def soles_of(model: mujoco.MjModel, first_body: int, links: int, radius_m: float, friction: float) -> Soles:
    """Of a compiled model, whose feet are called foot_0 onwards."""
    masses = model.body_mass[first_body : first_body + links]
    geoms = np.array([model.geom(f"foot_{i}").id for i in range(links + 1)])
    shares = 0.5 * (np.append(masses, 0.0) + np.append(0.0, masses))
    return Soles(geoms, first_body, shares, radius_m, friction)


class FlatGround:
    """The ground at height 0 of one simulation. `apply` comes between `mj_step1` and `mj_step2`."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, chain: Chain, soles: Soles) -> None:
        gravity, step_s = -float(model.opt.gravity[2]), float(model.opt.timestep)
        sink_m = max(SINK_M, gravity * (step_s / MAX_PHASE) ** 2)
        self._friction, self.least = soles.friction, 0.0  # least: while a robot settles
        self.push_n = np.zeros(len(soles.geoms))  # on every foot, in the last step
        self._geoms, self._radius_m, self._step_s = soles.geoms, soles.radius_m, step_s
        self._stiffness = soles.shares_kg * gravity / sink_m  # N/m
        self._damping = 2.0 * DAMPING * soles.shares_kg * math.sqrt(gravity / sink_m) / step_s  # N per m in one step
        first, count = soles.first_body, len(soles.geoms)
        self._bodies = np.minimum(np.arange(count) + first, first + count - 2)
        self._positions, self._velocities = data.geom_xpos, data.cvel
        self._reference, self._chain = data.subtree_com[first], chain
        kept = data.userdata[: KEPT * count].reshape(KEPT, count)
        self._slip, self._before = kept[:2].reshape(-1).view(np.complex128), kept[2:]

    def begin(self) -> None:
        """Take the feet as standing where they are."""
        self._slip[:] = 0.0
        self._before[:] = self._positions[self._geoms].T

    def apply(self) -> None:
        """Add the forces on the feet where they are now to MuJoCo's passive forces, which it computes in each step."""
        x, y, z = now = self._positions.take(self._geoms, axis=0).T
        turning = self._velocities.take(self._bodies, axis=0)
        moved = now - self._before
        self._before[:] = now
        rolled_m = self._radius_m * self._step_s
        slipped = moved[0] + 1j * moved[1] + rolled_m * (1j * turning[:, 0] - turning[:, 1])
        # N = k depth - d (dz/dt), and never a pull
        self.push_n = push = np.maximum(self._stiffness * (self._radius_m - z) - self._damping * moved[2], 0.0)
        most = max(self._friction, self.least) * push
        slip = self._slip
        slip += slipped
        slip *= np.minimum(1.0, most / np.maximum(self._stiffness * np.abs(slip), 1e-12))
        rub = self._stiffness * slip + self._damping * slipped
        rub *= -np.minimum(1.0, most / np.maximum(np.abs(rub), 1e-12))
        force_x, force_y = rub.real, rub.imag
        at_x, at_y, at_z = self._reference.tolist()
        x, y, z = x - at_x, y - at_y, z - self._radius_m - at_z
        wrenches = np.array(
            (
                y * push - z * force_y,
                z * force_x - x * push,
                x * force_y - y * force_x,
                force_x,
                force_y,
                push,
            )
        )
        wrenches[:, -2] += wrenches[:, -1]  # both feet of the head's link
        self._chain.push_links(wrenches[:, :-1])
