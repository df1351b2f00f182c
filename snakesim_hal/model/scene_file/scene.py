"""The scene file: ground, obstacles, and the route of the snake through them.

The simulator builds the scene, guidance uses it as its map, and the report draws it. `placement` places its obstacles.
"""

import math
from typing import Annotated

import numpy as np
from msgspec import Meta

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.geometry.outlines import Coordinate, Friction, Heading, Point, Size
from snakesim_hal.model.geometry.route import Route, sample_sine_curve
from snakesim_hal.model.scene_file.fluid import Fluid
from snakesim_hal.model.scene_file.friction import Surface, ViscousFriction
from snakesim_hal.model.scene_file.random_field import RandomField
from snakesim_hal.model.scene_file.solids import GRAVITY_M_S2, SolidObstacle, UprightSolid
from snakesim_hal.model.scene_file.terrain import Gaps, Pipe, Stairs
from snakesim_hal.wire.quantities import Name, Vector, above, from_zero

MAX_SLOPE_RAD = 0.7854  # 45 degrees


class Heightfield(FileStruct, frozen=True, kw_only=True):
    """Smooth random hills."""

    height_m: Annotated[float, above(1, "m")]
    """Height from the lowest to the highest point of the ground."""

    wavelength_m: Annotated[float, above(100, "m")]
    """Typical distance between two hills."""

    area_m: Annotated[float, above(200, "m")] = 20.0
    """Edge length of the square around the origin that has hills."""

    seed: Annotated[int, Meta(ge=0, le=2**31)] = 0
    """Seed of the random hills. The same seed gives the same hills."""


class Ground(Surface, frozen=True, kw_only=True):
    """The ground, and its friction."""

    friction: Friction
    """Coulomb friction between the ground and the snake."""

    viscous: ViscousFriction | None = None
    """Viscous friction in addition to dry friction, such as in mud; none: there is none."""

    heightfield: Heightfield | None = None
    """Random hills. None: the ground is flat."""

    slope_rad: Annotated[float, from_zero(MAX_SLOPE_RAD, "rad")] = 0.0
    """Angle by which the ground slopes down. The world frame stays on the ground, with z normal to it, and gravity
    tilts. 0: the ground is level.
    """

    slope_towards_rad: Heading = 0.0
    """Direction in which the ground slopes down most steeply. 0: along x."""


class SineRoute(FileStruct, frozen=True, kw_only=True, tag="sine", tag_field="kind"):
    """y = amplitude sin(2 pi x / wavelength), from x = 0."""

    amplitude_m: Annotated[float, Meta(ge=0, le=10, extra_json_schema={"unit": "m"})]
    """Amplitude of the sine along y."""

    wavelength_m: Size
    """Wavelength of the sine along x."""

    length_m: Size
    """Length of the route along x."""


class WaypointRoute(FileStruct, frozen=True, kw_only=True, tag="waypoints", tag_field="kind"):
    """Straight lines between points. Use many points for a smooth curve."""

    points_m: Annotated[list[Point], Meta(min_length=2, max_length=20000)]
    """Points of the route in the world frame, as [x, y], from its start to its end."""


class Cylinder(UprightSolid, frozen=True, kw_only=True):
    """A peg."""

    position_m: Point
    """Center of the foot in the world frame, as [x, y]."""

    radius_m: Size
    """Radius of the peg."""

    height_m: Size = 0.2
    """Height of the peg."""

    name: Name | None = None
    """Name, which no other obstacle has. None: `cylinder_` with its number in the file."""


class Box(UprightSolid, frozen=True, kw_only=True):
    """A block."""

    position_m: Point
    """Center of the foot in the world frame, as [x, y]."""

    size_m: tuple[Size, Size, Size]
    """Length, width and height of the block."""

    yaw_rad: Heading = 0.0
    """Rotation about the vertical. 0: its length is along x."""

    name: Name | None = None
    """Name, which no other obstacle has. None: `box_` with its number in the file."""


class Sphere(SolidObstacle, frozen=True, kw_only=True):
    """A ball. One that slides does not roll."""

    position_m: Point
    """Center in the world frame, as [x, y]."""

    radius_m: Size
    """Radius of the ball."""

    center_height_m: Coordinate = 0.0
    """Height of the center above the ground."""

    name: Name | None = None
    """Name, which no other obstacle has. None: `sphere_` with its number in the file."""


class Wall(UprightSolid, frozen=True, kw_only=True):
    """A straight wall between two points."""

    from_m: Point
    """One end of the wall in the world frame, as [x, y]."""

    to_m: Point
    """The other end of the wall in the world frame, as [x, y]."""

    thickness_m: Size = 0.05
    """Thickness of the wall."""

    height_m: Size = 0.3
    """Height of the wall."""

    name: Name | None = None
    """Name, which no other obstacle has. None: `wall_` with its number in the file."""


class Step(Surface, frozen=True, kw_only=True):
    """A low platform that the snake may lie on or climb."""

    position_m: Point
    """Center of the foot in the world frame, as [x, y]."""

    size_m: tuple[Size, Size]
    """Length and width of the platform."""

    height_m: Annotated[float, above(2, "m")]
    """Height of the platform."""

    yaw_rad: Heading = 0.0
    """Rotation about the vertical. 0: its length is along x."""

    friction: Friction = 0.5
    """Coulomb friction between the platform and the snake."""

    name: Name | None = None
    """Name, which no other obstacle has. None: `step_` with its number in the file."""


class PegsAlongRoute(UprightSolid, frozen=True, kw_only=True):
    """Pegs beside the route where a snake can push off: at its inflections, on alternating sides.

    `corridor_m` is the distance from the route to a peg's surface, so a body of radius r has `corridor_m - r` of
    clearance on that side.
    """

    corridor_m: Size
    """Distance from the route to a peg's surface."""

    radius_m: Size
    """Radius of every peg."""

    count: Annotated[int, Meta(ge=1, le=2000)]
    """Number of pegs, one at each inflection of the route."""

    first: Annotated[int, Meta(ge=0, le=2000)] = 0
    """Number of inflections without a peg at the start of the route."""

    height_m: Size = 0.2
    """Height of every peg."""


class ReferenceRobot(FileStruct, frozen=True, kw_only=True):
    """The body that a scene was laid out for. For another robot the scene is scaled in proportion, see fitting.py."""

    spacing_m: Size
    """Longest distance between two neighboring yaw joints."""

    radius_m: Size
    """Radius of the body."""


class SceneFile(FileStruct, frozen=True, kw_only=True):
    """A whole scene file."""

    name: Annotated[str, Meta(min_length=1, max_length=40, pattern="^[A-Za-z0-9_-]+$")]
    """Name of the scene: letters, digits, `_` and `-`."""

    description: str = ""
    """Description in one line, which lists of scenes show."""

    ground: Ground
    """The ground, and its friction."""

    gravity_m_s2: Annotated[float, above(30, "m/s²")] = GRAVITY_M_S2
    """Acceleration of gravity, such as 1.62 on the Moon."""

    fluid: Fluid | None = None
    """Fluid in which the snake swims. None: there is none."""

    reference_robot: ReferenceRobot | None = None
    """Body that the scene was laid out for, and in proportion to which it is scaled. None: it is the same for every
    robot.
    """

    route: SineRoute | WaypointRoute | None = None
    """Route of the snake, `kind` = "sine" or "waypoints". None: the scene has no route."""

    # Obstacles.
    cylinder: list[Cylinder] = []
    """Pegs, each an entry `[[cylinder]]`."""

    box: list[Box] = []
    """Blocks, each an entry `[[box]]`."""

    sphere: list[Sphere] = []
    """Balls, each an entry `[[sphere]]`."""

    wall: list[Wall] = []
    """Straight walls, each an entry `[[wall]]`."""

    step: list[Step] = []
    """Low platforms that the snake may lie on or climb, each an entry `[[step]]`."""

    stairs: list[Stairs] = []
    """Flights of stairs, each an entry `[[stairs]]`."""

    gaps: list[Gaps] = []
    """Rows of platforms with gaps between them, each an entry `[[gaps]]`."""

    pipe: list[Pipe] = []
    """Pipes, each an entry `[[pipe]]`."""

    pegs_along_route: list[PegsAlongRoute] = []
    """Rows of pegs beside the route, each an entry `[[pegs_along_route]]`."""

    random_field: list[RandomField] = []
    """Areas with randomly placed obstacles, each an entry `[[random_field]]`."""


def compute_gravity_w(scene: SceneFile) -> Vector:
    """Return the acceleration of gravity in m/s² in the world frame, whose z axis is normal to the ground."""
    ground = scene.ground
    along_ground_m_s2 = scene.gravity_m_s2 * math.sin(ground.slope_rad)
    # Adding 0.0 turns -0.0 into 0.0.
    return (
        along_ground_m_s2 * math.cos(ground.slope_towards_rad) + 0.0,
        along_ground_m_s2 * math.sin(ground.slope_towards_rad) + 0.0,
        -compute_normal_gravity_m_s2(scene),
    )


def compute_normal_gravity_m_s2(scene: SceneFile) -> float:
    """Return the part of gravity that presses bodies onto the ground, in m/s²."""
    return scene.gravity_m_s2 * math.cos(scene.ground.slope_rad)


def make_route(scene: SceneFile) -> Route | None:
    """Return the scene's route as a curve, or None if the scene has no route.

    Raises:
        ConfigError: The waypoints are not a line.
    """
    match scene.route:
        case None:
            return None
        case SineRoute(amplitude_m=amplitude, wavelength_m=wavelength, length_m=length):
            return Route(sample_sine_curve(amplitude, wavelength, length))
        case WaypointRoute(points_m=points):
            try:
                return Route(np.asarray(points))
            except ValueError as error:
                raise ConfigError(
                    f"scene {scene.name!r}: `route.points_m`: {error}", code="scene/invalid"
                ) from None
