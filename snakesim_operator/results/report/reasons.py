"""Why a tile of the report is red, as far as the record shows it; otherwise UNKNOWN."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Obstacle
from snakesim_operator.results.metrics.force_tracking import EMPTY_N, Pair, pairs
from snakesim_operator.results.report.top_view import outline_w
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import SATURATED_FROM, RunSummary

UNKNOWN = "the record does not show why"
NEAR_M = 0.1  # from the push-point to the outline of a true obstacle
TOUCHING_M = 0.0005  # a smaller gap is a touch: the body's outline is that of its angles, which are measured


def why_empty(record: RunRecord) -> str:
    """Return why push-points carried nothing: whether an obstacle stands there, and whether the body touched it."""
    empty = [pair for pair in pairs(record.control) if pair.measured_force_n < EMPTY_N]
    gaps_m = _gaps_at(record, empty)
    if not gaps_m:
        return UNKNOWN
    total = len(gaps_m)
    without_obstacle = gaps_m.count(np.inf)
    apart_m = [gap_m for gap_m in gaps_m if TOUCHING_M < gap_m < np.inf]
    touching = total - without_obstacle - len(apart_m)
    words: list[str] = []
    if without_obstacle:
        words.append(f"no obstacle stood within {NEAR_M:g} m of {_percent(without_obstacle, total)} of them")
    if apart_m:
        median_mm = 1e3 * float(np.median(apart_m))
        share = _percent(len(apart_m), total)
        words.append(f"the body was off the obstacle in {share} of them, by {median_mm:.1f} mm (median)")
    if touching:
        words.append(f"it touched in {_percent(touching, total)} of them")
    name, count = Counter(pair.obstacle for pair in empty).most_common(1)[0]
    return f"{'; '.join(words)}; most often {name}, {count} of {len(empty)}"


def _gaps_at(record: RunRecord, empty: Sequence[Pair]) -> list[float]:
    """Return the known gaps between the body and the obstacle at some push-points; infinite: no obstacle is near."""
    outlines = [_outline(item.obstacle) for item in record.placed]
    if not outlines:
        return []
    places_w: dict[tuple[int, str | None], Floats] = {}
    for state in record.control:
        for point in state.push_points:
            places_w[state.timestamp_ns, point.obstacle] = np.array(point.position_w[:2])
    gaps_m: list[float] = []
    for pair in empty:
        gap_m = _gap_m(record, pair, places_w[pair.timestamp_ns, pair.obstacle], outlines)
        if gap_m is not None:
            gaps_m.append(gap_m)
    return gaps_m


def why_at_limit(record: RunRecord) -> str:
    """Return which joint was at its torque limit most often."""
    limits = np.array([joint.torque_limit_nm for joint in record.description.joints])
    ticks = (np.abs(record.torque_nm) >= SATURATED_FROM * limits).sum(axis=0)
    if not ticks.any():
        return UNKNOWN
    joint = int(ticks.argmax())
    return f"most often {record.description.joints[joint].name}, in {_percent(int(ticks[joint]), len(record.time_s))}"


def why_late(summary: RunSummary) -> str:
    """Return how long commands took, compared with a tick."""
    slow_us = summary.state_to_command_us.get("p99")
    if slow_us is None:
        return UNKNOWN
    tick_ms = 1e3 / summary.rate_hz
    return f"1 in 100 commands took {slow_us * 1e-3:.1f} ms or more from the state; a tick is {tick_ms:.1f} ms"


def why_refused(summary: RunSummary) -> str:
    """Return the reasons for which the limiter refused commands."""
    return ", ".join(f"{why} {count}" for why, count in sorted(summary.rejected_commands.items()) if count)


def _gap_m(record: RunRecord, pair: Pair, place_w: Floats, outlines: Sequence[Floats]) -> float | None:
    """Return the gap between the body and the obstacle at a push-point, seen from above.

    Args:
        record: What was recorded of the run.
        pair: The push-point at one moment.
        place_w: (2,) its place.
        outlines: The obstacles, each as points (n, 2).

    Returns:
        The gap in m; infinite: no obstacle is near; None: the pose is unknown.
    """
    nodes_w = record.nodes_w(record.row_at(pair.timestamp_ns * 1e-9)) if len(record.time_s) else None
    if nodes_w is None:
        return None
    distances_m = [float(np.hypot(*(outline - place_w).T).min()) for outline in outlines]
    nearest = int(np.argmin(distances_m))
    if distances_m[nearest] > NEAR_M:
        return np.inf
    nodes = nodes_w[:, :2]
    links = np.diff(nodes, axis=0)
    from_nodes = outlines[nearest][:, None] - nodes[:-1]  # (points, links, 2)
    fraction = np.clip((from_nodes * links).sum(axis=2) / (links**2).sum(axis=1), 0.0, 1.0)
    radii_m = np.array([link.radius_m for link in record.description.links])
    axis_distances_m = np.linalg.norm(from_nodes - fraction[..., None] * links, axis=2)
    return float((axis_distances_m - radii_m).min())


def _outline(obstacle: Obstacle) -> Floats:
    """Return points around an obstacle, also on the edges of a box, (n, 2)."""
    corners = outline_w(obstacle)
    next_corners = np.roll(corners, -1, axis=0)
    return np.concatenate([corners + part * (next_corners - corners) for part in np.arange(0.0, 1.0, 0.1)])


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %"
