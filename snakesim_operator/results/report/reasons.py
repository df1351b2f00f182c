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
    """Explain why push-points carried no force, in words for the report.

    For each push-point that should push but carried less than EMPTY_N, the sentence distinguishes three causes: no
    obstacle is near, the body does not touch the obstacle, or the body touches it without force.

    Returns:
        The explanation, or UNKNOWN if the record does not show the gaps.
    """
    empty_pairs = [pair for pair in pairs(record.control) if pair.measured_force_n < EMPTY_N]
    gaps_m = _gaps_at(record, empty_pairs)
    if not gaps_m:
        return UNKNOWN
    total_count = len(gaps_m)
    no_obstacle_count = gaps_m.count(np.inf)
    apart_m = [gap_m for gap_m in gaps_m if TOUCHING_M < gap_m < np.inf]
    touching_count = total_count - no_obstacle_count - len(apart_m)
    causes: list[str] = []
    if no_obstacle_count:
        percent = _percent(no_obstacle_count, total_count)
        causes.append(f"no obstacle stood within {NEAR_M:g} m of {percent} of them")
    if apart_m:
        percent = _percent(len(apart_m), total_count)
        median_mm = 1e3 * float(np.median(apart_m))
        causes.append(f"the body was off the obstacle in {percent} of them, by {median_mm:.1f} mm (median)")
    if touching_count:
        causes.append(f"it touched in {_percent(touching_count, total_count)} of them")
    obstacle_counts = Counter(pair.obstacle for pair in empty_pairs)
    name, count = obstacle_counts.most_common(1)[0]
    return f"{'; '.join(causes)}; most often {name}, {count} of {len(empty_pairs)}"


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

    The body is a chain of capsules: its gap to a point is the distance to the axis of a link, minus the link's radius.

    Args:
        record: The recorded run.
        pair: Desired and measured force of the push-point, with its timestamp.
        place_w: (2,) position of the push-point, in m.
        outlines: The obstacles, each as points (n, 2) of its outline.

    Returns:
        The gap in m; infinite: no obstacle is within NEAR_M of the push-point; None: the pose is unknown.
    """
    if not len(record.time_s):
        return None
    nodes_w = record.nodes_w(record.row_at(pair.timestamp_ns * 1e-9))
    if nodes_w is None:
        return None
    distances_m = [float(np.hypot(*(outline - place_w).T).min()) for outline in outlines]
    nearest = int(np.argmin(distances_m))
    if distances_m[nearest] > NEAR_M:
        return np.inf

    # Project each point of the outline onto the axis of each link.
    nodes = nodes_w[:, :2]
    links = np.diff(nodes, axis=0)  # (links, 2)
    from_nodes = outlines[nearest][:, None] - nodes[:-1]  # (points, links, 2)
    fraction = (from_nodes * links).sum(axis=2) / (links**2).sum(axis=1)
    clipped_fraction = np.clip(fraction, 0.0, 1.0)  # (points, links): position along the link, 0 at its rear end
    axis_distances_m = np.linalg.norm(from_nodes - clipped_fraction[..., None] * links, axis=2)
    radii_m = np.array([link.radius_m for link in record.description.links])
    return float((axis_distances_m - radii_m).min())


def _outline(obstacle: Obstacle) -> Floats:
    """Return points around an obstacle, also on the edges of a box, (n, 2)."""
    corners = outline_w(obstacle)
    next_corners = np.roll(corners, -1, axis=0)
    return np.concatenate([corners + part * (next_corners - corners) for part in np.arange(0.0, 1.0, 0.1)])


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %"
