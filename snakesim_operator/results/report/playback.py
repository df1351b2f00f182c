"""Makes the playback of a whole run: a fixed map, and some hundred frames with the snake and its forces.

`playback.js` moves the drawing of `draw_body`. All coordinates are in units of the drawing.
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
from snakesim_hal.wire.messages import ControlState, WorldContact, WorldModel
from snakesim_operator.results.metrics.motion import (
    MOVING_LABEL,
    STATIONARY_LABEL,
    StopIntervals,
    find_stops,
)
from snakesim_operator.results.page.svg import Point, make_element, make_svg
from snakesim_operator.results.report.labels import LabelPlacer
from snakesim_operator.results.report.snapshots import make_force_balance
from snakesim_operator.results.report.timeline import describe_state
from snakesim_operator.results.report.top_view import (
    draw_body,
    draw_ground,
    draw_scales,
    find_outline_w,
)
from snakesim_operator.results.report.view import (
    MAX_ARROW_LENGTH,
    MAX_MEASURED_ARROW_RATIO,
    MapViewport,
    compute_map_viewport,
    find_body_points_xy_w,
)
from snakesim_operator.results.run_log import RunRecord
from snakesim_operator.results.sampling import choose_even_indices
from snakesim_operator.results.time_axis import get_run_end_s, get_time_origin_s

MessageT = TypeVar("MessageT", ControlState, WorldModel)
MAX_FRAMES = 300
MAX_MAPS = 80  # of a whole run
MAX_PATH_POINTS = 60
WIDTH = 1040.0
SAME_TICK_S = 1e-6
# Fraction of the forces that are drawn in full length; longer arrows are cut.
FULL_SIZE_QUANTILE = 0.9
# An older message is not shown: control and guidance publish many times per second.
SHOWN_FOR_S = 0.3


@dataclass(frozen=True)
class MapPlayback:
    """The map as markup, and the frames as data for playback.js."""

    picture: Markup
    data: dict[str, Any]
    has_desired_forces: bool
    has_measured_forces: bool


def make_playback(record: RunRecord) -> MapPlayback | None:
    """Make the playback of a run; None if the pose is never known."""
    rows_with_pose = np.flatnonzero(record.has_pose)
    if not len(rows_with_pose):
        return None
    rows = rows_with_pose[choose_even_indices(len(rows_with_pose), MAX_FRAMES)]
    body_points_w = [find_body_points_xy_w(record, int(row)) for row in rows]
    states = _find_latest_messages(record, rows, record.control_states)
    worlds = _find_latest_messages(record, rows, record.worlds)
    pixels_per_n = _find_force_scale(states, worlds)
    view = compute_map_viewport(record, body_points_w, pixels_per_n, WIDTH)
    maps, map_numbers = _collect_perceived_maps(record, view, rows)
    paths, path_numbers = _collect_planned_paths(record, view, rows)
    names = [joint.name for joint in record.description.joints]
    stop_intervals = find_stops(record)
    captions: list[str] = []
    frames: list[list[Any]] = []
    has_desired_forces = False
    has_measured_forces = False
    for i, (row, frame_points_w, state, world) in enumerate(
        zip(rows, body_points_w, states, worlds, strict=True)
    ):
        time_s = float(record.time_s[row]) - get_time_origin_s(record)
        propelling = state.propulsion_joint if state is not None else None
        caption = _describe_motion(stop_intervals, time_s, state)
        if caption not in captions:
            captions.append(caption)
        desired_arrows, desired_classes = _make_desired_arrows(view, state, world, pixels_per_n)
        measured_arrows = _make_measured_arrows(view, world, pixels_per_n)
        has_desired_forces = has_desired_forces or bool(desired_arrows)
        has_measured_forces = has_measured_forces or bool(measured_arrows)
        frames.append(  # playback.js reads the items of a frame by position
            [
                round(time_s, 3),
                _flatten_coordinates(view, frame_points_w),
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
        "end": round(get_run_end_s(record), 3),
        "maps": maps,
        "paths": paths,
    }
    return MapPlayback(
        Markup(_draw_first_frame(record, view, body_points_w[0])),
        data,
        has_desired_forces,
        has_measured_forces,
    )


def _draw_first_frame(record: RunRecord, view: MapViewport, nodes: Floats) -> str:
    """Draw the map and the snake, with empty groups that playback.js fills."""
    labels = LabelPlacer(view.width, view.height)
    snake = make_element("g", draw_body(record, view, nodes, labels), class_="snake")
    return make_svg(
        view.width,
        view.height,
        "The snake on the map, moved by the slider",
        draw_ground(record, view, labels)
        + '<g class="perceived"></g>'
        + snake
        + '<g class="forces"></g>'
        + draw_scales(view),
    )


def _describe_motion(
    stop_intervals: StopIntervals | None, time_s: float, state: ControlState | None
) -> str:
    """Describe the measured motion of the body at a time, and what control reported then if that differs."""
    reported = (
        "control reported nothing"
        if state is None
        else f"{describe_state(state.state)}: {state.reason}"
    )
    if stop_intervals is None:
        return reported
    is_stationary = stop_intervals.is_stationary_at(time_s)
    measured = STATIONARY_LABEL if is_stationary else MOVING_LABEL
    # Measured by control over a preceding window.
    if state is None or state.reason == STANDING_STILL:
        return measured
    reports_stationary = state.state != "Locomoting"
    if is_stationary == reports_stationary:
        return reported
    return measured if is_stationary else f"{measured}; control reported {reported}"


def _collect_perceived_maps(
    record: RunRecord, view: MapViewport, rows: NDArray[np.intp]
) -> tuple[list[list[list[float]]], list[int]]:
    """Collect some of the perceived maps that guidance published, for the playback.

    Returns:
        The maps, each a list with the outline of every obstacle as x, y, x, y, ...; and for each row the index of its
        map, or -1.
    """
    if record.config.mission.map != "perceived" or not record.worlds:
        return [], [-1] * len(rows)
    step = max(len(record.worlds) // MAX_MAPS, 1)
    shown = record.worlds[::step]
    maps: list[list[list[float]]] = []
    for world in shown:
        visible = [obstacle for obstacle in world.obstacles if view.is_drawn(obstacle)]
        maps.append([_flatten_coordinates(view, find_outline_w(obstacle)) for obstacle in visible])
    return maps, _find_latest_indices(record, rows, [world.timestamp_ns for world in shown])


def _collect_planned_paths(
    record: RunRecord, view: MapViewport, rows: NDArray[np.intp]
) -> tuple[list[list[float]], list[int]]:
    """Collect the paths that navigation planned, for the playback.

    Returns:
        The paths, each as x, y, x, y, ...; and for each row the index of its path, or -1. If navigation planned fewer
        than two paths there are none, because the map shows the route of the scene.
    """
    planned = [
        trajectory for trajectory in record.trajectories if trajectory.timestamp_ns is not None
    ]
    if len({trajectory.path_id for trajectory in planned}) < 2:
        return [], [-1] * len(rows)
    paths: list[list[float]] = []
    for trajectory in planned:
        step = max(len(trajectory.path_w) // MAX_PATH_POINTS, 1)
        paths.append(_flatten_coordinates(view, np.array(trajectory.path_w)[::step]))
    return paths, _find_latest_indices(
        record, rows, [trajectory.timestamp_ns or 0 for trajectory in planned]
    )


def _flatten_coordinates(view: MapViewport, points_w: Floats) -> list[float]:
    """Convert world points to coordinates of the drawing: x, y, x, y, ..."""
    return [round(part, 1) for point in points_w for part in view.to_pixels(point)]


def _find_latest_indices(
    record: RunRecord, rows: NDArray[np.intp], timestamps_ns: Sequence[int]
) -> list[int]:
    """Find for each row the index of the last timestamp up to its time, or -1."""
    timestamps_s = np.array(timestamps_ns) * 1e-9
    after = np.searchsorted(timestamps_s, record.time_s[rows] + SAME_TICK_S, side="right")
    return (after - 1).tolist()


def _find_latest_messages(
    record: RunRecord, rows: NDArray[np.intp], messages: Sequence[MessageT]
) -> list[MessageT | None]:
    """Find for each row the last message up to its time; None if there is none or it is older than SHOWN_FOR_S."""
    indices = _find_latest_indices(record, rows, [message.timestamp_ns for message in messages])
    latest: list[MessageT | None] = []
    for index, time_s in zip(indices, record.time_s[rows].tolist(), strict=True):
        message = messages[index] if index >= 0 else None
        if message is not None and time_s - message.timestamp_ns * 1e-9 < SHOWN_FOR_S:
            latest.append(message)
        else:
            latest.append(None)
    return latest


def _find_force_scale(
    states: Sequence[ControlState | None], worlds: Sequence[WorldModel | None]
) -> float:
    """Find the force scale, in units of the drawing per newton, at which most arrows have their full length.

    The desired forces set the scale; without any, the measured forces.
    """
    desired_n: list[float] = []
    for state in states:
        balance = make_force_balance(state) if state is not None else None
        if balance is not None:
            desired_n += [*balance.magnitudes_n, float(np.hypot(*balance.resultant_force_n))]
    measured_n = [
        math.hypot(*contact.force_w[:2]) for world in worlds for contact in _get_contacts(world)
    ]
    usual_n = float(np.quantile(desired_n or measured_n or [0.0], FULL_SIZE_QUANTILE))
    return MAX_ARROW_LENGTH / usual_n if usual_n > 0 else 0.0


def _make_desired_arrows(
    view: MapViewport, state: ControlState | None, world: WorldModel | None, pixels_per_n: float
) -> tuple[list[float], list[str]]:
    """Make the arrows of the desired forces, and last of their resultant, and the CSS classes of each arrow."""
    balance = make_force_balance(state) if state is not None else None
    if balance is None:
        return [], []
    feet = [view.to_pixels(contact.position_w) for contact in balance.contacts]
    forces = list(zip(feet, balance.contact_forces_n, strict=True))
    forces.append((feet[0], balance.resultant_force_n))
    contact_classes, resultant_class = balance.find_css_classes(_get_contacts(world))
    return _make_arrow_coordinates(view, forces, pixels_per_n), [*contact_classes, resultant_class]


def _make_measured_arrows(
    view: MapViewport, world: WorldModel | None, pixels_per_n: float
) -> list[float]:
    forces = [
        (view.to_pixels(contact.position_w), np.array(contact.force_w[:2]))
        for contact in _get_contacts(world)
    ]
    return _make_arrow_coordinates(view, forces, pixels_per_n)


def _get_contacts(world: WorldModel | None) -> list[WorldContact]:
    return world.contacts if world is not None else []


def _make_arrow_coordinates(
    view: MapViewport, forces: list[tuple[Point, Floats]], pixels_per_n: float
) -> list[float]:
    """Return four coordinates for each arrow: x and y of its tail, then of its tip.

    An arrow that is too long is cut, so that one impact does not dwarf the other forces.

    Args:
        view: The viewport of the drawing.
        forces: For each arrow its tail in the drawing, and the force (2,) in the world, in N.
        pixels_per_n: Force scale of the drawing.
    """
    coordinates: list[float] = []
    for foot, force in forces:
        cut = min(
            1.0,
            MAX_MEASURED_ARROW_RATIO
            * MAX_ARROW_LENGTH
            / max(pixels_per_n * math.hypot(*force), 1e-9),
        )
        tip = view.offset_pixels(foot, force, cut * pixels_per_n)
        coordinates += [*foot, *tip]
    return [round(coordinate, 1) for coordinate in coordinates]
