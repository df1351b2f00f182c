"""Friction that depends on the direction of sliding: scales, skins and passive wheels of a robot, and their surfaces.

A link that slides along its axis may rub less than one that slides sideways. The coefficients of a link on a surface
are products of a value of the surface, from `compute_surface_friction`, and a factor of the link, from
`compute_link_factors`.

Source: D. L. Hu, J. Nirody, T. Scott and M. J. Shelley, "The mechanics of slithering locomotion", PNAS 106, 2009.
"""

from collections.abc import Sequence
from typing import Annotated, NamedTuple

from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.model.geometry.outlines import Friction
from snakesim_hal.wire.quantities import MAX_JOINTS, above, from_zero

Coefficient = Annotated[float, above(5, "1 (Coulomb coefficient)")]
ViscousCoefficient = Annotated[float, from_zero(10, "s/m")]


class DirectionalFriction(NamedTuple):
    """Coulomb coefficients of a link that slides forward, backward or sideways, or factors on them."""

    forward: float
    backward: float
    sideways: float


SAME_IN_ALL_DIRECTIONS = DirectionalFriction(1.0, 1.0, 1.0)


class Surface(FileStruct, frozen=True, kw_only=True):
    """A surface on which links with scales or a skin slide more easily in some directions than in others."""

    forward_friction: Friction | None = None
    """Coulomb friction of a link that slides forward along its axis on this surface; none: `friction`, scaled by the
    robot's [skin].
    """

    backward_friction: Friction | None = None
    """Coulomb friction of a link that slides backward along its axis on this surface; none: `friction`, scaled by the
    robot's [skin].
    """


class ViscousFriction(FileStruct, frozen=True, kw_only=True):
    """Viscous friction of the ground, in addition to dry friction.

    The force on a link is its normal force times coefficient times speed, separately along the link and across it.
    """

    along_s_per_m: ViscousCoefficient
    """Coefficient for speed along the link; divided by the normal force, so a speed of 1 m/s acts like this coefficient
    of dry friction.
    """

    across_s_per_m: ViscousCoefficient
    """Coefficient for speed across the link, likewise."""


class LinkSkin(FileStruct, frozen=True, kw_only=True):
    """Coefficients of one link that differ from those of [skin]."""

    forward: Coefficient | None = None
    """Coefficient of this link when it slides forward; none: that of [skin]."""

    backward: Coefficient | None = None
    """Coefficient of this link when it slides backward; none: that of [skin]."""

    sideways: Coefficient | None = None
    """Coefficient of this link when it slides sideways; none: that of [skin]."""


class Skin(FileStruct, frozen=True, kw_only=True):
    """Scales or a skin on the underside of the links, as measured on one surface.

    Only ratios to `sideways` matter: on a surface with the coefficient `friction`, a link that slides forward rubs with
    `friction` * `forward` / `sideways`.
    """

    forward: Coefficient
    """Coulomb friction when a link slides forward along its axis, on the surface of the measurement."""

    backward: Coefficient
    """Coulomb friction when a link slides backward along its axis, on the same surface."""

    sideways: Coefficient
    """Coulomb friction when a link slides across its axis, on the same surface."""

    links: Annotated[dict[str, LinkSkin], Meta(max_length=MAX_JOINTS + 1)] = {}
    """Coefficients that differ in single links, as sections such as `[skin.links.link_3]`; link_0 is the tail."""


class PassiveWheels(FileStruct, frozen=True, kw_only=True):
    """Passive wheels under every link, which roll along it. They are modeled as friction that depends on direction.

    A link that moves along its axis is braked by the bearings and by the rolling resistance, one that moves sideways
    by the tires. The wheels have no mass of their own.
    """

    radius_m: Annotated[float, above(1, "m")]
    """Radius of a wheel."""

    bearing_radius_m: Annotated[float, above(1, "m")]
    """Radius at which a bearing rubs: half the mean diameter of a ball bearing, or the radius of an axle."""

    bearing_friction: Annotated[float, above(5, "1 (Coulomb coefficient)")]
    """Coulomb friction of a bearing: about 0.0015 for ball bearings, and 0.1 to 0.2 for plain ones."""

    rolling_resistance: Annotated[float, from_zero(1, "1 (Coulomb coefficient)")] = 0.0
    """Resistance of the tires to rolling, divided by the load."""

    tire_friction: Friction | None = None
    """Coulomb friction of the tires when they slide sideways; none: the `friction` of the surface."""

    separate_limits: bool = False
    """True: rolling does not reduce the friction of the tires sideways, as of wheels that really turn. False: wheels
    slide by the law of scales.
    """

    def __post_init__(self) -> None:
        """Check that the bearing fits into the wheel. Raises ValueError, which the file reader explains."""
        if self.bearing_radius_m >= self.radius_m:
            raise ValueError(
                f"`bearing_radius_m` = {self.bearing_radius_m:g} m must be below the wheel's `radius_m` = "
                f"{self.radius_m:g} m"
            )

    @property
    def rolling_friction(self) -> float:
        """Return the force that brakes a rolling link, divided by its load."""
        return (
            self.bearing_friction * self.bearing_radius_m / self.radius_m + self.rolling_resistance
        )


def compute_surface_friction(
    friction: float, surface: Surface | None, skin: Skin | None, wheels: PassiveWheels | None
) -> DirectionalFriction:
    """Compute the friction coefficients between a surface and the underside of a link without exceptions.

    Args:
        friction: Coulomb coefficient of the surface.
        surface: Coefficients of the surface along a link, which have precedence over the skin. None if it has none.
        skin: Skin of the robot. None if the robot has no skin.
        wheels: Wheels of the robot. None if the robot has no wheels. Wheels whose rolling resistance is higher than
            their sliding friction slide instead.
    """
    if wheels is not None:
        sideways = friction if wheels.tire_friction is None else wheels.tire_friction
        rolling = min(wheels.rolling_friction, sideways)
        return DirectionalFriction(rolling, rolling, sideways)
    forward = friction
    backward = friction
    if skin is not None:
        forward = friction * (skin.forward / skin.sideways)
        backward = friction * (skin.backward / skin.sideways)
    if surface is not None and surface.forward_friction is not None:
        forward = surface.forward_friction
    if surface is not None and surface.backward_friction is not None:
        backward = surface.backward_friction
    return DirectionalFriction(forward, backward, friction)


def compute_link_factors(skin: Skin | None, link_count: int) -> list[DirectionalFriction]:
    """Return the factors of every link on the coefficients of a surface, tail to head."""
    factors = [SAME_IN_ALL_DIRECTIONS] * link_count
    if skin is None:
        return factors
    for name, link in skin.links.items():
        factors[_parse_link_index(name)] = DirectionalFriction(
            _compute_friction_ratio(link.forward, skin.forward),
            _compute_friction_ratio(link.backward, skin.backward),
            _compute_friction_ratio(link.sideways, skin.sideways),
        )
    return factors


def validate_skin(
    skin: Skin | None, wheels: PassiveWheels | None, link_names: Sequence[str]
) -> None:
    """Raise ValueError if a skin has exceptions for a link that does not exist, or a robot has a skin and wheels."""
    if skin is None:
        return
    if wheels is not None:
        raise ValueError(
            "it has [skin] and [wheels], and both describe how links slide; leave one out"
        )
    for name in skin.links:
        if name not in link_names:
            raise ValueError(
                f"[skin.links.{name}]: this robot has {link_names[0]} (tail) to {link_names[-1]} (head)"
            )


def _parse_link_index(name: str) -> int:
    """Return the number of a link that is called `link_0` or onwards."""
    return int(name.removeprefix("link_"))


def _compute_friction_ratio(of_link: float | None, of_all: float) -> float:
    """Return the factor of a link; 1 if it has no coefficient of its own."""
    if of_link is None:
        return 1.0
    return of_link / of_all
