"""The map: obstacles from scans, touches and the body's own way, associated, fused, merged and forgotten. Pure.

Each measured point goes to the obstacle on whose outline it lies; what lies on none begins a new one. What is looked
through, or what the body lies in, loses its surface there, and an obstacle without a surface is dropped.
"""

import math
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from snakesim_gnc.guidance.circle_fit import RADIUS_M, RADIUS_SD_M
from snakesim_gnc.guidance.clusters import clusters_of
from snakesim_gnc.guidance.scan import MAX_RANGE_M, Scan
from snakesim_gnc.guidance.surfaces import MAX_DOUBTS
from snakesim_gnc.guidance.tracks import BELIEVED, GONE, HIT, MISS, TOUCH, Track, fit, outlines_of, position_sd_m
from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.outlines import Outlines
from snakesim_hal.wire.messages import Obstacle

Indices = NDArray[np.intp]
GATE_M = 0.02  # from an outline, beside what its sd and the point's allow
WIDEST_GATE_M = 0.08
MIN_POINTS = 2  # of a cluster that begins an obstacle
APART_M = 0.03  # from the outline of a well known circle: what is further off is something else
LOOKED_PAST_M = 0.03  # further than a cell: it was looked through
TOUCH_SD_M, NORMAL_SD_RAD = 0.003, 0.2
SUNK_M = 0.008  # deeper than this in the body nothing can be
SKIN_SD_M = 0.004
MAX_TRACKS = 1024
KEPT_M = 4.0  # from the body; what is further away is forgotten


class ObstacleMap:
    """What is known about obstacles."""

    def __init__(self) -> None:
        self.tracks: list[Track] = []
        self.here_m2 = 0.0  # variance of the robot's position now
        self._count = 0
        self._drift_m2 = 0.0

    def drift(self, variance_m2: float) -> None:
        """The robot's position has become less certain by this variance, and with it all that was mapped before."""
        self._drift_m2 += variance_m2

    def obstacles(self, now_ns: int, ground_z_m: float) -> list[Obstacle]:
        """The obstacles with enough evidence."""
        return [t.obstacle(now_ns, ground_z_m) for t in self.tracks if t.believed(now_ns) > BELIEVED]

    def take_scan(self, scan: Scan, sd_m: float = 0.0) -> None:
        """Take in a look. sd_m: of the sensor's position against the map."""
        near = [t for t in self.tracks if math.hypot(*(t.center_w - scan.origin_w)) < MAX_RANGE_M + 1.0]
        outlines = outlines_of(near)
        shares: dict[int, tuple[Track, list[Indices]]] = {}
        together: list[tuple[Track, Track]] = []
        for cluster in clusters_of(scan):
            owners = self._owners(cluster, scan, near, outlines, sd_m)
            for track, points in owners:
                shares.setdefault(track.number, (track, []))[1].append(points)
            together += [(a, b) for (a, _), (b, _) in pairwise(owners) if a is not b]
        self._doubt(near, scan, set(shares))
        for track, parts in shares.values():
            bins = np.concatenate(parts)
            self._refresh(track)
            towards = scan.origin_w - scan.points_w[bins]
            towards = towards / np.maximum(scan.range_m[bins], 1e-6)[:, None]
            track.surface.add(scan.points_w[bins], scan.sd_m[bins], towards)
            track.believe(HIT)
            track.last_seen_ns = scan.timestamp_ns
            track.top_m = max(track.top_m, float(np.nanmax(scan.top_m[bins])))
        seen = [track for track, _ in shares.values()]
        fit(seen)
        self._merge(seen, together)
        self._drop()

    def take_touches(self, touches: Sequence[tuple[Floats, Floats]], timestamp_ns: int) -> None:
        """Take in contacts: a point (2,) of a surface, and its normal (2,) into the body, of each."""
        felt: dict[int, Track] = {}
        for position_w, normal_w in touches:
            track = self.at(position_w) or self._new(position_w, normal_w)
            self._refresh(track)
            weight = 1.0 / (NORMAL_SD_RAD * track.radius_m) ** 2 if track.shape == "cylinder" else 0.0
            track.surface.add(position_w[None], np.array([TOUCH_SD_M]), normal_w[None], np.array([weight]))
            track.felt, track.last_seen_ns = True, max(track.last_seen_ns, timestamp_ns)
            track.believe(TOUCH)
            felt[track.number] = track
        fit(list(felt.values()))

    def at(self, position_w: Floats) -> Track | None:
        """The obstacle whose outline is at a point (2,), within its uncertainty."""
        if not self.tracks:
            return None
        off, sd = np.abs(outlines_of(self.tracks).distance_m(position_w)), position_sd_m(self.tracks)
        best = int(np.argmin(off - np.minimum(sd, 0.02)))
        return self.tracks[best] if off[best] < min(GATE_M + 2 * sd[best], WIDEST_GATE_M) else None

    def take_body(self, axis_w: Floats, radius_m: float, sd_m: float = 0.0) -> None:
        """Carve by the body: where it is nothing else can be. axis_w: (n, 2) points along it, closer than a radius."""
        near = [t for t in self.tracks if len(t.surface)]
        if not near:
            return
        outlines = outlines_of(near)
        gaps = outlines.distance_m(axis_w)  # (n, tracks)
        allowed = radius_m - SUNK_M - 2 * sd_m
        across = np.gradient(axis_w, axis=0) @ np.array([[0.0, 1.0], [-1.0, 0.0]])  # to the left of the body
        across = across / np.maximum(np.hypot(*across.T), 1e-9)[:, None]
        changed: list[Track] = []
        for k in np.flatnonzero(gaps.min(axis=0) < allowed):
            track, cells = near[k], len(near[k].surface)
            offset = track.surface.points_w[:, None] - axis_w
            apart = np.hypot(offset[..., 0], offset[..., 1])
            nearest = apart.argmin(axis=1)
            left = (offset[np.arange(cells), nearest] * across[nearest]).sum(axis=1) > 0
            track.surface.keep(apart.min(axis=1) > allowed)
            if len(track.surface) < cells or 0.2 < np.mean(left) < 0.8:  # it goes right through
                track.believe(MISS)
            else:
                sunk = np.flatnonzero(gaps[:, k] < allowed)
                towards = across[sunk] if left[0] else -across[sunk]  # to its surface, which is at the body's skin
                track.surface.add(axis_w[sunk] + radius_m * towards, np.full(len(sunk), SKIN_SD_M), -towards)
            changed.append(track)
        self._drop()
        fit([track for track in changed if len(track.surface)])

    def forget(self, axis_w: Floats) -> None:
        """Forget what is far from the body, and the least believed when there is too much."""
        kept = [t for t in self.tracks if np.hypot(*(axis_w - t.center_w).T).min() < KEPT_M + _length_m(t)]
        kept.sort(key=lambda t: -t.log_odds)
        self.tracks = sorted(kept[:MAX_TRACKS], key=lambda t: t.number)

    def _owners(
        self, cluster: Indices, scan: Scan, near: Sequence[Track], outlines: Outlines, sd_m: float
    ) -> list[tuple[Track, Indices]]:
        """Which track gets which bins of a cluster, in order of azimuth; new tracks are made as needed."""
        points = scan.points_w[cluster]
        if not near:
            return [(self._new(), cluster)] if len(cluster) >= min(MIN_POINTS, len(scan.range_m)) else []
        off = np.abs(outlines.distance_m(points))
        limiter = np.minimum(GATE_M + 2 * position_sd_m(near) + sd_m, WIDEST_GATE_M) + 2 * scan.sd_m[cluster][:, None]
        nearest = off.argmin(axis=1)
        fits = off[np.arange(len(cluster)), nearest] < limiter[np.arange(len(cluster)), nearest]
        counts = Counter(nearest[fits].tolist())
        owners = [k for k, n in counts.items() if n >= 0.2 * len(cluster) or n >= 4]
        if not owners:
            return [(self._new(), cluster)] if len(cluster) >= min(MIN_POINTS, len(scan.range_m)) else []
        best = np.array(owners)[off[:, owners].argmin(axis=1)]
        others = np.zeros(len(cluster), dtype=bool)
        for k in owners:
            track = near[k]
            if track.shape == "cylinder" and track.position_sd_m < 0.01 and len(track.surface) > 6:
                others |= (best == k) & (off[:, k] > limiter[:, k] + APART_M)
        found = [(near[k], cluster[(best == k) & ~others]) for k in owners]
        if np.count_nonzero(others) > MIN_POINTS:
            found.append((self._new(), cluster[others]))
        found = [(track, bins) for track, bins in found if len(bins)]
        return sorted(found, key=lambda each: int(each[1][0]))

    def _doubt(self, near: Sequence[Track], scan: Scan, hit: set[int]) -> None:
        """Lower the belief in what was looked through."""
        clear = scan.clear_m()
        for track in near:
            surface = track.surface
            bins, ranges = scan.bins_of(surface.points_w)
            inside = bins >= 0
            limit = ranges + LOOKED_PAST_M + 3 * scan.sd_m[bins] + min(track.position_sd_m, 0.05)
            through = inside & (clear[bins] > limit)
            surface.doubts = np.where(through, surface.doubts + 1, surface.doubts)
            surface.keep(surface.doubts < MAX_DOUBTS)
            if track.number not in hit and np.count_nonzero(through) > 0.5 * max(np.count_nonzero(inside), 1):
                track.believe(MISS)

    def _merge(self, seen: Sequence[Track], together: Sequence[tuple[Track, Track]]) -> None:
        """Merge duplicates: of two that overlap, or that one shape explains as well as two."""
        pairs = [(a, b, False) for a, b in together]
        if seen:
            outlines = outlines_of(self.tracks)
            for a in seen:
                apart = np.hypot(*(outlines.center_w - a.center_w).T) - outlines.reach_m
                for k in np.flatnonzero(apart < max(a.radius_m, float(a.half_m.max())) + GATE_M):
                    b = self.tracks[k]
                    if b is not a:
                        inside = outlines_of([b]).distance_m(a.surface.points_w)[:, 0] < 0.01
                        if np.count_nonzero(inside) > 0.4 * len(inside):
                            pairs.append((a, b, True))
        gone: set[int] = set()
        for a, b, surely in pairs:
            if a.number in gone or b.number in gone or a is b:
                continue
            old, new = (a, b) if a.number < b.number else (b, a)
            both = Track(old.number, old.name)
            self._refresh(old)
            self._refresh(new)
            both.surface.take(old.surface)
            both.surface.take(new.surface)
            if not len(both.surface):
                continue
            fit([both])
            if not surely and both.cost > old.cost + new.cost:
                continue
            old.surface, old.cost = both.surface, math.inf
            old.felt, old.top_m = old.felt or new.felt, max(old.top_m, new.top_m)
            old.log_odds = max(old.log_odds, new.log_odds)
            old.last_seen_ns = max(old.last_seen_ns, new.last_seen_ns)
            fit([old])
            gone.add(new.number)
        self.tracks = [t for t in self.tracks if t.number not in gone]

    def _refresh(self, track: Track) -> None:
        """Account for the drift since the track was last touched or seen."""
        if self._drift_m2 > track.drift_m2 and len(track.surface):
            track.surface.drift(self._drift_m2 - track.drift_m2)
        track.drift_m2 = self._drift_m2

    def _new(self, position_w: Floats | None = None, normal_w: Floats | None = None) -> Track:
        self._count += 1
        name = f"{'seen' if position_w is None else 'felt'}_{self._count}"
        track = Track(self._count, name, born_m2=self.here_m2, drift_m2=self._drift_m2)
        if position_w is not None and normal_w is not None:  # where the next touch of the same looks for it
            track.center_w, track.position_sd_m = position_w - RADIUS_M * normal_w, RADIUS_SD_M
        self.tracks.append(track)
        return track

    def _drop(self) -> None:
        self.tracks = [t for t in self.tracks if t.log_odds > GONE and len(t.surface)]


def _length_m(track: Track) -> float:
    return track.radius_m if track.shape == "cylinder" else float(track.half_m.max())
