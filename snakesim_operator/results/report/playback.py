"""The whole run as a film: a fixed map, and for each of some hundred times the snake and its forces.

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
from snakesim_operator.results.metrics.motion import MOVING, STANDING, Motion, measure_motion
from snakesim_operator.results.page.svg import Point, element, figure
from snakesim_operator.results.report.labels import Labels
from snakesim_operator.results.report.snapshots import balance_of
from snakesim_operator.results.report.timeline import in_words
from snakesim_operator.results.report.top_view import body, ground, outline_w, scales
from snakesim_operator.results.report.view import FELT_SHARE, LONGEST_ARROW, View, map_view, nodes_xy_w
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.time_axis import end_s, zero_s

MessageT = TypeVar("MessageT", ControlState, World)
MAX_FRAMES = 300
MAX_MAPS = 80  # of a whole run
MAX_PATH_POINTS = 60
WIDTH = 1040.0
SAME_TICK_S = 1e-6
FULL_SIZE_QUANTILE = 0.9  # of all forces are drawn in full; the strongest are cut
SHOWN_FOR_S = 0.3  # older states are not shown: control and guidance publish many times a second


@dataclass(frozen=True)
class Playback:
    """The map as markup, and what moves on it as data."""

    picture: Markup
    data: dict[str, Any]
    with_desired: bool
    with_measured: bool


def playback(record: RunRecord) -> Playback | None:
    """Return the film of a run, or None if its pose is never known."""
    posed = np.flatnonzero(record.posed)
    if not len(posed):
        return None
    evenly = np.linspace(0, len(posed) - 1, min(len(posed), MAX_FRAMES)).astype(int)
    rows = posed[np.unique(evenly)]
    nodes = [nodes_xy_w(record, int(row)) for row in rows]
    states = _latest_messages(record, rows, record.control)
    worlds = _latest_messages(record, rows, record.worlds)
    units_per_n = _force_scale(states, worlds)
    view = map_view(record, nodes, units_per_n, WIDTH)
    maps, map_numbers = _perceived_maps(record, view, rows)
    paths, path_numbers = _planned_paths(record, view, rows)
    names = [joint.name for joint in record.description.joints]
    motion = measure_motion(record)
    captions: list[str] = []
    frames: list[list[Any]] = []
    with_desired = False
    with_measured = False
    for i, (row, body_w, state, world) in enumerate(zip(rows, nodes, states, worlds, strict=True)):
        time_s = float(record.time_s[row]) - zero_s(record)
        propelling = state.propulsion_joint if state is not None else None
        caption = _caption(motion, time_s, state)
        if caption not in captions:
            captions.append(caption)
        desired_arrows, desired_classes = _desired_arrows(view, state, world, units_per_n)
        measured_arrows = _measured_arrows(view, world, units_per_n)
        with_desired = with_desired or bool(desired_arrows)
        with_measured = with_measured or bool(measured_arrows)
        frames.append(  # playback.js reads a frame by position
            [
                round(time_s, 3),
                _flat_coordinates(view, body_w),
                names.index(propelling) if propelling in names else -1,
                captions.index(caption),
                desired_arrows,
                measured_arrows,
                map_numbers[i],
                path_numbers[i],
                desired_classes,
            ]
        )
    data = {
        "frames": frames,
        "captions": captions,
        "joints": names,
        "end": round(end_s(record), 3),
        "maps": maps,
        "paths": paths,
    }
    return Playback(Markup(_draw_first_frame(record, view, nodes[0])), data, with_desired, with_measured)


def _draw_first_frame(record: RunRecord, view: View, nodes: Floats) -> str:
    """Draw the map and the snake, with empty groups for what playback.js adds."""
    labels = Labels(view.width, view.height)
    snake = element("g", body(record, view, nodes, labels), class_="snake")
    return figure(
        view.width,
        view.height,
        "The snake on the map, moved by the slider",
        ground(record, view, labels) + '<g class="perceived"></g>' + snake + '<g class="forces"></g>' + scales(view),
    )


def _caption(motion: Motion | None, time_s: float, state: ControlState | None) -> str:
    """Return what the body did at a time, as measured, and what control reported then."""
    reported = "control reported nothing" if state is None else f"{in_words(state.state)}: {state.reason}"
    if motion is None:
        return reported
    stands = motion.is_stationary_at(time_s)
    measured = STANDING if stands else MOVING
    if state is None or state.reason == STANDING_STILL:  # control's own measure, which looks back for a window
        return measured
    reports_standing = state.state != "Locomoting"
    if stands == reports_standing:
        return reported
    return measured if stands else f"{measured}; control reported {reported}"


def _perceived_maps(record: RunRecord, view: View, rows: NDArray[np.intp]) -> tuple[list[list[list[float]]], list[int]]:
    """Return the maps that are shown, and for each row the number of its map, or -1.

    They are some of those that guidance published. A map is a list of outlines, one for each obstacle.
    """
    if record.config.mission.map != "perceived" or not record.worlds:
        return [], [-1] * len(rows)
    step = max(len(record.worlds) // MAX_MAPS, 1)
    shown = record.worlds[::step]
    maps: list[list[list[float]]] = []
    for world in shown:
        visible = [obstacle for obstacle in world.obstacles if view.shows(obstacle)]
        maps.append([_flat_coordinates(view, outline_w(obstacle)) for obstacle in visible])
    return maps, _latest_indices(record, rows, [world.timestamp_ns for world in shown])


def _planned_paths(record: RunRecord, view: View, rows: NDArray[np.intp]) -> tuple[list[list[float]], list[int]]:
    """Return the paths that navigation planned, and for each row the number of its path, or -1.

    Without at least two of them the scene's route is drawn.
    """
    planned = [trajectory for trajectory in record.trajectories if trajectory.timestamp_ns is not None]
    if len({trajectory.path_id for trajectory in planned}) < 2:
        return [], [-1] * len(rows)
    paths: list[list[float]] = []
    for trajectory in planned:
        step = max(len(trajectory.path_w) // MAX_PATH_POINTS, 1)
        paths.append(_flat_coordinates(view, np.array(trajectory.path_w)[::step]))
    return paths, _latest_indices(record, rows, [trajectory.timestamp_ns or 0 for trajectory in planned])


def _flat_coordinates(view: View, points_w: Floats) -> list[float]:
    """Return x, y, x, y, ... of points in the drawing."""
    return [round(part, 1) for point in points_w for part in view.at(point)]


def _latest_indices(record: RunRecord, rows: NDArray[np.intp], timestamps_ns: Sequence[int]) -> list[int]:
    """Return for each row the index of the last timestamp before it, or -1."""
    timestamps_s = np.array(timestamps_ns) * 1e-9
    after = np.searchsorted(timestamps_s, record.time_s[rows] + SAME_TICK_S, side="right")
    return (after - 1).tolist()


def _latest_messages(record: RunRecord, rows: NDArray[np.intp], messages: Sequence[MessageT]) -> list[MessageT | None]:
    """Return for each row the last message before it, or None if that is older than SHOWN_FOR_S."""
    indices = _latest_indices(record, rows, [message.timestamp_ns for message in messages])
    latest: list[MessageT | None] = []
    for index, time_s in zip(indices, record.time_s[rows].tolist(), strict=True):
        message = messages[index] if index >= 0 else None
        if message is not None and time_s - message.timestamp_ns * 1e-9 < SHOWN_FOR_S:
            latest.append(message)
        else:
            latest.append(None)
    return latest


def _force_scale(states: Sequence[ControlState | None], worlds: Sequence[World | None]) -> float:
    """Return units of the drawing per newton, at which most forces fit: solved ones, else measured ones."""
    solved_n: list[float] = []
    for state in states:
        balance = balance_of(state) if state is not None else None
        if balance is not None:
            solved_n += [*balance.size_n, float(np.hypot(*balance.resultant_n))]
    measured_n = [math.hypot(*contact.force_w[:2]) for world in worlds for contact in _contacts(world)]
    usual_n = float(np.quantile(solved_n or measured_n or [0.0], FULL_SIZE_QUANTILE))
    return LONGEST_ARROW / usual_n if usual_n > 0 else 0.0


def _desired_arrows(
    view: View, state: ControlState | None, world: World | None, units_per_n: float
) -> tuple[list[float], list[str]]:
    """Return the arrows of the solved forces and last of their resultant, and the CSS classes of each."""
    balance = balance_of(state) if state is not None else None
    if balance is None:
        return [], []
    feet = [view.at(contact.position_w) for contact in balance.contacts]
    forces = list(zip(feet, balance.contact_n, strict=True))
    forces.append((feet[0], balance.resultant_n))
    contact_classes, resultant_class = balance.force_classes(_contacts(world))
    return _arrows(view, forces, units_per_n), [*contact_classes, resultant_class]


def _measured_arrows(view: View, world: World | None, units_per_n: float) -> list[float]:
    forces = [(view.at(contact.position_w), np.array(contact.force_w[:2])) for contact in _contacts(world)]
    return _arrows(view, forces, units_per_n)


def _contacts(world: World | None) -> list[WorldContact]:
    return world.contacts if world is not None else []


def _arrows(view: View, forces: list[tuple[Point, Floats]], units_per_n: float) -> list[float]:
    """Return four numbers for each arrow: from where to where.

    An arrow that is too long is cut, so that one impact does not dwarf the other forces.
    """
    numbers: list[float] = []
    for foot, force in forces:
        cut = min(1.0, FELT_SHARE * LONGEST_ARROW / max(units_per_n * math.hypot(*force), 1e-9))
        tip = view.along(foot, force, cut * units_per_n)
        numbers += [*foot, *tip]
    return [round(number, 1) for number in numbers]
