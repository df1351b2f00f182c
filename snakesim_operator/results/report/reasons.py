"""Why a tile of the report is red, as far as the record tells. Where it does not, that is said."""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import Obstacle
from snakesim_operator.results.metrics.force_tracking import EMPTY_N, Pair, pairs
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.top_view import outline_w
from snakesim_operator.results.summary import SATURATED_FROM, RunSummary

UNKNOWN = "the record does not tell why"
NEAR_M = 0.1  # from the push-point to the outline of a true obstacle
TOUCHING_M = 0.0005  # a smaller gap is a touch: the body's outline is that of its angles, which are measured


def why_empty(record: RunRecord) -> str:
    """Push-points that carried nothing: whether an obstacle stands there, and the body was at it."""
    empty = [pair for pair in pairs(record.control) if pair.measured_force_n < EMPTY_N]
    at_w = {
        (state.timestamp_ns, point.obstacle): np.array(point.position_w[:2])
        for state in record.control
        for point in state.push_points
    }
    outlines = [_outline(one.obstacle) for one in record.placed]
    gaps = (
        [_gap_m(record, pair, at_w[pair.timestamp_ns, pair.obstacle], outlines) for pair in empty] if outlines else []
    )
    known = [gap for gap in gaps if gap is not None]
    if not known:
        return UNKNOWN
    off = [gap for gap in known if TOUCHING_M < gap < np.inf]
    nowhere, every = known.count(np.inf), len(known)
    touched = every - nowhere - len(off)
    said = [f"no obstacle stood within {NEAR_M:g} m of {_share(nowhere, every)} of them"] if nowhere else []
    if off:
        by_mm = 1e3 * float(np.median(off))
        said.append(f"the body was off the obstacle in {_share(len(off), every)} of them, by {by_mm:.1f} mm (median)")
    if touched:
        said.append(f"it touched in {_share(touched, every)} of them")
    name, count = Counter(pair.obstacle for pair in empty).most_common(1)[0]
    return f"{'; '.join(said)}; most often {name}, {count} of {len(empty)}"


def why_at_limit(record: RunRecord) -> str:
    """Ticks with a joint at its torque limit: which joint."""
    limits = np.array([joint.torque_limit_nm for joint in record.description.joints])
    ticks = (np.abs(record.torque_nm) >= SATURATED_FROM * limits).sum(axis=0)
    if not ticks.any():
        return UNKNOWN
    joint = int(ticks.argmax())
    return f"most often {record.description.joints[joint].name}, in {_share(int(ticks[joint]), len(record.time_s))}"


def why_late(summary: RunSummary) -> str:
    """Ticks without a command in time: how long commands took, against a tick."""
    slow_us = summary.state_to_command_us.get("p99")
    if slow_us is None:
        return UNKNOWN
    tick_ms = 1e3 / summary.rate_hz
    return f"1 in 100 commands took {slow_us * 1e-3:.1f} ms or more from the state; a tick is {tick_ms:.1f} ms"


def why_refused(summary: RunSummary) -> str:
    """Commands that were refused: the limiter's own words."""
    return ", ".join(f"{why} {count}" for why, count in sorted(summary.rejected_commands.items()) if count)


def _gap_m(record: RunRecord, pair: Pair, at_w: Floats, outlines: Sequence[Floats]) -> float | None:
    """From above, between the body and the obstacle at a push-point; infinite: none is near; None: no pose."""
    nodes_w = record.nodes_w(record.row_at(pair.timestamp_ns * 1e-9)) if len(record.time_s) else None
    if nodes_w is None:
        return None
    near_m, outline = min(((float(np.hypot(*(one - at_w).T).min()), one) for one in outlines), key=lambda two: two[0])
    if near_m > NEAR_M:
        return np.inf
    nodes = nodes_w[:, :2]
    along = np.diff(nodes, axis=0)
    to = outline[:, None] - nodes[:-1]
    share = np.clip((to * along).sum(axis=2) / (along**2).sum(axis=1), 0.0, 1.0)
    radii_m = np.array([link.radius_m for link in record.description.links])
    return float((np.linalg.norm(to - share[..., None] * along, axis=2) - radii_m).min())


def _outline(obstacle: Obstacle) -> Floats:
    """Points around it, a box's edges too, (n, 2)."""
    corners = outline_w(obstacle)
    after = np.roll(corners, -1, axis=0)
    return np.concatenate([corners + part * (after - corners) for part in np.arange(0.0, 1.0, 0.1)])


def _share(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %"
