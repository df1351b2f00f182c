"""The world model from sensors alone: pose, contacts, and a map that begins empty. Pure.

Each sample is used once, with the body as it was at the sample's own timestamp. Nothing is invented: without images the
map stays as it is and its confidence falls, without contacts none are reported, without poses the covariance grows.
"""

import math
from collections import Counter

import numpy as np

from snakesim_gnc.guidance.mapping.obstacle_map import ObstacleMap
from snakesim_gnc.guidance.pose.body_history import BasePose, BodyFrames
from snakesim_gnc.guidance.pose.localization import PoseLocalizer, PoseNoise, compute_confidence
from snakesim_gnc.guidance.pose.scan_match import match_scan
from snakesim_gnc.guidance.ranging.depth_scan import CameraIntrinsics, DepthScanner, decode_depth_m
from snakesim_gnc.guidance.ranging.ground import fit_plane_under_body
from snakesim_gnc.guidance.ranging.scan import AzimuthScan, RangeNoise, RangingSample, make_scan
from snakesim_gnc.guidance.surveyed_world import transform_contact
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.kinematics import (
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from snakesim_hal.wire.messages import (
    Contacts,
    DepthImage,
    Imu,
    JointState,
    Pose,
    RobotDescription,
    WorldContact,
    WorldModel,
)
from snakesim_hal.wire.quantities import MAX_CONTACTS

# Contacts are mapped this often: the body slides a few millimeters meanwhile.
CONTACT_MAPPING_PERIOD_NS = 50_000_000
OWN_BODY_MARGIN_M = 0.01  # beyond the body's radius: nearer points of a scan are on the body itself
# Part of a contact's normal: with more, the body lies on the obstacle.
MAX_VERTICAL_NORMAL_PART = 0.7
MAX_TRUSTED_POSE_AGE_NS = 300_000_000  # with a pose newer than this, scans do not correct the base
# Limit of the position's standard deviation that the map assumes for the body.
MAX_CARVE_SD_M = 0.01
MAX_SCAN_SD_M = 0.02  # likewise for scans
MAX_POSITION_SD_M = 1e3  # upper limits of what is reported
MAX_YAW_SD_RAD = 10.0


class PerceivedWorld:
    """Makes world models from sensor samples."""

    def __init__(self, robot: RobotDescription, start: BasePose, pose_noise: PoseNoise) -> None:
        """Create an empty map and an estimate of the base pose, which the samples of sensors then update.

        Args:
            robot: Description of the robot.
            start: Base pose at the start.
            pose_noise: Noise of the pose sensor.
        """
        # The robot.
        lengths_m = np.array([link.length_m for link in robot.links])
        masses_kg = np.array([link.mass_kg for link in robot.links])
        self._half_lengths_m = 0.5 * lengths_m
        self._mass_fractions = masses_kg / masses_kg.sum()
        self._link_rear_s_m = np.concatenate(([0.0], np.cumsum(lengths_m)))[:-1]
        self._radius_m = max(link.radius_m for link in robot.links)

        # The estimates.
        self.map = ObstacleMap()
        self.localizer = PoseLocalizer(robot, start, pose_noise)
        self._variance_at_last_scan_m2 = 0.0  # of the position, after the last scan

        # Samples.
        # Samples that could not be used, by reason.
        self.rejected_sample_counts: Counter[str] = Counter()
        self.depth_timestamp_ns: int | None = None  # of the newest image or ranges in the map
        self._scanners: dict[tuple[CameraIntrinsics, RangeNoise], DepthScanner] = {}
        self._joints: JointState | None = None
        self._contacts: Contacts | None = None
        # Timestamp of the newest contacts that were added to the map; 0 before the first ones.
        self._last_mapped_contacts_ns = 0

    def add_joints(self, joints: JointState, contacts: Contacts | None, imu: Imu | None) -> None:
        """Move the estimated body to a joint state by dead reckoning. A joint state that is not newer is ignored.

        Args:
            joints: The newest joint state.
            contacts: The newest contacts, for dead reckoning; None if there are none.
            imu: The newest angular velocities and accelerations, for dead reckoning; None if there are none.
        """
        if self._joints is not None and joints.timestamp_ns <= self._joints.timestamp_ns:
            return
        self._joints = joints
        self.localizer.predict(joints, contacts, imu)

    def add_pose(self, pose: Pose) -> None:
        """Correct the body's pose by a sample of the pose sensor. A jump makes the map less certain."""
        self.localizer.add_pose(pose)
        if self.localizer.jump_distance_m:
            self.map.add_drift(self.localizer.jump_distance_m**2)

    def add_contacts(self, sample: Contacts) -> None:
        """Store the newest contacts, and add those with upright surfaces to the map.

        Contacts are mapped at most every CONTACT_MAPPING_PERIOD_NS. A sample whose time is not covered by the history
        of the body is counted in `rejected_sample_counts`. Contacts of links that the robot does not have are ignored.

        Args:
            sample: Contacts of the links, with positions and normals in the frames of the links.
        """
        self._contacts = sample
        has_mapped_contacts = self._last_mapped_contacts_ns != 0
        elapsed_ns = sample.timestamp_ns - self._last_mapped_contacts_ns
        if has_mapped_contacts and elapsed_ns < CONTACT_MAPPING_PERIOD_NS:
            return
        body = self.localizer.history.interpolate_body(sample.timestamp_ns)
        if body is None:
            self.rejected_sample_counts["contacts without a joint state of their time"] += 1
            return
        self._last_mapped_contacts_ns = sample.timestamp_ns
        points_and_normals_w: list[tuple[Floats, Floats]] = []  # (2,) and (2,) in the world
        for contact in sample.contacts:
            if contact.link >= len(body.origins_w):
                continue
            world_from_link = body.rotations[contact.link]
            normal_w = world_from_link @ np.array(contact.normal_l)
            # The body lies on a surface with a steeper normal, which is no obstacle beside it.
            if abs(normal_w[2]) >= MAX_VERTICAL_NORMAL_PART:
                continue
            position_w = body.origins_w[contact.link] + world_from_link @ np.array(
                contact.position_l
            )
            horizontal_normal_w = normal_w[:2] / math.hypot(*normal_w[:2])
            points_and_normals_w.append((position_w[:2], horizontal_normal_w))
        self.map.add_contacts(points_and_normals_w, sample.timestamp_ns)

    def add_ranging_sample(self, sample: RangingSample, noise: RangeNoise) -> None:
        """Add a sample of a depth camera, lidar or range finder to the map.

        A sample whose time is not covered by the history of the body is counted in `rejected_sample_counts`.

        Args:
            sample: Depth image or ranges, with the mounting of the sensor on its link.
            noise: Noise of the measured distances.
        """
        body = self._find_body_at_sample(
            sample.timestamp_ns, "image" if isinstance(sample, DepthImage) else "ranges"
        )
        if body is None or sample.link >= len(body.origins_w):
            return
        position_w, rotation = _compute_sensor_pose(body, sample)
        lowest_points_w = np.vstack([body.origins_w, body.head_end_w]) - [0.0, 0.0, self._radius_m]
        plane = fit_plane_under_body(lowest_points_w, position_w[:2])
        if isinstance(sample, DepthImage):
            scanner = self._get_scanner(CameraIntrinsics.from_image(sample), noise)
            scan = scanner.make_scan(
                decode_depth_m(sample), sample.timestamp_ns, position_w, rotation, plane
            )
        else:
            scan = make_scan(sample, position_w, rotation, float(plane[0]), noise)
        self._add_scan_to_map(scan, body)

    def make_world(self, tick: int, now_ns: int) -> WorldModel | None:
        """Return the world model at the newest joint state, after removing obstacles where the body is.

        Args:
            tick: Tick of the clock.
            now_ns: Robot time of the clock.

        Returns:
            The world model, or None before the first joint state.
        """
        joints = self._joints
        if joints is None:
            return None
        localizer = self.localizer
        base = localizer.base
        body = localizer.history.compute_frames(base, np.asarray(joints.angle_rad))
        axis_w = body.compute_axis_w()
        self.map.remove_surfaces_in_body(
            axis_w, self._radius_m, min(localizer.position_sd_m, MAX_CARVE_SD_M)
        )
        self.map.drop_distant_tracks(axis_w)
        middles_w = body.origins_w + self._half_lengths_m[:, None] * body.rotations[:, :, 0]
        contacts_timestamp_ns = None
        contacts_from = None
        if self._contacts is not None:
            contacts_timestamp_ns = self._contacts.timestamp_ns
            contacts_from = "sensor"
        return WorldModel(
            tick=tick,
            timestamp_ns=joints.timestamp_ns,
            base_position_w=tuple(base.position_w.tolist()),
            base_orientation_wxyz=quaternion_from_rotation(base.rotation),
            base_confidence=compute_confidence(localizer.position_sd_m),
            contacts=self._transform_contacts(body),
            obstacles=self.map.list_obstacles(now_ns, base.z_m - self._radius_m),
            pose_timestamp_ns=localizer.pose_timestamp_ns,
            contacts_timestamp_ns=contacts_timestamp_ns,
            center_w=tuple((self._mass_fractions @ middles_w).tolist()),
            base_position_sd_m=min(localizer.position_sd_m, MAX_POSITION_SD_M),
            base_yaw_sd_rad=min(localizer.yaw_sd_rad, MAX_YAW_SD_RAD),
            depth_timestamp_ns=self.depth_timestamp_ns,
            pose_from="sensor" if self._has_recent_pose(now_ns) else "dead_reckoning",
            contacts_from=contacts_from,
        )

    def _transform_contacts(self, body: BodyFrames) -> list[WorldContact]:
        """Return the newest contacts in the world frame.

        Args:
            body: Frames of the links at the current tick; used only if those at the time of the contacts are unknown.
        """
        contacts = self._contacts
        if contacts is None:
            return []
        body_then = self.localizer.history.interpolate_body(contacts.timestamp_ns) or body
        valid = [contact for contact in contacts.contacts if contact.link < len(body.origins_w)]
        return [
            transform_contact(
                contact,
                body_then.origins_w,
                body_then.rotations,
                self._link_rear_s_m,
                self._find_obstacle_name,
            )
            for contact in valid[:MAX_CONTACTS]
        ]

    def _find_obstacle_name(self, position_w: Floats) -> str | None:
        """Return the name of the mapped obstacle at a position (3,)."""
        track = self.map.find_track(position_w[:2])
        return None if track is None else track.name

    def _has_recent_pose(self, now_ns: int) -> bool:
        """Return whether the pose sensor has measured recently. If not, scan matching corrects the base instead."""
        pose_ns = self.localizer.pose_timestamp_ns
        return pose_ns is not None and now_ns - pose_ns <= MAX_TRUSTED_POSE_AGE_NS

    def _find_body_at_sample(self, timestamp_ns: int, sample_name: str) -> BodyFrames | None:
        """Return the frames of the links at the timestamp of a sample.

        Args:
            timestamp_ns: Timestamp of the sample.
            sample_name: Kind of the sample, for the reason under which a rejected sample is counted.

        Returns:
            The frames, or None if the sample cannot be used, which is counted in `rejected_sample_counts`.
        """
        if self._joints is None or not all(self._joints.valid):
            self.rejected_sample_counts[f"{sample_name} while a joint's angle is unknown"] += 1
            return None
        if self.depth_timestamp_ns is not None and timestamp_ns < self.depth_timestamp_ns:
            self.rejected_sample_counts[f"{sample_name} older than one before"] += 1
            return None
        body = self.localizer.history.interpolate_body(timestamp_ns)
        if body is None:
            self.rejected_sample_counts[f"{sample_name} without a joint state of its time"] += 1
        return body

    def _get_scanner(self, intrinsics: CameraIntrinsics, noise: RangeNoise) -> DepthScanner:
        """Return the scanner of a camera; it is created at the first call for the camera's intrinsics and noise."""
        key = (intrinsics, noise)
        scanner = self._scanners.get(key)
        if scanner is None:
            scanner = DepthScanner(intrinsics, noise)
            self._scanners[key] = scanner
        return scanner

    def _add_scan_to_map(self, scan: AzimuthScan, body: BodyFrames) -> None:
        """Add a scan to the map. Without a recent pose, first correct the base by matching the scan to the map.

        Args:
            scan: The scan, with its points in the world.
            body: Frames of the links at the timestamp of the scan; points on the robot's own body are masked.
        """
        offset = scan.points_w[:, None] - body.compute_axis_w()
        from_axis_m = np.hypot(offset[..., 0], offset[..., 1]).min(axis=1)
        scan = scan.mask_bins(from_axis_m < self._radius_m + OWN_BODY_MARGIN_M)
        variance_m2 = self._compute_position_variance_m2()
        self.map.add_drift(max(variance_m2 - self._variance_at_last_scan_m2, 0.0))
        self.map.current_variance_m2 = variance_m2
        if not self._has_recent_pose(scan.timestamp_ns):
            scan = self._correct_base_by_scan(scan)
        self.depth_timestamp_ns = scan.timestamp_ns
        self.map.add_scan(scan, min(self.localizer.position_sd_m, MAX_SCAN_SD_M))
        self._variance_at_last_scan_m2 = self._compute_position_variance_m2()

    def _correct_base_by_scan(self, scan: AzimuthScan) -> AzimuthScan:
        """Correct the base by matching a scan to the map, and return the scan moved to the corrected base.

        If the scan does not match, the base and the scan stay as they are.
        """
        base_then = self.localizer.history.interpolate_base(scan.timestamp_ns)
        if base_then is None:
            return scan
        match = match_scan(scan, self.map.tracks, base_then.planar_w)
        if match is None:
            return scan
        self.localizer.correct_by_pose(
            base_then, match.planar_w, match.covariance, match.map_variance_m2
        )
        return scan.move_to_base(base_then.planar_w, match.planar_w)

    def _compute_position_variance_m2(self) -> float:
        """Return the mean variance of the base's position over x and y."""
        return 0.5 * float(np.trace(self.localizer.covariance[:2, :2]))


def _compute_sensor_pose(body: BodyFrames, sensor: RangingSample) -> tuple[Floats, Floats]:
    """Return position (3,) in the world and rotation (3, 3) world_from_sensor of a mounted sensor."""
    rotation = body.rotations[sensor.link]
    position_w = body.origins_w[sensor.link] + rotation @ np.array(sensor.position_l)
    return position_w, rotation @ rotation_from_quaternion(sensor.orientation_l_wxyz)
