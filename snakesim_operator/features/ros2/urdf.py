"""URDF of a robot from its description on the network: links as capsules, joints with axes and limits.

It is what RViz draws and what planners read. The robot file, which knows meshes, sensors, inertia and friction, may be
on another machine; a comment in the document says what is missing.
"""

import math
from xml.etree import ElementTree

from snakesim_hal.wire.messages import Description, JointDescription, LinkDescription

AXES = {"yaw": "0 0 1", "pitch": "0 1 0"}
LOSSES = (
    " The description on the network has neither inertia nor friction: each link has the inertia of a solid cylinder, "
    "and no joint has dynamics. `snakesim robot export` writes both, from the robot file. "
)


def urdf_of(robot: Description, prefix: str = "") -> str:
    """The document. prefix: before the names of links, as in the frames."""
    root = ElementTree.Element("robot", name=robot.robot)
    root.append(ElementTree.Comment(LOSSES))
    ElementTree.SubElement(root, "link", name=f"{prefix}base_link")
    _joint(root, "base", "fixed", f"{prefix}base_link", prefix + robot.links[0].name, 0.0)
    for link in robot.links:
        _link(root, link, prefix)
    for behind, joint, ahead in zip(robot.links[:-1], robot.joints, robot.links[1:], strict=True):
        made = _joint(root, joint.name, "revolute", prefix + behind.name, prefix + ahead.name, behind.length_m)
        _limits(made, joint)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)


def _link(root: ElementTree.Element, link: LinkDescription, prefix: str) -> None:
    """A link with the inertia of a solid cylinder, drawn and collided with as a capsule."""
    made = ElementTree.SubElement(root, "link", name=prefix + link.name)
    middle, along_x = f"{link.length_m / 2:.9g} 0 0", f"0 {math.pi / 2:.9g} 0"
    inertial = ElementTree.SubElement(made, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=middle)
    ElementTree.SubElement(inertial, "mass", value=f"{link.mass_kg:.9g}")
    about_x = f"{link.mass_kg * link.radius_m**2 / 2:.9g}"
    across = f"{link.mass_kg * (3 * link.radius_m**2 + link.length_m**2) / 12:.9g}"
    ElementTree.SubElement(inertial, "inertia", ixx=about_x, iyy=across, izz=across, ixy="0", ixz="0", iyz="0")
    for use in ("visual", "collision"):
        for at, turned, shape, size in (
            (middle, along_x, "cylinder", {"length": f"{link.length_m:.9g}"}),
            ("0 0 0", "0 0 0", "sphere", {}),
            (f"{link.length_m:.9g} 0 0", "0 0 0", "sphere", {}),
        ):
            part = ElementTree.SubElement(made, use)
            ElementTree.SubElement(part, "origin", xyz=at, rpy=turned)
            geometry = ElementTree.SubElement(part, "geometry")
            ElementTree.SubElement(geometry, shape, {"radius": f"{link.radius_m:.9g}", **size})


def _joint(
    root: ElementTree.Element, name: str, kind: str, parent: str, child: str, at_m: float
) -> ElementTree.Element:
    made = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(made, "parent", link=parent)
    ElementTree.SubElement(made, "child", link=child)
    ElementTree.SubElement(made, "origin", xyz=f"{at_m:.9g} 0 0")
    return made


def _limits(made: ElementTree.Element, joint: JointDescription) -> None:
    ElementTree.SubElement(made, "axis", xyz=AXES[joint.axis])
    ElementTree.SubElement(
        made,
        "limit",
        lower=f"{joint.angle_min_rad:.9g}",
        upper=f"{joint.angle_max_rad:.9g}",
        velocity=f"{joint.speed_limit_rad_s:.9g}",
        effort=f"{joint.torque_limit_nm:.9g}",
    )
