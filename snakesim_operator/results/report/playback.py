"""The whole run as a film: a map that stands still, and for each of some hundred instants the snake and its forces.

`playback.js` moves what `body` has drawn. All coordinates are those of the drawing.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.locomotion import STANDING_STILL
from snakesim_hal.wire.messages import ControlState, World, WorldContact
from snakesim_operator.results.metrics.motion import MOVING, STANDING, Motion, motion_of
from snakesim_operator.results.record import RunRecord
from snakesim_operator.results.report.instants import balance_of
from snakesim_operator.results.report.labels import Labels
from snakesim_operator.results.report.svg import Point, element, figure
from snakesim_operator.results.report.timeline import in_words
from snakesim_operator.results.report.top_view import body, ground, outline_w, scales
from snakesim_operator.results.report.view import FELT_SHARE, LONGEST_ARROW, View, map_view, nodes_xy_w
from snakesim_operator.results.time_axis import end_s, zero_s

MessageT = TypeVar("MessageT", ControlState, World)
FRAMES = 300
MAPS, PATH_POINTS = 80, 60  # of a whole run; of a path
WIDTH = 1040.0
SAME_TICK_S = 1e-6
USUAL_SHARE = 0.9  # of all forces are drawn in full; the strongest are cut
SHOWN_FOR_S = 0.3  # what is older is not shown: control and guidance publish their state many times a second


@dataclass(frozen=True)
class Playback:
    """The map as markup, and what moves on it as data."""

    picture: Markup
    data: dict[str, Any]
    with_desired: bool
    with_measured: bool


def playback(record: RunRecord) -> Playback | None:
    """None when the pose is never known."""
    posed = np.flatnonzero(record.posed)
    if not len(posed):
        return None
    rows = posed[np.unique(np.linspace(0, len(posed) - 1, min(len(posed), FRAMES)).astype(int))]
    nodes = [nodes_xy_w(record, int(row)) for row in rows]
    names = [joint.name for joint in record.description.joints]
    states = _latest(record, rows, record.control)
    worlds = _latest(record, rows, record.worlds)
    units = _units_per_n(states, worlds)
    view = map_view(record, nodes, units, WIDTH)
    motion = motion_of(record)
    said: list[str] = []
    maps, map_of = _perceived(record, view, rows)
    paths, path_of = _planned(record, view, rows)
    frames: list[list[Any]] = []
    for i, (row, body_w, state, world) in enumerate(zip(rows, nodes, states, worlds, strict=True)):
        joint = state.propulsion_joint if state is not None else None
        solved, kinds = _solved(view, state, world, units)
        felt = _arrows(view, [(view.at(one.position_w), np.array(one.force_w[:2])) for one in _contacts(world)], units)
        words = _caption(motion, float(record.time_s[row]) - zero_s(record), state)
        if words not in said:
            said.append(words)
        time_s = float(record.time_s[row]) - zero_s(record)
        propels = names.index(joint) if joint in names else -1
        body_at, said_at = _flat(view, body_w), said.index(words)
        frames.append([round(time_s, 3), body_at, propels, said_at, solved, felt, map_of[i], path_of[i], kinds])
    labels = Labels(view.width, view.height)
    snake = element("g", body(record, view, nodes[0], labels), class_="snake")
    picture = figure(
        view.width,
        view.height,
        "The snake on the map, moved by the slider",
        ground(record, view, labels) + '<g class="perceived"></g>' + snake + '<g class="forces"></g>' + scales(view),
    )
    data = {"frames": frames, "said": said, "joints": names, "end": round(end_s(record), 3)}
    data |= {"maps": maps, "paths": paths}
    with_desired, with_measured = (any(frame[k] for frame in frames) for k in (4, 5))
    return Playback(Markup(picture), data, with_desired, with_measured)


def _caption(motion: Motion | None, time_s: float, state: ControlState | None) -> str:
    """What the body did at a time, as measured, and what control reported then."""
    reported = "control reported nothing" if state is None else f"{in_words(state.state)}: {state.reason}"
    if motion is None:
        return reported
    stands = motion.stands_at(time_s)
    measured = STANDING if stands else MOVING
    if state is None or state.reason == STANDING_STILL:  # control's own measure, which looks back for a window
        return measured
    agrees = stands == (state.state != "Locomoting")
    if agrees:
        return reported
    return measured if stands else f"{measured}; control reported {reported}"


def _perceived(record: RunRecord, view: View, rows: NDArray[np.intp]) -> tuple[list[list[list[float]]], list[int]]:
    """Some of the maps that guidance published, each obstacle as its outline; and for each row which one, or -1."""
    if record.config.mission.map != "perceived" or not record.worlds:
        return [], [-1] * len(rows)
    some = record.worlds[:: max(len(record.worlds) // MAPS, 1)]
    outlines = [[_flat(view, outline_w(one)) for one in world.obstacles if view.shows(one)] for world in some]
    return outlines, _last_before(record, rows, [world.timestamp_ns for world in some])


def _planned(record: RunRecord, view: View, rows: NDArray[np.intp]) -> tuple[list[list[float]], list[int]]:
    """The paths that navigation planned, and for each row which one, or -1. Without them a scene's route is drawn."""
    planned = [one for one in record.trajectories if one.timestamp_ns is not None]
    if len({one.path_id for one in planned}) < 2:
        return [], [-1] * len(rows)
    paths = [_flat(view, np.array(one.path_w)[:: max(len(one.path_w) // PATH_POINTS, 1)]) for one in planned]
    return paths, _last_before(record, rows, [one.timestamp_ns or 0 for one in planned])


def _flat(view: View, points_w: Floats) -> list[float]:
    return [round(part, 1) for point in points_w for part in view.at(point)]


def _last_before(record: RunRecord, rows: NDArray[np.intp], timestamps_ns: Sequence[int]) -> list[int]:
    timestamps_s = np.array(timestamps_ns) * 1e-9
    return (np.searchsorted(timestamps_s, record.time_s[rows] + SAME_TICK_S, side="right") - 1).tolist()


def _latest(record: RunRecord, rows: NDArray[np.intp], messages: Sequence[MessageT]) -> list[MessageT | None]:
    """What was said last before each row, unless that is long ago."""
    before = _last_before(record, rows, [one.timestamp_ns for one in messages])
    newest = [messages[i] if i >= 0 else None for i in before]
    times_s = record.time_s[rows].tolist()
    return [
        one if one is not None and time_s - one.timestamp_ns * 1e-9 < SHOWN_FOR_S else None
        for one, time_s in zip(newest, times_s, strict=True)
    ]


def _units_per_n(states: Sequence[ControlState | None], worlds: Sequence[World | None]) -> float:
    balances = [balance for state in states if state is not None and (balance := balance_of(state)) is not None]
    sizes = [size for balance in balances for size in (*balance.size_n, float(np.hypot(*balance.resultant_n)))]
    felt = [math.hypot(*contact.force_w[:2]) for world in worlds if world is not None for contact in world.contacts]
    usual = float(np.quantile(sizes or felt or [0.0], USUAL_SHARE))
    return LONGEST_ARROW / usual if usual > 0 else 0.0


def _solved(view: View, state: ControlState | None, world: World | None, units: float) -> tuple[list[float], list[str]]:
    """The solved forces, and last their resultant: four numbers each, from where to where; and how each is drawn."""
    balance = balance_of(state) if state is not None else None
    if balance is None:
        return [], []
    feet = [view.at(contact.position_w) for contact in balance.contacts]
    pairs = list(zip([*feet, feet[0]], [*balance.contact_n, balance.resultant_n], strict=True))
    return _arrows(view, pairs, units), balance.kinds(_contacts(world))


def _contacts(world: World | None) -> list[WorldContact]:
    return world.contacts if world is not None else []


def _arrows(view: View, forces: list[tuple[Point, Floats]], units: float) -> list[float]:
    """From where to where each arrow goes. Too long a one is cut, so that one impact does not dwarf the rest."""
    found: list[float] = []
    for foot, force in forces:
        cut = min(1.0, FELT_SHARE * LONGEST_ARROW / max(units * math.hypot(*force), 1e-9))
        found += [*foot, *view.along(foot, force, cut * units)]
    return [round(part, 1) for part in found]
