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

from snakesim_gnc.guidance.circle_fit import RADIUS_M, RADIUS_SD_M
from snakesim_gnc.guidance.clusters import find_clusters
from snakesim_gnc.guidance.scan import MAX_RANGE_M, Scan
from snakesim_gnc.guidance.surfaces import MAX_DOUBTS
from snakesim_gnc.guidance.tracks import (
    DROP_LOG_ODDS,
    HIT_LOG_ODDS,
    MISS_LOG_ODDS,
    REPORT_LOG_ODDS,
    TOUCH_LOG_ODDS,
    Track,
    fit_shapes,
    list_position_sd_m,
    make_outlines,
)
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Obstacle

Indices = NDArray[np.intp]
Claim = tuple[Track, Indices]  # a track, and the bins of a scan that belong to it

# Which obstacle a point belongs to.
GATE_M = 0.02  # distance from an outline, in addition to what the standard deviations allow
MAX_GATE_M = 0.08
MAX_GATE_SD_M = 0.02  # of an obstacle's position: with more it is not preferred to others
MIN_CLUSTER_POINTS = 2  # of a cluster that begins an obstacle
MIN_OWNER_RATIO = 0.2  # of a cluster's points, or
MIN_OWNER_POINTS = 4  # so many, that an obstacle must have to own a part of it
APART_M = 0.03  # from the outline of a well-known circle: a point farther away belongs to another obstacle
WELL_KNOWN_SD_M = 0.01
WELL_KNOWN_CELLS = 6

# Merging two obstacles into one.
MERGE_OVERLAP_M = 0.01  # a point that is nearer to the other's outline than this, or inside, overlaps
MERGE_RATIO = 0.4  # of the points of one obstacle that overlap with the other

# Evidence against an obstacle.
SEEN_PAST_M = 0.03  # a ray that ends farther behind a point than this has seen through it
MAX_TRACK_SD_M = 0.05  # of an obstacle's position that a ray must pass, in addition
SEEN_THROUGH_RATIO = 0.5  # of the visible surface
SUNK_M = 0.008  # an obstacle deeper in the body than this is not there
# Part of the surface to the left of the body: between these, the body goes right through the obstacle.
OTHER_SIDE_RATIO = 0.2
ONE_SIDE_RATIO = 0.8

# Measurements by the body.
TOUCH_SD_M = 0.003
NORMAL_SD_RAD = 0.2
SKIN_SD_M = 0.004

# Memory.
MAX_TRACKS = 1024
FORGET_DISTANCE_M = 4.0  # from the body; obstacles farther away are forgotten
SCAN_MARGIN_M = 1.0  # beyond the range of a scan: obstacles whose center is within it may be seen


class ObstacleMap:
    """The obstacles that are known so far."""

    def __init__(self) -> None:
        self.tracks: list[Track] = []
        self.here_m2 = 0.0  # variance of the robot's position now
        self._track_count = 0  # of all that there ever were
        self._drift_m2 = 0.0

    def drift(self, variance_m2: float) -> None:
        """Record that the robot's position has become less certain, relative to all that was mapped before."""
        self._drift_m2 += variance_m2

    def obstacles(self, now_ns: int, ground_z_m: float) -> list[Obstacle]:
        """Return the obstacles with enough evidence."""
        return [
            track.to_obstacle(now_ns, ground_z_m) for track in self.tracks if track.belief_at(now_ns) > REPORT_LOG_ODDS
        ]

    def add_scan(self, scan: Scan, sd_m: float = 0.0) -> None:
        """Add the points of a scan to the tracks that they belong to, and start new tracks for the others.

        Tracks that the scan sees through lose confidence, and duplicate tracks are merged.

        Args:
            scan: the scan, with its points in the world.
            sd_m: standard deviation of the sensor's position relative to the map.
        """
        nearby_tracks = [track for track in self.tracks if _is_in_range(track, scan)]
        outlines = make_outlines(nearby_tracks)
        bins_by_track: dict[int, list[Indices]] = {}  # by the track's number
        seen: dict[int, Track] = {}  # by the track's number
        adjacent: list[tuple[Track, Track]] = []  # tracks side by side in one cluster
        for cluster in find_clusters(scan):
            claims = self._divide_cluster(cluster, scan, nearby_tracks, outlines, sd_m)
            for track, bins in claims:
                seen.setdefault(track.number, track)
                bins_by_track.setdefault(track.number, []).append(bins)
            for (track, _), (next_track, _) in pairwise(claims):
                if track is not next_track:
                    adjacent.append((track, next_track))
        self._doubt_what_is_seen_through(nearby_tracks, scan, set(seen))
        for track in seen.values():
            self._add_points(track, scan, np.concatenate(bins_by_track[track.number]))
        fit_shapes(list(seen.values()))
        self._merge_duplicates(list(seen.values()), adjacent)
        self._drop_disproved()

    def add_touches(self, touches: Sequence[tuple[Floats, Floats]], timestamp_ns: int) -> None:
        """Add contacts, each a point (2,) of a surface and the normal (2,) there into the body, in the world."""
        touched: dict[int, Track] = {}
        for position_w, normal_w in touches:
            track = self.find_track(position_w)
            if track is None:
                track = self._start_touched_track(position_w, normal_w)
            self._update_drift(track)
            # The normal of a cylinder leads through its center; that of a box hardly determines its place.
            is_round = track.shape == "cylinder"
            normal_weight = 1.0 / (NORMAL_SD_RAD * track.radius_m) ** 2 if is_round else 0.0
            track.surface.add(position_w[None], np.array([TOUCH_SD_M]), normal_w[None], np.array([normal_weight]))
            track.touched = True
            track.last_seen_ns = max(track.last_seen_ns, timestamp_ns)
            track.add_evidence(TOUCH_LOG_ODDS)
            touched[track.number] = track
        fit_shapes(list(touched.values()))

    def find_track(self, position_w: Floats) -> Track | None:
        """Return the obstacle whose outline is at a point (2,), within its uncertainty, or None."""
        if not self.tracks:
            return None
        distance_m = np.abs(make_outlines(self.tracks).distance_m(position_w))
        sd_m = list_position_sd_m(self.tracks)
        best = int(np.argmin(distance_m - np.minimum(sd_m, MAX_GATE_SD_M)))
        if distance_m[best] < min(GATE_M + 2 * sd_m[best], MAX_GATE_M):
            return self.tracks[best]
        return None

    def carve_body(self, axis_w: Floats, radius_m: float, sd_m: float = 0.0) -> None:
        """Remove surfaces where the body is, because nothing else can be there.

        Args:
            axis_w: (n, 2) points along the body's axis, closer together than its radius, m.
            radius_m: radius of the body.
            sd_m: standard deviation of the body's position relative to the map.
        """
        tracks_with_surface = [track for track in self.tracks if len(track.surface)]
        if not tracks_with_surface:
            return
        gaps_m = make_outlines(tracks_with_surface).distance_m(axis_w)  # (n, tracks)
        min_distance_m = radius_m - SUNK_M - 2 * sd_m
        left = np.gradient(axis_w, axis=0) @ np.array([[0.0, 1.0], [-1.0, 0.0]])  # (n, 2)
        left = left / np.maximum(np.hypot(left[:, 0], left[:, 1]), 1e-9)[:, None]
        changed: list[Track] = []
        for index in np.flatnonzero(gaps_m.min(axis=0) < min_distance_m):
            is_sunk = gaps_m[:, index] < min_distance_m
            _carve_track(tracks_with_surface[index], axis_w, left, is_sunk, radius_m, min_distance_m)
            changed.append(tracks_with_surface[index])
        self._drop_disproved()
        fit_shapes([track for track in changed if len(track.surface)])

    def drop_distant(self, axis_w: Floats) -> None:
        """Forget obstacles far from the body's axis (n, 2), and the least believed ones if there are too many."""
        near_tracks = [
            track for track in self.tracks if _distance_m(track, axis_w) < FORGET_DISTANCE_M + _size_m(track)
        ]
        near_tracks.sort(key=lambda track: -track.log_odds)
        self.tracks = sorted(near_tracks[:MAX_TRACKS], key=lambda track: track.number)

    def _divide_cluster(
        self, cluster: Indices, scan: Scan, nearby_tracks: Sequence[Track], outlines: Outlines, sd_m: float
    ) -> list[Claim]:
        """Divide the bins of a cluster among tracks. New tracks are started as needed.

        A track near enough to many of the points is an owner. Each point belongs to the nearest owner.

        Args:
            cluster: bins of the scan that show one surface.
            scan: the scan.
            nearby_tracks: tracks in the range of the scan.
            outlines: outlines of these tracks.
            sd_m: standard deviation of the sensor's position relative to the map.

        Returns:
            Tracks with their bins, in order of azimuth.
        """
        if not nearby_tracks:
            return self._claim_for_new_track(cluster, scan)
        distance_m = np.abs(outlines.distance_m(scan.points_w[cluster]))  # (points, tracks)
        track_gate_m = np.minimum(GATE_M + 2 * list_position_sd_m(nearby_tracks) + sd_m, MAX_GATE_M)
        gate_m = track_gate_m + 2 * scan.sd_m[cluster][:, None]  # (points, tracks)
        rows = np.arange(len(cluster))
        nearest = distance_m.argmin(axis=1)
        is_within_gate = distance_m[rows, nearest] < gate_m[rows, nearest]
        counts = Counter(nearest[is_within_gate].tolist())
        owners = [
            index
            for index, count in counts.items()
            if count >= MIN_OWNER_RATIO * len(cluster) or count >= MIN_OWNER_POINTS
        ]
        if not owners:
            return self._claim_for_new_track(cluster, scan)

        # Every point is assigned to the nearest owner, except for points far from a circle whose shape is certain.
        owner = np.array(owners)[distance_m[:, owners].argmin(axis=1)]
        is_apart = np.zeros(len(cluster), dtype=bool)
        for index in owners:
            if _is_well_known_circle(nearby_tracks[index]):
                is_apart |= (owner == index) & (distance_m[:, index] > gate_m[:, index] + APART_M)
        claims = [(nearby_tracks[index], cluster[(owner == index) & ~is_apart]) for index in owners]
        if np.count_nonzero(is_apart) > MIN_CLUSTER_POINTS:
            claims.append((self._start_seen_track(), cluster[is_apart]))
        claims = [(track, bins) for track, bins in claims if len(bins)]
        return sorted(claims, key=lambda claim: int(claim[1][0]))

    def _claim_for_new_track(self, cluster: Indices, scan: Scan) -> list[Claim]:
        """Return a new track for a whole cluster, or nothing for one that is too small. A lone beam is large enough."""
        if len(cluster) < min(MIN_CLUSTER_POINTS, len(scan.range_m)):
            return []
        return [(self._start_seen_track(), cluster)]

    def _add_points(self, track: Track, scan: Scan, bins: Indices) -> None:
        """Add bins of a scan to a track."""
        self._update_drift(track)
        towards_sensor = scan.origin_w - scan.points_w[bins]
        towards_sensor = towards_sensor / np.maximum(scan.range_m[bins], 1e-6)[:, None]
        track.surface.add(scan.points_w[bins], scan.sd_m[bins], towards_sensor)
        track.add_evidence(HIT_LOG_ODDS)
        track.last_seen_ns = scan.timestamp_ns
        track.top_m = max(track.top_m, float(np.nanmax(scan.top_m[bins])))

    def _doubt_what_is_seen_through(self, near: Sequence[Track], scan: Scan, hit: set[int]) -> None:
        """Lower the belief in surfaces that the scan sees through. hit: numbers of the tracks that it has seen."""
        clear_m = scan.clear_m()
        for track in near:
            surface = track.surface
            bins, ranges_m = scan.find_bins(surface.points_w)
            is_in_view = bins >= 0
            margin_m = min(track.position_sd_m, MAX_TRACK_SD_M)
            limit_m = ranges_m + SEEN_PAST_M + 3 * scan.sd_m[bins] + margin_m
            is_seen_through = is_in_view & (clear_m[bins] > limit_m)
            surface.doubts = np.where(is_seen_through, surface.doubts + 1, surface.doubts)
            surface.keep(surface.doubts < MAX_DOUBTS)
            visible = max(np.count_nonzero(is_in_view), 1)
            if track.number not in hit and np.count_nonzero(is_seen_through) > SEEN_THROUGH_RATIO * visible:
                track.add_evidence(MISS_LOG_ODDS)

    def _merge_duplicates(self, seen: Sequence[Track], adjacent: Sequence[tuple[Track, Track]]) -> None:
        """Merge tracks that overlap, and adjacent tracks that one shape explains as well as two."""
        candidates = [(a, b, False) for a, b in adjacent]
        candidates += [(a, b, True) for a, b in self._find_overlaps(seen)]
        gone: set[int] = set()
        for a, b, overlaps in candidates:
            if a is b or a.number in gone or b.number in gone:
                continue
            old, new = (a, b) if a.number < b.number else (b, a)
            if self._try_merge(old, new, overlaps=overlaps):
                gone.add(new.number)
        self.tracks = [track for track in self.tracks if track.number not in gone]

    def _find_overlaps(self, seen: Sequence[Track]) -> list[tuple[Track, Track]]:
        """Find tracks that may be the same obstacle, because one covers a large part of the other's surface.

        Args:
            seen: the tracks that the last scan saw.

        Returns:
            Pairs of a seen track and another track of the map, whose outline covers more than MERGE_RATIO of its
            surface.
        """
        if not seen:
            return []
        outlines = make_outlines(self.tracks)
        pairs: list[tuple[Track, Track]] = []
        for track in seen:
            offset = outlines.center_w - track.center_w
            apart_m = np.hypot(offset[:, 0], offset[:, 1]) - outlines.reach_m
            size_m = max(track.radius_m, float(track.half_m.max()))
            for index in np.flatnonzero(apart_m < size_m + GATE_M):
                other = self.tracks[index]
                if other is track:
                    continue
                is_covered = make_outlines([other]).distance_m(track.surface.points_w)[:, 0] < MERGE_OVERLAP_M
                if np.count_nonzero(is_covered) > MERGE_RATIO * len(is_covered):
                    pairs.append((track, other))
        return pairs

    def _try_merge(self, older: Track, newer: Track, *, overlaps: bool) -> bool:
        """Merge a newer track into an older one, unless two shapes explain their points better than one.

        Args:
            older: the older track. After a merge it has the points of both.
            newer: the newer track, which is only read.
            overlaps: whether the tracks overlap; then they are merged in any case.

        Returns:
            Whether the tracks were merged.
        """
        merged = Track(older.number, older.name)
        self._update_drift(older)
        self._update_drift(newer)
        merged.surface.add_surface(older.surface)
        merged.surface.add_surface(newer.surface)
        if not len(merged.surface):
            return False
        fit_shapes([merged])
        if not overlaps and merged.cost > older.cost + newer.cost:
            return False
        older.surface = merged.surface
        older.cost = math.inf
        older.touched = older.touched or newer.touched
        older.top_m = max(older.top_m, newer.top_m)
        older.log_odds = max(older.log_odds, newer.log_odds)
        older.last_seen_ns = max(older.last_seen_ns, newer.last_seen_ns)
        fit_shapes([older])
        return True

    def _update_drift(self, track: Track) -> None:
        """Add the robot's drift since a track was last seen or touched to the uncertainty of its surface."""
        if self._drift_m2 > track.drift_m2 and len(track.surface):
            track.surface.drift(self._drift_m2 - track.drift_m2)
        track.drift_m2 = self._drift_m2

    def _start_seen_track(self) -> Track:
        return self._start_track("seen")

    def _start_touched_track(self, position_w: Floats, normal_w: Floats) -> Track:
        """Start a track at a touch, with its center one prior radius behind the point."""
        track = self._start_track("touched")
        track.center_w = position_w - RADIUS_M * normal_w
        track.position_sd_m = RADIUS_SD_M
        return track

    def _start_track(self, sense: str) -> Track:
        self._track_count += 1
        name = f"{sense}_{self._track_count}"
        track = Track(self._track_count, name, born_m2=self.here_m2, drift_m2=self._drift_m2)
        self.tracks.append(track)
        return track

    def _drop_disproved(self) -> None:
        self.tracks = [track for track in self.tracks if track.log_odds > DROP_LOG_ODDS and len(track.surface)]


def _carve_track(
    track: Track, axis_w: Floats, left: Floats, is_sunk: NDArray[np.bool_], radius_m: float, min_distance_m: float
) -> None:
    """Remove the part of a track's surface that is in the body, or move the surface to the body's skin.

    Args:
        track: the track, which is changed.
        axis_w: (n, 2) points along the body's axis, m.
        left: (n, 2) unit vectors to the left of the body.
        is_sunk: (n,) where the track's outline is too deep in the body.
        radius_m: radius of the body.
        min_distance_m: smallest distance from the axis at which a surface may be.
    """
    surface = track.surface
    cell_count = len(surface)
    offset = surface.points_w[:, None] - axis_w
    distance_m = np.hypot(offset[..., 0], offset[..., 1])  # (cells, n)
    nearest = distance_m.argmin(axis=1)
    is_left = (offset[np.arange(cell_count), nearest] * left[nearest]).sum(axis=1) > 0
    surface.keep(distance_m.min(axis=1) > min_distance_m)
    body_goes_through = OTHER_SIDE_RATIO < np.mean(is_left) < ONE_SIDE_RATIO
    if len(surface) < cell_count or body_goes_through:
        track.add_evidence(MISS_LOG_ODDS)
        return

    # The whole surface is beside the body, only its fitted outline is not: add surface points at the body's skin.
    sunk = np.flatnonzero(is_sunk)
    towards_surface = left[sunk] if is_left[0] else -left[sunk]
    skin_w = axis_w[sunk] + radius_m * towards_surface
    surface.add(skin_w, np.full(len(sunk), SKIN_SD_M), -towards_surface)


def _is_in_range(track: Track, scan: Scan) -> bool:
    return math.hypot(*(track.center_w - scan.origin_w)) < MAX_RANGE_M + SCAN_MARGIN_M


def _is_well_known_circle(track: Track) -> bool:
    return track.shape == "cylinder" and track.position_sd_m < WELL_KNOWN_SD_M and len(track.surface) > WELL_KNOWN_CELLS


def _distance_m(track: Track, axis_w: Floats) -> float:
    """Return the distance from a track's center to the body's axis (n, 2)."""
    offset = axis_w - track.center_w
    return float(np.hypot(offset[:, 0], offset[:, 1]).min())


def _size_m(track: Track) -> float:
    return track.radius_m if track.shape == "cylinder" else float(track.half_m.max())
