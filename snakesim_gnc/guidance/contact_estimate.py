"""Contacts without contact sensors: the forces on links that explain the torques and accelerations of the chain.

For every yaw joint Newton and Euler hold for the part of the body ahead of it, and for the whole body:

    sum over contacts ahead of (r_c - p_i) x f_c = sum over links ahead of d/dt(angular momentum about p_i) - tau_i
    sum of f_c = sum of m_k a_k

Accelerations come from the IMUs, which measure specific force, so weight and support cancel in the plane of the body.
Without any IMU they are taken to be small.
The rows weigh by their errors: the moments of accelerations add up from the head backwards and, with the sums over
the whole body, from the tail forwards as well, so that a contact is felt best from its nearer end. The unknowns are
friction of the ground along the links' velocities, and pushes at the ends of each link, on either side: two of them on
one link are one push between. The fewest that explain the readings are sought, one after another, none negative
(Lawson and Hanson's active set, stopped at the noise).

What it cannot resolve: pushes of opposite sign close together, forces along the links but at the head's tip, contacts
from above or below, and pushes below about 1 N. Pitch joints give no equation of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import link_frames, rotation_from_quaternion
from snakesim_hal.model.solids import GRAVITY_M_S2
from snakesim_hal.wire.messages import Description, Imu, Pose
from snakesim_hal.wire.quantities import Vector

SLIP_M_S = 0.01  # slower links are held by friction as much as they are braked
# Standard deviations of what goes in; of the shipped robots.
TORQUE_NM, ACCELERATION_M_S2 = 0.012, 0.05
SHARING = 0.06  # of the weight of each link, in each direction: the ground does not carry all links alike
# Of links without an IMU reading, before anything is known: turning, rad/s², and the base, m/s².
BETWEEN_IMUS = (30.0, 3.0)
WITHOUT_IMUS = (3.0, 0.3)  # of a snake that creeps, about 0.1 m/s: with more, hardly any push would show
LIKELY = 1.0  # standard deviations by which a push may show to be considered
SURE = 3.0  # standard deviations by which a push must show
MAX_STEPS = 30  # of the search


class FeltContact(NamedTuple):
    """A push on a link."""

    link: int  # from 0 at the tail
    along_m: float  # from the link's rear joint
    normal_l: Vector  # from the obstacle into the body
    force_n: float
    confidence: float  # 0 to 1: 1 - its standard deviation / force


def estimate(
    robot: Description,
    joints: Sequence[float],
    velocities: Sequence[float],
    torques: Sequence[float],
    imu: Imu,
    pose: Pose | None,
) -> list[FeltContact]:
    """Contacts of the links with obstacles, tail to head; none that could be noise.

    joints, velocities, torques: of every joint, tail to head, in rad, rad/s and N·m, at the time of `imu`. Without a
    pose the links are taken to slide forwards along themselves.
    """
    body = _body(robot, joints)
    spins = _spins(body, velocities, imu)
    motion, motion_sd = _motion(body, spins, imu)
    dynamics = _dynamics(body, spins)
    turns: NDArray[np.bool_] = np.any(body.axes_b != 0.0, axis=1)
    right = dynamics @ np.append(motion, 1.0)
    right[: len(torques)] -= np.where(turns, torques, 0.0)
    right[: len(torques)] *= turns
    drag, drag_sd = _drag(body, spins, pose)
    pushes = _pushes(body)
    # Errors of all right sides together: of torques, of accelerations, and of how friction is shared by the links.
    of_motion = dynamics[:, :-1] @ motion_sd
    errors = np.diag(np.append(np.full(len(torques), TORQUE_NM**2), np.full(3, 1e-6)))
    errors += of_motion @ of_motion.T + drag_sd @ drag_sd.T
    white = np.linalg.inv(np.linalg.cholesky(errors))
    amounts, covariance = _fewest(white @ np.column_stack([drag, *(push.effect for push in pushes)]), white @ right)
    return _contacts(body, pushes, amounts[1:], covariance[1:, 1:])


@dataclass(frozen=True)
class Body:
    """The chain as it lies, in the frame of its base."""

    rear_b: Floats  # (n + 1, 3) rear end of each link, which is a joint but for the tail
    frames: Floats  # (n + 1, 3, 3) base_from_link
    axes_b: Floats  # (n, 3) of the yaw joints; zero for others
    lengths_m: Floats
    masses_kg: Floats
    radii_m: Floats
    rotors_kg_m2: Floats  # (n,)

    @property
    def steps_b(self) -> Floats:
        """From the rear to the front end of each link, (n + 1, 3)."""
        return self.frames[:, :, 0] * self.lengths_m[:, None]

    @property
    def middles_b(self) -> Floats:
        """Middle of each link, (n + 1, 3)."""
        return self.rear_b + self.steps_b / 2

    def effect(self, links: NDArray[np.intp], points_b: Floats, forces: Floats) -> Floats:
        """Left sides of all equations for forces (m, 3) on links (m,) at points (m, 3): (n + 3, m)."""
        arms = points_b - self.rear_b[1:, None]
        moments = np.einsum("ij,imj->im", self.axes_b, np.cross(arms, forces))
        moments *= np.arange(len(self.axes_b))[:, None] < links
        arms = points_b - self.masses_kg @ self.middles_b / self.masses_kg.sum()
        return np.vstack([moments, np.cross(arms, forces)[:, 2], forces[:, :2].T])


@dataclass(frozen=True)
class Push:
    """A unit push that may be there."""

    link: int
    side: int  # 1: on the left, -1: on the right, 0: on the tip of the head
    along_m: float
    effect: Floats


def _body(robot: Description, joints: Sequence[float]) -> Body:
    axes = [joint.axis for joint in robot.joints]
    lengths = [link.length_m for link in robot.links]
    rear, frames = link_frames((0.0, 0.0, 0.0), np.eye(3), joints, axes, lengths)
    yaws = np.array([axis == "yaw" for axis in axes])
    return Body(
        rear_b=rear,
        frames=frames,
        axes_b=frames[1:, :, 2] * yaws[:, None],
        lengths_m=np.array(lengths),
        masses_kg=np.array([link.mass_kg for link in robot.links]),
        radii_m=np.array([link.radius_m for link in robot.links]),
        rotors_kg_m2=np.array([joint.rotor_kg_m2 for joint in robot.joints]) * yaws,
    )


def _spins(body: Body, velocities: Sequence[float], imu: Imu) -> Floats:
    """Turning of each link about z, rad/s: differences from the joints, the level from the gyroscopes."""
    chain = np.append(0.0, np.cumsum(body.axes_b[:, 2] * velocities))
    if not imu.link:
        return chain
    gyros = [body.frames[link][2] @ spin for link, spin in zip(imu.link, imu.angular_velocity_rad_s, strict=True)]
    return chain + float(np.mean(np.array(gyros) - chain[imu.link]))


def _accelerations(body: Body, spins: Floats) -> Floats:
    """Accelerations of the links' middles in the plane, linear in those of the tail end and the turning of each link.

    (2, n + 1, 2 + n + 1 + 1): x and y; of each link; by (tail's x, y, turning of each link, 1).
    """
    count = len(spins)
    reach = np.tril(np.ones((count, count)), -1) + np.eye(count) / 2  # of each link's step, to each link's middle
    x, y = body.steps_b[:, 0], body.steps_b[:, 1]
    found = np.zeros((2, count, count + 3))
    found[0, :, 0] = found[1, :, 1] = 1.0
    found[0, :, 2:-1], found[1, :, 2:-1] = -reach * y, reach * x
    found[0, :, -1], found[1, :, -1] = -reach @ (spins**2 * x), -reach @ (spins**2 * y)
    return found


def _motion(body: Body, spins: Floats, imu: Imu) -> tuple[Floats, Floats]:
    """Accelerations of the tail end and turning of each link, (n + 3,), and a root of their covariance.

    Least squares over all accelerometers: neighbors share a joint, so that they correct one another.
    """
    model = _accelerations(body, spins)[:, imu.link].reshape(2 * len(imu.link), len(spins) + 3)
    in_links = np.reshape(imu.acceleration_m_s2, (-1, 3))
    measured = np.einsum("kij,kj->ki", body.frames[imu.link], in_links)[:, :2].T.ravel()
    turning_rad_s2, base_m_s2 = BETWEEN_IMUS if imu.link else WITHOUT_IMUS
    before = np.append(np.full(2, base_m_s2), np.full(len(spins), turning_rad_s2))
    precision = model[:, :-1].T @ model[:, :-1] / ACCELERATION_M_S2**2 + np.diag(before**-2.0)
    covariance = np.linalg.inv(precision)
    found = covariance @ model[:, :-1].T @ (measured - model[:, -1]) / ACCELERATION_M_S2**2
    return found, np.asarray(np.linalg.cholesky(covariance), np.float64)


def _dynamics(body: Body, spins: Floats) -> Floats:
    """Right sides of all equations but for the torques, linear in the motion: (n + 3, n + 4)."""
    count, model = len(spins), _accelerations(body, spins)
    every, middles = np.arange(count), body.middles_b
    right = np.zeros((count + 2, count + 3))
    for axis in (0, 1):
        right += body.effect(every, middles, body.masses_kg[:, None] * np.eye(3)[axis]) @ model[axis]
    turning = body.masses_kg * (body.lengths_m**2 / 12 + body.radii_m**2 / 4)  # of a cylinder across its axis
    ahead = np.arange(count - 1)[:, None] < every
    right[: count - 1, 2:-1] += ahead * turning + body.rotors_kg_m2[:, None] * np.diff(np.eye(count), axis=0)
    right[count - 1, 2:-1] += turning
    return right


def _drag(body: Body, spins: Floats, pose: Pose | None) -> tuple[Floats, Floats]:
    """Effect of friction of the ground with coefficient 1, (n + 3,), and a root of the covariance of its sharing."""
    every, middles = np.arange(len(spins)), body.middles_b
    slide = body.frames[:, :, 0].copy()
    if pose is not None:
        arms = middles - body.rear_b
        carried = np.vstack([np.zeros(3), np.cumsum(np.cross([0.0, 0.0, 1.0], body.steps_b) * spins[:, None], 0)[:-1]])
        slide = carried + np.cross([0.0, 0.0, 1.0], arms) * spins[:, None]
        slide += rotation_from_quaternion(pose.orientation_wxyz).T @ pose.velocity_w
        slide[:, 2] = 0.0
        slide /= np.hypot(np.linalg.norm(slide, axis=1), SLIP_M_S)[:, None]
    weights = GRAVITY_M_S2 * body.masses_kg[:, None]
    drag = body.effect(every, middles, -weights * slide).sum(axis=1)
    unshared = SHARING * np.hstack([body.effect(every, middles, weights * axis) for axis in np.eye(3)[:2]])
    return drag, unshared


def _pushes(body: Body) -> list[Push]:
    """Every push that is considered: on either side of both ends of each link, and on the tip of the head."""
    last = len(body.rear_b) - 1
    places = [(k, side, end) for k in range(last + 1) for side in (1, -1) for end in (0.0, 1.0)] + [(last, 0, 1.0)]
    links = np.array([link for link, _, _ in places])
    outward = np.array([[0.0, side, 0.0] if side else [1.0, 0.0, 0.0] for _, side, _ in places])
    along = np.array([end for _, _, end in places]) * body.lengths_m[links]
    skin_l = along[:, None] * [1.0, 0.0, 0.0] + body.radii_m[links, None] * outward
    points = body.rear_b[links] + np.einsum("kij,kj->ki", body.frames[links], skin_l)
    effects = body.effect(links, points, -np.einsum("kij,kj->ki", body.frames[links], outward))
    return [
        Push(link, side, place_m, effect)
        for (link, side, _), place_m, effect in zip(places, along.tolist(), effects.T, strict=True)
    ]


def _fewest(columns: Floats, right: Floats) -> tuple[Floats, Floats]:
    """Amounts >= 0 of few columns that explain the right side up to noise of deviation 1, and their covariance.

    Forward selection by gradient, with the first column always active; then columns that the others can replace are
    dropped again.
    """
    amounts, active = np.zeros(columns.shape[1]), [0]
    lengths = np.linalg.norm(columns, axis=0) + 1e-12
    for _ in range(MAX_STEPS):
        active = _nonnegative(columns, right, amounts, active)
        gradient = columns.T @ (right - columns @ amounts) / lengths
        gradient[active] = 0.0
        best = int(np.argmax(gradient))
        if gradient[best] < LIKELY:
            break
        active.append(best)
    while True:
        chosen = columns[:, active]
        covariance = np.linalg.pinv(chosen.T @ chosen)
        shows = amounts[active] / np.sqrt(np.diag(covariance) + 1e-12)
        shows[[column == 0 for column in active]] = np.inf
        if not active or shows.min() >= SURE:
            break
        active.pop(int(np.argmin(shows)))
        active = _nonnegative(columns, right, amounts, active)
    whole = np.zeros((len(amounts), len(amounts)))
    whole[np.ix_(active, active)] = covariance
    return amounts, whole


def _nonnegative(columns: Floats, right: Floats, amounts: Floats, active: list[int]) -> list[int]:
    """Least squares over the active columns; those that would become negative are left out. Changes `amounts`."""
    while active:
        wanted = np.linalg.lstsq(columns[:, active], right, rcond=None)[0]
        now = amounts[active]
        falling = wanted <= 0.0
        if not falling.any():
            amounts[:] = 0.0
            amounts[active] = wanted
            return active
        share = float(np.min(now[falling] / (now[falling] - wanted[falling] + 1e-12)))
        moved = now + share * (wanted - now)
        gone = falling & (moved <= 1e-9)
        if not gone.any():
            gone = falling
        amounts[:] = 0.0
        active = [column for column, out in zip(active, gone, strict=True) if not out]
        amounts[active] = np.maximum(moved[~gone], 0.0)
    amounts[:] = 0.0
    return active


def _contacts(body: Body, pushes: Sequence[Push], amounts: Floats, covariance: Floats) -> list[FeltContact]:
    """Pushes of one side that are no further apart than a link is long are one contact."""
    starts_m = np.append(0.0, np.cumsum(body.lengths_m))
    found: list[FeltContact] = []
    for side in (1, -1, 0):
        here = [i for i, push in enumerate(pushes) if push.side == side and amounts[i] > 0.0]
        places_m = np.array([starts_m[pushes[i].link] + pushes[i].along_m for i in here])
        order = np.argsort(places_m, kind="stable")
        gaps = np.flatnonzero(np.diff(places_m[order]) > 1.01 * body.lengths_m.max()) + 1
        for group in np.split(order, gaps) if here else ():
            of = [here[i] for i in group]
            force_n = float(amounts[of].sum())
            sd_n = float(np.sqrt(covariance[np.ix_(of, of)].sum()))
            if force_n < SURE * sd_n:
                continue
            place_m = float(amounts[of] @ places_m[group]) / force_n
            link = min(int(np.searchsorted(starts_m, place_m, side="right")) - 1, len(body.lengths_m) - 1)
            normal = (0.0, -float(side), 0.0) if side else (-1.0, 0.0, 0.0)
            found.append(FeltContact(link, place_m - float(starts_m[link]), normal, force_n, 1.0 - sd_n / force_n))
    return sorted(found)
