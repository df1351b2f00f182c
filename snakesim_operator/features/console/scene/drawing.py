"""A snapshot as shapes in the world: poses of links, arrows, lines, cameras. Pure; metres, quaternions wxyz."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import link_frames, quaternions_from_rotations, rotation_from_quaternion
from snakesim_hal.model.scenario import RunConfig, place_all
from snakesim_hal.physics.hills import hills
from snakesim_hal.wire.messages import ColorImage, DepthImage, Obstacle, World, WorldContact
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.results.force_tracking import is_measured

M_PER_N, LONGEST_M = 0.02, 0.5  # of a force arrow
ABOVE_M = 0.02  # forces are drawn above the body, which would hide most of them at the height of the contacts
NORMAL_M, TANGENT_M = 0.08, 0.05
MIN_FORCE_N = 0.3  # weaker forces are not drawn
# A camera looks along its x, z up; a frustum of the viewer along z, y down.
Z_TO_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
LINK_FROM_FRUSTUM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def _nothing() -> Floats:
    return np.zeros((0, 3))


def _no_arrows() -> Floats:
    return np.zeros((0, 2, 3))


@dataclass(frozen=True)
class Surroundings:
    """What stands around the robot in truth, by the configuration of its run."""

    config: RunConfig

    @cached_property
    def obstacles(self) -> list[Obstacle]:
        """Obstacles, steps too."""
        return [placed.obstacle for placed in place_all(self.config)]

    @cached_property
    def heights_m(self) -> tuple[Floats, Floats] | None:
        """Heightfield ground: coordinates of the samples along an edge (n,), heights (n, n) row by row along y."""
        uneven = self.config.scene.ground.heightfield
        if uneven is None:
            return None
        heights = hills(uneven)
        return np.linspace(-uneven.area_m / 2, uneven.area_m / 2, len(heights)), heights

    def ground_m(self, points_w: Floats) -> Floats:
        """Height of the ground at points (n, 2), from the nearest sample: (n,)."""
        if self.heights_m is None:
            return np.zeros(len(points_w))
        along, heights = self.heights_m
        cell = np.clip(np.rint((points_w - along[0]) / (along[1] - along[0])), 0, len(along) - 1).astype(int)
        return heights[cell[:, 1], cell[:, 0]]


@dataclass(frozen=True)
class CameraFrustum:
    """A camera's frustum: z forward, y down."""

    key: str
    position_w: Floats
    wxyz: Floats
    fov_rad: float  # vertical
    aspect: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawing:
    """Everything that is drawn of one snapshot."""

    center_w: Floats  # of the body
    links_w: Floats  # (links, 3) middle of each link
    links_wxyz: Floats  # (links, 4)
    hinges_w: Floats  # (joints, 3)
    hinges_wxyz: Floats  # (joints, 4); z is the joint's axis
    failed: frozenset[int] = frozenset()  # joints that are isolated, or have a fault
    pushing: int | None = None  # the propulsion joint
    contacts_w: Floats = field(default_factory=_nothing)
    normals: Floats = field(default_factory=_no_arrows)  # (n, 2, 3) from, to; as all arrows
    tangents: Floats = field(default_factory=_no_arrows)
    forces: Floats = field(default_factory=_no_arrows)  # measured, on the body
    solved: Floats = field(default_factory=_no_arrows)  # as the controller expects them where it feels its push-points
    asked: Floats = field(default_factory=_no_arrows)  # likewise, where no contact is felt
    resultant: Floats = field(default_factory=_no_arrows)  # of the measured forces, at the center
    path_w: Floats = field(default_factory=_nothing)
    perceived: tuple[Obstacle, ...] = ()  # by guidance
    pushed: frozenset[str] = frozenset()  # obstacles that the body pushes off
    ahead: frozenset[str] = frozenset()  # push-points that navigation expects along the path
    cameras: tuple[CameraFrustum, ...] = ()


def draw(snapshot: RobotSnapshot, around: Surroundings | None) -> Drawing | None:
    """None while the joints are unknown. Without a pose the tail end lies at the origin."""
    body, robot = snapshot.body or snapshot.joints, snapshot.robot
    if body is None:
        return None
    position_w, wxyz = snapshot.base or ((0.0, 0.0, robot.links[0].radius_m), (1.0, 0.0, 0.0, 0.0))
    axes, lengths = [joint.axis for joint in robot.joints], [link.length_m for link in robot.links]
    origins, rotations = link_frames(position_w, rotation_from_quaternion(wxyz), body.angle_rad, axes, lengths)
    middles = origins + rotations[:, :, 0] * (np.array(lengths)[:, None] / 2)
    trajectory, status = snapshot.trajectory, snapshot.status
    lost = set[str | None]() if status is None else {*status.isolated, *(fault.joint for fault in status.faults)}
    return Drawing(
        center_w=middles.mean(axis=0),
        links_w=middles,
        links_wxyz=quaternions_from_rotations(rotations),
        hinges_w=origins[1:],
        hinges_wxyz=quaternions_from_rotations(_hinges(rotations[:-1], axes)),
        failed=frozenset(i for i, joint in enumerate(robot.joints) if joint.name in lost),
        pushing=pushing_joint(snapshot),
        path_w=_on_ground(np.array(trajectory.path_w), around) if trajectory is not None else _nothing(),
        perceived=_perceived(snapshot.world),
        pushed=_pushed(snapshot),
        ahead=frozenset(trajectory.push_points) if trajectory is not None else frozenset(),
        cameras=tuple(_camera(key, image, origins, rotations) for key, image in snapshot.images.items()),
        **_forces(snapshot, middles.mean(axis=0)),
    )


def _hinges(rotations: Floats, axes: Sequence[str]) -> Floats:
    """Rotations whose z is the axis about which each joint turns."""
    found = rotations.copy()
    for i, axis in enumerate(axes):
        if axis == "pitch":
            found[i] = rotations[i] @ Z_TO_Y
    return found


def pushing_joint(snapshot: RobotSnapshot) -> int | None:
    """Number of the propulsion joint."""
    name = None if snapshot.control is None else snapshot.control.propulsion_joint
    return next((i for i, joint in enumerate(snapshot.robot.joints) if joint.name == name), None)


def _perceived(world: World | None) -> tuple[Obstacle, ...]:
    """Obstacles that guidance knows from its sensors; those of a map are the truth, which is drawn anyway."""
    return () if world is None else tuple(o for o in world.obstacles if o.last_seen_ns is not None or o.felt)


def _felt(snapshot: RobotSnapshot) -> list[WorldContact]:
    return snapshot.world.contacts if snapshot.world is not None else []


def _pushed(snapshot: RobotSnapshot) -> frozenset[str]:
    points = snapshot.control.push_points if snapshot.control is not None else []
    return frozenset(one.obstacle for one in points if one.obstacle and is_measured(one, _felt(snapshot)))


def _forces(snapshot: RobotSnapshot, center_w: Floats) -> dict[str, Floats]:
    """Contacts and forces; at most as long as the body's contacts are known."""
    found: dict[str, Floats] = {}
    contacts = _felt(snapshot)
    if contacts:
        at = np.array([c.position_w for c in contacts])
        force = np.array([c.force_w for c in contacts])
        strong = np.linalg.norm(force, axis=1) > MIN_FORCE_N
        found |= {
            "contacts_w": at,
            "normals": _arrows(at, NORMAL_M * np.array([c.normal_w for c in contacts])),
            "tangents": _arrows(at, TANGENT_M * np.array([c.tangent_w for c in contacts])),
            "forces": _forces_above(snapshot, at[strong], force[strong]),
        }
        total = force.sum(axis=0)
        if np.linalg.norm(total) > MIN_FORCE_N:
            found["resultant"] = _forces_above(snapshot, center_w[None], total[None])
    control = snapshot.control
    if control is not None and control.push_points and len(control.push_points) == len(control.desired_force_n):
        at = np.array([c.position_w for c in control.push_points])
        normal = np.array([c.normal_w for c in control.push_points])
        solved = _forces_above(snapshot, at, np.array(control.desired_force_n)[:, None] * normal)
        there = np.array([is_measured(point, contacts) for point in control.push_points])
        found |= {"solved": solved[there], "asked": solved[~there]}
    return found


def _forces_above(snapshot: RobotSnapshot, at_w: Floats, forces_n: Floats) -> Floats:
    """Arrows of forces (n, 3), above where they act."""
    size_n = np.linalg.norm(forces_n, axis=1, keepdims=True)
    scale = np.minimum(M_PER_N, LONGEST_M / np.maximum(size_n, 1e-9))
    above_m = max(link.radius_m for link in snapshot.robot.links) + ABOVE_M
    return _arrows(at_w + np.array([0.0, 0.0, above_m]), scale * forces_n)


def _arrows(start_w: Floats, span: Floats) -> Floats:
    return np.stack([start_w, start_w + span], axis=1)


def _on_ground(points_w: Floats, around: Surroundings | None) -> Floats:
    """Points (n, 2) just above the ground, (n, 3)."""
    height = np.zeros(len(points_w)) if around is None else around.ground_m(points_w)
    return np.column_stack([points_w, height + 0.006])


def _camera(key: str, image: DepthImage | ColorImage, origins: Floats, rotations: Floats) -> CameraFrustum:
    link = rotations[image.link]
    looks = link @ rotation_from_quaternion(image.orientation_l_wxyz) @ LINK_FROM_FRUSTUM
    return CameraFrustum(
        key=key,
        position_w=origins[image.link] + link @ np.array(image.position_l),
        wxyz=quaternions_from_rotations(looks[None])[0],
        fov_rad=2 * math.atan(image.height / 2 / image.fy_px),
        aspect=image.width / image.height,
    )
