"""The world model from sensors alone: pose, contacts, and a map that begins empty. Pure.

Each sample is used once, with the body as it was at the sample's own timestamp. Nothing is invented: without images the
map stays as it is and its confidence falls, without contacts none are reported, without poses the covariance grows.
"""

import math
from collections import Counter

import numpy as np

from snakesim_gnc.guidance.body_history import Base, BodyFrames
from snakesim_gnc.guidance.core import transform_contact
from snakesim_gnc.guidance.depth_scan import DepthScanner, Intrinsics, decode_depth_m
from snakesim_gnc.guidance.ground import fit_plane_under
from snakesim_gnc.guidance.localization import Localizer, PoseNoise
from snakesim_gnc.guidance.obstacle_map import ObstacleMap
from snakesim_gnc.guidance.scan import Noise, RangingSample, Scan, make_scan
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
    WorldContact,
)
from snakesim_hal.wire.quantities import MAX_CONTACTS

TOUCH_PERIOD_NS = 50_000_000  # contacts are mapped this often: the body slides a few millimeters meanwhile
OWN_BODY_M = 0.01  # beyond the body's radius: nearer points of a scan are on the body itself
HALF_CONFIDENCE_SD_M = 0.05  # of the position, at which the confidence in it is one half
MAX_UPWARD = 0.7  # part of a contact's normal: with more, the body lies on the obstacle
TRUSTED_POSE_NS = 300_000_000  # with a pose newer than this, scans do not correct the base
MAX_CARVE_SD_M = 0.01  # limit of the position's standard deviation that the map assumes for the body
MAX_SCAN_SD_M = 0.02  # likewise for scans
MAX_POSITION_SD_M = 1e3  # upper limits of what is reported
MAX_YAW_SD_RAD = 10.0


class PerceivedWorld:
    """Makes world models from sensor samples."""

    def __init__(self, robot: Description, start: Base, pose_noise: PoseNoise) -> None:
        """Create an empty map and an estimate of the base pose, which the samples of sensors then update.

        Args:
            robot: description of the robot.
            start: base pose at the start.
            pose_noise: noise of the pose sensor.
        """
        # The robot.
        lengths_m = np.array([link.length_m for link in robot.links])
        masses_kg = np.array([link.mass_kg for link in robot.links])
        self._half_m = 0.5 * lengths_m
        self._mass_ratios = masses_kg / masses_kg.sum()
        self._rear_s_m = np.concatenate(([0.0], np.cumsum(lengths_m)))[:-1]
        self._radius_m = max(link.radius_m for link in robot.links)

        # The estimates.
        self.map = ObstacleMap()
        self.localizer = Localizer(robot, start, pose_noise)
        self._mapped_variance_m2 = 0.0  # of the position, after the last scan

        # Samples.
        self.refused: Counter[str] = Counter()  # samples that could not be used, by reason
        self.depth_timestamp_ns: int | None = None  # of the newest image or ranges in the map
        self._scanners: dict[tuple[Intrinsics, Noise], DepthScanner] = {}
        self._joints: JointState | None = None
        self._contacts: Contacts | None = None
        self._touched_ns = 0  # timestamp of the newest contacts in the map; 0: none yet

    def add_joints(self, joints: JointState, contacts: Contacts | None, imu: Imu | None) -> None:
        """Move the body to the newest joint state. contacts, imu: the newest, for dead reckoning."""
        if self._joints is not None and joints.timestamp_ns <= self._joints.timestamp_ns:
            return
        self._joints = joints
        self.localizer.move(joints, contacts, imu)

    def add_pose(self, pose: Pose) -> None:
        """Correct the body's pose by a sample of the pose sensor."""
        self.localizer.add_pose(pose)
        if self.localizer.carried_m:
            self.map.drift(self.localizer.carried_m**2)

    def add_contacts(self, contacts: Contacts) -> None:
        """Store contacts, and add the touched places of upright surfaces to the map, at most every TOUCH_PERIOD_NS.

        Contacts whose time is not covered by the history of the body are counted in `refused`.

        Args:
            contacts: contacts of the links, in the frames of the links.
        """
        self._contacts = contacts
        has_touched = self._touched_ns != 0
        if has_touched and contacts.timestamp_ns - self._touched_ns < TOUCH_PERIOD_NS:
            return
        body = self.localizer.history.body_at(contacts.timestamp_ns)
        if body is None:
            self.refused["contacts without a joint state of their time"] += 1
            return
        self._touched_ns = contacts.timestamp_ns
        touches: list[tuple[Floats, Floats]] = []  # position (2,) and normal (2,) in the world
        for contact in contacts.contacts:
            if contact.link >= len(body.origins_w):
                continue
            rotation = body.rotations[contact.link]
            normal_w = rotation @ np.array(contact.normal_l)
            if abs(normal_w[2]) < MAX_UPWARD:
                position_w = body.origins_w[contact.link] + rotation @ np.array(contact.position_l)
                touches.append((position_w[:2], normal_w[:2] / math.hypot(*normal_w[:2])))
        self.map.add_touches(touches, contacts.timestamp_ns)

    def add_ranging_sample(self, look: RangingSample, noise: Noise) -> None:
        """Add an image or ranges of any camera, lidar or range finder to the map. noise: of its distances."""
        body = self._find_body(look.timestamp_ns, "image" if isinstance(look, DepthImage) else "ranges")
        if body is None or look.link >= len(body.origins_w):
            return
        position_w, rotation = _sensor_pose(body, look)
        bottoms_w = np.vstack([body.origins_w, body.head_w]) - [0.0, 0.0, self._radius_m]
        plane = fit_plane_under(bottoms_w, position_w[:2])
        if isinstance(look, DepthImage):
            scanner = self._find_scanner(Intrinsics.from_image(look), noise)
            scan = scanner.scan(decode_depth_m(look), look.timestamp_ns, position_w, rotation, plane)
        else:
            scan = make_scan(look, position_w, rotation, float(plane[0]), noise)
        self._map_scan(scan, body)

    def make_world(self, tick: int, now_ns: int) -> World | None:
        """Return the world model at the newest joint state, after removing obstacles where the body is.

        Args:
            tick: tick of the clock.
            now_ns: robot time of the clock.

        Returns:
            The world model, or None before the first joint state.
        """
        joints = self._joints
        if joints is None:
            return None
        localizer = self.localizer
        base = localizer.base
        body = localizer.history.compute_frames(base, np.asarray(joints.angle_rad))
        axis_w = body.axis_w()
        self.map.carve_body(axis_w, self._radius_m, min(localizer.position_sd_m, MAX_CARVE_SD_M))
        self.map.drop_distant(axis_w)
        middles_w = body.origins_w + self._half_m[:, None] * body.rotations[:, :, 0]
        contacts_timestamp_ns = None
        contacts_from = None
        if self._contacts is not None:
            contacts_timestamp_ns = self._contacts.timestamp_ns
            contacts_from = "sensor"
        return World(
            tick=tick,
            timestamp_ns=joints.timestamp_ns,
            base_position_w=tuple(base.position_w.tolist()),
            base_orientation_wxyz=quaternion_from_rotation(base.rotation),
            base_confidence=compute_confidence(localizer.position_sd_m),
            contacts=self._transform_contacts(body),
            obstacles=self.map.obstacles(now_ns, base.z_m - self._radius_m),
            pose_timestamp_ns=localizer.pose_timestamp_ns,
            contacts_timestamp_ns=contacts_timestamp_ns,
            center_w=tuple((self._mass_ratios @ middles_w).tolist()),
            base_position_sd_m=min(localizer.position_sd_m, MAX_POSITION_SD_M),
            base_yaw_sd_rad=min(localizer.yaw_sd_rad, MAX_YAW_SD_RAD),
            depth_timestamp_ns=self.depth_timestamp_ns,
            pose_from="sensor" if self._trusts_pose(now_ns) else "dead_reckoning",
            contacts_from=contacts_from,
        )

    def _transform_contacts(self, body: BodyFrames) -> list[WorldContact]:
        """Return the newest contacts in the world, with the body of their time. body: of now."""
        contacts = self._contacts
        if contacts is None:
            return []
        then = self.localizer.history.body_at(contacts.timestamp_ns) or body
        valid = [contact for contact in contacts.contacts if contact.link < len(body.origins_w)]
        return [
            transform_contact(contact, then.origins_w, then.rotations, self._rear_s_m, self._find_name)
            for contact in valid[:MAX_CONTACTS]
        ]

    def _find_name(self, position_w: Floats) -> str | None:
        """Return the name of the mapped obstacle at a position (3,)."""
        track = self.map.find_track(position_w[:2])
        return None if track is None else track.name

    def _trusts_pose(self, now_ns: int) -> bool:
        """Return whether the pose sensor has measured lately. If not, the map corrects dead reckoning."""
        pose_ns = self.localizer.pose_timestamp_ns
        return pose_ns is not None and now_ns - pose_ns <= TRUSTED_POSE_NS

    def _find_body(self, timestamp_ns: int, sample: str) -> BodyFrames | None:
        """Return the body at a sample's timestamp; None if it is unknown, which is counted. sample: what it is."""
        if self._joints is None or not all(self._joints.valid):
            self.refused[f"{sample} while a joint's angle is unknown"] += 1
            return None
        if self.depth_timestamp_ns is not None and timestamp_ns < self.depth_timestamp_ns:
            self.refused[f"{sample} older than one before"] += 1
            return None
        body = self.localizer.history.body_at(timestamp_ns)
        if body is None:
            self.refused[f"{sample} without a joint state of its time"] += 1
        return body

    def _find_scanner(self, lens: Intrinsics, noise: Noise) -> DepthScanner:
        """Return the scanner of a camera, which is made once."""
        key = (lens, noise)
        scanner = self._scanners.get(key)
        if scanner is None:
            scanner = DepthScanner(lens, noise)
            self._scanners[key] = scanner
        return scanner

    def _map_scan(self, scan: Scan, body: BodyFrames) -> None:
        """Correct the base by a scan if no pose sensor does, and add the scan to the map. body: at its timestamp."""
        offset = scan.points_w[:, None] - body.axis_w()
        from_axis_m = np.hypot(offset[..., 0], offset[..., 1]).min(axis=1)
        scan = scan.without(from_axis_m < self._radius_m + OWN_BODY_M)
        variance_m2 = self._position_variance_m2()
        self.map.drift(max(variance_m2 - self._mapped_variance_m2, 0.0))
        self.map.here_m2 = variance_m2
        if not self._trusts_pose(scan.timestamp_ns):
            scan = self._correct_by_scan(scan)
        self.depth_timestamp_ns = scan.timestamp_ns
        self.map.add_scan(scan, min(self.localizer.position_sd_m, MAX_SCAN_SD_M))
        self._mapped_variance_m2 = self._position_variance_m2()

    def _correct_by_scan(self, scan: Scan) -> Scan:
        """Correct the base by matching a scan to the map. Returns the scan as seen from the corrected base."""
        then = self.localizer.history.base_at(scan.timestamp_ns)
        if then is None:
            return scan
        match = match_scan(scan, self.map.tracks, then.planar_w)
        if match is None:
            return scan
        self.localizer.correct(then, match.planar_w, match.covariance, match.map_m2)
        return scan.moved(then.planar_w, match.planar_w)

    def _position_variance_m2(self) -> float:
        """Return the mean variance of the base's position over x and y."""
        return 0.5 * float(np.trace(self.localizer.covariance[:2, :2]))


def compute_confidence(position_sd_m: float) -> float:
    """Return the confidence in a position, 0 to 1, by its standard deviation."""
    return 1.0 / (1.0 + (position_sd_m / HALF_CONFIDENCE_SD_M) ** 2)


def quaternion_from_rotation(rotation: Floats) -> tuple[float, float, float, float]:
    """Return the unit quaternion wxyz of a rotation matrix (3, 3).

    The rows of a symmetric matrix are 4 q_i q for i = w, x, y, z. The one with the largest diagonal entry is the most
    precise; it only has to be normalized.
    """
    m = rotation
    four_times_products = np.array(
        [
            [1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]],
            [m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[2, 1] + m[1, 2]],
            [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]],
        ]
    )
    best_row = four_times_products[np.argmax(np.diagonal(four_times_products))]
    return tuple((best_row / np.linalg.norm(best_row)).tolist())


def _sensor_pose(body: BodyFrames, sensor: RangingSample) -> tuple[Floats, Floats]:
    """Return position (3,) in the world and rotation (3, 3) world_from_sensor of a mounted sensor."""
    rotation = body.rotations[sensor.link]
    position_w = body.origins_w[sensor.link] + rotation @ np.array(sensor.position_l)
    return position_w, rotation @ rotation_from_quaternion(sensor.orientation_l_wxyz)
