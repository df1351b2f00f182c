"""Makes the URDF of a robot from its description on the network: links as capsules, joints with axes and limits.

RViz draws the robot from it, and planners read it. The robot file, which knows meshes, sensors, inertia and friction,
may be on another computer; a comment in the document lists what is missing.
"""

import math
from xml.etree import ElementTree

from snakesim_hal.wire.messages import JointDescription, LinkDescription, RobotDescription

AXIS_XYZ = {"yaw": "0 0 1", "pitch": "0 1 0"}
MISSING_DATA_COMMENT = (
    " The description on the network has neither inertia nor friction: each link has the inertia of a solid cylinder, "
    "and no joint has dynamics. `snakesim robot export` writes both, from the robot file. "
)


def make_urdf(robot: RobotDescription, prefix: str = "") -> str:
    """Return a URDF document with the links and joints of a robot, for viewers in ROS.

    Args:
        robot: Description of the robot, with one link more than joints.
        prefix: Text before the names of links, the same as in the frames.
    """
    root = ElementTree.Element("robot", name=robot.robot)
    root.append(ElementTree.Comment(MISSING_DATA_COMMENT))
    base_link = f"{prefix}base_link"
    ElementTree.SubElement(root, "link", name=base_link)
    _add_joint(root, "base", "fixed", base_link, prefix + robot.links[0].name, 0.0)
    for link in robot.links:
        _add_link(root, link, prefix)
    rear_links = robot.links[:-1]
    front_links = robot.links[1:]
    for rear, joint, front in zip(rear_links, robot.joints, front_links, strict=True):
        element = _add_joint(
            root, joint.name, "revolute", prefix + rear.name, prefix + front.name, rear.length_m
        )
        _add_limits(element, joint)
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode", xml_declaration=True)


def _add_link(root: ElementTree.Element, link: LinkDescription, prefix: str) -> None:
    """Add a link with the inertia of a solid cylinder; a capsule is its shape for drawing and collisions."""
    element = ElementTree.SubElement(root, "link", name=prefix + link.name)
    _add_inertia(element, link)
    middle_xyz = f"{link.length_m / 2:.9g} 0 0"
    front_end_xyz = f"{link.length_m:.9g} 0 0"
    z_to_x_rpy = f"0 {math.pi / 2:.9g} 0"  # a cylinder of URDF stands along z
    unrotated_rpy = "0 0 0"
    length = f"{link.length_m:.9g}"
    radius = f"{link.radius_m:.9g}"
    for element_name in ("visual", "collision"):
        _add_shape(
            element,
            element_name,
            middle_xyz,
            z_to_x_rpy,
            "cylinder",
            {"radius": radius, "length": length},
        )
        _add_shape(element, element_name, "0 0 0", unrotated_rpy, "sphere", {"radius": radius})
        _add_shape(
            element, element_name, front_end_xyz, unrotated_rpy, "sphere", {"radius": radius}
        )


def _add_inertia(element: ElementTree.Element, link: LinkDescription) -> None:
    """Add the mass and inertia of a solid cylinder along x.

    I_xx = m r^2 / 2 and I_yy = I_zz = m (3 r^2 + l^2) / 12.
    """
    axial = f"{link.mass_kg * link.radius_m**2 / 2:.9g}"
    lateral = f"{link.mass_kg * (3 * link.radius_m**2 + link.length_m**2) / 12:.9g}"
    inertial = ElementTree.SubElement(element, "inertial")
    ElementTree.SubElement(inertial, "origin", xyz=f"{link.length_m / 2:.9g} 0 0")
    ElementTree.SubElement(inertial, "mass", value=f"{link.mass_kg:.9g}")
    ElementTree.SubElement(
        inertial, "inertia", ixx=axial, iyy=lateral, izz=lateral, ixy="0", ixz="0", iyz="0"
    )


def _add_shape(
    element: ElementTree.Element,
    use: str,
    xyz: str,
    rpy: str,
    shape: str,
    attributes: dict[str, str],
) -> None:
    """Add one shape to a link. `use` is `visual` or `collision`."""
    part = ElementTree.SubElement(element, use)
    ElementTree.SubElement(part, "origin", xyz=xyz, rpy=rpy)
    geometry = ElementTree.SubElement(part, "geometry")
    ElementTree.SubElement(geometry, shape, attributes)


def _add_joint(
    root: ElementTree.Element, name: str, kind: str, parent: str, child: str, offset_m: float
) -> ElementTree.Element:
    """Add a joint at a distance along x of its parent link, and return its element."""
    element = ElementTree.SubElement(root, "joint", name=name, type=kind)
    ElementTree.SubElement(element, "parent", link=parent)
    ElementTree.SubElement(element, "child", link=child)
    ElementTree.SubElement(element, "origin", xyz=f"{offset_m:.9g} 0 0")
    return element


def _add_limits(element: ElementTree.Element, joint: JointDescription) -> None:
    """Add a joint's axis, and its limits of angle, speed and torque."""
    ElementTree.SubElement(element, "axis", xyz=AXIS_XYZ[joint.axis])
    ElementTree.SubElement(
        element,
        "limit",
        lower=f"{joint.angle_min_rad:.9g}",
        upper=f"{joint.angle_max_rad:.9g}",
        velocity=f"{joint.speed_limit_rad_s:.9g}",
        effort=f"{joint.torque_limit_nm:.9g}",
    )
