"""The friction coefficients of all geoms of a model, where the laws read them: see `laws/directional.py`."""

import mujoco

from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig
from snakesim_hal.model.scene_file.friction import (
    DirectionalFriction,
    Surface,
    compute_link_factors,
    compute_surface_friction,
)
from snakesim_hal.model.scene_file.placement import PlacedObstacle
from snakesim_sim_backend.model.obstacles import make_geom_name
from snakesim_sim_backend.model.pipes import get_pipe_geom_names


def set_friction(
    spec: mujoco.MjSpec,
    config: RunConfig,
    placed: list[PlacedObstacle],
    rough_ground_geoms: list[str],
    self_friction: float,
) -> None:
    """Set the friction of every geom: one coefficient for all directions, and user data with one for each direction.

    Args:
        spec: Model with all geoms, which is changed.
        config: Configuration of the run, with the robot and the ground.
        placed: All obstacles with their places.
        rough_ground_geoms: Names of the geoms of ground that is not flat.
        self_friction: Coulomb coefficient between links.
    """
    robot = config.robot
    ground = config.scene.ground
    factors = compute_link_factors(robot.skin, len(robot.link_masses_kg))
    ground_coefficients = _find_coefficients(robot, ground.friction, ground)
    viscous = [0.0, 0.0]
    if ground.viscous is not None:
        viscous = [ground.viscous.along_s_per_m, ground.viscous.across_s_per_m]

    friction_by_geom: dict[str, float] = {}
    # Three dry and two viscous coefficients, see `directional`.
    directions_by_geom: dict[str, list[float]] = {}
    for name in rough_ground_geoms:
        friction_by_geom[name] = ground.friction
        directions_by_geom[name] = [*ground_coefficients, *viscous]
    for i, foot_factors in enumerate(_average_over_links(factors, robot.link_masses_kg)):
        friction_by_geom[f"foot_{i}"] = ground.friction
        pairs = zip(ground_coefficients, foot_factors, strict=True)
        directions_by_geom[f"foot_{i}"] = [
            *(coefficient * factor for coefficient, factor in pairs),
            *viscous,
        ]
    for item in placed:
        friction_by_geom[make_geom_name(item)] = item.friction
        directions_by_geom[make_geom_name(item)] = [
            *_find_coefficients(robot, item.friction, item),
            0.0,
            0.0,
        ]
    for index, pipe in enumerate(config.scene.pipe):
        for name in get_pipe_geom_names(index, pipe):
            friction_by_geom[name] = pipe.friction
            directions_by_geom[name] = [*_find_coefficients(robot, pipe.friction, pipe), 0.0, 0.0]
    for i, one_link_factors in enumerate(factors):
        friction_by_geom[f"link_{i}"] = self_friction
        directions_by_geom[f"link_{i}"] = [*one_link_factors, 0.0, 0.0]

    has_separate_limits = robot.wheels is not None and robot.wheels.separate_limits
    for geom in spec.geoms:
        geom.friction[0] = friction_by_geom.get(geom.name, 0.0)
        if geom.name in directions_by_geom:
            foot_mark = geom.userdata[0] if len(geom.userdata) else 0.0
            separate_limits = float(
                has_separate_limits and geom.name.startswith(("foot_", "link_"))
            )
            geom.userdata = [foot_mark, *directions_by_geom[geom.name], separate_limits]


def _find_coefficients(robot: RobotFile, friction: float, surface: Surface) -> DirectionalFriction:
    return compute_surface_friction(friction, surface, robot.skin, robot.wheels)


def _average_over_links(
    factors: list[DirectionalFriction], masses_kg: list[float]
) -> list[DirectionalFriction]:
    """Return the factors of every foot: the mean of those of the links that it ends, by the weight that it carries."""
    averages = [factors[0]]
    for i in range(1, len(factors)):
        behind_kg = masses_kg[i - 1]
        ahead_kg = masses_kg[i]
        mean = [
            behind
            if behind == ahead
            else (behind_kg * behind + ahead_kg * ahead) / (behind_kg + ahead_kg)
            for behind, ahead in zip(factors[i - 1], factors[i], strict=True)
        ]
        averages.append(DirectionalFriction(*mean))
    return [*averages, factors[-1]]
