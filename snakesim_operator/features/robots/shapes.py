"""Shapes of a URDF as points whose hull holds them: box, cylinder, capsule, sphere and mesh."""

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError, short
from snakesim_operator.features.robots.imported import Notes
from snakesim_operator.features.robots.meshes import find_mesh, vertices
from snakesim_operator.features.robots.xml_tree import Element

RIM = 32  # points of a cylinder's rim


@dataclass(frozen=True)
class Shape:
    """A shape with its sizes, in the file's unit of length."""

    kind: str
    sizes: list[float]  # box: x, y, z; cylinder and capsule: radius, length; sphere: radius; mesh: its scale
    mesh: str = ""  # the name of its file


def read_shape(element: Element) -> Shape:
    """Read a shape. Raises ConfigError for an unknown one, and for a size that is zero or negative."""
    match element.tag:
        case "box":
            return Shape("box", _positive(element, "size", element.numbers("size", 3)))
        case "cylinder" | "capsule":
            radius = _positive(element, "radius", [element.number("radius")])
            length = _positive(element, "length", [element.number("length")])
            return Shape(element.tag, radius + length)
        case "sphere":
            return Shape("sphere", _positive(element, "radius", [element.number("radius")]))
        case "mesh":
            scale = element.numbers("scale", 3, "1 1 1")
            if not all(1e-12 < abs(one) < 1e12 for one in scale):
                raise element.wrong(f"has `scale` = {element.get('scale')!r}; expected factors that are not 0")
            return Shape("mesh", scale, element.get("filename"))
        case _:
            raise element.wrong("is no shape of URDF: box, cylinder, sphere or mesh")


def outline(shape: Shape, element: Element, file: Path, omissions: Notes) -> Floats | None:
    """Points whose hull holds a shape, in its frame, (n, 3); None for a mesh that cannot be read, which is reported."""
    match shape.kind:
        case "box":
            corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            return corners * np.array(shape.sizes) / 2
        case "cylinder" | "capsule":
            radius, length = shape.sizes
            return _tube(radius, length / 2, with_caps=shape.kind == "capsule")
        case "sphere":
            return _ball(shape.sizes[0])
        case _:
            return _mesh(shape, element, file, omissions)


def _positive(element: Element, attribute: str, sizes: list[float]) -> list[float]:
    if not all(0 < size < 1e9 for size in sizes):
        raise element.wrong(f"has `{attribute}` = {element.get(attribute)!r}; expected sizes above 0")
    return sizes


def _tube(radius: float, half: float, *, with_caps: bool) -> Floats:
    turn = np.arange(RIM) * 2 * math.pi / RIM
    rim = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.full(RIM, half)])
    tips = [[0, 0, half + radius], [0, 0, -half - radius]] if with_caps else np.empty((0, 3))
    return np.vstack([rim, rim * [1, 1, -1], tips])


def _ball(radius: float) -> Floats:
    turn = np.arange(RIM) * 2 * math.pi / RIM
    ring = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(RIM)])
    return radius * np.vstack([ring, ring[:, [0, 2, 1]], ring[:, [2, 0, 1]]])


def _mesh(shape: Shape, element: Element, file: Path, omissions: Notes) -> Floats | None:
    path = find_mesh(shape.mesh, file)
    try:
        if path is None:
            raise ConfigError("not on this computer")
        return vertices(path) * np.array(shape.sizes)
    except ConfigError as error:
        omissions.add(f"line {element.line}: mesh {short(shape.mesh)!r} left out: {error}")
        return None
