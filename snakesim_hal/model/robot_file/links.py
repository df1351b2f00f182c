"""One link of a robot file's `[[links]]`: for a robot that is no row of equal modules."""

from typing import Annotated

import numpy as np

from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import above, bounded

Offset = Annotated[float, bounded(-10, 10, "m")]
Moment = Annotated[float, bounded(-100, 100, "kg·m²")]
# Relative; a thin plate has moments of which one is exactly the sum of the other two.
ROUNDING_TOLERANCE = 1e-6
Inertia = tuple[Moment, Moment, Moment, Moment, Moment, Moment]


class Link(FileStruct, frozen=True, kw_only=True):
    """A rigid link. It extends along x from the joint at its rear to the next joint. Tail and head, to their ends.

    Its outline is a capsule of that length and of the modules' radius.
    """

    length_m: Annotated[float, above(2, "m")]
    """Length of the link along its x axis, without the caps of the capsule."""

    mass_kg: Annotated[float, above(100, "kg")]
    """Mass of the link."""

    center_m: tuple[Offset, Offset, Offset] | None = None
    """Center of mass in the link's frame, from the joint at its rear. None: the middle of the link."""

    inertia_kg_m2: Inertia | None = None
    """Moments of inertia ixx, iyy, izz, ixy, ixz, iyz about the center of mass, along the link's axes. None: those of a
    solid capsule.
    """

    def __post_init__(self) -> None:
        """Check that a rigid body can have this inertia. Raises ValueError, which the file reader explains."""
        if self.inertia_kg_m2 is None:
            return
        smallest, middle, largest = compute_principal_moments(self.inertia_kg_m2)
        if smallest <= 0 or smallest + middle < largest * (1 - ROUNDING_TOLERANCE):
            raise ValueError(
                f"`inertia_kg_m2` has the principal moments {smallest:.3g}, {middle:.3g} and {largest:.3g} kg·m², and "
                f"no body does: each must be above 0, and at most the sum of the other two"
            )

    @property
    def has_inertia(self) -> bool:
        """Return whether the file gives a mass distribution that differs from that of a solid capsule."""
        return self.center_m is not None or self.inertia_kg_m2 is not None

    @property
    def center(self) -> tuple[float, float, float]:
        """Return the center of mass in the link's frame, in m."""
        if self.center_m is None:
            return (self.length_m / 2, 0.0, 0.0)
        return self.center_m

    def inertia(self, radius_m: float) -> tuple[float, ...]:
        """Return ixx, iyy, izz, ixy, ixz, iyz about the center of mass, along the link's axes, in kg·m².

        Args:
            radius_m: radius of the link, for the inertia of a capsule.
        """
        if self.inertia_kg_m2 is not None:
            return self.inertia_kg_m2
        return compute_capsule_inertia(self.length_m, radius_m, self.mass_kg)


def compute_principal_moments(inertia: tuple[float, ...]) -> tuple[float, float, float]:
    """Return the principal moments of ixx, iyy, izz, ixy, ixz, iyz, in ascending order, in kg·m²."""
    xx, yy, zz, xy, xz, yz = inertia
    matrix = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    smallest, middle, largest = np.linalg.eigvalsh(matrix).tolist()
    return smallest, middle, largest


def compute_capsule_inertia(length_m: float, radius_m: float, mass_kg: float) -> tuple[float, ...]:
    """Compute the inertia of a solid capsule along x about its center: ixx, iyy, izz, ixy, ixz, iyz in kg·m².

    A capsule is a tube (a solid cylinder) with a hemisphere at each end; both have the same density. With the radius r,
    the tube's length l and mass m_t, and the mass m_b of both hemispheres:

        ixx = (m_t / 2 + 2/5 m_b) r²
        iyy = izz = m_t (r² / 4 + l² / 12) + m_b (2/5 r² + l² / 4 + 3/8 l r)

    The center of a hemisphere is 3/8 of the radius from its flat side.

    Args:
        length_m: Length of the tube, without the hemispheres.
        radius_m: Radius of the tube and the hemispheres.
        mass_kg: Mass of the whole capsule.
    """
    # Volumes of the tube and of both hemispheres, divided by the area of the cross-section.
    tube_volume_m = length_m
    ball_volume_m = 4 * radius_m / 3
    tube_mass_kg = mass_kg * tube_volume_m / (tube_volume_m + ball_volume_m)
    ball_mass_kg = mass_kg * ball_volume_m / (tube_volume_m + ball_volume_m)
    ixx = (tube_mass_kg / 2 + ball_mass_kg * 2 / 5) * radius_m**2
    iyy = tube_mass_kg * (radius_m**2 / 4 + length_m**2 / 12)
    iyy += ball_mass_kg * (2 * radius_m**2 / 5 + length_m**2 / 4 + 3 * length_m * radius_m / 8)
    izz = iyy
    return ixx, iyy, izz, 0.0, 0.0, 0.0
