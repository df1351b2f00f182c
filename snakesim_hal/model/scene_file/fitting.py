"""Scale a scene that was laid out for one robot to another robot.

A row of pegs suits a robot with the same distance between joints, and the same radius, as the robot that it was laid
out for. So a scene that names this robot's dimensions (`reference_robot`) is changed for every other robot, before
anything else reads it: the wave of its route in proportion to the spacing of the joints, and corridors and gaps by the
radius. Random fields keep their distance from the end of the route. Values that a flag gives are not changed.
Afterwards `reference_robot` has the dimensions of the new robot, so a scene that is read again does not change again.
"""

from collections.abc import Callable
from typing import Any

from snakesim_hal.model.geometry.route import compute_yaw_segments_m
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scene_file.scene import SceneFile, SineRoute


def compute_joint_spacing_m(robot: RobotFile) -> float | None:
    """Return the longest straight part between two neighboring yaw joints; None if there are no two yaw joints."""
    segments_m = compute_yaw_segments_m(robot.axes, robot.link_lengths_m)
    between_joints_m = segments_m[1:-1]
    return max(between_joints_m, default=None)


def compute_scaled_scene_values(
    scene: SceneFile, robot: RobotFile, is_set_by_flag: Callable[[str], bool]
) -> dict[str, Any]:
    """Compute the values of a scene that change when it is scaled to another robot than its reference robot.

    The route and the corridors between pegs scale with the joint spacing. Clearances grow with the radius of the body.

    Args:
        scene: Scene that was laid out for its `reference_robot`.
        robot: Robot of the run.
        is_set_by_flag: Returns whether a flag sets the value of a dotted key below `scene`. Such values do not change.

    Returns:
        The changed values by dotted key below `scene`. Empty if the scene fits already, or has no reference robot.
    """
    reference_robot = scene.reference_robot
    robot_spacing_m = compute_joint_spacing_m(robot)
    if reference_robot is None or robot_spacing_m is None:
        return {}
    radius_m = robot.module.radius_m
    extra_radius_m = radius_m - reference_robot.radius_m
    scale = robot_spacing_m / reference_robot.spacing_m
    if scale == 1.0 and extra_radius_m == 0.0:
        return {}

    changed: dict[str, Any] = {
        "reference_robot.spacing_m": robot_spacing_m,
        "reference_robot.radius_m": radius_m,
    }
    route_extension_m = 0.0
    route = scene.route
    if isinstance(route, SineRoute):
        changed["route.amplitude_m"] = scale * route.amplitude_m
        changed["route.wavelength_m"] = scale * route.wavelength_m
        changed["route.length_m"] = scale * route.length_m
        if not is_set_by_flag("route.length_m"):
            route_extension_m = (scale - 1.0) * route.length_m
    for i, row in enumerate(scene.pegs_along_route):
        body_clearance_m = row.corridor_m - reference_robot.radius_m
        changed[f"pegs_along_route.{i}.corridor_m"] = radius_m + scale * body_clearance_m
    for i, field in enumerate(scene.random_field):
        min_x, min_y = field.min_corner_m
        max_x, max_y = field.max_corner_m
        changed[f"random_field.{i}.min_corner_m"] = [min_x + route_extension_m, min_y]
        changed[f"random_field.{i}.max_corner_m"] = [max_x + route_extension_m, max_y]
        changed[f"random_field.{i}.clearance_m"] = max(
            field.clearance_m + 2.0 * extra_radius_m, 0.0
        )
    return {key: value for key, value in changed.items() if not is_set_by_flag(key)}
