"""Sections of a scene file for ground that is neither flat nor hilly: pipes, stairs, and platforms with gaps.

Stairs and platforms are made of the same blocks as `[[step]]`. Pipes are bodies of their own.
"""

from typing import Annotated

from msgspec import Meta

from snakesim_hal.model.geometry.outlines import Coordinate, Friction, Heading, Point, Size
from snakesim_hal.model.scene_file.friction import Surface
from snakesim_hal.wire.quantities import Name, above

MAX_PLATFORMS = 200  # of one flight of stairs, or one row
PlatformHeight = Annotated[float, above(2, "m")]


class Pipe(Surface, frozen=True, kw_only=True):
    """A horizontal pipe. The snake crawls inside of a hollow one, and on the outside of any."""

    position_m: Point
    """Middle of the pipe in the world frame, as [x, y]."""

    length_m: Size
    """Length of the pipe. That of a solid pipe includes its round ends."""

    radius_m: Size
    """Radius of the outside."""

    inner_radius_m: Size | None = None
    """Radius of the inside, less than `radius_m`. None: the pipe is solid."""

    open_top: bool = False
    """Whether a hollow pipe has only its lower half."""

    axis_height_m: Coordinate | None = None
    """Height of the axis above the ground. None: that of `radius_m`, so that the pipe lies on the ground. A solid pipe
    may be partly or wholly below.
    """

    yaw_rad: Heading = 0.0
    """Direction of the axis. 0: along x."""

    friction: Friction = 0.5
    """Coulomb friction between the pipe and the snake."""

    name: Name | None = None
    """Name, which no other pipe or obstacle has. None: `pipe_` with its number in the file."""

    def find_axis_height_m(self) -> float:
        """Return the height of the axis above the ground."""
        if self.axis_height_m is None:
            return self.radius_m
        return self.axis_height_m


class Stairs(Surface, frozen=True, kw_only=True):
    """A straight flight of steps that ends on a landing. It goes up in the direction of `yaw_rad`."""

    position_m: Point
    """Middle of the front edge of the lowest step in the world frame, as [x, y]."""

    count: Annotated[int, Meta(ge=1, le=MAX_PLATFORMS)]
    """Number of steps, with the landing."""

    rise_m: PlatformHeight
    """Height of every step above the one before. The landing is at most 2 m high."""

    run_m: Size
    """Depth of every tread, from one edge to the next."""

    width_m: Size
    """Width of the stairs."""

    landing_m: Size = 2.0
    """Depth of the landing, which is the highest step."""

    yaw_rad: Heading = 0.0
    """Direction in which the stairs go up. 0: along x."""

    friction: Friction = 0.5
    """Coulomb friction between the stairs and the snake."""

    name: Name | None = None
    """Beginning of the names of the steps, which end with their numbers. None: `stairs_` with its number in the file.
    """


class Gaps(Surface, frozen=True, kw_only=True):
    """A row of platforms of equal height with gaps between them."""

    position_m: Point
    """Middle of the near edge of the first platform in the world frame, as [x, y]."""

    count: Annotated[int, Meta(ge=1, le=MAX_PLATFORMS - 1)]
    """Number of gaps. There is one more platform."""

    gap_m: Size
    """Distance from one platform to the next."""

    depth_m: PlatformHeight
    """Depth of the gaps, which is the height of the platforms above the ground."""

    platform_m: Size
    """Length of every platform, along the row."""

    width_m: Size
    """Width of the platforms."""

    yaw_rad: Heading = 0.0
    """Direction of the row. 0: along x."""

    friction: Friction = 0.5
    """Coulomb friction between the platforms and the snake."""

    name: Name | None = None
    """Beginning of the names of the platforms, which end with their numbers. None: `gaps_` with its number in the file.
    """
