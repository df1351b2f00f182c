"""`snakesim robot shape draw`: writes the shapes of a robot for a printer or a plotter. No robot has to run."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.base.terminal import print_line
from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.textfiles import export_atomically
from snakesim_operator.features.commissioning.shape.decide import judge_shapes
from snakesim_operator.features.commissioning.shape.design import (
    PLACEMENT_TOLERANCE_RAD,
    ShapePose,
    design_poses,
)
from snakesim_operator.features.commissioning.shape.drawing import encode_pdf, encode_svg
from snakesim_operator.features.commissioning.shape.outline import compute_drawing_mark
from snakesim_operator.features.commissioning.shape.pages import PaperName, make_pages, make_poster


def draw_shapes(robot_name: str, output_path: Path, paper: PaperName) -> int:
    """Write the shapes of a robot: a PDF with sheets of paper, or an SVG with all shapes in one drawing.

    Args:
        robot_name: Path of a robot file, or name of a shipped one.
        output_path: Path of the drawing; its ending decides about the format.
        paper: Size of the sheets of a PDF.

    Returns:
        The exit code, which is always 0.

    Raises:
        ConfigError: The robot file cannot be read, or the drawing cannot be written.
    """
    robot = decode_table(read_table_with_base(robot_name, "robots"), RobotFile)
    poses = design_poses(robot.joint_table)
    mark = compute_drawing_mark(robot, poses)
    title = f"{robot.name}: shapes of the joint check, {mark}"
    match output_path.suffix:
        case ".pdf":
            pages = make_pages(robot, poses, mark, paper)
            content = encode_pdf(pages, title)
            size = f"an overview and {len(pages) - 1} sheets of {paper}; print them at 100 %"
        case ".svg":
            content = encode_svg(make_poster(robot, poses, mark), title).encode()
            size = "all in one drawing, in true scale"
        case suffix:
            raise ConfigError(
                f"--out {output_path}: {suffix or 'a file without an ending'} is neither .pdf (for a printer) nor .svg "
                "(for a plotter)",
                code="config/invalid-value",
            )
    with export_atomically(output_path) as partial:
        partial.write_bytes(content)
    names = ", ".join(pose.name for pose in poses if pose.axis is not None)
    print_line(f"{output_path}: shapes {names}, drawing {mark}: {size}")
    for line in list_undecidable_properties(robot, poses):
        print_line(line)
    print_line(
        f"place every joint within {PLACEMENT_TOLERANCE_RAD:g} rad of the drawing: each link within "
        f"{100 * PLACEMENT_TOLERANCE_RAD / 2:g} mm per 100 mm of its length"
    )
    return 0


def list_undecidable_properties(robot: RobotFile, poses: Sequence[ShapePose]) -> list[str]:
    """Return a line for each joint of which the shapes cannot decide every property, however well it is placed."""
    lines: list[str] = []
    for verdict in judge_shapes(
        robot.joint_table, poses, np.array([pose.angle_rad for pose in poses])
    ):
        unknown = verdict.list_properties("unknown")
        if unknown:
            reasons = dict.fromkeys(verdict.findings[name].reason for name in unknown)
            lines.append(
                f"{verdict.joint}: {', '.join(unknown)} will stay unknown: {'; '.join(reasons)}"
            )
    return lines
