"""One link of a robot file's `[[links]]`: for a robot that is no row of equal modules."""

from typing import Annotated

import numpy as np

from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import above, bounded

Offset = Annotated[float, bounded(-10, 10, "m")]
Moment = Annotated[float, bounded(-100, 100, "kg·m²")]
Inertia = tuple[Moment, Moment, Moment, Moment, Moment, Moment]


class Link(FileStruct, frozen=True, kw_only=True):
    """A rigid link: from the joint at its rear to the next one, along x; of the tail and the head, to their ends.

    Its outline is a capsule of that length and of the modules' radius.
    """

    length_m: Annotated[float, above(2, "m")]
    mass_kg: Annotated[float, above(100, "kg")]
    center_m: tuple[Offset, Offset, Offset] | None = None  # center of mass, in the link's frame; none: the middle
    inertia_kg_m2: Inertia | None = None  # ixx, iyy, izz, ixy, ixz, iyz about it; none: a solid capsule's

    def __post_init__(self) -> None:
        """An inertia must be that of a body. Raises ValueError, which the file reader explains."""
        if self.inertia_kg_m2 is None:
            return
        least, middle, most = principal_moments(self.inertia_kg_m2)
        if least <= 0 or least + middle < most * (1 - 1e-6):
            raise ValueError(
                f"`inertia_kg_m2` has the principal moments {least:.3g}, {middle:.3g} and {most:.3g} kg·m², and no "
                f"body does: each must be above 0, and at most the sum of the other two"
            )

    @property
    def has_inertia(self) -> bool:
        """Whether mass is distributed otherwise than in the capsule."""
        return self.center_m is not None or self.inertia_kg_m2 is not None

    @property
    def center(self) -> tuple[float, float, float]:
        """Centre of mass, in the link's frame, in m."""
        return (self.length_m / 2, 0.0, 0.0) if self.center_m is None else self.center_m

    def inertia(self, radius_m: float) -> tuple[float, ...]:
        """About the center of mass, along the link's axes: ixx, iyy, izz, ixy, ixz, iyz in kg·m². radius_m: of it."""
        if self.inertia_kg_m2 is not None:
            return self.inertia_kg_m2
        return capsule_inertia(self.length_m, radius_m, self.mass_kg)


def principal_moments(inertia: tuple[float, ...]) -> tuple[float, float, float]:
    """Of ixx, iyy, izz, ixy, ixz, iyz, in ascending order, in kg·m²."""
    xx, yy, zz, xy, xz, yz = inertia
    least, middle, most = np.linalg.eigvalsh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])).tolist()
    return least, middle, most


def capsule_inertia(length_m: float, radius_m: float, mass_kg: float) -> tuple[float, ...]:
    """Of a solid capsule along x, `length_m` without its caps: ixx, iyy, izz, ixy, ixz, iyz in kg·m²."""
    tube, ball = length_m, 4 * radius_m / 3  # in volumes of a cross-section
    tube_kg, ball_kg = mass_kg * tube / (tube + ball), mass_kg * ball / (tube + ball)
    about = (tube_kg / 2 + ball_kg * 2 / 5) * radius_m**2
    # A hemisphere's center is 3/8 of the radius from its flat side.
    across = tube_kg * (radius_m**2 / 4 + length_m**2 / 12)
    across += ball_kg * (2 * radius_m**2 / 5 + length_m**2 / 4 + 3 * length_m * radius_m / 8)
    return about, across, across, 0.0, 0.0, 0.0
