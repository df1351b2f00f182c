"""Scenes that were made for one robot, in proportion for another.

A row of pegs suits a body whose joints are as far apart, and as thick, as the one that it was laid out for. So a scene
that says which one (`reference_robot`) is changed for other robots before anything else reads it: the wave of its route
by the spacing of joints, corridors and gaps by the radius, and random fields stand as far beyond the route as before.
What a flag sets stays. The scene then is made for this robot, so it can be read again.
"""

from collections.abc import Callable
from typing import Any

from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.route import yaw_segments_m
from snakesim_hal.model.scene import SceneFile, SineRoute


def spacing_m(robot: RobotFile) -> float | None:
    """The longest straight part between two neighboring yaw joints; None: there are no two."""
    return max(yaw_segments_m(robot.axes, robot.link_lengths_m)[1:-1], default=None)


def fitted(scene: SceneFile, robot: RobotFile, is_given: Callable[[str], bool]) -> dict[str, Any]:
    """What is different for this robot, by dotted key below `scene`. is_given: whether a flag sets a key."""
    reference_robot, spacing = scene.reference_robot, spacing_m(robot)
    if reference_robot is None or spacing is None:
        return {}
    radius, more = robot.module.radius_m, robot.module.radius_m - reference_robot.radius_m
    share = spacing / reference_robot.spacing_m
    if share == 1.0 and more == 0.0:
        return {}
    changed: dict[str, Any] = {"reference_robot.spacing_m": spacing, "reference_robot.radius_m": radius}
    route, ahead = scene.route, 0.0
    if isinstance(route, SineRoute):
        lengths = {name: getattr(route, name) for name in ("amplitude_m", "wavelength_m", "length_m")}
        changed |= {f"route.{name}": share * length for name, length in lengths.items()}
        ahead = 0.0 if is_given("route.length_m") else (share - 1.0) * route.length_m
    for i, row in enumerate(scene.pegs_along_route):
        changed[f"pegs_along_route.{i}.corridor_m"] = radius + share * (row.corridor_m - reference_robot.radius_m)
    for i, field in enumerate(scene.random_field):
        for name in ("min_corner_m", "max_corner_m"):
            x, y = getattr(field, name)
            changed[f"random_field.{i}.{name}"] = [x + ahead, y]
        changed[f"random_field.{i}.clearance_m"] = max(field.clearance_m + 2.0 * more, 0.0)
    return {key: value for key, value in changed.items() if not is_given(key)}
