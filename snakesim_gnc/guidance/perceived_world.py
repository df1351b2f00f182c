"""The world model from sensors alone: pose, contacts, and a map that begins empty. Pure.

Each sample is taken in once, with the body as it was at the sample's own stamp. Nothing is invented: without images the
map stays as it is and fades, without contacts none are reported, without poses the covariance grows.
"""

import math
from collections import Counter

import numpy as np

from snakesim_gnc.guidance.body_history import Base, Body
from snakesim_gnc.guidance.contacts_w import contact_w
from snakesim_gnc.guidance.depth_scan import DepthScanner, Intrinsics, decode_depth_m
from snakesim_gnc.guidance.ground import fit_plane_under
from snakesim_gnc.guidance.localization import Localizer, PoseNoise
from snakesim_gnc.guidance.obstacle_map import ObstacleMap
from snakesim_gnc.guidance.scan import Look, Noise, Scan, make_scan
from snakesim_gnc.guidance.scan_match import match_scan
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import rotation_from_quaternion
from snakesim_hal.wire.messages import (
    Contacts,
    DepthImage,
    Description,
    Imu,
    JointState,
    Pose,
    World,
)
from snakesim_hal.wire.quantities import MAX_CONTACTS

TOUCH_EVERY_NS = 50_000_000  # the body slides a few millimetres meanwhile
OWN_BODY_M = 0.01  # beyond its radius
SURE_SD_M = 0.05  # of the position, at which the confidence in it is one half
UPRIGHT = 0.7  # a normal with more than this upwards is of something that the body lies on
TRUSTED_NS = 300_000_000  # a pose newer than this needs no help from the map


class PerceivedWorld:
    """Sensor samples in, World out."""

    def __init__(self, robot: Description, start: Base, pose_noise: PoseNoise) -> None:
        """start: where the robot is laid down. pose_noise: of the pose sensor."""
        self.map = ObstacleMap()
        self.localizer = Localizer(robot, start, pose_noise)
        self.refused: Counter[str] = Counter()  # samples that could not be used, by reason
        self._scanners: dict[tuple[Intrinsics, Noise], DepthScanner] = {}
        lengths = np.array([link.length_m for link in robot.links])
        masses = np.array([link.mass_kg for link in robot.links])
        self._half_m, self._shares = 0.5 * lengths, masses / masses.sum()
        self._rear_s = np.concatenate(([0.0], np.cumsum(lengths)))[:-1]
        self._radius_m = max(link.radius_m for link in robot.links)
        self._joints: JointState | None = None
        self._contacts: Contacts | None = None
        self._body: Body | None = None
        self._touched_ns = self._variance_m2 = 0
        self.depth_timestamp_ns: int | None = None  # of the newest image or ranges in the map

    def add_joints(self, joints: JointState, contacts: Contacts | None, imu: Imu | None) -> None:
        """The newest joint state moves the body. contacts, imu: the newest, for dead reckoning."""
        if self._joints is not None and joints.timestamp_ns <= self._joints.timestamp_ns:
            return
        self._joints = joints
        self.localizer.move(joints, contacts, imu)

    def add_pose(self, pose: Pose) -> None:
        """A sample of the pose sensor."""
        self.localizer.add_pose(pose)
        if self.localizer.carried_m:
            self.map.drift(self.localizer.carried_m**2)

    def add_contacts(self, contacts: Contacts) -> None:
        """Touches, and the body's own way: where it is, nothing else is."""
        self._contacts = contacts
        if contacts.timestamp_ns - self._touched_ns < TOUCH_EVERY_NS and self._touched_ns:
            return
        body = self.localizer.history.body_at(contacts.timestamp_ns)
        if body is None:
            self.refused["contacts without a joint state of their time"] += 1
            return
        self._touched_ns = contacts.timestamp_ns
        touches: list[tuple[Floats, Floats]] = []
        for contact in contacts.contacts:
            if contact.link >= len(body.origins_w):
                continue
            rotation = body.rotations[contact.link]
            normal = rotation @ np.array(contact.normal_l)
            if abs(normal[2]) < UPRIGHT:
                position = body.origins_w[contact.link] + rotation @ np.array(contact.position_l)
                touches.append((position[:2], normal[:2] / math.hypot(*normal[:2])))
        self.map.add_touches(touches, contacts.timestamp_ns)

    def add_look(self, look: Look, noise: Noise) -> None:
        """An image or a scan, of any camera, lidar or range finder. noise: of its distances."""
        body = self._body_of(look.timestamp_ns, "image" if isinstance(look, DepthImage) else "ranges")
        if body is None or look.link >= len(body.origins_w):
            return
        position, rotation = _mount(body, look)
        bottoms_w = np.vstack([body.origins_w, body.head_w]) - [0.0, 0.0, self._radius_m]
        plane = fit_plane_under(bottoms_w, position[:2])
        if isinstance(look, DepthImage):
            kind = (Intrinsics.from_image(look), noise)
            scanner = self._scanners.get(kind)
            if scanner is None:
                scanner = self._scanners[kind] = DepthScanner(*kind)
            scan = scanner.scan(decode_depth_m(look), look.timestamp_ns, position, rotation, plane)
        else:
            scan = make_scan(look, position, rotation, float(plane[0]), noise)
        self._take(scan, body)

    def make_world(self, tick: int, now_ns: int) -> World | None:
        """The world now; None before the first joint state. tick, now_ns: of the clock."""
        joints = self._joints
        if joints is None:
            return None
        here = self.localizer
        base = here.base
        body = self._body = here.history.lay(base, np.asarray(joints.angle_rad))
        self.map.carve_body(body.axis_w(), self._radius_m, min(here.position_sd_m, 0.01))
        self.map.forget(body.axis_w())
        middles = body.origins_w + self._half_m[:, None] * body.rotations[:, :, 0]
        contacts = self._contacts
        felt = [] if contacts is None else [c for c in contacts.contacts if c.link < len(body.origins_w)]
        then = body if contacts is None else here.history.body_at(contacts.timestamp_ns) or body
        contacts_w = [
            contact_w(c, then.origins_w, then.rotations, self._rear_s, self._name_at) for c in felt[:MAX_CONTACTS]
        ]
        return World(
            tick=tick,
            timestamp_ns=joints.timestamp_ns,
            base_position_w=tuple(base.position_w.tolist()),
            base_orientation_wxyz=quaternion_of(base.rotation),
            base_confidence=confidence_of(here.position_sd_m),
            contacts=contacts_w,
            obstacles=self.map.obstacles(now_ns, base.z_m - self._radius_m),
            pose_timestamp_ns=here.pose_timestamp_ns,
            contacts_timestamp_ns=None if contacts is None else contacts.timestamp_ns,
            center_w=tuple((self._shares @ middles).tolist()),
            base_position_sd_m=min(here.position_sd_m, 1e3),
            base_yaw_sd_rad=min(here.yaw_sd_rad, 10.0),
            depth_timestamp_ns=self.depth_timestamp_ns,
            pose_from="sensor" if self._trusts_pose(now_ns) else "dead_reckoning",
            contacts_from=None if contacts is None else "sensor",
        )

    def _trusts_pose(self, now_ns: int) -> bool:
        """Whether the pose sensor has just told; else dead reckoning goes on alone, and the map helps."""
        pose_ns = self.localizer.pose_timestamp_ns
        return pose_ns is not None and now_ns - pose_ns <= TRUSTED_NS

    def _body_of(self, timestamp_ns: int, what: str) -> Body | None:
        """The body at a sample's stamp; None when it is unknown, which is counted."""
        if self._joints is None or not all(self._joints.valid):
            self.refused[f"{what} while a joint's angle is unknown"] += 1
            return None
        if self.depth_timestamp_ns is not None and timestamp_ns < self.depth_timestamp_ns:
            self.refused[f"{what} older than one before"] += 1
            return None
        body = self.localizer.history.body_at(timestamp_ns)
        if body is None:
            self.refused[f"{what} without a joint state of its time"] += 1
        return body

    def _take(self, scan: Scan, body: Body) -> None:
        offset = scan.points_w[:, None] - body.axis_w()
        scan = scan.without(np.hypot(offset[..., 0], offset[..., 1]).min(axis=1) < self._radius_m + OWN_BODY_M)
        here = self.localizer
        variance = 0.5 * float(np.trace(here.covariance[:2, :2]))
        self.map.drift(max(variance - self._variance_m2, 0.0))
        self.map.here_m2 = variance
        if not self._trusts_pose(scan.timestamp_ns):
            then = here.history.base_at(scan.timestamp_ns)
            found = None if then is None else match_scan(scan, self.map.tracks, then.planar_w)
            if then is not None and found is not None:
                here.correct(then, found.planar_w, found.covariance, found.map_m2)
                scan = scan.moved(then.planar_w, found.planar_w)
        self.depth_timestamp_ns = scan.timestamp_ns
        self.map.add_scan(scan, min(here.position_sd_m, 0.02))
        self._variance_m2 = 0.5 * float(np.trace(here.covariance[:2, :2]))

    def _name_at(self, position_w: Floats) -> str | None:
        track = self.map.find_track(position_w[:2])
        return None if track is None else track.name


def confidence_of(position_sd_m: float) -> float:
    """In a position; one half when it is known to 5 cm."""
    return 1.0 / (1.0 + (position_sd_m / SURE_SD_M) ** 2)


def quaternion_of(rotation: Floats) -> tuple[float, float, float, float]:
    """Unit quaternion wxyz of a rotation matrix (3, 3)."""
    m = rotation
    four_times_products = np.array(  # row i: 4 q_i q
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    by_maximum = four_times_products[np.argmax(np.diagonal(four_times_products))]
    return tuple((by_maximum / np.linalg.norm(by_maximum)).tolist())


def _mount(body: Body, sensor: Look) -> tuple[Floats, Floats]:
    """Position (3,) and rotation (3, 3) world_from_sensor."""
    rotation = body.rotations[sensor.link]
    position = body.origins_w[sensor.link] + rotation @ np.array(sensor.position_l)
    return position, rotation @ rotation_from_quaternion(sensor.orientation_l_wxyz)
