"""What obstacles of every shape may be made of, and whether they lean, spring back or slide when they are pushed."""

from typing import Annotated, Any

from msgspec import Meta

from snakesim_hal.model.geometry.outlines import Friction, Heading, Point
from snakesim_hal.model.scene_file.friction import Surface
from snakesim_hal.wire.messages import KnownObstacle

GRAVITY_M_S2 = 9.81  # as in MuJoCo, unless the scene says otherwise
# Plastic shell against plastic or metal: 0.13 to 0.32 in tables, see docs/how-to/scenes.md.
PEG_FRICTION = 0.2
BASE_FRICTION = 0.4  # an obstacle on the ground on which it slides
MAX_LEAN_RAD = 0.6


class SolidObstacle(Surface, frozen=True, kw_only=True):
    """An obstacle that the snake can push against. By default it is rigid, and fixed to the ground."""

    friction: Friction = PEG_FRICTION
    """Coulomb friction between the obstacle and the snake."""

    stiffness_n_per_m: (
        Annotated[float, Meta(ge=10, le=1e6, extra_json_schema={"unit": "N/m"})] | None
    ) = None
    """Stiffness of the spring that holds the obstacle at its position, or where it has slid to. None: it is rigid."""

    mass_kg: Annotated[float, Meta(ge=0.01, le=1000, extra_json_schema={"unit": "kg"})] | None = (
        None
    )
    """Mass of an obstacle that slides on the ground when it is pushed. None: it is fixed to the ground."""

    base_friction: Friction = BASE_FRICTION
    """Coulomb friction between the obstacle and the ground on which it slides."""

    @property
    def can_move(self) -> bool:
        """Return whether the obstacle moves when it is pushed."""
        return self.stiffness_n_per_m is not None or self.mass_kg is not None

    def compute_sliding_force_n(self, normal_gravity_m_s2: float = GRAVITY_M_S2) -> float | None:
        """Return the smallest force that moves the obstacle along the ground; None if it is fixed.

        On a slope, the weight of the obstacle is a part of that force.

        Args:
            normal_gravity_m_s2: Part of gravity that presses the obstacle onto the ground.
        """
        if self.mass_kg is None:
            return None
        return self.base_friction * normal_gravity_m_s2 * self.mass_kg


class UprightSolid(SolidObstacle, frozen=True, kw_only=True):
    """A solid with an axis, which may lean about the middle of its foot."""

    lean_rad: Annotated[float, Meta(ge=0, le=MAX_LEAN_RAD, extra_json_schema={"unit": "rad"})] = 0.0
    """Angle by which its axis leans from the vertical, about the middle of its foot."""

    lean_towards_rad: Heading = 0.0
    """Direction in which its top leans, seen from above. 0: along x."""


def get_material_fields(solid: SolidObstacle) -> dict[str, Any]:
    """Return the fields of `SolidObstacle`, and those of `UprightSolid` if it is upright, without those of a shape."""
    struct = UprightSolid if isinstance(solid, UprightSolid) else SolidObstacle
    return {name: getattr(solid, name) for name in struct.__struct_fields__}


def make_peg(name: str, position_m: Point, radius_m: float, height_m: float) -> KnownObstacle:
    """Return an upright cylinder that stands on the ground.

    Args:
        name: Name of the obstacle.
        position_m: Center of the cylinder on the ground, as (x, y).
        radius_m: Radius of the cylinder.
        height_m: Height of the cylinder.
    """
    x, y = position_m
    return KnownObstacle(
        name=name,
        shape="cylinder",
        position_w=(float(x), float(y), height_m / 2),
        radius_m=radius_m,
        height_m=height_m,
    )


def make_block(
    name: str, position_m: Point, size_m: tuple[float, float, float], yaw_rad: float
) -> KnownObstacle:
    """Return a box that stands on the ground.

    Args:
        name: Name of the obstacle.
        position_m: Center of the box on the ground, as (x, y).
        size_m: Length, width and height of the box.
        yaw_rad: Rotation about the vertical. 0 if the length is along x.
    """
    length_m, width_m, height_m = size_m
    return KnownObstacle(
        name=name,
        shape="box",
        position_w=(*position_m, height_m / 2),
        yaw_rad=yaw_rad,
        half_size_m=(length_m / 2, width_m / 2, height_m / 2),
        height_m=height_m,
    )
