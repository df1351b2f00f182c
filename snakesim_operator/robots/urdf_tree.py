"""URDF -> rigid bodies in a row: links that fixed joints connect are one body, with its mass and its outline.

Everything is in the frame of the URDF's root link, with all joints at zero.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from snakesim_hal.arrays import Floats
from snakesim_hal.errors import ConfigError, short
from snakesim_operator.robots.meshes import find_mesh, vertices
from snakesim_operator.robots.xml_tree import Element

Warn = Callable[[str], None]
TURNING = ("revolute", "continuous")
RIM = 32  # points of a cylinder's rim


@dataclass
class Body:
    """Links that move as one."""

    links: list[str] = field(default_factory=list[str])
    mass_kg: float = 0.0
    moment: Floats = field(default_factory=lambda: np.zeros(3))  # mass x centre
    second: Floats = field(default_factory=lambda: np.zeros((3, 3)))  # inertia about the root's origin
    points: list[Floats] = field(default_factory=list[Floats])  # of the outline, each (n, 3)
    frames: dict[str, Floats] = field(default_factory=dict[str, Floats])  # root_from_link of each link, (4, 4)

    def add_mass(self, mass_kg: float, center: Floats, inertia: Floats) -> None:
        """inertia: about the centre, (3, 3)."""
        self.mass_kg += mass_kg
        self.moment += mass_kg * center
        self.second += inertia + mass_kg * (center @ center * np.eye(3) - np.outer(center, center))

    @property
    def center(self) -> Floats:
        """Centre of mass."""
        return self.moment / self.mass_kg

    @property
    def inertia(self) -> Floats:
        """About the centre of mass, (3, 3)."""
        c = self.center
        return self.second - self.mass_kg * (c @ c * np.eye(3) - np.outer(c, c))


@dataclass(frozen=True)
class Joint:
    """A joint that turns, between bodies `rear` and `front` of the row."""

    element: Element
    name: str
    origin: Floats
    axis: Floats  # about which the front body turns against the rear one, for a positive angle of ours


@dataclass(frozen=True)
class Row:
    """Bodies from tail to head, and the joints between them."""

    bodies: list[Body]
    joints: list[Joint]


def row_of(urdf: Element, file: Path, *, tail: str | None, warn: Warn) -> Row:
    """The bodies of a URDF, tail to head. tail: a link of the first one; None: the root link. Raises ConfigError."""
    links = _named(urdf, "link")
    joints = _named(urdf, "joint")
    frames, movable, body_of = _walk(urdf, links, joints, warn)
    bodies: dict[str, Body] = {}
    for name, element in links.items():
        body = bodies.setdefault(body_of[name], Body())
        body.links.append(name)
        body.frames[name] = frames[name]
        _add_link(body, element, frames[name], file, warn)
    return _in_a_row(bodies, movable, body_of, tail, urdf)


def _named(urdf: Element, tag: str) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in urdf.all(tag):
        if found.setdefault(element.get("name"), element) is not element:
            raise element.wrong("is there twice; give each a name of its own")
    return found


def transform(element: Element | None) -> Floats:
    """parent_from_child (4, 4) of an <origin>; none is the identity. Fixed axes: roll about x, pitch, then yaw."""
    placed = np.eye(4)
    if element is not None:
        placed[:3, 3] = element.numbers("xyz", 3, "0 0 0")
        placed[:3, :3] = rotation(*element.numbers("rpy", 3, "0 0 0"))
    return placed


def rotation(roll: float, pitch: float, yaw: float) -> Floats:
    """Of URDF's rpy, in rad, (3, 3)."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ about_y @ about_x


def _walk(urdf: Element, links: dict[str, Element], joints: dict[str, Element], warn: Warn):
    """Frames of all links, the joints that turn as (parent, child, joint), and the first link of each link's body."""
    below: dict[str, list[tuple[str, Element]]] = {}
    parents: dict[str, Element] = {}
    for joint in joints.values():
        ends: list[str] = []
        for tag in ("parent", "child"):
            end = joint.first(tag)
            name = "" if end is None else end.get("link")
            if name not in links:
                raise joint.wrong(f"has the {tag} {short(name)!r}, which is no link of the file")
            ends.append(name)
        if ends[1] in parents:
            raise joint.wrong(f"and another joint both have the child {ends[1]!r}; a link has one parent")
        parents[ends[1]] = joint
        below.setdefault(ends[0], []).append((ends[1], joint))
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        found = f": {', '.join(map(short, roots[:8]))}" if roots else ""
        raise urdf.wrong(f"needs one link without a parent, and has {len(roots)}{found}")
    frames, body_of, movable = {roots[0]: np.eye(4)}, {roots[0]: roots[0]}, list[tuple[str, str, Joint]]()
    waiting = [roots[0]]
    while waiting:
        parent = waiting.pop()
        for child, element in below.get(parent, []):
            frames[child] = frames[parent] @ transform(element.first("origin"))
            kind = element.get("type")
            body_of[child] = child
            if kind in TURNING:
                movable.append((parent, child, _joint(element, frames[child])))
            elif kind == "fixed":
                body_of[child] = body_of[parent]
                element.first("axis")
            elif kind in ("floating", "planar") and parent == roots[0] and not below[parent][1:]:
                warn(f"joint {short(element.get('name'))!r} ({kind}) left out: the base is always free to move")
                frames[child] = np.eye(4)
                body_of[child] = body_of[parent]
            else:
                raise element.wrong(f"has the type {short(kind)!r}; a snake's joints are revolute, continuous or fixed")
            waiting.append(child)
    if len(frames) != len(links):
        raise urdf.wrong(f"has joints in a circle: {', '.join(sorted(links.keys() - frames.keys())[:8])}")
    return frames, movable, body_of


def _joint(element: Element, frame: Floats) -> Joint:
    if element.first("mimic") is not None:
        raise element.wrong("mimics another joint; every joint of a snake has a motor of its own: remove <mimic>")
    axis_element = element.first("axis")
    axis = np.array([1.0, 0.0, 0.0] if axis_element is None else axis_element.numbers("xyz", 3))
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise element.wrong("has an axis of length 0")
    return Joint(element, element.get("name"), frame[:3, 3], frame[:3, :3] @ axis / length)


def _add_link(body: Body, link: Element, frame: Floats, file: Path, warn: Warn) -> None:
    inertial = link.first("inertial")
    if inertial is not None:
        mass, moments = inertial.first("mass"), inertial.first("inertia")
        if mass is None or moments is None:
            raise inertial.wrong("needs <mass> and <inertia>")
        placed = frame @ transform(inertial.first("origin"))
        xx, xy, xz, yy, yz, zz = (moments.number(name, "0") for name in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz"))
        inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        if (mass_kg := mass.number("value")) < 0:
            raise mass.wrong(f"is {mass_kg:g} kg; it cannot be negative")
        body.add_mass(mass_kg, placed[:3, 3], placed[:3, :3] @ inertia @ placed[:3, :3].T)
    for element in link.all("collision") or link.all("visual"):
        element.get("name", "")
        geometry = element.first("geometry")
        if geometry is None or not geometry.children:
            raise element.wrong("has no shape in <geometry>")
        points = _outline(geometry.children[0], file, warn)
        placed = frame @ transform(element.first("origin"))
        if points is not None:
            body.points.append(points @ placed[:3, :3].T + placed[:3, 3])


def _outline(shape: Element, file: Path, warn: Warn) -> Floats | None:
    """Points whose hull holds a shape, in its frame, (n, 3)."""
    shape.read = True
    match shape.tag:
        case "box":
            half = np.array(shape.numbers("size", 3)) / 2
            return np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
        case "cylinder" | "capsule":
            turn = np.arange(RIM) * 2 * math.pi / RIM
            r, half_m = shape.number("radius"), shape.number("length") / 2
            rim = np.column_stack([r * np.cos(turn), r * np.sin(turn), np.full(RIM, half_m)])
            tips = [[0, 0, half_m + r], [0, 0, -half_m - r]] if shape.tag == "capsule" else np.empty((0, 3))
            return np.vstack([rim, rim * [1, 1, -1], tips])
        case "sphere":
            turn = np.arange(RIM) * 2 * math.pi / RIM
            ring = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(RIM)])
            return shape.number("radius") * np.vstack([ring, ring[:, [0, 2, 1]], ring[:, [2, 0, 1]]])
        case "mesh":
            name, scale = shape.get("filename"), np.array(shape.numbers("scale", 3, "1 1 1"))
            path = find_mesh(name, file)
            try:
                if path is None:
                    raise ConfigError("not on this computer")
                found = vertices(path) * scale
            except ConfigError as error:
                warn(f"line {shape.line}: mesh {short(name)!r} left out: {error}")
                return None
            return found
        case _:
            raise shape.wrong("is no shape of URDF: box, cylinder, sphere or mesh")


def _in_a_row(
    bodies: dict[str, Body],
    movable: list[tuple[str, str, Joint]],
    body_of: dict[str, str],
    tail: str | None,
    urdf: Element,
) -> Row:
    """Order the bodies from the tail on. A joint whose parent is in front turns the other way round."""
    if tail is not None and tail not in body_of:
        raise ConfigError(f"--tail {short(tail)}: there is no such link; there are {', '.join(list(body_of)[:8])}")
    near: dict[str, list[tuple[str, Joint]]] = {name: [] for name in bodies}
    for parent, child, joint in movable:
        near[body_of[parent]].append((body_of[child], joint))
        turned = Joint(joint.element, joint.name, joint.origin, -joint.axis)
        near[body_of[child]].append((body_of[parent], turned))
    forks = [name for name, joints in near.items() if len(joints) > 2]
    if forks:
        raise urdf.wrong(f"is no chain: more than two joints meet at link {short(forks[0])!r}")
    ends = [name for name, joints in near.items() if len(joints) == 1]
    if len(movable) < 2:
        raise urdf.wrong(f"has {len(movable)} joints that turn; a snake has 2 or more")
    first = body_of[tail] if tail is not None else next(iter(body_of))
    if first not in ends:
        choices = " or ".join(f"--tail {short(end)}" for end in ends)
        raise urdf.wrong(f"has the link {short(tail or first)!r} amid the chain; say which end is the tail: {choices}")
    order, joints = [first], list[Joint]()
    while ahead := [(name, joint) for name, joint in near[order[-1]] if name not in order[-2:]]:
        order.append(ahead[0][0])
        joints.append(ahead[0][1])
    return Row([bodies[name] for name in order], joints)
