"""Corrects dead reckoning by known obstacles: contacts are at the body's skin, and no obstacle is in the body. Pure.

For each obstacle near the body, the gap between its outline and the skin, with the estimated pose, counts as a
measurement of zero

    if a contact near that place pushes the body away from the obstacle
    if the gap is negative, because the body would lie in the obstacle

Three contacts whose normals do not meet in a point fix the pose as firmly as a pose sensor. Fewer contacts leave it
free along directions in which they do not push.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from snakesim_gnc.guidance.pose.body_history import BodyFrames
from snakesim_gnc.guidance.pose.localization import PoseLocalizer
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import Contact, KnownObstacle, RobotDescription

MIN_FORCE_N = 1.0  # a weaker push may be noise
# Along the body, in link lengths: how far an estimated contact may be from its place.
MAX_CONTACT_DISTANCE_LINKS = 1.5
MAX_GAP_M = 0.06  # a contact does not belong to an obstacle farther away than this
MAX_DEPTH_M = 0.04  # deeper than this, the body may lie on either side of the obstacle
POINTS_PER_LINK = 12  # on the axis of each link, at which gaps are computed


class GapTrust(NamedTuple):
    """Standard deviations of a gap that is measured as zero, in each update."""

    contact_m: float  # where a contact pushes
    sunk_m: float  # where the body would lie in an obstacle


# Sensors report contacts in every update, with the same error each time. Estimated contacts are rare. Between them the
# body's steps along the path, which dead reckoning takes on trust, would lead it away. Tuned on `triplet`.
MEASURED_CONTACT_TRUST = GapTrust(0.03, 0.02)
ESTIMATED_CONTACT_TRUST = GapTrust(0.003, 0.002)


class ObstacleAnchors:
    """The known obstacles, which correct the pose of one robot."""

    def __init__(self, robot: RobotDescription, known_obstacles: Sequence[KnownObstacle]) -> None:
        self._outlines = ObstacleOutlines.from_obstacles(known_obstacles)
        self._lengths_m = np.array([link.length_m for link in robot.links])
        self._radii_m = np.array([link.radius_m for link in robot.links])
        # Of each link's length.
        self._point_fractions = (np.arange(POINTS_PER_LINK) + 0.5) / POINTS_PER_LINK

    def correct_pose(
        self,
        localizer: PoseLocalizer,
        angles_rad: Floats,
        contacts: Sequence[Contact],
        trust: GapTrust,
    ) -> None:
        """Correct an estimated base pose by the known obstacles near the body.

        For each obstacle, the gap between its outline and the skin counts as a measurement of zero if a contact pushes
        the body away from the obstacle, or if the gap is negative.

        Args:
            localizer: Estimator of the base pose, whose estimate is corrected.
            angles_rad: (n_joints,) joint angles at the time of the estimate.
            contacts: Contacts of the links at that time.
            trust: Standard deviations of a gap of zero, for a contact and for an overlap.
        """
        if not len(self._outlines):
            return
        body = localizer.history.compute_frames(localizer.base, angles_rad)
        axis_w = self._sample_axis_w(body)
        gaps_m = (
            self._outlines.compute_distances_m(axis_w)
            - np.repeat(self._radii_m, POINTS_PER_LINK)[:, None]
        )
        nearest_points = gaps_m.argmin(axis=0)  # index of the body point nearest to each obstacle
        min_gaps_m = gaps_m.min(axis=0)
        near_obstacles = np.flatnonzero((min_gaps_m < MAX_GAP_M) & (min_gaps_m > -MAX_DEPTH_M))
        _, normals_w = self._outlines.compute_distances_and_normals(
            axis_w[nearest_points[near_obstacles]], near_obstacles
        )

        rows: list[Floats] = []
        measured_gaps_m: list[float] = []
        sds_m: list[float] = []
        for obstacle, normal_w in zip(near_obstacles.tolist(), normals_w, strict=True):
            point_index = int(nearest_points[obstacle])
            gap_m = float(gaps_m[point_index, obstacle])
            is_sunk = gap_m < 0.0
            is_pushed = (
                self._sum_pushing_contact_forces(body, contacts, point_index, normal_w)
                > MIN_FORCE_N
            )
            if not is_sunk and not is_pushed:
                continue
            measured_gaps_m.append(gap_m)
            sds_m.append(trust.sunk_m if is_sunk else trust.contact_m)
            x, y = axis_w[point_index] - localizer.base.planar_w[:2]
            # How the gap changes with x, y and heading of the base.
            rows.append(np.array([normal_w[0], normal_w[1], normal_w[1] * x - normal_w[0] * y]))
        if rows:
            localizer.correct_by_linear_measurements(
                np.array(rows), -np.array(measured_gaps_m), np.array(sds_m)
            )

    def _sample_axis_w(self, body: BodyFrames) -> Floats:
        """Return POINTS_PER_LINK points on the axis of each link, (points, 2), tail to head."""
        links = self._lengths_m[:, None] * body.rotations[:, :2, 0]
        points_w = body.origins_w[:, None, :2] + self._point_fractions[:, None] * links[:, None]
        return points_w.reshape(-1, 2)

    def _sum_pushing_contact_forces(
        self, body: BodyFrames, contacts: Sequence[Contact], point_index: int, normal_w: Floats
    ) -> float:
        """Sum the contact forces near a point of the body that push the body away from an obstacle.

        Args:
            body: Frames of the links.
            contacts: Contacts of the links. `position_l`, `normal_l` and `force_l` are in the frame of the link.
            point_index: Index of the point among those of `_sample_axis_w`.
            normal_w: (2,) unit vector in the world frame from the obstacle to the body.

        Returns:
            Sum of the magnitudes of these forces in N.
        """
        # Distance from the tail end, in link lengths.
        point_position_in_links = (point_index + 0.5) / POINTS_PER_LINK
        forces_n: list[float] = []
        for contact in contacts:
            contact_position_in_links = (
                contact.link + contact.position_l[0] / self._lengths_m[contact.link]
            )
            contact_normal_w = (body.rotations[contact.link] @ np.array(contact.normal_l))[:2]
            is_near = (
                abs(contact_position_in_links - point_position_in_links)
                < MAX_CONTACT_DISTANCE_LINKS
            )
            if is_near and float(contact_normal_w @ normal_w) > 0.0:
                forces_n.append(math.hypot(*contact.force_l))
        return math.fsum(forces_n)
