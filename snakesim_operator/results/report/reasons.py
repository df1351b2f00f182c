"""Explains why a number of the report is alarming, as far as the record shows it; otherwise UNKNOWN."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import KnownObstacle
from snakesim_operator.results.metrics.force_tracking import (
    MIN_CONTACT_FORCE_N,
    ForcePair,
    pair_forces,
)
from snakesim_operator.results.report.top_view import find_outline_w
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.summary import SATURATION_RATIO, RunSummary

UNKNOWN = "the record does not show why"
MAX_OBSTACLE_DISTANCE_M = 0.1  # from a push-point to the outline of a true obstacle
MAX_TOUCHING_GAP_M = 0.0005  # a smaller gap counts as contact, because measured angles have errors


def explain_push_points_without_contact(record: RunRecord) -> str:
    """Explain why some push-points carried no force, as text for the report.

    For each push-point with a desired force that carried less than MIN_CONTACT_FORCE_N, the sentence distinguishes
    three causes: no obstacle is near, the body does not touch the obstacle, or the body touches it without force.

    Returns:
        The explanation, or UNKNOWN if the record does not show the gaps.
    """
    pairs_without_force = [
        pair
        for pair in pair_forces(record.control_states)
        if pair.measured_force_n < MIN_CONTACT_FORCE_N
    ]
    gaps_m = _measure_gaps_m(record, pairs_without_force)
    if not gaps_m:
        return UNKNOWN
    total_count = len(gaps_m)
    no_obstacle_count = gaps_m.count(np.inf)
    apart_m = [gap_m for gap_m in gaps_m if MAX_TOUCHING_GAP_M < gap_m < np.inf]
    touching_count = total_count - no_obstacle_count - len(apart_m)
    causes: list[str] = []
    if no_obstacle_count:
        percent = _format_percent(no_obstacle_count, total_count)
        causes.append(
            f"no obstacle stood within {MAX_OBSTACLE_DISTANCE_M:g} m of {percent} of them"
        )
    if apart_m:
        percent = _format_percent(len(apart_m), total_count)
        median_mm = 1e3 * float(np.median(apart_m))
        causes.append(
            f"the body was off the obstacle in {percent} of them, by {median_mm:.1f} mm (median)"
        )
    if touching_count:
        causes.append(f"it touched in {_format_percent(touching_count, total_count)} of them")
    obstacle_counts = Counter(pair.obstacle for pair in pairs_without_force)
    name, count = obstacle_counts.most_common(1)[0]
    return f"{'; '.join(causes)}; most often {name}, {count} of {len(pairs_without_force)}"


def _measure_gaps_m(record: RunRecord, force_pairs: Sequence[ForcePair]) -> list[float]:
    """Measure the gaps between the body and the obstacle at push-points, in m, as far as the pose is known.

    A gap is infinite if no obstacle is near the push-point.
    """
    outlines = [_sample_outline_w(item.obstacle) for item in record.placed_obstacles]
    if not outlines:
        return []
    push_point_by_time_and_obstacle_w: dict[tuple[int, str | None], Floats] = {}
    for state in record.control_states:
        for point in state.push_points:
            push_point_by_time_and_obstacle_w[state.timestamp_ns, point.obstacle] = np.array(
                point.position_w[:2]
            )
    gaps_m: list[float] = []
    for pair in force_pairs:
        gap_m = _measure_gap_m(
            record,
            pair,
            push_point_by_time_and_obstacle_w[pair.timestamp_ns, pair.obstacle],
            outlines,
        )
        if gap_m is not None:
            gaps_m.append(gap_m)
    return gaps_m


def explain_torque_limit(record: RunRecord) -> str:
    """Explain which joint was at its torque limit most often."""
    limits = np.array([joint.torque_limit_nm for joint in record.description.joints])
    saturated_counts = (np.abs(record.torque_nm) >= SATURATION_RATIO * limits).sum(axis=0)
    if not saturated_counts.any():
        return UNKNOWN
    joint_index = int(saturated_counts.argmax())
    percent = _format_percent(int(saturated_counts[joint_index]), len(record.time_s))
    return f"most often {record.description.joints[joint_index].name}, in {percent}"


def explain_late_commands(summary: RunSummary) -> str:
    """Explain how long commands took, compared with the duration of a tick."""
    latency_us = summary.state_to_command_us.get("p99")
    if latency_us is None:
        return UNKNOWN
    tick_ms = 1e3 / summary.rate_hz
    return f"1 in 100 commands took {latency_us * 1e-3:.1f} ms or more from the state; a tick is {tick_ms:.1f} ms"


def explain_refused_commands(summary: RunSummary) -> str:
    """List the reasons for which the limiter refused commands, each with its count."""
    return ", ".join(
        f"{reason} {count}" for reason, count in sorted(summary.rejected_commands.items()) if count
    )


def _measure_gap_m(
    record: RunRecord, pair: ForcePair, push_point_w: Floats, outlines: Sequence[Floats]
) -> float | None:
    """Measure the gap between the body and the obstacle at a push-point, seen from above.

    The body is a chain of capsules: its gap to a point is the distance to the axis of a link, minus the link's radius.

    Args:
        record: The recorded run.
        pair: Desired and measured force of the push-point, with its timestamp.
        push_point_w: (2,) position of the push-point, in m.
        outlines: The obstacles, each as points (n, 2) of its outline.

    Returns:
        The gap in m; infinite if no obstacle is within MAX_OBSTACLE_DISTANCE_M; None if the pose is unknown.
    """
    if not len(record.time_s):
        return None
    body_points_w = record.find_body_points_w(record.find_nearest_row(pair.timestamp_ns * 1e-9))
    if body_points_w is None:
        return None
    distances_m = [float(np.hypot(*(outline - push_point_w).T).min()) for outline in outlines]
    nearest = int(np.argmin(distances_m))
    if distances_m[nearest] > MAX_OBSTACLE_DISTANCE_M:
        return np.inf

    # Project each point of the outline onto the axis of each link.
    points_w = body_points_w[:, :2]
    link_vectors = np.diff(points_w, axis=0)  # (links, 2)
    from_link_rear = outlines[nearest][:, None] - points_w[:-1]  # (points, links, 2)
    fraction = (from_link_rear * link_vectors).sum(axis=2) / (link_vectors**2).sum(axis=1)
    # (points, links): position along the link, 0 at its rear end.
    clipped_fraction = np.clip(fraction, 0.0, 1.0)
    axis_distances_m = np.linalg.norm(
        from_link_rear - clipped_fraction[..., None] * link_vectors, axis=2
    )
    radii_m = np.array([link.radius_m for link in record.description.links])
    return float((axis_distances_m - radii_m).min())


def _sample_outline_w(obstacle: KnownObstacle) -> Floats:
    """Sample points on the outline of an obstacle, also between the corners of a box, (n, 2)."""
    corners = find_outline_w(obstacle)
    next_corners = np.roll(corners, -1, axis=0)
    return np.concatenate(
        [corners + part * (next_corners - corners) for part in np.arange(0.0, 1.0, 0.1)]
    )


def _format_percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %"
