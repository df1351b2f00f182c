"""The friction coefficients of all geoms of a model, where the laws read them: see `laws/directional.py`."""

import mujoco

from snakesim_hal.model.friction import DirectionalFriction, Surface, link_factors, surface_friction
from snakesim_hal.model.placement import Placed
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.scenario import RunConfig
from snakesim_sim_backend.model.obstacles import geom_name


def set_friction(
    spec: mujoco.MjSpec,
    config: RunConfig,
    placed: list[Placed],
    rough_ground_geoms: list[str],
    self_friction: float,
) -> None:
    """Give every geom its friction: the coefficient in all directions, and user data for those of each direction.

    Args:
        spec: the model with all geoms.
        config: of the run.
        placed: all obstacles.
        rough_ground_geoms: names of the geoms of ground that is not flat.
        self_friction: Coulomb coefficient between links.
    """
    robot = config.robot
    ground = config.scene.ground
    factors = link_factors(robot.skin, len(robot.link_masses_kg))
    on_ground = _find_coefficients(robot, ground.friction, ground)
    viscous = [0.0, 0.0]
    if ground.viscous is not None:
        viscous = [ground.viscous.along_s_per_m, ground.viscous.across_s_per_m]

    friction_of: dict[str, float] = {}
    directions_of: dict[str, list[float]] = {}
    for name in rough_ground_geoms:
        friction_of[name] = ground.friction
        directions_of[name] = [*on_ground, *viscous]
    for i, of_foot in enumerate(_average_over_links(factors, robot.link_masses_kg)):
        friction_of[f"foot_{i}"] = ground.friction
        pairs = zip(on_ground, of_foot, strict=True)
        directions_of[f"foot_{i}"] = [*(coefficient * factor for coefficient, factor in pairs), *viscous]
    for item in placed:
        friction_of[geom_name(item)] = item.friction
        directions_of[geom_name(item)] = [*_find_coefficients(robot, item.friction, item), 0.0, 0.0]
    for i, of_link in enumerate(factors):
        friction_of[f"link_{i}"] = self_friction
        directions_of[f"link_{i}"] = [*of_link, 0.0, 0.0]

    for geom in spec.geoms:
        geom.friction[0] = friction_of.get(geom.name, 0.0)
        if geom.name in directions_of:
            is_foot = geom.userdata[0] if len(geom.userdata) else 0.0
            geom.userdata = [is_foot, *directions_of[geom.name]]


def _find_coefficients(robot: RobotFile, friction: float, surface: Surface) -> DirectionalFriction:
    return surface_friction(friction, surface, robot.skin, robot.wheels)


def _average_over_links(factors: list[DirectionalFriction], masses_kg: list[float]) -> list[DirectionalFriction]:
    """Return the factors of every foot: the mean of those of the links that it ends, by the weight that it carries."""
    averages = [factors[0]]
    for i in range(1, len(factors)):
        behind_kg = masses_kg[i - 1]
        ahead_kg = masses_kg[i]
        mean = [
            behind if behind == ahead else (behind_kg * behind + ahead_kg * ahead) / (behind_kg + ahead_kg)
            for behind, ahead in zip(factors[i - 1], factors[i], strict=True)
        ]
        averages.append(DirectionalFriction(*mean))
    return [*averages, factors[-1]]
