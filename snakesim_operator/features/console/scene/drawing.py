"""Computes what is drawn of a snapshot: poses of links, arrows, lines, cameras. Pure.

Lengths are in m in world coordinates, quaternions are wxyz.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import (
    compute_link_frames,
    quaternions_from_rotations,
    rotation_from_quaternion,
)
from snakesim_hal.model.scenario import RunConfig, place_obstacles
from snakesim_hal.model.scene_file.terrain import Pipe
from snakesim_hal.physics.hills import make_heights
from snakesim_hal.wire.messages import (
    ColorImage,
    DepthImage,
    KnownObstacle,
    WorldContact,
    WorldModel,
)
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.results.metrics.force_tracking import is_contact_measured

M_PER_N = 0.02  # length of a force arrow
MAX_FORCE_ARROW_M = 0.5  # of a force arrow
ABOVE_M = 0.02  # forces are drawn above the body, which would hide most of them at the height of the contacts
NORMAL_ARROW_M = 0.08  # length of a contact's normal
TANGENT_ARROW_M = 0.05
PATH_ABOVE_M = 0.006  # the path is drawn just above the ground
MIN_FORCE_N = 0.3  # weaker forces are not drawn
# A camera looks along its x, z up; a frustum of the viewer along z, y down.
Z_TO_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
LINK_FROM_FRUSTUM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
AT_ORIGIN_WXYZ = (1.0, 0.0, 0.0, 0.0)


def _make_no_points() -> Floats:
    return np.zeros((0, 3))


def _make_no_arrows() -> Floats:
    return np.zeros((0, 2, 3))


@dataclass(frozen=True)
class TrueSurroundings:
    """The true surroundings of a robot, from the configuration of its run."""

    config: RunConfig

    @cached_property
    def obstacles(self) -> list[KnownObstacle]:
        """All obstacles, with steps among them."""
        return [placed.obstacle for placed in place_obstacles(self.config)]

    @property
    def pipes(self) -> list[Pipe]:
        """All pipes."""
        return self.config.scene.pipe

    @cached_property
    def heights_m(self) -> tuple[Floats, Floats] | None:
        """Heightfield ground: coordinates of the samples along an edge (n,), heights (n, n) row by row along y."""
        heightfield = self.config.scene.ground.heightfield
        if heightfield is None:
            return None
        heights = make_heights(heightfield)
        along = np.linspace(-heightfield.area_m / 2, heightfield.area_m / 2, len(heights))
        return along, heights

    def find_ground_heights_m(self, points_w: Floats) -> Floats:
        """Return the height of the ground at points (n, 2), from the nearest sample: (n,)."""
        if self.heights_m is None:
            return np.zeros(len(points_w))
        along, heights = self.heights_m
        spacing_m = along[1] - along[0]
        nearest = np.rint((points_w - along[0]) / spacing_m)
        cell = np.clip(nearest, 0, len(along) - 1).astype(int)
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
class ForceArrows:
    """Contacts and forces of one snapshot, as points (n, 3) and arrows (n, 2, 3) from start to end."""

    contacts_w: Floats = field(default_factory=_make_no_points)
    normals: Floats = field(default_factory=_make_no_arrows)
    tangents: Floats = field(default_factory=_make_no_arrows)
    measured_forces: Floats = field(default_factory=_make_no_arrows)  # on the body
    # Of the measured forces, at the body's center.
    resultant: Floats = field(default_factory=_make_no_arrows)
    # Of the controller, at push-points with contact.
    desired_forces: Floats = field(default_factory=_make_no_arrows)
    # Likewise, at push-points without contact.
    forces_without_contact: Floats = field(default_factory=_make_no_arrows)


@dataclass(frozen=True, kw_only=True, eq=False)
class SnapshotDrawing(ForceArrows):
    """Everything that is drawn of one snapshot."""

    # The snake.
    center_w: Floats  # of the body
    links_w: Floats  # (links, 3) middle of each link
    links_wxyz: Floats  # (links, 4)
    hinges_w: Floats  # (joints, 3)
    hinges_wxyz: Floats  # (joints, 4); z is the joint's axis
    failed_joints: frozenset[int] = frozenset()  # joints that are isolated, or have a fault
    propulsion_joint: int | None = None

    # What it moves among.
    path_w: Floats = field(default_factory=_make_no_points)
    perceived: tuple[KnownObstacle, ...] = ()  # by guidance
    pushed_obstacles: frozenset[str] = frozenset()  # names; the body pushes off these
    # Names; navigation expects push-points there along the path.
    obstacles_ahead: frozenset[str] = frozenset()
    cameras: tuple[CameraFrustum, ...] = ()


def draw(snapshot: RobotSnapshot, surroundings: TrueSurroundings | None) -> SnapshotDrawing | None:
    """Compute the positions of everything that is drawn of a snapshot.

    If the pose of the robot is unknown, its tail is drawn at the origin.

    Args:
        snapshot: Snapshot of the robot at one time.
        surroundings: The true surroundings of the robot; None if they are unknown.

    Returns:
        The drawing, or None while the joint angles are unknown.
    """
    robot = snapshot.robot
    body = snapshot.body or snapshot.joints
    if body is None:
        return None
    pose_at_origin = (0.0, 0.0, robot.links[0].radius_m), AT_ORIGIN_WXYZ
    position_w, orientation_wxyz = snapshot.base or pose_at_origin
    base_rotation = rotation_from_quaternion(orientation_wxyz)
    axes = [joint.axis for joint in robot.joints]
    lengths_m = [link.length_m for link in robot.links]
    origins_w, rotations = compute_link_frames(
        position_w, base_rotation, body.angle_rad, axes, lengths_m
    )
    middles_w = origins_w + rotations[:, :, 0] * (np.array(lengths_m)[:, None] / 2)
    center_w = middles_w.mean(axis=0)
    path_w = _make_no_points()
    obstacles_ahead = frozenset[str]()
    if snapshot.trajectory is not None:
        path_w = _lay_on_ground(np.array(snapshot.trajectory.path_w), surroundings)
        obstacles_ahead = frozenset(snapshot.trajectory.push_points)
    cameras = [
        _make_camera_frustum(key, image, origins_w, rotations)
        for key, image in snapshot.images.items()
    ]
    return SnapshotDrawing(
        # The snake.
        center_w=center_w,
        links_w=middles_w,
        links_wxyz=quaternions_from_rotations(rotations),
        hinges_w=origins_w[1:],
        hinges_wxyz=quaternions_from_rotations(_compute_hinge_rotations(rotations[:-1], axes)),
        failed_joints=_find_failed_joints(snapshot),
        propulsion_joint=find_propulsion_joint(snapshot),
        # What it moves among.
        path_w=path_w,
        perceived=_list_perceived(snapshot.world),
        pushed_obstacles=_find_pushed_obstacles(snapshot),
        obstacles_ahead=obstacles_ahead,
        cameras=tuple(cameras),
        # Contacts and forces.
        **_make_contact_arrows(snapshot, center_w),
        **_make_desired_force_arrows(snapshot),
    )


def _compute_hinge_rotations(rotations: Floats, axes: Sequence[str]) -> Floats:
    """Return rotations whose z is the axis about which each joint turns."""
    hinges = rotations.copy()
    for i, axis in enumerate(axes):
        if axis == "pitch":
            hinges[i] = rotations[i] @ Z_TO_Y
    return hinges


def _find_failed_joints(snapshot: RobotSnapshot) -> frozenset[int]:
    """Return the indices of joints that are isolated or have a fault."""
    status = snapshot.status
    if status is None:
        return frozenset()
    failed_names = {*status.isolated, *(fault.joint for fault in status.faults)}
    return frozenset(
        i for i, joint in enumerate(snapshot.robot.joints) if joint.name in failed_names
    )


def find_propulsion_joint(snapshot: RobotSnapshot) -> int | None:
    """Return the index of the joint that propels the robot now; None if the controller names none."""
    if snapshot.control is None:
        return None
    for i, joint in enumerate(snapshot.robot.joints):
        if joint.name == snapshot.control.propulsion_joint:
            return i
    return None


def _list_perceived(world: WorldModel | None) -> tuple[KnownObstacle, ...]:
    """Return the obstacles that guidance knows from its sensors.

    Those that it knows from a map are the truth, which is drawn anyway.
    """
    if world is None:
        return ()
    return tuple(
        obstacle
        for obstacle in world.obstacles
        if obstacle.last_seen_ns is not None or obstacle.touched
    )


def _list_contacts(snapshot: RobotSnapshot) -> list[WorldContact]:
    if snapshot.world is None:
        return []
    return snapshot.world.contacts


def _find_pushed_obstacles(snapshot: RobotSnapshot) -> frozenset[str]:
    """Return the names of obstacles at whose push-points a contact is measured."""
    if snapshot.control is None:
        return frozenset()
    contacts = _list_contacts(snapshot)
    names: set[str] = set()
    for push_point in snapshot.control.push_points:
        if push_point.obstacle and is_contact_measured(push_point, contacts):
            names.add(push_point.obstacle)
    return frozenset(names)


def _make_contact_arrows(snapshot: RobotSnapshot, center_w: Floats) -> dict[str, Floats]:
    """Make the arrows of contacts, measured forces and their resultant, as fields of `ForceArrows`.

    Args:
        snapshot: The newest snapshot of the robot, with its contacts.
        center_w: (3,) center of the body in the world, where the resultant is drawn, m.

    Returns:
        Points (n, 3) or arrows (n, 2, 3) by the name of the field; an empty dict without contacts.
    """
    contacts = _list_contacts(snapshot)
    if not contacts:
        return {}
    positions_w = np.array([contact.position_w for contact in contacts])
    normals_w = np.array([contact.normal_w for contact in contacts])
    tangents_w = np.array([contact.tangent_w for contact in contacts])
    forces_n = np.array([contact.force_w for contact in contacts])
    is_strong = np.linalg.norm(forces_n, axis=1) > MIN_FORCE_N
    arrows_by_field = {
        "contacts_w": positions_w,
        "normals": _arrows(positions_w, NORMAL_ARROW_M * normals_w),
        "tangents": _arrows(positions_w, TANGENT_ARROW_M * tangents_w),
        "measured_forces": _make_force_arrows(
            snapshot, positions_w[is_strong], forces_n[is_strong]
        ),
    }
    total_n = forces_n.sum(axis=0)
    if np.linalg.norm(total_n) > MIN_FORCE_N:
        arrows_by_field["resultant"] = _make_force_arrows(snapshot, center_w[None], total_n[None])
    return arrows_by_field


def _make_desired_force_arrows(snapshot: RobotSnapshot) -> dict[str, Floats]:
    """Return the controller's desired forces, with and without contact, as fields of ForceArrows."""
    control = snapshot.control
    if (
        control is None
        or not control.push_points
        or len(control.push_points) != len(control.desired_force_n)
    ):
        return {}
    contacts = _list_contacts(snapshot)
    positions_w = np.array([point.position_w for point in control.push_points])
    normals_w = np.array([point.normal_w for point in control.push_points])
    forces_n = np.array(control.desired_force_n)[:, None] * normals_w
    arrows = _make_force_arrows(snapshot, positions_w, forces_n)
    has_contact = np.array([is_contact_measured(point, contacts) for point in control.push_points])
    return {"desired_forces": arrows[has_contact], "forces_without_contact": arrows[~has_contact]}


def _make_force_arrows(snapshot: RobotSnapshot, positions_w: Floats, forces_n: Floats) -> Floats:
    """Return arrows of limited length for forces (n, 3), above the places where they act."""
    magnitude_n = np.linalg.norm(forces_n, axis=1, keepdims=True)
    scale = np.minimum(M_PER_N, MAX_FORCE_ARROW_M / np.maximum(magnitude_n, 1e-9))
    above_m = max(link.radius_m for link in snapshot.robot.links) + ABOVE_M
    return _arrows(positions_w + np.array([0.0, 0.0, above_m]), scale * forces_n)


def _arrows(start_w: Floats, span: Floats) -> Floats:
    return np.stack([start_w, start_w + span], axis=1)


def _lay_on_ground(points_w: Floats, surroundings: TrueSurroundings | None) -> Floats:
    """Return points (n, 2) lifted to just above the ground, (n, 3)."""
    heights_m = np.zeros(len(points_w))
    if surroundings is not None:
        heights_m = surroundings.find_ground_heights_m(points_w)
    return np.column_stack([points_w, heights_m + PATH_ABOVE_M])


def _make_camera_frustum(
    key: str, image: DepthImage | ColorImage, origins: Floats, rotations: Floats
) -> CameraFrustum:
    """Return where a camera of the robot is, from the pose of its link and the mounting in its image."""
    link_rotation = rotations[image.link]
    rotation = (
        link_rotation @ rotation_from_quaternion(image.orientation_l_wxyz) @ LINK_FROM_FRUSTUM
    )
    return CameraFrustum(
        key=key,
        position_w=origins[image.link] + link_rotation @ np.array(image.position_l),
        wxyz=quaternions_from_rotations(rotation[None])[0],
        fov_rad=2 * math.atan(image.height / 2 / image.fy_px),
        aspect=image.width / image.height,
    )
