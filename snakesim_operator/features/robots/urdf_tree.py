"""Reads the links and joints of a URDF as a chain of rigid bodies, from tail to head.

Links that fixed joints connect are one body, with its mass and its outline. Everything is in the frame of the URDF's
root link, with all joints at zero.
"""

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_operator.features.robots.imported import ImportResult
from snakesim_operator.features.robots.shapes import read_shape, sample_outline
from snakesim_operator.features.robots.xml_tree import XmlElement

ROTARY_JOINT_TYPES = ("revolute", "continuous")
MAX_COORDINATE = 1e6  # of an origin, in the file's unit of length
MAX_MASS_KG = 100.0  # of a link; as in snakesim_hal.model.robot_file.links
MAX_INERTIA_KG_M2 = 100.0
MOMENT_ATTRIBUTES = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


@dataclass
class UrdfBody:
    """A rigid body: links that move as one. Lengths are in the file's unit."""

    # The links.
    links: list[str] = field(default_factory=list[str])
    # Name and line of each link in the file, for a report.
    link_places: list[str] = field(default_factory=list[str])
    # root_from_link of each link, (4, 4).
    frames: dict[str, Floats] = field(default_factory=dict[str, Floats])

    # Mass, summed over the links.
    mass_kg: float = 0.0
    # (3,) sum of mass times center of mass.
    first_moment: Floats = field(default_factory=lambda: np.zeros(3))
    # (3, 3) about the root's origin.
    inertia_about_root: Floats = field(default_factory=lambda: np.zeros((3, 3)))
    # The <mass> elements that were summed.
    masses: list[XmlElement] = field(default_factory=list[XmlElement])
    # The <inertia> elements that were summed.
    inertias: list[XmlElement] = field(default_factory=list[XmlElement])

    # Outline.
    points: list[Floats] = field(default_factory=list[Floats])  # of each shape, (n, 3)
    shapes: list[XmlElement] = field(default_factory=list[XmlElement])  # that have these points

    def add_mass(self, mass_kg: float, center: Floats, inertia: Floats) -> None:
        """Add the mass of a link, by the parallel axis theorem: I += J + m (c·c E - c c^T).

        Args:
            mass_kg: Mass m of the link.
            center: (3,) its center of mass c.
            inertia: (3, 3) its inertia J about the center of mass.
        """
        self.mass_kg += mass_kg
        self.first_moment += mass_kg * center
        self.inertia_about_root += inertia + mass_kg * (
            center @ center * np.eye(3) - np.outer(center, center)
        )

    @property
    def center(self) -> Floats:
        """The center of mass, (3,)."""
        return self.first_moment / self.mass_kg

    @property
    def inertia(self) -> Floats:
        """The inertia about the center of mass, (3, 3)."""
        c = self.center
        return self.inertia_about_root - self.mass_kg * (c @ c * np.eye(3) - np.outer(c, c))


@dataclass(frozen=True)
class UrdfJoint:
    """A rotary joint between two neighboring bodies of the chain."""

    element: XmlElement
    name: str
    origin: Floats  # (3,)
    axis: Floats  # (3,), about which the front body turns against the rear one for a positive angle

    def format_place(self, tag: str = "") -> str:
        """Return the place of the joint in the file, for a report.

        Args:
            tag: If the joint has a child of this tag, the line is that of the child.
        """
        place = next((child for child in self.element.children if child.tag == tag), self.element)
        return f"{shorten(self.name)} (line {place.line})"


@dataclass(frozen=True)
class BodyChain:
    """The rigid bodies of a snake from tail to head, and the joints between neighbors."""

    bodies: list[UrdfBody]
    joints: list[UrdfJoint]


@dataclass(frozen=True)
class _JointConnection:
    """A rotary joint of the tree, and the links on both sides of it."""

    parent: str
    child: str
    joint: UrdfJoint


@dataclass
class _LinkTree:
    """The links, as the joints place them from the root link on."""

    frames: dict[str, Floats]  # root_from_link, (4, 4)
    body_of: dict[str, str]  # link -> the first link of its body
    connections: list[_JointConnection] = field(default_factory=list[_JointConnection])


def read_body_chain(
    result: ImportResult, urdf: XmlElement, file: Path, *, tail: str | None
) -> BodyChain:
    """Read the bodies and rotary joints of a URDF, and order them from tail to head.

    Links that fixed joints connect become one body, with the sum of their masses and all their outlines.

    Args:
        result: The result of the import, whose report is extended.
        urdf: The root element of the URDF.
        file: Path of the URDF, from which its mesh files are looked for.
        tail: A link at the tail; None takes the root link.

    Raises:
        ConfigError: The links are no chain, or a value in them is wrong.
    """
    links = _index_elements_by_name(urdf, "link")
    joints = _index_elements_by_name(urdf, "joint")
    tree = _build_tree(result, urdf, links, joints)
    bodies: dict[str, UrdfBody] = {}  # by the name of their first link
    for name, element in links.items():
        root_from_link = tree.frames[name]
        body = bodies.setdefault(tree.body_of[name], UrdfBody())
        body.links.append(name)
        body.link_places.append(element.place)
        body.frames[name] = root_from_link
        _add_mass(result, body, element, root_from_link)
        _add_shapes(result, body, element, root_from_link, file)
    return _order_bodies_from_tail(bodies, tree, tail, urdf)


def _index_elements_by_name(urdf: XmlElement, tag: str) -> dict[str, XmlElement]:
    """Return the elements of a tag by their names. Raises ConfigError for a name that two of them have."""
    elements: dict[str, XmlElement] = {}
    for element in urdf.find_children(tag):
        name = element.read_attribute("name")
        if name in elements:
            raise element.make_error("is there twice; give each a name of its own")
        elements[name] = element
    return elements


def read_origin(owner: XmlElement) -> Floats:
    """Return parent_from_child, (4, 4), of the <origin> of an element; without one it is the identity.

    Raises:
        ConfigError: The <origin> has no finite numbers, or is too far away.
    """
    frame = np.eye(4)
    origin = owner.find_child("origin")
    if origin is None:
        owner.note_absent("<origin>", "0 0 0")
        return frame
    position = origin.read_numbers("xyz", 3, "0 0 0")
    if not all(abs(coordinate) < MAX_COORDINATE for coordinate in position):
        raise origin.make_error(
            f"has `xyz` = {origin.read_attribute('xyz')!r}; expected lengths below {MAX_COORDINATE:g}"
        )
    frame[:3, 3] = position
    frame[:3, :3] = make_rotation_from_rpy(*origin.read_numbers("rpy", 3, "0 0 0"))
    return frame


def make_rotation_from_rpy(roll: float, pitch: float, yaw: float) -> Floats:
    """Return the rotation matrix, (3, 3), of URDF's `rpy`: about the fixed axes x, then y, then z. Angles in rad."""
    cos_roll = math.cos(roll)
    sin_roll = math.sin(roll)
    cos_pitch = math.cos(pitch)
    sin_pitch = math.sin(pitch)
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    about_x = np.array([[1, 0, 0], [0, cos_roll, -sin_roll], [0, sin_roll, cos_roll]])
    about_y = np.array([[cos_pitch, 0, sin_pitch], [0, 1, 0], [-sin_pitch, 0, cos_pitch]])
    about_z = np.array([[cos_yaw, -sin_yaw, 0], [sin_yaw, cos_yaw, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def _build_tree(
    result: ImportResult,
    urdf: XmlElement,
    links: dict[str, XmlElement],
    joints: dict[str, XmlElement],
) -> _LinkTree:
    """Build the tree of links: follow the joints from the root link, and compute the frame of every link.

    Args:
        result: The result of the import, whose report is extended.
        urdf: The root element of the URDF.
        links: <link> elements by name.
        joints: <joint> elements by name.

    Raises:
        ConfigError: The links are no tree, or a joint has a type that no snake has.
    """
    parent_by_child: dict[str, str] = {}  # child link -> parent link
    # Parent link -> child links with their joints.
    joints_by_parent: dict[str, list[tuple[str, XmlElement]]] = {}
    for joint in joints.values():
        parent = _read_joint_link(joint, "parent", links)
        child = _read_joint_link(joint, "child", links)
        if child in parent_by_child:
            raise joint.make_error(
                f"and another joint both have the child {child!r}; a link has one parent"
            )
        parent_by_child[child] = parent
        joints_by_parent.setdefault(parent, []).append((child, joint))

    # From the root link outwards, so that the frame of a parent is known before those of its children.
    root = _find_root(urdf, links, parent_by_child)
    tree = _LinkTree(frames={root: np.eye(4)}, body_of={root: root})
    links_to_visit = [root]
    while links_to_visit:
        parent = links_to_visit.pop()
        children = joints_by_parent.get(parent, [])
        is_only_joint_of_root = parent == root and len(children) == 1
        for child, element in children:
            _add_joint(
                result, tree, element, parent, child, is_only_joint_of_root=is_only_joint_of_root
            )
            links_to_visit.append(child)
    unreached = sorted(links.keys() - tree.frames.keys())
    if unreached:
        raise urdf.make_error(f"has joints in a circle: {', '.join(unreached[:8])}")
    return tree


def _find_root(urdf: XmlElement, links: dict[str, XmlElement], parent_of: dict[str, str]) -> str:
    """Return the only link without a parent. Raises ConfigError when there is none, or several."""
    roots = [name for name in links if name not in parent_of]
    if len(roots) == 1:
        return roots[0]
    names = f": {', '.join(map(shorten, roots[:8]))}" if roots else ""
    raise urdf.make_error(f"needs one link without a parent, and has {len(roots)}{names}")


def _read_joint_link(joint: XmlElement, tag: str, links: dict[str, XmlElement]) -> str:
    """Return the link at one end of a joint. Raises ConfigError for a link that does not exist."""
    end = joint.find_child(tag)
    name = "" if end is None else end.read_attribute("link")
    if name not in links:
        raise joint.make_error(f"has the {tag} {shorten(name)!r}, which is no link of the file")
    return name


def _add_joint(
    result: ImportResult,
    tree: _LinkTree,
    element: XmlElement,
    parent: str,
    child: str,
    *,
    is_only_joint_of_root: bool,
) -> None:
    """Add the child link of a joint with its frame to the tree, and the joint itself if it rotates.

    Links on both sides of a fixed joint become one body.

    Args:
        result: The result of the import, whose report is extended.
        tree: The links and joints so far, which is extended.
        element: The <joint> element.
        parent: Name of the link on the side of the root.
        child: Name of the link on the other side.
        is_only_joint_of_root: Whether no other joint is at the root link, which may then be free to move.

    Raises:
        ConfigError: The joint slides, or has another type that no snake has.
    """
    joint_type = element.read_attribute("type")
    if joint_type in ("floating", "planar") and is_only_joint_of_root:
        name = shorten(element.read_attribute("name"))
        result.omissions.add(
            f"joint {name!r} ({joint_type}) left out: the base is always free to move",
            element.place,
        )
        tree.frames[child] = np.eye(4)
        tree.body_of[child] = tree.body_of[parent]
        return  # its <origin> has not been read, and so is reported
    root_from_joint = tree.frames[parent] @ read_origin(element)
    tree.frames[child] = root_from_joint
    if joint_type in ROTARY_JOINT_TYPES:
        tree.body_of[child] = child
        tree.connections.append(
            _JointConnection(parent, child, _read_joint(result, element, root_from_joint))
        )
    elif joint_type == "fixed":
        tree.body_of[child] = tree.body_of[parent]
        result.changes.add("fixed joints: the links on both sides became one", element.place)
    else:
        raise element.make_error(
            f"has the type {shorten(joint_type)!r}; a snake's joints are revolute, continuous or fixed"
        )


def _read_joint(result: ImportResult, element: XmlElement, frame: Floats) -> UrdfJoint:
    """Read a rotary joint. Raises ConfigError for one that mimics another, and for an axis without direction.

    frame: root_from_joint, (4, 4).
    """
    if element.find_child("mimic") is not None:
        raise element.make_error(
            "mimics another joint; every joint of a snake has a motor of its own: remove <mimic>"
        )
    axis = _read_unit_axis(result, element)
    return UrdfJoint(element, element.read_attribute("name"), frame[:3, 3], frame[:3, :3] @ axis)


def _read_unit_axis(result: ImportResult, joint: XmlElement) -> Floats:
    """Read the axis of a joint in the joint's frame, (3,), and normalize it to length 1.

    Args:
        result: The result of the import, whose report gets a change if the file's vector has another length.
        joint: The <joint> element.

    Raises:
        ConfigError: The vector has no usable direction.
    """
    axis_element = joint.find_child("axis")
    if axis_element is None:
        joint.note_absent("<axis>", "1 0 0")
        return np.array([1.0, 0.0, 0.0])
    axis = np.array(axis_element.read_numbers("xyz", 3, "1 0 0"))
    length = float(np.linalg.norm(axis))
    if not 1e-9 < length < 1e9:
        raise axis_element.make_error(
            f"of joint {joint.read_attribute('name')!r} has `xyz` = {axis_element.read_attribute('xyz')!r} of length "
            f"{length:g}; give a vector of length 1"
        )
    if abs(length - 1.0) > 1e-3:
        result.changes.add(
            f"<axis xyz> {axis_element.read_attribute('xyz')!r} has the length {length:.4g}; only its direction counts",
            f"{shorten(joint.read_attribute('name'))} (line {axis_element.line})",
        )
    return axis / length


def _add_mass(
    result: ImportResult, body: UrdfBody, link: XmlElement, root_from_link: Floats
) -> None:
    """Add mass and inertia of a link to its body, which is all links that fixed joints connect.

    Args:
        result: The result of the import, whose report gets an assumption for a link without mass.
        body: The body, which is changed.
        link: The <link> element.
        root_from_link: Transform from the link's frame to the root's, (4, 4), in the file's unit of length.

    Raises:
        ConfigError: The mass is negative or too large, or a value is missing.
    """
    inertial = link.find_child("inertial")
    if inertial is None:
        result.assumptions.add("<link> without <inertial>: 0 kg", link.place)
        return
    mass = inertial.find_child("mass")
    moments = inertial.find_child("inertia")
    if mass is None or moments is None:
        raise inertial.make_error("needs <mass> and <inertia>")
    body.masses.append(mass)
    body.inertias.append(moments)
    mass_kg = mass.read_number("value")
    if not 0 <= mass_kg <= MAX_MASS_KG:
        raise mass.make_error(
            f"is {mass_kg:g} kg; expected 0 or more and at most {MAX_MASS_KG:g} kg. Is it in grams?"
        )
    xx, xy, xz, yy, yz, zz = (_read_moment(moments, name) for name in MOMENT_ATTRIBUTES)
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    root_from_inertial = root_from_link @ read_origin(inertial)
    rotation_matrix = root_from_inertial[:3, :3]
    center = root_from_inertial[:3, 3]
    body.add_mass(mass_kg, center, rotation_matrix @ inertia @ rotation_matrix.T)


def _read_moment(moments: XmlElement, name: str) -> float:
    """Return a moment of inertia in the file's unit of length. Raises ConfigError for one that is too large."""
    value = moments.read_number(name, "0")
    if abs(value) > 1e15:
        raise moments.make_error(
            f"has `{name}` = {value:g}; expected at most {MAX_INERTIA_KG_M2:g} kg·m²"
        )
    return value


def _add_shapes(
    result: ImportResult, body: UrdfBody, link: XmlElement, root_from_link: Floats, file: Path
) -> None:
    """Add the outline of a link to its body: that of <collision> or, without one, that of <visual>.

    Args:
        result: The result of the import, whose report is extended.
        body: The body, whose points and shapes are extended.
        link: The <link> element.
        root_from_link: Transform from the link's frame to the root's, (4, 4), in the file's unit of length.
        file: Path of the URDF, from which its mesh files are looked for.
    """
    collisions = link.find_children("collision")
    visuals = [child for child in link.children if child.tag == "visual"]
    if collisions:
        _mark_repeated_visuals(visuals, collisions)
    elif visuals:
        link.find_children("visual")  # marks them as read
        result.assumptions.add(
            "<link> without <collision>: its outline is that of <visual>", link.place
        )
    for element in collisions or visuals:
        geometry = element.find_child("geometry")
        if geometry is None or not geometry.children:
            raise element.make_error("has no shape in <geometry>")
        shape = geometry.children[0]
        shape.read = True
        points = sample_outline(read_shape(shape), shape, file, result.omissions)
        root_from_shape = root_from_link @ read_origin(element)
        if points is not None:
            rotation = root_from_shape[:3, :3]
            position = root_from_shape[:3, 3]
            body.points.append(points @ rotation.T + position)
            body.shapes.append(shape)


def _mark_repeated_visuals(visuals: list[XmlElement], collisions: list[XmlElement]) -> None:
    """Mark a <visual> as read where a <collision> repeats it, so that only its other values are reported."""
    for visual in visuals:
        if any(_have_same_shape(visual, collision) for collision in collisions):
            visual.read = True
            for child in visual.children:
                if child.tag in ("origin", "geometry"):
                    child.mark_all_as_read()


def _have_same_shape(visual: XmlElement, collision: XmlElement) -> bool:
    """Return whether both have the same <origin> and <geometry>."""
    for tag in ("origin", "geometry"):
        of_visual = [child for child in visual.children if child.tag == tag]
        of_collision = [child for child in collision.children if child.tag == tag]
        if len(of_visual) != len(of_collision):
            return False
        if not all(a.is_equal_to(b) for a, b in zip(of_visual, of_collision, strict=True)):
            return False
    return True


def _order_bodies_from_tail(
    bodies: dict[str, UrdfBody], tree: _LinkTree, tail: str | None, urdf: XmlElement
) -> BodyChain:
    """Order bodies and joints from tail to head, after a check that they are a chain.

    Args:
        bodies: Bodies by the name of their first link. A body is all links that fixed joints connect.
        tree: The links with the joints that connect them.
        tail: A link of the body at the tail; None takes the body of the root link.
        urdf: The root element of the URDF, for error messages.

    Raises:
        ConfigError: The bodies are no chain, or the tail is not at one of its ends.
    """
    if tail is not None and tail not in tree.body_of:
        raise ConfigError(
            f"--tail {shorten(tail)}: there is no such link; there are {', '.join(list(tree.body_of)[:8])}",
            code="urdf/invalid",
        )
    neighbors = _find_neighbors(bodies, tree)
    bodies_at_forks = [name for name, joints in neighbors.items() if len(joints) > 2]
    if bodies_at_forks:
        raise urdf.make_error(
            f"is no chain: more than two joints meet at link {shorten(bodies_at_forks[0])!r}"
        )
    if len(tree.connections) < 2:
        raise urdf.make_error(
            f"has {len(tree.connections)} joints that turn; a snake has 2 or more"
        )
    tail_body = tree.body_of[tail] if tail is not None else next(iter(tree.body_of))
    end_bodies = [name for name, joints in neighbors.items() if len(joints) == 1]
    if tail_body not in end_bodies:
        choices = " or ".join(f"--tail {shorten(end)}" for end in end_bodies)
        raise urdf.make_error(
            f"has the link {shorten(tail or tail_body)!r} amid the chain; choose which end is the tail: {choices}"
        )
    return _follow_chain(bodies, neighbors, tail_body)


def _follow_chain(
    bodies: dict[str, UrdfBody], neighbors: dict[str, list[tuple[str, UrdfJoint]]], first_body: str
) -> BodyChain:
    """Follow a chain from one of its ends, and return its bodies and joints in this order.

    Args:
        bodies: Bodies by name.
        neighbors: For each body, the names of its one or two neighbors with the joints between them.
        first_body: Name of the body at the end to begin with.
    """
    names = [first_body]
    joints: list[UrdfJoint] = []
    while True:
        visited = names[-2:]
        next_bodies = [(name, joint) for name, joint in neighbors[names[-1]] if name not in visited]
        if not next_bodies:
            return BodyChain([bodies[name] for name in names], joints)
        name, joint = next_bodies[0]
        names.append(name)
        joints.append(joint)


def _find_neighbors(
    bodies: dict[str, UrdfBody], tree: _LinkTree
) -> dict[str, list[tuple[str, UrdfJoint]]]:
    """Return the neighbors of each body, and the joints to them, as if the neighbor were in front of the body.

    A joint whose parent is in front turns the other way round, so its axis is negated.
    """
    neighbors: dict[str, list[tuple[str, UrdfJoint]]] = {name: [] for name in bodies}
    for connection in tree.connections:
        parent = tree.body_of[connection.parent]
        child = tree.body_of[connection.child]
        joint = connection.joint
        reversed_joint = UrdfJoint(joint.element, joint.name, joint.origin, -joint.axis)
        neighbors[parent].append((child, joint))
        neighbors[child].append((parent, reversed_joint))
    return neighbors
