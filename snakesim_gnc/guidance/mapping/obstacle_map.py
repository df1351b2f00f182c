"""The map: obstacles from scans, touches and the body's own path. Pure.

Each measured point belongs to the obstacle on whose outline it lies; points that lie on none begin a new obstacle.
Where a scan sees through an obstacle, or the body lies in it, the obstacle loses that part of its surface. An obstacle
without a surface is dropped.
"""

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.mapping.circle_fit import PRIOR_RADIUS_M, PRIOR_RADIUS_SD_M
from snakesim_gnc.guidance.mapping.clusters import find_clusters
from snakesim_gnc.guidance.mapping.surfaces import MAX_SEEN_THROUGH_COUNT
from snakesim_gnc.guidance.mapping.tracks import (
    HIT_LOG_ODDS,
    MIN_KEPT_LOG_ODDS,
    MIN_REPORTED_LOG_ODDS,
    MISS_LOG_ODDS,
    TOUCH_LOG_ODDS,
    ObstacleTrack,
    fit_shapes,
    get_position_sds_m,
    make_outlines,
)
from snakesim_gnc.guidance.ranging.scan import MAX_RANGE_M, AzimuthScan
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.geometry.outlines import ObstacleOutlines
from snakesim_hal.wire.messages import KnownObstacle

Indices = NDArray[np.intp]
TrackClaim = tuple[ObstacleTrack, Indices]  # a track, and the bins of a scan that belong to it

# Which obstacle a point belongs to.
BASE_GATE_M = 0.02  # distance from an outline, in addition to what the standard deviations allow
MAX_GATE_M = 0.08
MAX_GATE_SD_M = 0.02  # of an obstacle's position: with more it is not preferred to others
MIN_CLUSTER_POINTS = 2  # of a cluster that begins an obstacle
MIN_OWNER_RATIO = 0.2  # of a cluster's points, or
MIN_OWNER_POINTS = 4  # so many, that an obstacle must have to own a part of it
MIN_APART_DISTANCE_M = 0.03  # from the outline of a well-known circle: a point farther away belongs to another obstacle
WELL_KNOWN_SD_M = 0.01
WELL_KNOWN_CELLS = 6

# Merging two obstacles into one.
# A point that is nearer to the other's outline than this, or inside, overlaps.
MERGE_OVERLAP_M = 0.01
MERGE_RATIO = 0.4  # of the points of one obstacle that overlap with the other

# Evidence against an obstacle.
# A ray that ends farther behind a point than this has seen through it.
SEEN_THROUGH_DISTANCE_M = 0.03
MAX_TRACK_SD_M = 0.05  # of an obstacle's position that a ray must pass, in addition
SEEN_THROUGH_RATIO = 0.5  # of the visible surface
MAX_OVERLAP_WITH_BODY_M = 0.008  # an obstacle deeper in the body than this is not there
# Part of the surface to the left of the body: between these, the body goes right through the obstacle.
MIN_LEFT_RATIO_WHEN_CROSSING = 0.2
MAX_LEFT_RATIO_WHEN_CROSSING = 0.8

# Measurements by the body.
TOUCH_SD_M = 0.003
NORMAL_SD_RAD = 0.2
SKIN_SD_M = 0.004

MIN_LENGTH_M = 1e-9  # avoids a division by zero where two points of the body's axis coincide

# Memory.
MAX_TRACKS = 1024
FORGET_DISTANCE_M = 4.0  # from the body; obstacles farther away are forgotten
SCAN_MARGIN_M = 1.0  # beyond the range of a scan: obstacles whose center is within it may be seen


class ObstacleMap:
    """The obstacles that are known so far."""

    def __init__(self) -> None:
        self.tracks: list[ObstacleTrack] = []
        self.current_variance_m2 = 0.0  # variance of the robot's position now
        self._track_count = 0  # of all that there ever were
        self._total_drift_m2 = 0.0

    def add_drift(self, variance_m2: float) -> None:
        """Record that the robot's position has become less certain, relative to all that was mapped before."""
        self._total_drift_m2 += variance_m2

    def list_obstacles(self, now_ns: int, ground_z_m: float) -> list[KnownObstacle]:
        """Return the obstacles with enough evidence that they exist.

        Args:
            now_ns: Robot time; the evidence decays with the time since an obstacle was last seen.
            ground_z_m: Height of the ground in the world.
        """
        return [
            track.to_obstacle(now_ns, ground_z_m)
            for track in self.tracks
            if track.compute_log_odds_at(now_ns) > MIN_REPORTED_LOG_ODDS
        ]

    def add_scan(self, scan: AzimuthScan, sd_m: float = 0.0) -> None:
        """Add the points of a scan to the tracks that they belong to, and start new tracks for the others.

        Tracks that the scan sees through lose confidence, and duplicate tracks are merged.

        Args:
            scan: The scan, with its points in the world.
            sd_m: Standard deviation of the sensor's position relative to the map.
        """
        nearby_tracks = [track for track in self.tracks if _is_in_range(track, scan)]
        outlines = make_outlines(nearby_tracks)
        bins_by_track: dict[int, list[Indices]] = {}  # by the track's number
        seen_track_by_number: dict[int, ObstacleTrack] = {}  # by the track's number
        # Tracks side by side in one cluster.
        adjacent_pairs: list[tuple[ObstacleTrack, ObstacleTrack]] = []
        for cluster in find_clusters(scan):
            claims = self._assign_cluster_to_tracks(cluster, scan, nearby_tracks, outlines, sd_m)
            for track, bins in claims:
                seen_track_by_number.setdefault(track.number, track)
                bins_by_track.setdefault(track.number, []).append(bins)
            for (track, _), (next_track, _) in pairwise(claims):
                if track is not next_track:
                    adjacent_pairs.append((track, next_track))
        self._lower_belief_in_seen_through_surfaces(nearby_tracks, scan, set(seen_track_by_number))
        for track in seen_track_by_number.values():
            self._add_scan_points(track, scan, np.concatenate(bins_by_track[track.number]))
        fit_shapes(list(seen_track_by_number.values()))
        self._merge_duplicates(list(seen_track_by_number.values()), adjacent_pairs)
        self._drop_disproved_tracks()

    def add_contacts(
        self, points_and_normals_w: Sequence[tuple[Floats, Floats]], timestamp_ns: int
    ) -> None:
        """Add contacts of the body to the surfaces of tracks, and start tracks for contacts that belong to none.

        Args:
            points_and_normals_w: For each contact, the position (2,) on the surface and the unit normal (2,) into the
                body, in the world.
            timestamp_ns: Time of the contacts.
        """
        touched_track_by_number: dict[int, ObstacleTrack] = {}
        for position_w, normal_w in points_and_normals_w:
            track = self.find_track(position_w)
            if track is None:
                track = self._start_touched_track(position_w, normal_w)
            self._apply_drift(track)
            # The normal of a cylinder leads through its center; that of a box hardly determines its place.
            is_round = track.shape == "cylinder"
            normal_weight = 1.0 / (NORMAL_SD_RAD * track.radius_m) ** 2 if is_round else 0.0
            track.surface.add(
                position_w[None], np.array([TOUCH_SD_M]), normal_w[None], np.array([normal_weight])
            )
            track.is_touched = True
            track.last_seen_ns = max(track.last_seen_ns, timestamp_ns)
            track.add_evidence(TOUCH_LOG_ODDS)
            touched_track_by_number[track.number] = track
        fit_shapes(list(touched_track_by_number.values()))

    def find_track(self, position_w: Floats) -> ObstacleTrack | None:
        """Return the track whose outline is at a position (2,) within its uncertainty; None if there is none."""
        if not self.tracks:
            return None
        distance_m = np.abs(make_outlines(self.tracks).compute_distances_m(position_w))
        sd_m = get_position_sds_m(self.tracks)
        best_index = int(np.argmin(distance_m - np.minimum(sd_m, MAX_GATE_SD_M)))
        if distance_m[best_index] < min(BASE_GATE_M + 2 * sd_m[best_index], MAX_GATE_M):
            return self.tracks[best_index]
        return None

    def remove_surfaces_in_body(self, axis_w: Floats, radius_m: float, sd_m: float = 0.0) -> None:
        """Remove the parts of surfaces that are where the body is, because no obstacle can be there.

        Args:
            axis_w: (n, 2) points along the body's axis, closer together than its radius, m.
            radius_m: Radius of the body.
            sd_m: Standard deviation of the body's position relative to the map.
        """
        tracks_with_surface = [track for track in self.tracks if len(track.surface)]
        if not tracks_with_surface:
            return
        # Distance of each point of the axis from each outline, and the distance below which the body is surely inside.
        distances_m = make_outlines(tracks_with_surface).compute_distances_m(axis_w)  # (n, tracks)
        min_distance_m = radius_m - MAX_OVERLAP_WITH_BODY_M - 2 * sd_m
        # Unit vectors to the left of the body: the direction of the axis, turned by a quarter. (n, 2)
        left_w = np.gradient(axis_w, axis=0) @ np.array([[0.0, 1.0], [-1.0, 0.0]])
        left_w = left_w / np.maximum(np.hypot(left_w[:, 0], left_w[:, 1]), MIN_LENGTH_M)[:, None]
        changed_tracks: list[ObstacleTrack] = []
        for index in np.flatnonzero(distances_m.min(axis=0) < min_distance_m):
            is_in_body = distances_m[:, index] < min_distance_m
            _remove_surface_in_body(
                tracks_with_surface[index], axis_w, left_w, is_in_body, radius_m, min_distance_m
            )
            changed_tracks.append(tracks_with_surface[index])
        self._drop_disproved_tracks()
        fit_shapes([track for track in changed_tracks if len(track.surface)])

    def drop_distant_tracks(self, axis_w: Floats) -> None:
        """Drop tracks far from the body's axis, and the tracks with the least evidence if there are too many.

        Args:
            axis_w: (n, 2) points along the body's axis, m.
        """
        near_tracks = [
            track
            for track in self.tracks
            if _compute_distance_m(track, axis_w) < FORGET_DISTANCE_M + _get_radius_m(track)
        ]
        near_tracks.sort(key=lambda track: -track.log_odds)
        self.tracks = sorted(near_tracks[:MAX_TRACKS], key=lambda track: track.number)

    def _assign_cluster_to_tracks(
        self,
        cluster: Indices,
        scan: AzimuthScan,
        nearby_tracks: Sequence[ObstacleTrack],
        outlines: ObstacleOutlines,
        sd_m: float,
    ) -> list[TrackClaim]:
        """Divide the bins of a cluster among tracks. New tracks are started as needed.

        A track near enough to many of the points is an owner. Each point belongs to the nearest owner.

        Args:
            cluster: Bins of the scan that show one surface.
            scan: The scan.
            nearby_tracks: Tracks in the range of the scan.
            outlines: Outlines of these tracks.
            sd_m: Standard deviation of the sensor's position relative to the map.

        Returns:
            Tracks with their bins, in order of azimuth.
        """
        if not nearby_tracks:
            return self._start_track_for_cluster(cluster, scan)
        # Distance of each point from each outline, and the gate: the distance up to which it may belong to the track.
        # (points, tracks) each.
        distance_m = np.abs(outlines.compute_distances_m(scan.points_w[cluster]))
        track_gate_m = np.minimum(
            BASE_GATE_M + 2 * get_position_sds_m(nearby_tracks) + sd_m, MAX_GATE_M
        )
        gate_m = track_gate_m + 2 * scan.sd_m[cluster][:, None]

        # Owners are the tracks, as indices in `nearby_tracks`, that are nearest to many points within their gate.
        rows = np.arange(len(cluster))
        nearest_tracks = distance_m.argmin(axis=1)
        is_within_gate = distance_m[rows, nearest_tracks] < gate_m[rows, nearest_tracks]
        point_count_by_track = Counter(nearest_tracks[is_within_gate].tolist())
        owners = [
            index
            for index, count in point_count_by_track.items()
            if count >= MIN_OWNER_RATIO * len(cluster) or count >= MIN_OWNER_POINTS
        ]
        if not owners:
            return self._start_track_for_cluster(cluster, scan)

        # Every point is assigned to the nearest owner, except for points far from a circle whose shape is certain.
        owner_of_point = np.array(owners)[distance_m[:, owners].argmin(axis=1)]
        is_apart = np.zeros(len(cluster), dtype=bool)
        for index in owners:
            if _is_well_known_circle(nearby_tracks[index]):
                is_apart |= (owner_of_point == index) & (
                    distance_m[:, index] > gate_m[:, index] + MIN_APART_DISTANCE_M
                )
        claims = [
            (nearby_tracks[index], cluster[(owner_of_point == index) & ~is_apart])
            for index in owners
        ]
        if np.count_nonzero(is_apart) > MIN_CLUSTER_POINTS:
            claims.append((self._start_seen_track(), cluster[is_apart]))
        claims = [(track, bins) for track, bins in claims if len(bins)]
        return sorted(claims, key=_get_first_bin)

    def _start_track_for_cluster(self, cluster: Indices, scan: AzimuthScan) -> list[TrackClaim]:
        """Start a track for a whole cluster.

        A cluster with fewer than MIN_CLUSTER_POINTS gets no track, except in a scan with a single beam.

        Returns:
            The new track with all bins of the cluster; an empty list if the cluster is too small.
        """
        if len(cluster) < min(MIN_CLUSTER_POINTS, len(scan.range_m)):
            return []
        return [(self._start_seen_track(), cluster)]

    def _add_scan_points(self, track: ObstacleTrack, scan: AzimuthScan, bins: Indices) -> None:
        """Add the points in some bins of a scan to the surface of a track, as evidence that its obstacle exists."""
        self._apply_drift(track)
        towards_sensor = scan.origin_w - scan.points_w[bins]
        towards_sensor = towards_sensor / np.maximum(scan.range_m[bins], 1e-6)[:, None]
        track.surface.add(scan.points_w[bins], scan.sd_m[bins], towards_sensor)
        track.add_evidence(HIT_LOG_ODDS)
        track.last_seen_ns = scan.timestamp_ns
        track.top_m = max(track.top_m, float(np.nanmax(scan.top_m[bins])))

    def _lower_belief_in_seen_through_surfaces(
        self, nearby_tracks: Sequence[ObstacleTrack], scan: AzimuthScan, seen_numbers: set[int]
    ) -> None:
        """Lower the belief in surfaces that a scan sees through, and remove cells that several scans saw through.

        Args:
            nearby_tracks: Tracks in the range of the scan.
            scan: The scan.
            seen_numbers: Numbers of the tracks that the scan has seen, whose evidence is not lowered.
        """
        clear_m = scan.compute_clear_distances_m()  # (bins,)
        for track in nearby_tracks:
            surface = track.surface
            # A cell of the surface is seen through if its bin of the scan is clear far beyond the cell.
            bins, ranges_m = scan.find_bins(surface.points_w)
            is_in_view = bins >= 0
            margin_m = min(track.position_sd_m, MAX_TRACK_SD_M)
            seen_through_range_m = (
                ranges_m + SEEN_THROUGH_DISTANCE_M + 3 * scan.sd_m[bins] + margin_m
            )
            is_seen_through = is_in_view & (clear_m[bins] > seen_through_range_m)
            surface.seen_through_counts = np.where(
                is_seen_through, surface.seen_through_counts + 1, surface.seen_through_counts
            )
            surface.keep_cells(surface.seen_through_counts < MAX_SEEN_THROUGH_COUNT)
            visible_count = max(np.count_nonzero(is_in_view), 1)
            seen_through_count = np.count_nonzero(is_seen_through)
            is_mostly_seen_through = seen_through_count > SEEN_THROUGH_RATIO * visible_count
            if is_mostly_seen_through and track.number not in seen_numbers:
                track.add_evidence(MISS_LOG_ODDS)

    def _merge_duplicates(
        self,
        seen_tracks: Sequence[ObstacleTrack],
        adjacent_pairs: Sequence[tuple[ObstacleTrack, ObstacleTrack]],
    ) -> None:
        """Merge tracks that overlap, and adjacent tracks that one shape explains as well as two shapes.

        Args:
            seen_tracks: Tracks that the last scan saw.
            adjacent_pairs: Pairs of tracks side by side in one cluster of the scan.
        """
        # Pairs of tracks, each with whether the tracks overlap.
        candidates = [(a, b, False) for a, b in adjacent_pairs]
        candidates += [(a, b, True) for a, b in self._find_overlaps(seen_tracks)]
        merged_numbers: set[int] = set()  # of tracks that are part of an older track now
        for a, b, is_overlap in candidates:
            if a is b or a.number in merged_numbers or b.number in merged_numbers:
                continue
            older_track = min(a, b, key=lambda track: track.number)
            newer_track = max(a, b, key=lambda track: track.number)
            if self._merge_if_plausible(older_track, newer_track, overlaps=is_overlap):
                merged_numbers.add(newer_track.number)
        self.tracks = [track for track in self.tracks if track.number not in merged_numbers]

    def _find_overlaps(
        self, seen_tracks: Sequence[ObstacleTrack]
    ) -> list[tuple[ObstacleTrack, ObstacleTrack]]:
        """Find tracks that may be the same obstacle, because one covers a large part of the other's surface.

        Args:
            seen_tracks: The tracks that the last scan saw.

        Returns:
            Pairs of a seen track and another track of the map, whose outline covers more than MERGE_RATIO of its
            surface.
        """
        if not seen_tracks:
            return []
        outlines = make_outlines(self.tracks)
        pairs: list[tuple[ObstacleTrack, ObstacleTrack]] = []
        for track in seen_tracks:
            # Distance from the track's center to the bounding circle of each track; a quick test for those nearby.
            offset = outlines.center_w - track.center_w
            distance_m = np.hypot(offset[:, 0], offset[:, 1]) - outlines.bounding_radius_m
            size_m = max(track.radius_m, float(track.half_size_m.max()))
            for index in np.flatnonzero(distance_m < size_m + BASE_GATE_M):
                other = self.tracks[index]
                if other is track:
                    continue
                is_covered = (
                    make_outlines([other]).compute_distances_m(track.surface.points_w)[:, 0]
                    < MERGE_OVERLAP_M
                )
                if np.count_nonzero(is_covered) > MERGE_RATIO * len(is_covered):
                    pairs.append((track, other))
        return pairs

    def _merge_if_plausible(
        self, older: ObstacleTrack, newer: ObstacleTrack, *, overlaps: bool
    ) -> bool:
        """Merge a newer track into an older one, unless two shapes explain their points better than one.

        Args:
            older: The older track. After a merge it has the points of both.
            newer: The newer track, which is only read.
            overlaps: Whether the tracks overlap; then they are merged in any case.

        Returns:
            Whether the tracks were merged.
        """
        merged = ObstacleTrack(older.number, older.name)
        self._apply_drift(older)
        self._apply_drift(newer)
        merged.surface.add_surface(older.surface)
        merged.surface.add_surface(newer.surface)
        if not len(merged.surface):
            return False
        fit_shapes([merged])
        if not overlaps and merged.penalized_cost > older.penalized_cost + newer.penalized_cost:
            return False
        older.surface = merged.surface
        older.penalized_cost = math.inf
        older.is_touched = older.is_touched or newer.is_touched
        older.top_m = max(older.top_m, newer.top_m)
        older.log_odds = max(older.log_odds, newer.log_odds)
        older.last_seen_ns = max(older.last_seen_ns, newer.last_seen_ns)
        fit_shapes([older])
        return True

    def _apply_drift(self, track: ObstacleTrack) -> None:
        """Add the drift of the robot's position since a track was last updated to the uncertainty of its surface."""
        if self._total_drift_m2 > track.position_variance_m2 and len(track.surface):
            track.surface.add_variance(self._total_drift_m2 - track.position_variance_m2)
        track.position_variance_m2 = self._total_drift_m2

    def _start_seen_track(self) -> ObstacleTrack:
        return self._start_track("seen")

    def _start_touched_track(self, position_w: Floats, normal_w: Floats) -> ObstacleTrack:
        """Start a track at a touch, with its center PRIOR_RADIUS_M behind the touched point.

        Args:
            position_w: (2,) touched point in the world, m.
            normal_w: (2,) unit vector from the obstacle into the body.
        """
        track = self._start_track("touched")
        track.center_w = position_w - PRIOR_RADIUS_M * normal_w
        track.position_sd_m = PRIOR_RADIUS_SD_M
        return track

    def _start_track(self, sense: str) -> ObstacleTrack:
        self._track_count += 1
        name = f"{sense}_{self._track_count}"
        track = ObstacleTrack(
            self._track_count,
            name,
            initial_variance_m2=self.current_variance_m2,
            position_variance_m2=self._total_drift_m2,
        )
        self.tracks.append(track)
        return track

    def _drop_disproved_tracks(self) -> None:
        self.tracks = [
            track
            for track in self.tracks
            if track.log_odds > MIN_KEPT_LOG_ODDS and len(track.surface)
        ]


def _remove_surface_in_body(
    track: ObstacleTrack,
    axis_w: Floats,
    left_w: Floats,
    is_in_body: NDArray[np.bool_],
    radius_m: float,
    min_distance_m: float,
) -> None:
    """Remove the part of a track's surface that is in the body, or move the surface to the body's skin.

    Args:
        track: The track, which is changed.
        axis_w: (n, 2) points along the body's axis, m.
        left_w: (n, 2) unit vectors to the left of the body.
        is_in_body: (n,) where the track's outline is too deep in the body.
        radius_m: Radius of the body.
        min_distance_m: Smallest distance from the axis at which a surface may be.
    """
    surface = track.surface
    cell_count = len(surface)
    # From each point of the axis to each cell of the surface: (cells, n, 2) and (cells, n).
    offset = surface.points_w[:, None] - axis_w
    distance_m = np.hypot(offset[..., 0], offset[..., 1])
    # On which side of the body each cell is, (cells,), by the nearest point of the axis.
    nearest_axis_points = distance_m.argmin(axis=1)
    nearest_offset = offset[np.arange(cell_count), nearest_axis_points]
    is_left = (nearest_offset * left_w[nearest_axis_points]).sum(axis=1) > 0
    surface.keep_cells(distance_m.min(axis=1) > min_distance_m)
    body_goes_through = (
        MIN_LEFT_RATIO_WHEN_CROSSING < np.mean(is_left) < MAX_LEFT_RATIO_WHEN_CROSSING
    )
    if len(surface) < cell_count or body_goes_through:
        track.add_evidence(MISS_LOG_ODDS)
        return

    # The whole surface is beside the body, only its fitted outline is not: add surface points at the body's skin.
    indices_in_body = np.flatnonzero(is_in_body)
    towards_surface = left_w[indices_in_body] if is_left[0] else -left_w[indices_in_body]
    skin_w = axis_w[indices_in_body] + radius_m * towards_surface
    surface.add(skin_w, np.full(len(indices_in_body), SKIN_SD_M), -towards_surface)


def _get_first_bin(claim: TrackClaim) -> int:
    """Return the first bin of a claim, which has the lowest azimuth."""
    _, bins = claim
    return int(bins[0])


def _is_in_range(track: ObstacleTrack, scan: AzimuthScan) -> bool:
    """Return whether the obstacle of a track may be seen in a scan, by the distance of its center."""
    return math.hypot(*(track.center_w - scan.origin_w)) < MAX_RANGE_M + SCAN_MARGIN_M


def _is_well_known_circle(track: ObstacleTrack) -> bool:
    return (
        track.shape == "cylinder"
        and track.position_sd_m < WELL_KNOWN_SD_M
        and len(track.surface) > WELL_KNOWN_CELLS
    )


def _compute_distance_m(track: ObstacleTrack, axis_w: Floats) -> float:
    """Return the distance from a track's center to the body's axis (n, 2)."""
    offset = axis_w - track.center_w
    return float(np.hypot(offset[:, 0], offset[:, 1]).min())


def _get_radius_m(track: ObstacleTrack) -> float:
    return track.radius_m if track.shape == "cylinder" else float(track.half_size_m.max())
