"""Friction that depends on the direction in which a link slides, for flat ground and for all other contacts.

Both laws of dry friction compute a force u with |u| <= mu N, from the stretch of a spring. Here mu is the largest of
the coefficients forward, backward and sideways, and u is reduced along and across the link:

    F = -N_c ds - D u        on a link, with u pointing along the slip

    D   diagonal in the link's frame: coefficient / mu, along the link that of its direction of sliding
    N_c diagonal in the link's frame: viscous damping, N per m of slip ds in one step

- **Sticking.** The forces that hold a link are all within two half ellipses, whose half axes are forward, backward and
  sideways coefficient, times N.
- **Sliding.** u is parallel to the velocity v, so F = -N (mu_along v_along, mu_across v_across) / |v|. That is the law
  of Hu et al. It dissipates in every direction, because every coefficient is positive. It is not the law of maximum
  dissipation, whose force would be normal to the ellipse: F = -N (mu_along^2 v_along, mu_across^2 v_across) /
  |(mu_along v_along, mu_across v_across)|. The two agree along the axes of the link, and if all coefficients are equal.

The underside of a robot is taken as a smooth curve: halfway between its joints it has the direction of the link, and at
a joint the mean direction of both links. A straight piece of each link would rub sideways next to every bent joint.

Sides and back of a link have no scales or wheels. They rub with one coefficient in all directions.

- **Wheels with separate limits.** A wheel rolls, so its tire slips sideways only, and its whole friction acts sideways,
  also while the link moves forward. There the spring has two parts, along the link and across it, and each has a limit
  of its own: see `apply_separate_limits`.

Source: D. L. Hu, J. Nirody, T. Scott and M. J. Shelley, "The mechanics of slithering locomotion", PNAS 106, 2009.
"""

import math
from typing import NamedTuple

import mujoco

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.quantities import Vector

# Numbers of a geom in its user data, after the mark of a foot. For a foot and a surface they are coefficients with the
# underside of a link, and viscous ones in s/m; for a link they are factors on the coefficients of a surface.
# The last one is 1 for feet and links on which friction along the link and across it do not limit each other.
FOOT_MARK, FORWARD, BACKWARD, SIDEWAYS, VISCOUS_ALONG, VISCOUS_ACROSS, SEPARATE_LIMITS = range(7)
USER_VALUES_PER_GEOM = 7

# Of the angle between a surface's normal and a link's z axis: within 45 degrees.
UNDERSIDE_COSINE = 0.7
MIN_AXIS = 0.1  # length of the mean of two directions; below it the body is folded, and has none
NO_AXIS = (0.0, 0.0, 0.0)


class DirectionalCoefficients(NamedTuple):
    """Coefficients of one contact or foot."""

    largest: float  # mu
    forward: float  # divided by the largest; likewise the next two
    backward: float
    sideways: float
    viscous_along: float  # s/m
    viscous_across: float  # s/m
    separate_limits: float = 0.0  # 1: friction along the link and across it do not limit each other

    @property
    def is_directional(self) -> bool:
        """Return whether the force differs from isotropic dry friction with the largest coefficient."""
        return (
            self.forward != 1.0
            or self.backward != 1.0
            or self.sideways != 1.0
            or self.viscous_along > 0.0
            or self.viscous_across > 0.0
        )


def combine_coefficients(
    forward: float,
    backward: float,
    sideways: float,
    viscous_along: float,
    viscous_across: float,
    min_friction: float,
    separate_limits: float = 0.0,
) -> DirectionalCoefficients:
    """Return the coefficients of a contact, none of which is lower than `min_friction`."""
    forward = max(forward, min_friction)
    backward = max(backward, min_friction)
    sideways = max(sideways, min_friction)
    largest = max(forward, backward, sideways)
    if largest == 0.0:
        return DirectionalCoefficients(
            0.0, 1.0, 1.0, 1.0, viscous_along, viscous_across, separate_limits
        )
    return DirectionalCoefficients(
        largest,
        forward / largest,
        backward / largest,
        sideways / largest,
        viscous_along,
        viscous_across,
        separate_limits,
    )


class LinkUndersides:
    """The undersides of the links of one simulation."""

    def __init__(self, data: mujoco.MjData, first_body: int, lengths_m: list[float]) -> None:
        """Prepare views of MuJoCo's arrays.

        Args:
            data: State of the simulation.
            first_body: MuJoCo's number of the tail link's body.
            lengths_m: Lengths of the links, tail to head.
        """
        self._rotations = data.xmat  # world_from_body, row by row
        self._first_body = first_body
        self._last_body = first_body + len(lengths_m) - 1
        self._lengths_m = lengths_m

    def find_neighbor(self, body_id: int, along_m: float) -> tuple[int, float]:
        """Return the link that a point of a link is nearest to besides its own, and the weight of its direction.

        Args:
            body_id: MuJoCo's number of the link's body.
            along_m: Distance of the point from the link's rear joint.

        Returns:
            MuJoCo's number of the neighbor's body, and its weight: 0 in the middle of the link, 0.5 at a joint.
        """
        length_m = self._lengths_m[body_id - self._first_body]
        from_middle = along_m / length_m - 0.5
        neighbor = body_id + 1 if from_middle > 0.0 else body_id - 1
        if neighbor < self._first_body or neighbor > self._last_body:
            return body_id, 0.0
        return neighbor, min(abs(from_middle), 0.5)

    def faces(self, body_id: int, neighbor: int, weight: float, normal_w: Vector) -> bool:
        """Return whether a surface with this normal, which points into the link, touches the underside."""
        nx, ny, nz = normal_w
        ux, uy, uz = self._average_axes(body_id, neighbor, weight, 2)
        return ux * nx + uy * ny + uz * nz > UNDERSIDE_COSINE

    def find_axis(self, body_id: int, neighbor: int, weight: float, normal_w: Vector) -> Vector:
        """Return the direction of the underside in the plane of contact, a unit vector, or `NO_AXIS`."""
        nx, ny, nz = normal_w
        x, y, z = self._average_axes(body_id, neighbor, weight, 0)
        along = x * nx + y * ny + z * nz
        x, y, z = x - along * nx, y - along * ny, z - along * nz
        length = math.sqrt(x * x + y * y + z * z)
        if length < MIN_AXIS:
            return NO_AXIS
        return x / length, y / length, z / length

    def _average_axes(self, body_id: int, neighbor: int, weight: float, column: int) -> Vector:
        """Return the weighted mean of one axis of two links. `column` is 0 for the x axis, and 2 for the z axis."""
        x, y, z = _read_axis(self._rotations, body_id, column)
        ox, oy, oz = _read_axis(self._rotations, neighbor, column)
        own_weight = 1.0 - weight
        return (
            own_weight * x + weight * ox,
            own_weight * y + weight * oy,
            own_weight * z + weight * oz,
        )


def apply_directional_friction(
    force_w: Vector,
    slip_w: Vector,
    axis_w: Vector,
    coefficients: DirectionalCoefficients,
    damping_per_viscous: float,
) -> Vector:
    """Reduce an isotropic friction force along and across the link, and add viscous friction.

    Args:
        force_w: Isotropic friction force on the link with the largest coefficient, -u, in N.
        slip_w: Slip of the link in the last step, ds, in m.
        axis_w: Direction of the link in the plane of contact. `NO_AXIS` applies the sideways coefficient in all
            directions.
        coefficients: Friction coefficients of this contact.
        damping_per_viscous: Normal force divided by the time step, in N/s.

    Returns:
        The friction force on the link in N, in the world frame.
    """
    ax, ay, az = axis_w
    fx, fy, fz = force_w
    sx, sy, sz = slip_w
    force_along = fx * ax + fy * ay + fz * az
    slip_along = sx * ax + sy * ay + sz * az
    # A force that points backward brakes a link that slides forward.
    ratio = coefficients.forward if force_along < 0.0 else coefficients.backward
    sideways = coefficients.sideways
    damping_along = damping_per_viscous * coefficients.viscous_along
    damping_across = damping_per_viscous * coefficients.viscous_across
    result_along = ratio * force_along - damping_along * slip_along
    return (
        result_along * ax
        + sideways * (fx - force_along * ax)
        - damping_across * (sx - slip_along * ax),
        result_along * ay
        + sideways * (fy - force_along * ay)
        - damping_across * (sy - slip_along * ay),
        result_along * az
        + sideways * (fz - force_along * az)
        - damping_across * (sz - slip_along * az),
    )


def apply_separate_limits(
    stretch_w: Vector,
    slip_w: Vector,
    axis_w: Vector,
    coefficients: DirectionalCoefficients,
    max_friction_n: float,
    stiffness: float,
    damping: float,
    damping_per_viscous: float,
) -> tuple[Vector, Vector]:
    """Limit the spring of a contact along the link and across it, each by its own coefficient.

    With the stretch s after the slip ds, its part s_i in one of both directions, and the limit L_i = mu_i N:

        s_i = s_i min(1, L_i / (k |s_i|))
        F_i = -(k s_i + d ds_i), limited to |F_i| <= L_i, and viscous friction

    Args:
        stretch_w: Stretch of the spring with the slip of this step, s + ds, in m.
        slip_w: Slip of the link in the last step, ds, in m.
        axis_w: Direction of the link in the plane of contact. `NO_AXIS` applies the sideways coefficient in all
            directions.
        coefficients: Friction coefficients of this contact.
        max_friction_n: Normal force times the largest coefficient.
        stiffness: Stiffness of the spring, k, in N/m.
        damping: Damping of the spring, d, in N per m of slip in one step.
        damping_per_viscous: Normal force divided by the time step, in N/s.

    Returns:
        The stretch of the spring after this step in m, and the friction force on the link in N, in the world frame.
    """
    ax, ay, az = axis_w
    sx, sy, sz = stretch_w
    dx, dy, dz = slip_w
    stretch_along = sx * ax + sy * ay + sz * az
    slip_along = dx * ax + dy * ay + dz * az

    # Along the link. A stretch or a force forward belongs to a link that slides forward.
    ratio = coefficients.forward if stretch_along > 0.0 else coefficients.backward
    sx, sy, sz = sx - stretch_along * ax, sy - stretch_along * ay, sz - stretch_along * az
    stretch_along = (
        _compute_limit_scale(ratio * max_friction_n, stiffness * abs(stretch_along)) * stretch_along
    )
    force_along = stiffness * stretch_along + damping * slip_along
    ratio = coefficients.forward if force_along > 0.0 else coefficients.backward
    force_along = -_compute_limit_scale(ratio * max_friction_n, abs(force_along)) * force_along
    force_along = force_along - damping_per_viscous * coefficients.viscous_along * slip_along

    # Across it.
    limit_n = coefficients.sideways * max_friction_n
    scale = _compute_limit_scale(limit_n, stiffness * math.sqrt(sx * sx + sy * sy + sz * sz))
    sx, sy, sz = scale * sx, scale * sy, scale * sz
    dx, dy, dz = dx - slip_along * ax, dy - slip_along * ay, dz - slip_along * az
    fx, fy, fz = (
        stiffness * sx + damping * dx,
        stiffness * sy + damping * dy,
        stiffness * sz + damping * dz,
    )
    scale = -_compute_limit_scale(limit_n, math.sqrt(fx * fx + fy * fy + fz * fz))
    damping_across = damping_per_viscous * coefficients.viscous_across
    force_w = (
        force_along * ax + (scale * fx - damping_across * dx),
        force_along * ay + (scale * fy - damping_across * dy),
        force_along * az + (scale * fz - damping_across * dz),
    )
    return (stretch_along * ax + sx, stretch_along * ay + sy, stretch_along * az + sz), force_w


def _compute_limit_scale(limit: float, size: float) -> float:
    """Return the factor that brings a number of this size down to the limit; 1 if it is within."""
    if size > limit:
        return limit / size
    return 1.0


def _read_axis(rotations: Floats, body_id: int, column: int) -> Vector:
    """Return one axis of a body's frame in the world frame."""
    rotation = rotations[body_id].tolist()
    return rotation[column], rotation[column + 3], rotation[column + 6]
