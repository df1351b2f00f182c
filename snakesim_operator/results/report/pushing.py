"""Makes the report section on pushing with the whole body: forces, obstacles, stops, and quality of the map."""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.scene_file.friction import compute_surface_friction
from snakesim_hal.model.scene_file.scene import compute_normal_gravity_m_s2
from snakesim_hal.wire.messages import WorldContact
from snakesim_operator.results.metrics.map_score import MapScore, score_map
from snakesim_operator.results.metrics.motion import find_stops
from snakesim_operator.results.page.charts import (
    ChartBar,
    ChartLine,
    PlotlyDict,
    make_bar_chart,
    make_line_chart,
)
from snakesim_operator.results.report.timeline import find_longest_reason, find_state_intervals
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import (
    get_report_time_s,
    get_run_end_s,
    get_time_origin_s,
    list_control_state_spans,
)

MAX_OBSTACLES = 24  # with a row of their own: those with the largest impulse
MIN_FORCE_N = 0.5  # a smaller desired force is ignored
MIN_STOP_S = 0.5  # a shorter stop is not listed
MAX_STOPS = 40
# Intervals with a smaller gap between them are adjacent: it is a rounding error.
MAX_MERGED_GAP_S = 1e-6
MAX_MAPS_SCORED = 60
MIN_BODY_DISTANCE_M = 1e-9  # from tail to head; avoids a division by zero


@dataclass(frozen=True)
class StationaryInterval:
    """An interval in which the body was stationary."""

    start_s: float
    end_s: float
    reason: str  # the reason that control reported for longest, or the measured state


@dataclass(frozen=True)
class ForceSample:
    """The sum of some contact forces at one time."""

    time_s: float  # on the time axis
    timestamp_ns: int
    force_w: Floats  # (2,)


@dataclass(frozen=True)
class ForceSpan:
    """An interval in which the controller desired a force on one obstacle."""

    start_s: float
    end_s: float
    force_n: float


@dataclass(frozen=True)
class PushingSection:
    """Content of the report section on pushing."""

    forces: PlotlyDict
    obstacles: PlotlyDict
    stops: list[StationaryInterval]  # the longest, in order of time
    hidden_stop_count: int  # number of shorter stops that are not shown
    map_score: MapScore | None  # of the perceived map; None if the map was given
    # 50th and 90th percentile of the position errors of perceived obstacles.
    position_error_percentiles_mm: tuple[float, float]
    map_errors: PlotlyDict | None


def make_pushing_section(record: RunRecord) -> PushingSection | None:
    """Make the section of the report about pushing off many obstacles at once.

    Args:
        record: The recorded run.

    Returns:
        The section, or None if it does not apply: the controller reported no push-points, or it drives one propulsion
        joint at a time, which other sections of the report cover.
    """
    states = [state for state in record.control_states if state.push_points]
    has_propulsion_joint = any(state.propulsion_joint is not None for state in states)
    if not states or has_propulsion_joint or not len(record.time_s):
        return None
    stops = _find_stops(record)
    longest_first = sorted(stops, key=lambda stop: stop.start_s - stop.end_s)
    shown_stops = longest_first[:MAX_STOPS]
    score, map_errors = _score_maps(record)
    return PushingSection(
        forces=_draw_contact_forces(record),
        obstacles=_draw_pushed_obstacles(record),
        stops=sorted(shown_stops, key=lambda stop: stop.start_s),
        hidden_stop_count=len(stops) - len(shown_stops),
        map_score=score,
        position_error_percentiles_mm=_compute_position_error_percentiles_mm(score),
        map_errors=map_errors,
    )


def _compute_position_error_percentiles_mm(score: MapScore | None) -> tuple[float, float]:
    """Return the 50th and 90th percentile of the position errors in mm; NaN if no obstacle was matched."""
    if score is None or not score.position_errors_m:
        return math.nan, math.nan
    errors_mm = [1e3 * error_m for error_m in score.position_errors_m]
    return float(np.percentile(errors_mm, 50)), float(np.percentile(errors_mm, 90))


def _draw_contact_forces(record: RunRecord) -> PlotlyDict:
    """Draw desired and measured contact forces in the direction from tail to head, and the drag that they overcome.

    Args:
        record: The recorded run, with the reports of control and the world models.
    """
    lines = [
        _make_force_line(
            record, "desired at all push-points", _list_desired_forces(record), "--reference"
        ),
        _make_force_line(record, "measured contacts", _list_measured_forces(record), "--measured"),
    ]
    return make_line_chart(
        "Contact forces along the body over time",
        "force, N",
        lines,
        get_run_end_s(record),
        levels=[(_compute_ground_friction_n(record), "friction of the ground")],
    )


def _list_desired_forces(record: RunRecord) -> list[ForceSample]:
    """Return the sum of the desired contact forces for each report of control. Its time is clipped to the run."""
    return [
        ForceSample(
            get_report_time_s(record, state), state.timestamp_ns, _sum_forces(state.push_points)
        )
        for state in record.control_states
    ]


def _list_measured_forces(record: RunRecord) -> list[ForceSample]:
    """Return the sum of the measured contact forces for each world model."""
    time_origin_s = get_time_origin_s(record)
    return [
        ForceSample(
            world.timestamp_ns * 1e-9 - time_origin_s,
            world.timestamp_ns,
            _sum_forces(world.contacts),
        )
        for world in record.worlds
    ]


def _make_force_line(
    record: RunRecord, label: str, samples: list[ForceSample], color: str
) -> ChartLine:
    """Return a line with the part of each force that acts from tail to head.

    Args:
        record: The recorded run, with the poses.
        label: Label of the line.
        samples: The forces over time.
        color: CSS variable with the color of the line.
    """
    times_s = np.array([sample.time_s for sample in samples])
    return ChartLine(label, times_s, _compute_forward_forces_n(record, samples), color)


def _compute_ground_friction_n(record: RunRecord) -> float:
    """Return the friction in N of the whole body that slides forward, with its whole weight on the ground."""
    normal_gravity_m_s2 = compute_normal_gravity_m_s2(record.config.scene)
    load_n = normal_gravity_m_s2 * sum(link.mass_kg for link in record.description.links)
    ground = record.config.scene.ground
    robot = record.config.robot
    friction = compute_surface_friction(ground.friction, ground, robot.skin, robot.wheels)
    return friction.forward * load_n


def _compute_forward_forces_n(record: RunRecord, samples: list[ForceSample]) -> Floats:
    """Project each force onto the direction from tail to head at its time.

    Args:
        record: The recorded run, with the poses.
        samples: The forces over time.

    Returns:
        (samples,) forces in N; NaN where the pose is unknown.
    """
    forward_n = np.full(len(samples), np.nan)
    for i, sample in enumerate(samples):
        row = record.find_nearest_row(sample.timestamp_ns * 1e-9)
        body_points_w = record.find_body_points_w(row)
        if body_points_w is None:
            continue
        tail_to_head_w = body_points_w[-1, :2] - body_points_w[0, :2]
        distance_m = max(float(np.hypot(*tail_to_head_w)), MIN_BODY_DISTANCE_M)
        forward_n[i] = float(sample.force_w @ tail_to_head_w) / distance_m
    return forward_n


def _sum_forces(contacts: list[WorldContact]) -> Floats:
    """Sum the horizontal forces of contacts, (2,) in the world, in N."""
    if not contacts:
        return np.zeros(2)
    return np.sum([contact.force_w[:2] for contact in contacts], axis=0)


def _draw_pushed_obstacles(record: RunRecord) -> PlotlyDict:
    """Draw a row for each obstacle that the controller pushed off, in the order of their first use."""
    spans_by_obstacle = _group_spans_by_obstacle(record)
    impulse_by_obstacle_n_s = {
        name: sum((span.end_s - span.start_s) * span.force_n for span in spans)
        for name, spans in spans_by_obstacle.items()
    }
    strongest_first = sorted(spans_by_obstacle, key=lambda name: -impulse_by_obstacle_n_s[name])
    shown_names = sorted(
        strongest_first[:MAX_OBSTACLES],
        key=lambda name: _make_sort_key(spans_by_obstacle[name][0]),
    )
    bars: list[ChartBar] = []
    for name in shown_names:
        for span in _merge_adjacent(spans_by_obstacle[name]):
            bars.append(
                ChartBar(name, span.start_s, span.end_s, f"{span.force_n:.0f} N", "--reference")
            )
    return make_bar_chart(
        "Obstacles pushed off over time", shown_names, bars, get_run_end_s(record)
    )


def _group_spans_by_obstacle(record: RunRecord) -> dict[str, list[ForceSpan]]:
    """Return the intervals in which control desired a force on each obstacle, by the obstacle's name."""
    spans_by_obstacle: dict[str, list[ForceSpan]] = {}
    for start_s, end_s, state in list_control_state_spans(record):
        for contact in state.push_points:
            force_n = math.hypot(*contact.force_w[:2])
            if force_n >= MIN_FORCE_N and end_s > start_s:
                name = contact.obstacle or "unnamed"
                spans_by_obstacle.setdefault(name, []).append(ForceSpan(start_s, end_s, force_n))
    return spans_by_obstacle


def _make_sort_key(span: ForceSpan) -> tuple[float, float, float]:
    """Return a key by which intervals are sorted by time, and equal ones by force."""
    return span.start_s, span.end_s, span.force_n


def _merge_adjacent(spans: list[ForceSpan]) -> list[ForceSpan]:
    """Merge adjacent intervals, in order of time, into one with the largest of their forces."""
    merged: list[ForceSpan] = []
    for span in spans:
        if merged and span.start_s <= merged[-1].end_s + MAX_MERGED_GAP_S:
            last = merged[-1]
            merged[-1] = ForceSpan(last.start_s, span.end_s, max(last.force_n, span.force_n))
        else:
            merged.append(span)
    return merged


def _find_stops(record: RunRecord) -> list[StationaryInterval]:
    """Find the intervals in which the body was stationary, as measured; without a pose, as control reported."""
    stop_intervals = find_stops(record)
    if stop_intervals is None:
        intervals = [band for band in find_state_intervals(record) if band.label == "NotLocomoting"]
    else:
        intervals = stop_intervals.stops
    stops: list[StationaryInterval] = []
    for span in intervals:
        if span.end_s - span.start_s >= MIN_STOP_S:
            stops.append(
                StationaryInterval(span.start_s, span.end_s, find_longest_reason(record, span))
            )
    return stops


def _score_maps(record: RunRecord) -> tuple[MapScore | None, PlotlyDict | None]:
    """Compare the perceived maps of a run with the true obstacles within a meter of the head.

    At most about MAX_MAPS_SCORED maps are scored, at equal intervals.

    Returns:
        The total over all maps, and a chart over time of errors, missed obstacles and ghosts. Both are None if the
        mission does not use a perceived map, the scene has no obstacles, or no pose is known.
    """
    true_obstacles = [placed.obstacle for placed in record.placed_obstacles if not placed.walkable]
    if record.config.mission.map != "perceived" or not true_obstacles:
        return None, None
    start_s = get_time_origin_s(record)
    total = MapScore()
    times_s: list[float] = []
    median_errors_mm: list[float] = []
    miss_counts: list[float] = []
    ghost_counts: list[float] = []
    step = max(len(record.worlds) // MAX_MAPS_SCORED, 1)
    for world in record.worlds[::step]:
        world_time_s = world.timestamp_ns * 1e-9
        body_points_w = record.find_body_points_w(record.find_nearest_row(world_time_s))
        if body_points_w is None:
            continue
        head_w = body_points_w[-1]
        forward_x, forward_y = body_points_w[-1, :2] - body_points_w[-2, :2]  # along the head link
        map_score = score_map(
            world.obstacles, true_obstacles, head_w, math.atan2(forward_y, forward_x)
        )
        total.add(map_score)
        median_error_mm = math.nan
        if map_score.position_errors_m:
            median_error_mm = 1e3 * float(np.median(map_score.position_errors_m))
        times_s.append(world_time_s - start_s)
        median_errors_mm.append(median_error_mm)
        miss_counts.append(map_score.missed_count)
        ghost_counts.append(map_score.ghost_count)
    if not times_s:
        return None, None
    time_s = np.array(times_s)
    drawn = [
        ChartLine("position error, median, mm", time_s, np.array(median_errors_mm), "--measured"),
        ChartLine("missed", time_s, np.array(miss_counts, dtype=np.float64), "--bad", shape="hv"),
        ChartLine(
            "ghosts", time_s, np.array(ghost_counts, dtype=np.float64), "--commanded", shape="hv"
        ),
    ]
    label = "Map against truth over time"
    return total, make_line_chart(
        label, "mm, or how many", drawn, get_run_end_s(record), height=190, from_zero=True
    )
