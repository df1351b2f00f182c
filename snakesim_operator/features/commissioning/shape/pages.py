"""Divides the drawn shapes into sheets of paper, with an overview of where each sheet belongs. Pure."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.commissioning.shape.design import ShapePose
from snakesim_operator.features.commissioning.shape.drawing import (
    GRAY,
    Drawing,
    Label,
    Page,
    Stroke,
    Window,
)
from snakesim_operator.features.commissioning.shape.outline import draw_shape

PaperName = Literal["a4", "a3", "letter"]
PAPER_SIZES_MM: dict[PaperName, tuple[float, float]] = {
    "a4": (297, 210),
    "a3": (420, 297),
    "letter": (279.4, 215.9),
}
MARGIN_MM = 12.0  # around the drawing; most printers need 5 mm
TEXT_HEIGHT_MM = 3.0
SCALE_BAR_MM = 100.0
SCALE_TEXT = "Print at 100 %, not fitted to the page. The line to the right must be 100 mm long."
# Of the search for the direction in which a shape needs the fewest sheets.
TURN_STEP_RAD = math.radians(7.5)
# Of the free space in a grid, by which a shape is shifted in it.
SLACK_FRACTIONS = 0.0, 0.25, 0.5, 0.75, 1.0
LINE_SAMPLES = 8  # of each side of an outline
OVERVIEW_GAP_MM = 8.0
SIDE_BY_AXIS = {"yaw": "belly down", "pitch": "left side down, its top to the top of this page"}


@dataclass(frozen=True)
class TiledShape:
    """A shape on a grid of sheets; row 0 is at the top."""

    pose: ShapePose
    drawing: Drawing  # the lower left corner of the grid is the origin
    row_count: int
    column_count: int
    sheets: Sequence[tuple[int, int]]  # row and column of every sheet that is not empty
    sheet_mm: Floats  # width and height of the part of the drawing on a sheet


@dataclass(frozen=True)
class _Placement:
    """A direction and a place of a drawing on a grid of sheets."""

    turn_rad: float
    shift_mm: Floats
    row_count: int
    column_count: int
    sheets: Sequence[tuple[int, int]]


def make_pages(
    robot: RobotFile, poses: Sequence[ShapePose], mark: str, paper: PaperName
) -> list[Page]:
    """Return the overview, then every sheet of every shape in true scale.

    Args:
        robot: The robot, with its lengths.
        poses: Poses of the check. The straight one needs no sheet.
        mark: Characters that are printed on every sheet.
        paper: Size of the paper, which is used in landscape.
    """
    paper_mm = np.array(PAPER_SIZES_MM[paper])
    shapes = [
        tile_shape(robot, pose, paper_mm - 2 * MARGIN_MM) for pose in poses if pose.axis is not None
    ]
    pages = [_make_overview(robot, shapes, mark, paper_mm)]
    for shape in shapes:
        pages += [
            _make_sheet(robot, shape, number, mark, paper_mm) for number in range(len(shape.sheets))
        ]
    return pages


def make_poster(robot: RobotFile, poses: Sequence[ShapePose], mark: str) -> Drawing:
    """Return all shapes in true scale below each other, for a plotter or a large printer."""
    poster = Drawing()
    top_mm = 0.0
    for pose in poses:
        if pose.axis is None:
            continue
        drawing = _turn_flat(robot, pose)
        lowest, highest = drawing.bounds_mm
        caption = Label(_describe_shape(robot, pose, mark), (0.0, top_mm), height_mm=6.0)
        drawing = drawing.transform(np.array((-lowest[0], top_mm - 12.0 - highest[1])))
        poster = poster + drawing + Drawing(labels=[caption])
        top_mm = float(drawing.bounds_mm[0][1]) - 25.0
    return poster


def tile_shape(robot: RobotFile, pose: ShapePose, sheet_mm: Floats) -> TiledShape:
    """Turn a shape so that it needs the fewest sheets, and place it within their grid.

    Args:
        robot: The robot, with its lengths.
        pose: The shape.
        sheet_mm: Width and height of the part of the drawing on a sheet.
    """
    placements = [
        _place_on_grid(draw_shape(robot, pose, float(turn_rad)), float(turn_rad), sheet_mm)
        for turn_rad in np.arange(-math.pi / 2, math.pi / 2, TURN_STEP_RAD)
    ]
    best = min(placements, key=lambda placement: (len(placement.sheets), placement.row_count))
    drawing = draw_shape(robot, pose, best.turn_rad).transform(best.shift_mm)
    return TiledShape(pose, drawing, best.row_count, best.column_count, best.sheets, sheet_mm)


def _place_on_grid(drawing: Drawing, turn_rad: float, sheet_mm: Floats) -> _Placement:
    """Place a drawing on the smallest grid of sheets, at the place where it touches the fewest."""
    lowest, highest = drawing.bounds_mm
    column_count, row_count = np.ceil((highest - lowest) / sheet_mm).astype(int).tolist()
    slack_mm = sheet_mm * (column_count, row_count) - (highest - lowest)
    points_mm = _sample_lines(drawing)
    placements: list[_Placement] = []
    for fractions in itertools.product(SLACK_FRACTIONS, repeat=2):
        shift_mm = np.array(fractions) * slack_mm - lowest
        sheets = _list_used_sheets(points_mm + shift_mm, row_count, column_count, sheet_mm)
        placements.append(_Placement(turn_rad, shift_mm, row_count, column_count, sheets))
    return min(placements, key=lambda placement: len(placement.sheets))


def _sample_lines(drawing: Drawing) -> Floats:
    """Return points along all lines, a few millimeters from each other, (n, 2)."""
    samples: list[Floats] = []
    for stroke in drawing.strokes:
        points_mm = stroke.points_mm
        if stroke.closed:
            points_mm = np.concatenate((points_mm, points_mm[:1]))
        numbers = np.arange(len(points_mm))
        fine_numbers = np.linspace(0.0, len(points_mm) - 1.0, LINE_SAMPLES * len(points_mm))
        samples.append(
            np.column_stack(
                [np.interp(fine_numbers, numbers, points_mm[:, axis]) for axis in (0, 1)]
            )
        )
    return np.concatenate(samples)


def _list_used_sheets(
    points_mm: Floats, rows: int, columns: int, sheet_mm: Floats
) -> list[tuple[int, int]]:
    """Return row and column of every sheet that has a point on it, from the top left."""
    cells = np.clip(np.floor(points_mm / sheet_mm).astype(int), 0, (columns - 1, rows - 1))
    numbers = np.unique((rows - 1 - cells[:, 1]) * columns + cells[:, 0]).tolist()
    return [divmod(number, columns) for number in numbers]


def _turn_flat(robot: RobotFile, pose: ShapePose) -> Drawing:
    """Return a shape, turned so that it is as low as possible."""
    drawings = [
        draw_shape(robot, pose, float(turn))
        for turn in np.arange(-math.pi / 2, math.pi / 2, TURN_STEP_RAD)
    ]
    return min(drawings, key=lambda drawing: float(np.diff(drawing.bounds_mm, axis=0)[0, 1]))


def _describe_shape(robot: RobotFile, pose: ShapePose, mark: str) -> str:
    side = SIDE_BY_AXIS[pose.axis] if pose.axis is not None else ""
    return f"{robot.name}, shape {pose.name}: {side}. Drawing {mark}"


def _make_sheet(
    robot: RobotFile, shape: TiledShape, number: int, mark: str, paper_mm: Floats
) -> Page:
    """Return one sheet: its part of the shape, a frame to cut along, and what to do with it."""
    row, column = shape.sheets[number]
    corner_mm = shape.sheet_mm * (column, shape.row_count - 1 - row)
    width_mm, height_mm = shape.sheet_mm.tolist()
    text = (
        f"{_describe_shape(robot, shape.pose, mark)}. Sheet {shape.pose.name}{number + 1} of {len(shape.sheets)}, "
        f"row {row + 1}, column {column + 1}. Cut along the frame."
    )
    margin = Drawing(
        strokes=[
            _make_frame(MARGIN_MM, MARGIN_MM, width_mm, height_mm),
            *_draw_scale_bar(width_mm),
        ],
        labels=[
            Label(text, (MARGIN_MM, MARGIN_MM - 5.0), TEXT_HEIGHT_MM),
            Label(SCALE_TEXT, (MARGIN_MM, MARGIN_MM - 9.5), TEXT_HEIGHT_MM),
        ],
    )
    content = shape.drawing.transform(MARGIN_MM - corner_mm)
    window = Window(MARGIN_MM, MARGIN_MM, width_mm, height_mm)
    return Page(float(paper_mm[0]), float(paper_mm[1]), content, window, margin)


def _make_frame(left_mm: float, bottom_mm: float, width_mm: float, height_mm: float) -> Stroke:
    corners = ((0.0, 0.0), (width_mm, 0.0), (width_mm, height_mm), (0.0, height_mm))
    return Stroke(
        np.array(corners) + np.array((left_mm, bottom_mm)), width_mm=0.1, gray=GRAY, closed=True
    )


def _draw_scale_bar(width_mm: float) -> list[Stroke]:
    """Draw a line with ends in the bottom margin, by which a person sees whether the printer has scaled the page."""
    right_mm = MARGIN_MM + width_mm
    y_mm = MARGIN_MM - 8.5
    bar = np.array(((right_mm - SCALE_BAR_MM, y_mm), (right_mm, y_mm)))
    tick = np.array(((0.0, -1.0), (0.0, 1.0)))
    return [
        Stroke(bar, width_mm=0.2),
        Stroke(bar[0] + tick, width_mm=0.2),
        Stroke(bar[1] + tick, width_mm=0.2),
    ]


def _make_overview(
    robot: RobotFile, shapes: Sequence[TiledShape], mark: str, paper_mm: Floats
) -> Page:
    """Return a page with all shapes in small, and the number of every sheet in its place."""
    width_mm, height_mm = paper_mm.tolist()
    slot_mm = (height_mm - 2 * MARGIN_MM - OVERVIEW_GAP_MM) / len(shapes)
    content = Drawing(
        labels=[
            Label(
                f"{robot.name}, drawing {mark}: glue the sheets of each shape together as shown",
                (MARGIN_MM, height_mm - MARGIN_MM - 4.0),
            )
        ]
    )
    for index, shape in enumerate(shapes):
        bottom_mm = height_mm - MARGIN_MM - OVERVIEW_GAP_MM - (index + 1) * slot_mm
        content += _draw_small_shape(
            robot, shape, mark, np.array((MARGIN_MM, bottom_mm)), width_mm, slot_mm
        )
    return Page(width_mm, height_mm, content)


def _draw_small_shape(
    robot: RobotFile,
    shape: TiledShape,
    mark: str,
    corner_mm: Floats,
    paper_width_mm: float,
    slot_mm: float,
) -> Drawing:
    """Return a shape with its grid of sheets in small.

    Args:
        robot: The robot.
        shape: The shape and its sheets.
        mark: Characters that are printed on every sheet.
        corner_mm: Lower left corner of its place.
        paper_width_mm: Width of the paper.
        slot_mm: Height of its place.
    """
    grid_mm = shape.sheet_mm * (shape.column_count, shape.row_count)
    space_mm = np.array((paper_width_mm - 2 * MARGIN_MM, slot_mm - OVERVIEW_GAP_MM))
    scale = float((space_mm / grid_mm).min())
    small = Drawing(shape.drawing.strokes).transform(corner_mm, scale)
    strokes = [*small.strokes]
    title = (corner_mm[0], corner_mm[1] + scale * grid_mm[1] + 1.5)
    labels = [Label(_describe_shape(robot, shape.pose, mark), title, TEXT_HEIGHT_MM)]
    for number, (row, column) in enumerate(shape.sheets):
        left_mm, bottom_mm = (
            corner_mm + scale * shape.sheet_mm * (column, shape.row_count - 1 - row)
        ).tolist()
        width_mm, height_mm = (scale * shape.sheet_mm).tolist()
        strokes.append(_make_frame(left_mm, bottom_mm, width_mm, height_mm))
        labels.append(
            Label(
                f"{shape.pose.name}{number + 1}",
                (left_mm + 1.0, bottom_mm + 1.0),
                TEXT_HEIGHT_MM,
                GRAY,
            )
        )
    return Drawing(strokes, labels)
