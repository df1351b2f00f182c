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

from snakesim_hal.base.arrays import Floats
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
    """The ground at height 0 of one simulation. `apply` comes between `mj_step1` and `mj_step2`.

    For so few feet a call of numpy costs more than what it computes, and a step is a millisecond or two. So `apply`
    makes few calls, on arrays and views that are there already. `_xy`: x and y of a foot, then those of the next, so
    that a complex number is a vector.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, chain: Chain, soles: Soles) -> None:
        gravity, step_s = -float(model.opt.gravity[2]), float(model.opt.timestep)
        sink_m = max(SINK_M, gravity * (step_s / MAX_PHASE) ** 2)
        self._friction, self.least = soles.friction, 0.0  # least: while a robot settles
        self.push_n = np.zeros(len(soles.geoms))  # on every foot, in the last step
        self._stiffness = stiffness = soles.shares_kg * gravity / sink_m  # N/m
        damping = 2.0 * DAMPING * soles.shares_kg * math.sqrt(gravity / sink_m) / step_s  # N per m in one step
        self._lift, self._lift_damping = -stiffness, -damping
        self._pull_xy, self._drag_xy = -stiffness.repeat(2), -damping.repeat(2)
        first, count, both = soles.first_body, len(soles.geoms), 2 * len(soles.geoms)
        bodies = np.minimum(np.arange(count) + first, first + count - 2)
        xy, z = np.add.outer(3 * soles.geoms, [0, 1]).ravel(), 3 * soles.geoms + 2
        self._positions, self._places = data.geom_xpos.reshape(-1), np.concatenate((xy, z))
        self._twists, self._turning_yx = data.cvel.reshape(-1), np.add.outer(6 * bodies, [1, 0]).ravel()
        self._rolled_xy = np.tile([-soles.radius_m * step_s, soles.radius_m * step_s], count)  # m for 1 rad/s
        self._about_xy, self._about_z = data.subtree_com[first, :2, None], data.subtree_com[first, 2:]
        self._radius_m, self._nothing, self._hardly = (np.full(count, value) for value in (soles.radius_m, 0.0, 1e-12))
        self._slip_xy, self._before = data.userdata[:both], data.userdata[both : KEPT * count]
        self._now, self._moved = np.empty(3 * count), np.empty(3 * count)
        self._slipped_xy, self._rub_xy = np.empty(both), np.empty(both)
        self._moved_xy, self._sunk, self._height = self._moved[:both], self._moved[both:], self._now[both:]
        self._slip, self._rub = self._slip_xy.view(np.complex128), self._rub_xy.view(np.complex128)
        self._rub_by_axis, self._now_by_axis = self._rub_xy.reshape(count, 2).T, self._now[:both].reshape(count, 2).T
        # What a cross product needs, row by row: arms along x, y, z, x, y; moments, and forces along x, y, z, x, y.
        self._arms, wrenches = np.empty((5, count)), np.zeros((8, count))
        self._moments, self._forces, self._wrenches, self._chain = wrenches[:3], wrenches[3:], wrenches[:6], chain

    def begin(self) -> None:
        """Take the feet as standing where they are."""
        self._slip_xy[:] = 0.0
        self._before[:] = self._positions[self._places]

    def apply(self) -> None:
        """Add the forces on the feet where they are now to MuJoCo's passive forces, which it computes in each step."""
        now, moved, height, slipped_xy = self._now, self._moved, self._height, self._slipped_xy
        self._positions.take(self._places, None, now, "clip")
        np.subtract(now, self._before, moved)
        self._before[:] = now
        self._twists.take(self._turning_yx, None, slipped_xy, "clip")
        slipped_xy *= self._rolled_xy
        slipped_xy += self._moved_xy
        height -= self._radius_m
        # N = k depth - d (dz/dt), and never a pull
        self._sunk *= self._lift_damping  # from here on in N
        self._sunk += self._lift * height
        self.push_n = push = np.maximum(self._sunk, self._nothing)
        most = max(self._friction, self.least) * push
        bound = np.maximum(most, self._hardly)  # of what is divided by: mu N, and never 0
        self._slip_xy += slipped_xy
        self._slip_xy *= (most / np.maximum(self._stiffness * np.abs(self._slip), bound)).repeat(2)
        # Spring and damper pull back, together no harder than mu N
        np.multiply(self._pull_xy, self._slip_xy, self._rub_xy)
        slipped_xy *= self._drag_xy
        self._rub_xy += slipped_xy
        forces, arms, moments = self._forces, self._arms, self._moments
        np.multiply(self._rub_by_axis, most / np.maximum(np.abs(self._rub), bound), forces[:2])
        forces[2], forces[3:] = push, forces[:2]
        # Moments: arm x force, about where MuJoCo's axes of motion are told
        np.subtract(self._now_by_axis, self._about_xy, arms[:2])
        np.subtract(height, self._about_z, arms[2])
        arms[3:] = arms[:2]
        np.multiply(arms[1:4], forces[2:], moments)
        moments -= arms[2:] * forces[1:4]
        self._wrenches[:, -2] += self._wrenches[:, -1]  # both feet of the head's link
        self._chain.push_links(self._wrenches[:, :-1])
