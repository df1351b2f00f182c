"""Dry friction wherever a link touches something: obstacles, steps, hills, other links.

MuJoCo only pushes here, along normals. Its own friction is relaxed to a convex problem, with a side effect: a contact
that slides at speed v is pushed apart as well, with an acceleration of friction * 2 v / (time in which slip decays). A
body that slides along a rough peg then hops off it and back, and what it feels hangs on that time and on the step.

So friction is a law of its own, as under the feet (flat_ground.py): a contact sticks by a tangential spring to where it
stuck (Cundall and Strack, 1979), and slips where the spring would pull harder than mu N, with the normal force N of the
step before. The spring is as stiff as both bodies allow at this step.

What contacts remember is in MuJoCo's `userdata`, so a saved state is whole. A snake has few contacts, and for few of
them plain floats take less time than numpy.
"""

import math
from collections.abc import Collection

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.quantities import Vector
from snakesim_sim_backend.chain import Chain

# Numbers per contact in `userdata`: which one it is, its two bodies, the link's first, the mass that the spring has to
# follow, mu N, the normal and the stretch in the world, and the place on each body in that one's frame.
KEPT = 17
PER_LINK = 16  # contacts on average; more have no friction
MOST = 64  # contacts of two geoms, more than MuJoCo makes
AT_AN_END = 4.0  # how many times as easily a rod moves there as in its middle
PHASE = 0.5  # of the springs' vibration in one physics step
DAMPING = 0.5  # of critical
NO_TORQUE, NOTHING = np.zeros(3), (0.0, 0.0, 0.0)


def numbers_kept(links: int) -> int:
    """In `userdata`."""
    return 1 + KEPT * PER_LINK * links


class ContactFriction:
    """Friction of one simulation. `apply` comes between `mj_step1` and `mj_step2`, `remember` after them."""

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        chain: Chain,
        link_geoms: Collection[int],
        friction: Floats,
        kept: Floats,
    ) -> None:
        """friction: (ngeom,) of what a link touches."""
        self._model, self._data, self._contact, self._chain = model, data, data.contact, chain
        self._friction: list[float] = friction.tolist()
        self._links = frozenset(link_geoms)
        self._bodies: list[int] = model.geom_bodyid.tolist()
        self._looseness = [AT_AN_END / mass if mass > 0.0 else 0.0 for mass in model.body_mass.tolist()]  # 1/kg
        step_s = float(model.opt.timestep)
        self._hardness = (PHASE / step_s) ** 2  # N/m for each kg
        self._damping = 2.0 * DAMPING * PHASE / step_s**2  # N per m in one step for each kg
        self._places, self._turns = data.xpos, data.xmat  # world_from_body, row by row
        self._kept = kept
        self._now: dict[float, tuple[Vector, Vector]] = {}  # stretch and force of each contact in this step
        self.least = 0.0  # of all friction, while a robot settles
        self.pairs: list[list[int]] = []  # geoms of all contacts of the last step, in MuJoCo's order
        self.push_n: list[float] = []  # along the normal of each
        self.rub_w: dict[int, Vector] = {}  # in N on the link, of those that rub

    def begin(self) -> None:
        """Forget all contacts."""
        self._kept[0] = 0.0
        self._now = {}

    def apply(self) -> None:
        """Add the forces of friction to MuJoCo's passive ones, which it computes in each step."""
        self._now = now = {}
        if not (count := int(self._kept[0])):
            return
        flat = self._kept[1 : 1 + KEPT * count].tolist()
        forces, places, owners = list[Vector](), list[Vector](), list[int]()
        for at in range(0, KEPT * count, KEPT):
            key, own, other, mass, most, nx, ny, nz, sx, sy, sz, *on_bodies = flat[at : at + KEPT]
            own, other = int(own), int(other)
            x, y, z = place = self._in_world(own, *on_bodies[:3])
            ox, oy, oz = self._in_world(other, *on_bodies[3:])
            dx, dy, dz = _across(x - ox, y - oy, z - oz, nx, ny, nz)  # how far it has slipped
            sx, sy, sz = _across(sx + dx, sy + dy, sz + dz, nx, ny, nz)
            stiffness, damping = self._hardness * mass, self._damping * mass
            held = _at_most(most, stiffness * math.sqrt(sx * sx + sy * sy + sz * sz))
            sx, sy, sz = held * sx, held * sy, held * sz
            fx, fy, fz = stiffness * sx + damping * dx, stiffness * sy + damping * dy, stiffness * sz + damping * dz
            held = -_at_most(most, math.sqrt(fx * fx + fy * fy + fz * fz))
            force = held * fx, held * fy, held * fz
            now[key] = (sx, sy, sz), force
            forces.append(force)
            places.append(place)
            owners.append(own)
            if other:
                back, passive = -np.array(force), self._data.qfrc_passive
                mujoco.mj_applyFT(self._model, self._data, back, NO_TORQUE, np.array(place), other, passive)
        self._chain.push(forces, places, owners)

    def remember(self) -> None:
        """Take up the contacts of the step that was made."""
        if not self._data.ncon:
            if self.pairs or self._kept[0]:
                self._kept[0], self.pairs, self.push_n, self.rub_w = 0.0, [], [], {}
            return
        contact, before = self._contact, self._now
        self._kept[0], self.rub_w = 0.0, {}
        self.pairs, forces = contact.geom.tolist(), self._data.efc_force.tolist()
        self.push_n = [forces[start] if start >= 0 else 0.0 for start in contact.efc_address.tolist()]
        links, friction, least = self._links, self._friction, self.least
        found: list[tuple[int, int, int, float]] = []
        for i, (first, second) in enumerate(self.pairs):
            link, other, sign = (first, second, -1.0) if first in links else (second, first, 1.0)
            if self.push_n[i] > 0.0 and link in links and (friction[other] > 0.0 or least > 0.0):
                found.append((i, link, other, sign))
        if not found:
            return
        del found[(len(self._kept) - 1) // KEPT :]
        frames, places = contact.frame.tolist(), contact.pos.tolist()
        flat, counts, bodies, looseness = list[float](), dict[int, int](), self._bodies, self._looseness
        owners = [bodies[link] for _, link, _, _ in found]
        for i, link, geom, sign in found:
            pair, own, other = link * len(bodies) + geom, bodies[link], bodies[geom]
            counts[pair] = nth = counts.get(pair, -1) + 1
            key, stretch = float(MOST * pair + nth), NOTHING
            if (was := before.get(key)) is not None:
                stretch, self.rub_w[i] = was
            normal = [sign * along for along in frames[i][:3]]  # MuJoCo's is from the first geom to the second
            mass = 1.0 / (owners.count(own) * (looseness[own] + looseness[other]))
            flat += (key, own, other, mass, max(friction[geom], least) * self.push_n[i], *normal, *stretch)
            flat += (*self._on_body(own, *places[i]), *self._on_body(other, *places[i]))
        self._kept[1 : 1 + len(flat)] = flat
        self._kept[0] = len(found)

    def _in_world(self, body: int, x: float, y: float, z: float) -> Vector:
        if not body:
            return x, y, z
        a, b, c, d, e, f, g, h, i = self._turns[body].tolist()
        px, py, pz = self._places[body].tolist()
        return px + a * x + b * y + c * z, py + d * x + e * y + f * z, pz + g * x + h * y + i * z

    def _on_body(self, body: int, x: float, y: float, z: float) -> Vector:
        if not body:
            return x, y, z
        a, b, c, d, e, f, g, h, i = self._turns[body].tolist()
        px, py, pz = self._places[body].tolist()
        x, y, z = x - px, y - py, z - pz
        return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z


def _across(x: float, y: float, z: float, nx: float, ny: float, nz: float) -> Vector:
    along = x * nx + y * ny + z * nz
    return x - along * nx, y - along * ny, z - along * nz


def _at_most(most: float, size: float) -> float:
    return most / size if size > most else 1.0
