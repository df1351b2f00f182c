"""What obstacles of every shape may be made of, and whether they lean, spring back or slide when they are pushed."""

from typing import Annotated, Any

from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.outlines import Friction, Heading, Point
from snakesim_hal.wire.messages import Obstacle

GRAVITY_M_S2 = 9.81  # as in MuJoCo, unless configured otherwise
PEG_FRICTION = 0.2  # of a plastic shell against plastic or metal: 0.13 to 0.32 in tables, see docs/scenes.md
BASE_FRICTION = 0.4
MOST_LEAN_RAD = 0.6


class Solid(FileStruct, frozen=True, kw_only=True):
    """An obstacle that the snake can push against. By default it is rigid, and fixed to the ground."""

    friction: Friction = PEG_FRICTION  # between it and the snake
    # Of a spring that holds it where it stands, or where it has slid to; null: rigid.
    stiffness_n_per_m: Annotated[float, Meta(ge=10, le=1e6, extra_json_schema={"unit": "N/m"})] | None = None
    mass_kg: Annotated[float, Meta(ge=0.01, le=1000, extra_json_schema={"unit": "kg"})] | None = None  # null: fixed
    base_friction: Friction = BASE_FRICTION  # of one with a mass, on the ground, where it slides

    @property
    def yields(self) -> bool:
        """Whether it moves when it is pushed."""
        return self.stiffness_n_per_m is not None or self.mass_kg is not None

    @property
    def slides_at_n(self) -> float | None:
        """The least push that moves it along the ground; None: it is fixed."""
        return None if self.mass_kg is None else self.base_friction * GRAVITY_M_S2 * self.mass_kg


class Upright(Solid, frozen=True, kw_only=True):
    """A solid with an axis, which may lean about the middle of its foot."""

    lean_rad: Annotated[float, Meta(ge=0, le=MOST_LEAN_RAD, extra_json_schema={"unit": "rad"})] = 0.0
    lean_towards_rad: Heading = 0.0  # to where its top leans, seen from above; 0: along x


def made_of(solid: Solid) -> dict[str, Any]:
    """The fields that any obstacle has, of one with more: of an upright one also how it leans."""
    kind = Upright if isinstance(solid, Upright) else Solid
    return {name: getattr(solid, name) for name in kind.__struct_fields__}


def peg(name: str, position: Point, radius: float, height: float) -> Obstacle:
    """An upright cylinder on the ground, in m."""
    center = (float(position[0]), float(position[1]), height / 2)
    return Obstacle(name=name, shape="cylinder", position_w=center, radius_m=radius, height_m=height)


def block(name: str, position: Point, size: tuple[float, float, float], yaw: float) -> Obstacle:
    """A box on the ground, in m, turned by so many rad."""
    return Obstacle(
        name=name,
        shape="box",
        position_w=(*position, size[2] / 2),
        yaw_rad=yaw,
        half_size_m=(size[0] / 2, size[1] / 2, size[2] / 2),
        height_m=size[2],
    )
