"""URDF -> rigid bodies in a row: links that fixed joints connect are one body, with its mass and its outline.

Everything is in the frame of the URDF's root link, with all joints at zero.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError, short
from snakesim_operator.features.robots.imported import Imported
from snakesim_operator.features.robots.shapes import outline, read_shape
from snakesim_operator.features.robots.xml_tree import Element

TURNING = ("revolute", "continuous")
MAX_PLACE = 1e6  # of an origin, in the file's unit of length
MAX_MASS_KG = 100.0  # of a link; as in snakesim_hal.model.links
MAX_INERTIA_KG_M2 = 100.0
MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass
class Body:
    """Links that move as one."""

    links: list[str] = field(default_factory=list[str])
    places: list[str] = field(default_factory=list[str])  # of these links, for a report
    mass_kg: float = 0.0
    moment: Floats = field(default_factory=lambda: np.zeros(3))  # mass x center
    second: Floats = field(default_factory=lambda: np.zeros((3, 3)))  # inertia about the root's origin
    points: list[Floats] = field(default_factory=list[Floats])  # of the outline, each (n, 3)
    shapes: list[Element] = field(default_factory=list[Element])  # that have these points
    masses: list[Element] = field(default_factory=list[Element])
    inertias: list[Element] = field(default_factory=list[Element])
    frames: dict[str, Floats] = field(default_factory=dict[str, Floats])  # root_from_link of each link, (4, 4)

    def add_mass(self, mass_kg: float, center: Floats, inertia: Floats) -> None:
        """inertia: about the center, (3, 3)."""
        self.mass_kg += mass_kg
        self.moment += mass_kg * center
        self.second += inertia + mass_kg * (center @ center * np.eye(3) - np.outer(center, center))

    @property
    def center(self) -> Floats:
        """Centre of mass."""
        return self.moment / self.mass_kg

    @property
    def inertia(self) -> Floats:
        """About the center of mass, (3, 3)."""
        c = self.center
        return self.second - self.mass_kg * (c @ c * np.eye(3) - np.outer(c, c))


@dataclass(frozen=True)
class Joint:
    """A joint that turns, between bodies `rear` and `front` of the row."""

    element: Element
    name: str
    origin: Floats
    axis: Floats  # about which the front body turns against the rear one, for a positive angle of ours

    def place(self, tag: str = "") -> str:
        """Where it is, for a report; with a tag where its child of that tag is, if it has one."""
        child = next((child for child in self.element.children if child.tag == tag), self.element)
        return f"{short(self.name)} (line {child.line})"


@dataclass(frozen=True)
class Row:
    """Bodies from tail to head, and the joints between them."""

    bodies: list[Body]
    joints: list[Joint]


@dataclass
class _Tree:
    """Links by their joints, from the root on."""

    frames: dict[str, Floats]  # root_from_link, (4, 4)
    body_of: dict[str, str]  # link -> the first link of its body
    movable: list[tuple[str, str, Joint]] = field(default_factory=list[tuple[str, str, Joint]])  # parent, child, joint


def row_of(found: Imported, urdf: Element, file: Path, *, tail: str | None) -> Row:
    """Bodies and joints from the tail on. Raises ConfigError for what is no chain."""
    links = _named(urdf, "link")
    joints = _named(urdf, "joint")
    tree = _walk(found, urdf, links, joints)
    bodies: dict[str, Body] = {}
    for name, element in links.items():
        body = bodies.setdefault(tree.body_of[name], Body())
        body.links.append(name)
        body.places.append(element.place)
        body.frames[name] = tree.frames[name]
        _add_mass(found, body, element, tree.frames[name])
        _add_shapes(found, body, element, tree.frames[name], file)
    return _in_a_row(bodies, tree, tail, urdf)


def _named(urdf: Element, tag: str) -> dict[str, Element]:
    found: dict[str, Element] = {}
    for element in urdf.all(tag):
        if found.setdefault(element.get("name"), element) is not element:
            raise element.wrong("is there twice; give each a name of its own")
    return found


def transform(owner: Element) -> Floats:
    """parent_from_child (4, 4) of its <origin>; none is the identity. Fixed axes: roll about x, pitch, then yaw."""
    placed = np.eye(4)
    origin = owner.first("origin")
    if origin is None:
        owner.note_absent("<origin>", "0 0 0")
        return placed
    place = origin.numbers("xyz", 3, "0 0 0")
    if not all(abs(one) < MAX_PLACE for one in place):
        raise origin.wrong(f"has `xyz` = {origin.get('xyz')!r}; expected lengths below {MAX_PLACE:g}")
    placed[:3, 3] = place
    placed[:3, :3] = rotation(*origin.numbers("rpy", 3, "0 0 0"))
    return placed


def rotation(roll: float, pitch: float, yaw: float) -> Floats:
    """Of URDF's rpy, in rad, (3, 3)."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ about_y @ about_x


def _walk(found: Imported, urdf: Element, links: dict[str, Element], joints: dict[str, Element]) -> _Tree:
    """Follow the joints from the root link to every other link. Raises ConfigError for what is no tree."""
    parent_of: dict[str, str] = {}
    below: dict[str, list[tuple[str, Element]]] = {}
    for joint in joints.values():
        parent = _end_of(joint, "parent", links)
        child = _end_of(joint, "child", links)
        if child in parent_of:
            raise joint.wrong(f"and another joint both have the child {child!r}; a link has one parent")
        parent_of[child] = parent
        below.setdefault(parent, []).append((child, joint))
    roots = [name for name in links if name not in parent_of]
    if len(roots) != 1:
        named = f": {', '.join(map(short, roots[:8]))}" if roots else ""
        raise urdf.wrong(f"needs one link without a parent, and has {len(roots)}{named}")
    root = roots[0]
    tree = _Tree(frames={root: np.eye(4)}, body_of={root: root})
    waiting = [root]
    while waiting:
        parent = waiting.pop()
        for child, element in below.get(parent, []):
            alone_at_root = parent == root and len(below[parent]) == 1
            _add_joint(found, tree, element, parent, child, alone_at_root=alone_at_root)
            waiting.append(child)
    if len(tree.frames) != len(links):
        circle = sorted(links.keys() - tree.frames.keys())
        raise urdf.wrong(f"has joints in a circle: {', '.join(circle[:8])}")
    return tree


def _end_of(joint: Element, tag: str, links: dict[str, Element]) -> str:
    """The link at one end of a joint."""
    end = joint.first(tag)
    name = "" if end is None else end.get("link")
    if name not in links:
        raise joint.wrong(f"has the {tag} {short(name)!r}, which is no link of the file")
    return name


def _add_joint(found: Imported, tree: _Tree, element: Element, parent: str, child: str, *, alone_at_root: bool) -> None:
    """Place the link behind a joint, and keep the joint if it turns. Raises ConfigError for one that slides."""
    kind = element.get("type")
    if kind in ("floating", "planar") and alone_at_root:
        found.omissions.add(
            f"joint {short(element.get('name'))!r} ({kind}) left out: the base is always free to move", element.place
        )
        tree.frames[child] = np.eye(4)
        tree.body_of[child] = tree.body_of[parent]
        return  # its <origin> has not been read, and so is reported
    frame = tree.frames[parent] @ transform(element)
    tree.frames[child] = frame
    if kind in TURNING:
        tree.body_of[child] = child
        tree.movable.append((parent, child, _joint(found, element, frame)))
    elif kind == "fixed":
        tree.body_of[child] = tree.body_of[parent]
        found.changes.add("fixed joints: the links on both sides became one", element.place)
    else:
        raise element.wrong(f"has the type {short(kind)!r}; a snake's joints are revolute, continuous or fixed")


def _joint(found: Imported, element: Element, frame: Floats) -> Joint:
    if element.first("mimic") is not None:
        raise element.wrong("mimics another joint; every joint of a snake has a motor of its own: remove <mimic>")
    axis_element = element.first("axis")
    if axis_element is None:
        element.note_absent("<axis>", "1 0 0")
        axis = np.array([1.0, 0.0, 0.0])
    else:
        axis = np.array(axis_element.numbers("xyz", 3, "1 0 0"))
        length = float(np.linalg.norm(axis))
        if not 1e-9 < length < 1e9:
            raise axis_element.wrong(
                f"of joint {element.get('name')!r} has `xyz` = {axis_element.get('xyz')!r} of length {length:g}; give "
                f"a vector of length 1"
            )
        if abs(length - 1.0) > 1e-3:
            found.changes.add(
                f"<axis xyz> {axis_element.get('xyz')!r} has the length {length:.4g}; only its direction counts",
                f"{short(element.get('name'))} (line {axis_element.line})",
            )
        axis = axis / length
    return Joint(element, element.get("name"), frame[:3, 3], frame[:3, :3] @ axis)


def _add_mass(found: Imported, body: Body, link: Element, frame: Floats) -> None:
    """Add mass and inertia of a link to its body. Raises ConfigError for a mass that is negative or too large."""
    inertial = link.first("inertial")
    if inertial is None:
        found.assumptions.add("<link> without <inertial>: 0 kg", link.place)
        return
    mass = inertial.first("mass")
    moments = inertial.first("inertia")
    if mass is None or moments is None:
        raise inertial.wrong("needs <mass> and <inertia>")
    body.masses.append(mass)
    body.inertias.append(moments)
    mass_kg = mass.number("value")
    if not 0 <= mass_kg <= MAX_MASS_KG:
        raise mass.wrong(f"is {mass_kg:g} kg; expected 0 or more and at most {MAX_MASS_KG:g} kg. Is it in grams?")
    xx, xy, xz, yy, yz, zz = (_read_moment(moments, name) for name in MOMENTS)
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    placed = frame @ transform(inertial)
    body.add_mass(mass_kg, placed[:3, 3], placed[:3, :3] @ inertia @ placed[:3, :3].T)


def _read_moment(moments: Element, name: str) -> float:
    """A moment of inertia as in the file, in its unit of length."""
    value = moments.number(name, "0")
    if abs(value) > 1e15:
        raise moments.wrong(f"has `{name}` = {value:g}; expected at most {MAX_INERTIA_KG_M2:g} kg·m²")
    return value


def _add_shapes(found: Imported, body: Body, link: Element, frame: Floats, file: Path) -> None:
    """Add the outline of a link to its body: of <collision>, or else of <visual>."""
    collisions = link.all("collision")
    looks = [child for child in link.children if child.tag == "visual"]
    if collisions:
        _mark_repeated(looks, collisions)
    elif looks:
        link.all("visual")
        found.assumptions.add("<link> without <collision>: its outline is that of <visual>", link.place)
    for element in collisions or looks:
        geometry = element.first("geometry")
        if geometry is None or not geometry.children:
            raise element.wrong("has no shape in <geometry>")
        shape = geometry.children[0]
        shape.read = True
        points = outline(read_shape(shape), shape, file, found.omissions)
        placed = frame @ transform(element)
        if points is not None:
            body.points.append(points @ placed[:3, :3].T + placed[:3, 3])
            body.shapes.append(shape)


def _mark_repeated(looks: list[Element], collisions: list[Element]) -> None:
    """Mark a <visual> as read where a <collision> says the same, so that only what it says besides is reported."""
    for look in looks:
        if any(_has_the_shape_of(look, collision) for collision in collisions):
            look.read = True
            for child in look.children:
                if child.tag in ("origin", "geometry"):
                    child.read_all()


def _has_the_shape_of(look: Element, collision: Element) -> bool:
    for tag in ("origin", "geometry"):
        mine = [child for child in look.children if child.tag == tag]
        theirs = [child for child in collision.children if child.tag == tag]
        if len(mine) != len(theirs):
            return False
        if not all(a.says_the_same_as(b) for a, b in zip(mine, theirs, strict=True)):
            return False
    return True


def _in_a_row(bodies: dict[str, Body], tree: _Tree, tail: str | None, urdf: Element) -> Row:
    """Order the bodies from the tail on. A joint whose parent is in front turns the other way round."""
    body_of, movable = tree.body_of, tree.movable
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
