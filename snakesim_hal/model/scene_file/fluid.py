"""The section `[fluid]` of a scene file: the fluid in which the snake swims."""

from typing import Annotated

from msgspec import Meta

from snakesim_hal.model.files import FileStruct
from snakesim_hal.wire.quantities import from_zero

FluidCoefficient = Annotated[float, from_zero(10, "1")]


class Fluid(FileStruct, frozen=True, kw_only=True):
    """A fluid at rest everywhere above the ground, as MuJoCo models it: each link is an ellipsoid.

    Source: MuJoCo's documentation, Computation, Fluid forces, Ellipsoid model.
    """

    density_kg_m3: Annotated[float, from_zero(2000, "kg/m³")]
    """Density: 1000 for water, 1.2 for air."""

    viscosity_pa_s: Annotated[float, from_zero(100, "Pa·s")] = 0.0
    """Dynamic viscosity: 0.001 for water, 1.4 for glycerol."""

    buoyancy: Annotated[float, Meta(ge=0, le=1, extra_json_schema={"unit": "1"})] = 1.0
    """Fraction of the weight of every link that the fluid carries. 1: the robot neither sinks nor rises."""

    blunt_drag: FluidCoefficient = 0.5
    """Coefficient of drag for the area that a link turns against the flow."""

    slender_drag: FluidCoefficient = 0.25
    """Coefficient of drag for the rest of the largest area of a link."""

    angular_drag: FluidCoefficient = 1.5
    """Coefficient of drag against rotation."""

    kutta_lift: FluidCoefficient = 1.0
    """Coefficient of the lift on a link that is oblique to the flow."""

    magnus_lift: FluidCoefficient = 1.0
    """Coefficient of the lift on a link that rotates in the flow."""
