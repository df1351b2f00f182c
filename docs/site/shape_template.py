"""The picture of the drawn shapes: the overview page that `snakesim robot shape draw planar13` writes."""

from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.commissioning.shape.design import design_poses
from snakesim_operator.features.commissioning.shape.drawing import encode_svg
from snakesim_operator.features.commissioning.shape.outline import compute_drawing_mark
from snakesim_operator.features.commissioning.shape.pages import make_pages


def make_shape_template() -> str:
    """Return the overview of the shapes of planar13 on A4 as SVG."""
    robot = decode_table(read_table_with_base("planar13", "robots"), RobotFile)
    poses = design_poses(robot.joint_table)
    overview = make_pages(robot, poses, compute_drawing_mark(robot, poses), "a4")[0]
    return encode_svg(overview.content, "Shapes A, B and C of planar13 on numbered sheets of A4")
