"""How a whole body pushed: forces along it over time, which obstacle when, why it stood, and how good its map was."""

import math
from dataclasses import dataclass

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.solids import GRAVITY_M_S2
from snakesim_hal.wire.messages import WorldContact
from snakesim_operator.results.metrics.map_score import MapScore, score
from snakesim_operator.results.metrics.motion import motion_of
from snakesim_operator.results.page.charts import Bar, Figure, Line, bars, lines
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.timeline import longest_reason, state_bands
from snakesim_operator.results.time_axis import end_s, reported_at_s, reported_spans, zero_s

MAX_OBSTACLES = 24  # that get a row of their own: those that gave most
MIN_FORCE_N = 0.5  # a smaller wanted force is none
STOOD_S = 0.5  # a shorter stop is not worth a line
MAX_STOPS = 40
MAPS_SCORED = 60


@dataclass(frozen=True)
class Stop:
    """It stood still for a while; why: the reason that control reported for longest, or what was measured."""

    start_s: float
    end_s: float
    why: str


@dataclass(frozen=True)
class Pushing:
    """What stands in the section."""

    forces: Figure
    obstacles: Figure
    stops: list[Stop]  # the longest, in order of time
    shorter: int  # stops that are left out
    score: MapScore | None  # of the map that guidance perceived; None when it was known
    position_mm: tuple[float, float]  # of the perceived obstacles: median, and below which 90 % are
    map_errors: Figure | None


def pushing(record: RunRecord) -> Pushing | None:
    """None for a controller that reports no push-points, or one joint that pushes: that has sections of its own."""
    states = [state for state in record.control if state.push_points]
    if not states or any(state.propulsion_joint is not None for state in states) or not len(record.time_s):
        return None
    stops = _stops(record)
    longest = sorted(stops, key=lambda one: one.start_s - one.end_s)[:MAX_STOPS]
    total, errors = _scored(record)
    off_mm = [1e3 * off for off in total.position_m] if total is not None else []
    return Pushing(
        _forces(record),
        _obstacles(record),
        sorted(longest, key=lambda one: one.start_s),
        len(stops) - len(longest),
        total,
        (float(np.percentile(off_mm, 50)), float(np.percentile(off_mm, 90))) if off_mm else (math.nan, math.nan),
        errors,
    )


def _forces(record: RunRecord) -> Figure:
    """Wanted and measured contact forces in the direction from tail to head, and the drag that they work against."""
    wanted = [(reported_at_s(record, one), one.timestamp_ns, _sum_w(one.push_points)) for one in record.control]
    felt = [(one.timestamp_ns * 1e-9 - zero_s(record), one.timestamp_ns, _sum_w(one.contacts)) for one in record.worlds]
    drawn = [
        Line("wanted of all push-points", np.array([t for t, _, _ in wanted]), _ahead_n(record, wanted), "--reference"),
        Line("measured contacts", np.array([t for t, _, _ in felt]), _ahead_n(record, felt), "--measured"),
    ]
    weight_n = GRAVITY_M_S2 * sum(link.mass_kg for link in record.description.links)
    drag_n = record.config.scene.ground.friction * weight_n
    words = "Contact forces along the body over time"
    return lines(words, "force, N", drawn, end_s(record), levels=[(drag_n, "friction of the ground")])


def _ahead_n(record: RunRecord, forces: list[tuple[float, int, Floats]]) -> Floats:
    """The part of each force in the direction from tail to head at its time; NaN when the pose is unknown."""
    found = np.full(len(forces), np.nan)
    for i, (_, timestamp_ns, force_w) in enumerate(forces):
        nodes = record.nodes_w(record.row_at(timestamp_ns * 1e-9))
        if nodes is not None:
            ahead = nodes[-1, :2] - nodes[0, :2]
            found[i] = float(force_w @ ahead) / max(float(np.hypot(*ahead)), 1e-9)
    return found


def _sum_w(contacts: list[WorldContact]) -> Floats:
    return np.sum([one.force_w[:2] for one in contacts], axis=0) if contacts else np.zeros(2)


def _obstacles(record: RunRecord) -> Figure:
    """A row for each obstacle that was pushed off, in the order of their first use."""
    spans: dict[str, list[tuple[float, float, float]]] = {}
    for since, until, state in reported_spans(record):
        for contact in state.push_points:
            force_n = math.hypot(*contact.force_w[:2])
            if force_n >= MIN_FORCE_N and until > since:
                spans.setdefault(contact.obstacle or "unnamed", []).append((since, until, force_n))
    impulse = {name: sum((b - a) * force for a, b, force in found) for name, found in spans.items()}
    shown = sorted(sorted(spans, key=lambda name: -impulse[name])[:MAX_OBSTACLES], key=lambda name: spans[name][0])
    drawn: list[Bar] = []
    for name in shown:
        for since, until, most in _merged(spans[name]):
            drawn.append(Bar(name, since, until, f"{most:.0f} N", "--reference"))
    return bars("Obstacles pushed off over time", shown, drawn, end_s(record))


def _merged(spans: list[tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    """Spans that touch become one, with the largest force."""
    found: list[tuple[float, float, float]] = []
    for since, until, force in spans:
        if found and since <= found[-1][1] + 1e-6:
            found[-1] = (found[-1][0], until, max(found[-1][2], force))
        else:
            found.append((since, until, force))
    return found


def _stops(record: RunRecord) -> list[Stop]:
    """Every time that the body stood still for a while, by the measured motion; without a pose by what was reported."""
    motion = motion_of(record)
    if motion is None:
        standing = [band for band in state_bands(record) if band.what == "NotLocomoting"]
    else:
        standing = motion.standing
    long = [one for one in standing if one.end_s - one.start_s >= STOOD_S]
    return [Stop(one.start_s, one.end_s, longest_reason(record, one)) for one in long]


def _scored(record: RunRecord) -> tuple[MapScore | None, Figure | None]:
    """The perceived map within a metre of the head, held against the truth; as a whole and over time."""
    truth = [placed.obstacle for placed in record.placed if not placed.walkable]
    if record.config.mission.map != "perceived" or not truth:
        return None, None
    total, time_s = MapScore(), list[float]()
    counts: list[tuple[float, int, int]] = []
    for world in record.worlds[:: max(len(record.worlds) // MAPS_SCORED, 1)]:
        nodes = record.nodes_w(record.row_at(world.timestamp_ns * 1e-9))
        if nodes is None:
            continue
        x, y = nodes[-1, :2] - nodes[-2, :2]
        one = score(world.obstacles, truth, nodes[-1], math.atan2(y, x))
        total.add(one)
        time_s.append(world.timestamp_ns * 1e-9 - zero_s(record))
        counts.append((1e3 * float(np.median(one.position_m)) if one.position_m else math.nan, one.misses, one.ghosts))
    if not counts:
        return None, None
    off_mm, misses, ghosts = np.array(counts, dtype=np.float64).T
    drawn = [
        Line("position error, median, mm", np.array(time_s), off_mm, "--measured"),
        Line("missed", np.array(time_s), misses, "--bad", shape="hv"),
        Line("ghosts", np.array(time_s), ghosts, "--commanded", shape="hv"),
    ]
    label = "Map against truth over time"
    return total, lines(label, "mm, or how many", drawn, end_s(record), height=190, from_zero=True)
