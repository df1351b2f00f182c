"""Reads the shapes of a URDF as points whose convex hull encloses them: box, cylinder, capsule, sphere and mesh."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_operator.features.robots.imported import ReportNotes
from snakesim_operator.features.robots.meshes import find_mesh_file, read_mesh_vertices
from snakesim_operator.features.robots.xml_tree import XmlElement

RIM_POINTS = 32  # of a cylinder


@dataclass(frozen=True)
class UrdfShape:
    """A shape with its sizes, in the file's unit of length."""

    kind: str
    # Box: x, y, z; cylinder and capsule: radius, length; sphere: radius; mesh: its scale.
    sizes: list[float]
    mesh: str = ""  # the name of its file


def read_shape(element: XmlElement) -> UrdfShape:
    """Read the shape in a <geometry> element: a box, cylinder, capsule, sphere or mesh with its sizes.

    Args:
        element: The element.

    Raises:
        ConfigError: The shape is unknown, or a size is zero or negative.
    """
    match element.tag:
        case "box":
            return UrdfShape(
                "box", _require_positive(element, "size", element.read_numbers("size", 3))
            )
        case "cylinder" | "capsule":
            radius = _require_positive(element, "radius", [element.read_number("radius")])
            length = _require_positive(element, "length", [element.read_number("length")])
            return UrdfShape(element.tag, radius + length)
        case "sphere":
            return UrdfShape(
                "sphere", _require_positive(element, "radius", [element.read_number("radius")])
            )
        case "mesh":
            scale = element.read_numbers("scale", 3, "1 1 1")
            if not all(1e-12 < abs(factor) < 1e12 for factor in scale):
                raise element.make_error(
                    f"has `scale` = {element.read_attribute('scale')!r}; expected factors that are not 0"
                )
            return UrdfShape("mesh", scale, element.read_attribute("filename"))
        case _:
            raise element.make_error("is no shape of URDF: box, cylinder, sphere or mesh")


def sample_outline(
    shape: UrdfShape, element: XmlElement, file: Path, omissions: ReportNotes
) -> Floats | None:
    """Sample points whose convex hull encloses a shape.

    Args:
        shape: The shape.
        element: Element of the shape, for the report.
        file: The URDF, from which mesh files are looked for.
        omissions: Report that gets a note if a mesh file cannot be read.

    Returns:
        (n, 3) points in the shape's frame, in the file's unit of length; None for a mesh that cannot be read.
    """
    match shape.kind:
        case "box":
            corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            return corners * np.array(shape.sizes) / 2
        case "cylinder" | "capsule":
            radius, length = shape.sizes
            return _sample_cylinder(radius, length / 2, with_caps=shape.kind == "capsule")
        case "sphere":
            return _sample_sphere(shape.sizes[0])
        case _:
            return _read_mesh_points(shape, element, file, omissions)


def _require_positive(element: XmlElement, attribute: str, sizes: list[float]) -> list[float]:
    """Return the sizes. Raises ConfigError unless all of them are above 0."""
    if not all(0 < size < 1e9 for size in sizes):
        raise element.make_error(
            f"has `{attribute}` = {element.read_attribute(attribute)!r}; expected sizes above 0"
        )
    return sizes


def _compute_circle() -> tuple[Floats, Floats]:
    """Return cosines and sines of RIM_POINTS angles around a circle."""
    angles_rad = np.arange(RIM_POINTS) * 2 * math.pi / RIM_POINTS
    return np.cos(angles_rad), np.sin(angles_rad)


def _sample_cylinder(radius: float, half_length: float, *, with_caps: bool) -> Floats:
    """Return both rims of a cylinder along z; with caps also the tips of a capsule."""
    cosines, sines = _compute_circle()
    upper_rim = np.column_stack(
        [radius * cosines, radius * sines, np.full(RIM_POINTS, half_length)]
    )
    lower_rim = upper_rim * [1, 1, -1]
    if not with_caps:
        return np.vstack([upper_rim, lower_rim])
    tip = half_length + radius
    return np.vstack([upper_rim, lower_rim, [[0, 0, tip], [0, 0, -tip]]])


def _sample_sphere(radius: float) -> Floats:
    """Return three great circles of a sphere."""
    cosines, sines = _compute_circle()
    in_xy = np.column_stack([cosines, sines, np.zeros(RIM_POINTS)])
    in_xz = in_xy[:, [0, 2, 1]]
    in_yz = in_xy[:, [2, 0, 1]]
    return radius * np.vstack([in_xy, in_xz, in_yz])


def _read_mesh_points(
    shape: UrdfShape, element: XmlElement, file: Path, omissions: ReportNotes
) -> Floats | None:
    """Return the vertices of a mesh file, or None, with a note, if it cannot be read."""
    path = find_mesh_file(shape.mesh, file)
    try:
        if path is None:
            raise ConfigError("not on this computer", code="urdf/invalid")
        return read_mesh_vertices(path) * np.array(shape.sizes)
    except ConfigError as error:
        omissions.add(f"line {element.line}: mesh {shorten(shape.mesh)!r} left out: {error}")
        return None
