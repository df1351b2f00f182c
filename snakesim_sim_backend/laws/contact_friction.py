"""Dry friction wherever a link touches something: obstacles, steps, hills, other links.

MuJoCo only pushes along normals here. Its own friction is relaxed to a convex problem, which has a side effect: a
contact that slides at speed v is also pushed apart, with an acceleration of friction * 2 v / (time in which slip
decays). A body that slides along a rough peg then hops off it and back, and the measured forces depend on that time and
on the length of the physics step.

So friction is computed here, by the same law as under the feet (flat_ground.py): a contact sticks by a tangential
spring to the point where it stuck, and slips when the spring would pull harder than mu N. N is the normal force of the
previous step. The spring is as stiff as the masses of both bodies allow at this time step.

The state of the contacts is in MuJoCo's `userdata`, so that a saved MuJoCo state is complete. A snake has few contacts,
and for a few of them plain floats take less time than NumPy.

Source: P. A. Cundall and O. D. L. Strack, "A discrete numerical model for granular assemblies", Géotechnique 29, 1979.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import mujoco
import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.quantities import Vector
from snakesim_sim_backend.laws.chain import LinkChain
from snakesim_sim_backend.laws.directional import (
    BACKWARD,
    FORWARD,
    SEPARATE_LIMITS,
    SIDEWAYS,
    VISCOUS_ACROSS,
    VISCOUS_ALONG,
    DirectionalCoefficients,
    LinkUndersides,
    apply_directional_friction,
    apply_separate_limits,
    combine_coefficients,
)
from snakesim_sim_backend.laws.laws import find_normal_forces_n

# Numbers per contact in `userdata`: its key, the link's body, the other body, the mass that the spring has to follow in
# kg, mu N in N, the normal (3) and the stretch in m (3) in the world frame, the contact point in the frame of the link
# (3) and of the other body (3), the coefficients forward, backward and sideways divided by mu, viscous friction along
# and across the link in N·s/m, and 1 if friction along the link and across it do not limit each other.
VALUES_PER_CONTACT = 23
CONTACTS_PER_LINK = 16  # on average; the contacts beyond that number have no friction
CONTACTS_PER_PAIR = 64  # of two geoms: more than MuJoCo makes, so that keys are unique
END_MOBILITY = 4.0  # how many times as easily a rod moves at its end as in its middle
PHASE_RAD = 0.5  # by which the springs vibrate in one physics step
DAMPING_RATIO = 0.5  # of critical damping
WORLD_BODY = 0  # MuJoCo's number of the body that does not move
NO_TORQUE = np.zeros(3)
NO_STRETCH = (0.0, 0.0, 0.0)


def count_contact_values(link_count: int) -> int:
    """Return how many numbers in `userdata` the contacts of a snake need."""
    return 1 + VALUES_PER_CONTACT * CONTACTS_PER_LINK * link_count


class _FrictionContact(NamedTuple):
    """A contact of the last step that has friction."""

    number: int  # in MuJoCo's contacts
    link_geom: int
    other_geom: int
    sign: float  # makes MuJoCo's normal point from the other body into the link


class ContactFriction:
    """Friction of one simulation. Call `apply` between `mj_step1` and `mj_step2`, `update_contacts` after them.

    Equations of one contact, in the world frame, with the time step dt and the mass m that the spring has to follow:

        k = m (PHASE / dt)^2                     stiffness, N/m
        d = 2 DAMPING_RATIO m PHASE / dt^2       damping, N per m of slip in one step
        ds = motion of the link's point relative to the other body's point, without its part along the normal n
        s  = (s + ds) min(1, mu N / (k |s + ds|))    stretch of the spring, tangential to the surface
        F  = -(k s + d ds), limited to |F| <= mu N   friction force on the link

    On surfaces on which links slide more easily in one direction, `directional` changes F.

    Attributes:
        min_friction: Lowest coefficient that is used; above 0 only while a robot settles.
        geom_pairs: Geoms of all contacts of the last step, in MuJoCo's order.
        normal_force_n: Normal force of each of these contacts.
        friction_force_w: Index of a contact -> friction force on the link, in N; only contacts that have friction.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        chain: LinkChain,
        link_geoms: Collection[int],
        memory: Floats,
        underside: LinkUndersides,
    ) -> None:
        """Prepare the law for a compiled model.

        Args:
            model: Compiled model.
            data: State of the simulation.
            chain: Links on which the friction forces act.
            link_geoms: Numbers of the links' geoms.
            memory: (count_contact_values(n_links),), a view of `userdata`: the number of contacts, then their values.
            underside: Undersides of the links, for friction that depends on the direction.
        """
        step_s = float(model.opt.timestep)
        self._model = model
        self._data = data
        self._chain = chain
        self._memory = memory
        # Of each contact in this step, by its key.
        self._stretch_and_force: dict[float, tuple[Vector, Vector]] = {}
        self.min_friction = 0.0

        # Properties of geoms and bodies.
        # Coulomb coefficient with a link.
        self._friction: list[float] = model.geom_friction[:, 0].tolist()
        self._directions: list[list[float]] = model.geom_user.tolist()
        self._underside = underside
        self._link_geoms = frozenset(link_geoms)
        self._body_of_geom: list[int] = model.geom_bodyid.tolist()
        # 1/kg.
        self._mobility = [_compute_end_mobility(mass_kg) for mass_kg in model.body_mass.tolist()]
        self._stiffness_per_kg = (PHASE_RAD / step_s) * (PHASE_RAD / step_s)  # N/m for each kg
        # N per m in one step, for each kg.
        self._damping_per_kg = 2.0 * DAMPING_RATIO * PHASE_RAD / (step_s * step_s)
        self._damping_per_viscous = 1.0 / step_s  # 1/s

        # Views of MuJoCo's arrays.
        self._contact = data.contact
        self._body_positions = data.xpos
        self._body_rotations = data.xmat  # world_from_body, row by row

        # The contacts of the last step.
        self.geom_pairs: list[list[int]] = []
        self.normal_force_n: list[float] = []
        self.friction_force_w: dict[int, Vector] = {}

    def begin(self) -> None:
        """Remove all contacts."""
        self._memory[0] = 0.0
        self._stretch_and_force = {}

    def apply(self) -> None:
        """Add the friction forces to MuJoCo's passive forces, which it computes in each step."""
        self._stretch_and_force = {}
        count = int(self._memory[0])
        if count == 0:
            return
        values = self._memory[1 : 1 + VALUES_PER_CONTACT * count].tolist()
        forces_w: list[Vector] = []
        points_w: list[Vector] = []
        link_bodies: list[int] = []
        for start in range(0, VALUES_PER_CONTACT * count, VALUES_PER_CONTACT):
            # `remaining` has the contact point in both bodies (6 values) and the coefficients (6 values).
            key, link_body, other_body, m, mu_n, nx, ny, nz, sx, sy, sz, *remaining = values[
                start : start + VALUES_PER_CONTACT
            ]
            link_body = int(link_body)
            other_body = int(other_body)
            point_w = self._to_world(link_body, *remaining[:3])
            x, y, z = point_w
            ox, oy, oz = self._to_world(other_body, *remaining[3:6])

            # ds, and s + ds
            dx, dy, dz = _project_to_tangent(x - ox, y - oy, z - oz, nx, ny, nz)
            sx, sy, sz = _project_to_tangent(sx + dx, sy + dy, sz + dz, nx, ny, nz)

            stretch_w = (sx, sy, sz)

            # s = (s + ds) min(1, mu N / (k |s + ds|))
            k = self._stiffness_per_kg * m
            d = self._damping_per_kg * m
            scale = _compute_limit_scale(mu_n, k * math.sqrt(sx * sx + sy * sy + sz * sz))
            sx, sy, sz = scale * sx, scale * sy, scale * sz

            # F = -(k s + d ds), limited to mu N
            fx = k * sx + d * dx
            fy = k * sy + d * dy
            fz = k * sz + d * dz
            scale = -_compute_limit_scale(mu_n, math.sqrt(fx * fx + fy * fy + fz * fz))
            force_w = (scale * fx, scale * fy, scale * fz)
            coefficients = DirectionalCoefficients(mu_n, *remaining[6:])
            if coefficients.is_directional:
                neighbor, weight = self._underside.find_neighbor(link_body, remaining[0])
                axis_w = self._underside.find_axis(link_body, neighbor, weight, (nx, ny, nz))
                if coefficients.separate_limits:
                    (sx, sy, sz), force_w = apply_separate_limits(
                        stretch_w,
                        (dx, dy, dz),
                        axis_w,
                        coefficients,
                        mu_n,
                        k,
                        d,
                        self._damping_per_viscous,
                    )
                else:
                    force_w = apply_directional_friction(
                        force_w, (dx, dy, dz), axis_w, coefficients, self._damping_per_viscous
                    )

            self._stretch_and_force[key] = (sx, sy, sz), force_w
            forces_w.append(force_w)
            points_w.append(point_w)
            link_bodies.append(link_body)
            if other_body != WORLD_BODY:
                self._apply_reaction_force(other_body, force_w, point_w)
        self._chain.push(forces_w, points_w, link_bodies)

    def _apply_reaction_force(self, body_id: int, force_w: Vector, point_w: Vector) -> None:
        """Apply the opposite of a link's friction force to the body that it touches."""
        passive = self._data.qfrc_passive
        mujoco.mj_applyFT(
            self._model,
            self._data,
            -np.array(force_w),
            NO_TORQUE,
            np.array(point_w),
            body_id,
            passive,
        )

    def update_contacts(self) -> None:
        """Store the contacts of the step that was just made. `apply` uses them in the next step."""
        if not self._data.ncon:
            if self.geom_pairs or self._memory[0]:
                self._memory[0] = 0.0
                self.geom_pairs = []
                self.normal_force_n = []
                self.friction_force_w = {}
            return
        self._memory[0] = 0.0
        self.friction_force_w = {}
        self.geom_pairs = self._contact.geom.tolist()
        self.normal_force_n = find_normal_forces_n(self._data.efc_force, self._contact.efc_address)
        friction_contacts = self._find_friction_contacts()
        if friction_contacts:
            self._write_contacts(friction_contacts)

    def _find_friction_contacts(self) -> list[_FrictionContact]:
        """Return the contacts of links that have a normal force and friction, as many as there is memory for."""
        link_geoms = self._link_geoms
        friction = self._friction
        friction_contacts: list[_FrictionContact] = []
        for i, (first_geom, second_geom) in enumerate(self.geom_pairs):
            if first_geom in link_geoms:
                link_geom, other_geom, sign = first_geom, second_geom, -1.0
            else:
                link_geom, other_geom, sign = second_geom, first_geom, 1.0
            is_pressed = self.normal_force_n[i] > 0.0 and link_geom in link_geoms
            has_friction = (
                friction[other_geom] > 0.0 or max(self._directions[other_geom][FORWARD:]) > 0.0
            )
            if is_pressed and (has_friction or self.min_friction > 0.0):
                friction_contacts.append(_FrictionContact(i, link_geom, other_geom, sign))
        capacity = (
            len(self._memory) - 1
        ) // VALUES_PER_CONTACT  # the first value is the number of contacts
        return friction_contacts[:capacity]

    def _write_contacts(self, friction_contacts: list[_FrictionContact]) -> None:
        """Write contacts into `userdata`. A contact that existed in the last step keeps the stretch of its spring.

        The layout of the values is described at VALUES_PER_CONTACT.
        """
        frames = self._contact.frame.tolist()
        points_w = self._contact.pos.tolist()
        bodies = self._body_of_geom
        mobility = self._mobility
        link_bodies = [bodies[contact.link_geom] for contact in friction_contacts]
        last_number_of_pair: dict[int, int] = {}
        values: list[float] = []
        for i, link_geom, other_geom, sign in friction_contacts:
            link_body = bodies[link_geom]
            other_body = bodies[other_geom]

            # Contacts of one pair of geoms are distinguished by their order.
            pair = link_geom * len(bodies) + other_geom
            number_in_pair = last_number_of_pair.get(pair, -1) + 1
            last_number_of_pair[pair] = number_in_pair
            key = float(CONTACTS_PER_PAIR * pair + number_in_pair)
            stretch = NO_STRETCH
            stretch_and_force = self._stretch_and_force.get(key)
            if stretch_and_force is not None:
                stretch, self.friction_force_w[i] = stretch_and_force

            # From the other body into the link.
            normal_w = [sign * component for component in frames[i][:3]]
            # All contacts of a link share its mass.
            mass_kg = 1.0 / (
                link_bodies.count(link_body) * (mobility[link_body] + mobility[other_body])
            )
            nx, ny, nz = normal_w
            link_point = self._to_body(link_body, *points_w[i])
            coefficients = self._find_coefficients(
                link_geom, other_geom, link_point[0], (nx, ny, nz)
            )
            normal_force_n = self.normal_force_n[i]
            mu_n = coefficients.largest * normal_force_n
            values += (key, link_body, other_body, mass_kg, mu_n, *normal_w, *stretch)
            values += link_point
            values += self._to_body(other_body, *points_w[i])
            values += (coefficients.forward, coefficients.backward, coefficients.sideways)
            values += (
                coefficients.viscous_along * normal_force_n,
                coefficients.viscous_across * normal_force_n,
                coefficients.separate_limits,
            )
        self._memory[1 : 1 + len(values)] = values
        self._memory[0] = len(friction_contacts)

    def _find_coefficients(
        self, link_geom: int, other_geom: int, along_m: float, normal_w: Vector
    ) -> DirectionalCoefficients:
        """Return the friction coefficients of a contact, which depend on the side of the link and on its neighbor.

        The underside of a link rubs with the coefficients of each direction, and all other sides with one coefficient.

        Args:
            link_geom: Number of the link's geom.
            other_geom: Number of the geom that the link touches.
            along_m: Distance of the contact from the link's rear joint, in m.
            normal_w: Unit normal of the surface, which points into the link.
        """
        friction = self._friction[other_geom]
        forward = backward = sideways = friction
        viscous_along = viscous_across = separate_limits = 0.0
        if other_geom not in self._link_geoms:
            surface = self._directions[other_geom]
            factors = self._directions[link_geom]
            viscous_across = surface[VISCOUS_ACROSS]
            body = self._body_of_geom[link_geom]
            neighbor, weight = self._underside.find_neighbor(body, along_m)
            if self._underside.faces(body, neighbor, weight, normal_w):
                forward = surface[FORWARD] * factors[FORWARD]
                backward = surface[BACKWARD] * factors[BACKWARD]
                sideways = surface[SIDEWAYS] * factors[SIDEWAYS]
                viscous_along = surface[VISCOUS_ALONG]
                separate_limits = factors[SEPARATE_LIMITS]
            else:
                viscous_along = viscous_across
        return combine_coefficients(
            forward,
            backward,
            sideways,
            viscous_along,
            viscous_across,
            self.min_friction,
            separate_limits,
        )

    def _to_world(self, body_id: int, x: float, y: float, z: float) -> Vector:
        """Return the world coordinates of a point that is given in a body's frame, in m."""
        if body_id == WORLD_BODY:
            return x, y, z
        a, b, c, d, e, f, g, h, i = self._body_rotations[body_id].tolist()
        px, py, pz = self._body_positions[body_id].tolist()
        return px + a * x + b * y + c * z, py + d * x + e * y + f * z, pz + g * x + h * y + i * z

    def _to_body(self, body_id: int, x: float, y: float, z: float) -> Vector:
        """Return the coordinates in a body's frame of a point that is given in the world frame, in m."""
        if body_id == WORLD_BODY:
            return x, y, z
        a, b, c, d, e, f, g, h, i = self._body_rotations[body_id].tolist()
        px, py, pz = self._body_positions[body_id].tolist()
        x, y, z = x - px, y - py, z - pz
        return a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z


def _compute_end_mobility(mass_kg: float) -> float:
    """Return by how much a force of 1 N accelerates the end of a rod of this mass, in 1/kg; 0 for the world."""
    if mass_kg > 0.0:
        return END_MOBILITY / mass_kg
    return 0.0


def _project_to_tangent(x: float, y: float, z: float, nx: float, ny: float, nz: float) -> Vector:
    """Return a vector without its part along the unit normal n."""
    along = x * nx + y * ny + z * nz
    return x - along * nx, y - along * ny, z - along * nz


def _compute_limit_scale(limit: float, size: float) -> float:
    """Return the factor that brings a vector of this size down to the limit; 1 if it is within."""
    if size > limit:
        return limit / size
    return 1.0
