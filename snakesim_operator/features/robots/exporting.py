"""Exports a robot file as URDF, for RViz, Gazebo and others. `snakesim robot import` reads it back without a loss.

Links are `link_0` (tail, the root) to the head, joints `joint_1` on. A capsule is written as a cylinder and two
spheres, since URDF has none. What URDF has no words for follows in <snakesim> elements, which other readers skip.
"""

import json
import math
from collections.abc import Iterator
from typing import Any
from xml.sax.saxutils import quoteattr

import msgspec

from snakesim_hal.model.robot_file.links import Link
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.robots.urdf_sensors import format_gazebo_elements

# Which links, joints and the robot's own name contain.
GEOMETRY_SECTIONS = "name", "chain", "module", "links"
AXIS_XYZ = {"yaw": "0 0 1", "pitch": "0 1 0"}
COLOR = "0.87 0.45 0.12 1"
MATERIAL_ELEMENT = f'<material name="orange"><color rgba="{COLOR}"/></material>'


def format_urdf(robot: RobotFile) -> str:
    """Return the text of the URDF of a robot."""
    lines = ['<?xml version="1.0"?>', f"<robot name={quoteattr(robot.name)}>"]
    lines.append(f"  {MATERIAL_ELEMENT}")
    links = robot.links or [
        Link(length_m=length, mass_kg=mass)
        for length, mass in zip(robot.link_lengths_m, robot.link_masses_kg, strict=True)
    ]
    for i, link in enumerate(links):
        if i > 0:
            lines += _format_joint(robot, i, links[i - 1].length_m)
        lines += _format_link(i, link, robot.module.radius_m)
    lines += format_gazebo_elements(robot)
    for key, value in list_values_beside_urdf(robot).items():
        lines.append(
            f"  <snakesim key={quoteattr(key)} value={quoteattr(json.dumps(value, ensure_ascii=False))}/>"
        )
    return "\n".join([*lines, "</robot>", ""])


def list_values_beside_urdf(robot: RobotFile) -> dict[str, Any]:
    """Return the values that URDF cannot express, or that not all readers of URDF take, by dotted key."""
    rest = {
        key: value
        for key, value in msgspec.to_builtins(robot).items()
        if key not in GEOMETRY_SECTIONS
    }
    return dict(_flatten_values(rest))


def _flatten_values(values: dict[str, Any], within: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value with its dotted key; a list is one value."""
    for key, value in values.items():
        if isinstance(value, dict):
            yield from _flatten_values(value, f"{within}{key}.")
        else:
            yield f"{within}{key}", value


def _format_joint(robot: RobotFile, number: int, from_rear_m: float) -> list[str]:
    """Format a URDF <joint> element. `from_rear_m` is the length of the link behind the joint."""
    joint = robot.joint_table[number - 1]
    limits = joint.limits
    motor = joint.motor
    return [
        f'  <joint name="joint_{number}" type="revolute">',
        f'    <parent link="link_{number - 1}"/>',
        f'    <child link="link_{number}"/>',
        f'    <origin xyz="{from_rear_m!r} 0 0" rpy="0 0 0"/>',
        f'    <axis xyz="{AXIS_XYZ[joint.axis]}"/>',
        f'    <limit lower="{limits.lower_rad!r}" upper="{limits.upper_rad!r}" effort="{limits.torque_nm!r}" '
        f'velocity="{limits.speed_rad_s!r}"/>',
        f'    <dynamics damping="{motor.viscous_nm_s_per_rad!r}" friction="{motor.friction_nm!r}"/>',
        "  </joint>",
    ]


def _format_link(number: int, link: Link, radius_m: float) -> list[str]:
    """Format a URDF <link> element. URDF has no capsule, so a capsule is written as a cylinder and two spheres.

    Args:
        number: Number of the link, 0 at the tail.
        link: Length, mass, center of mass and inertia.
        radius_m: Radius of the capsule.
    """
    center = " ".join(map(repr, link.center))
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    moments = " ".join(
        f'{name}="{value!r}"' for name, value in zip(names, link.inertia(radius_m), strict=True)
    )
    lines = [
        f'  <link name="link_{number}">',
        "    <inertial>",
        f'      <origin xyz="{center}" rpy="0 0 0"/>',
        f'      <mass value="{link.mass_kg!r}"/>',
        f"      <inertia {moments}/>",
        "    </inertial>",
    ]
    lines += _format_shapes("visual", link.length_m, radius_m, ['      <material name="orange"/>'])
    lines += _format_shapes("collision", link.length_m, radius_m, [])
    return [*lines, "  </link>"]


def _format_shapes(
    tag: str, length_m: float, radius_m: float, additional_lines: list[str]
) -> list[str]:
    """Format three elements, <visual> or <collision>, that together are a capsule along x.

    Args:
        tag: "visual" or "collision".
        length_m: Length of the capsule without its caps.
        radius_m: Radius of the capsule.
        additional_lines: Further lines of XML in each element.
    """
    cylinder = f'<cylinder radius="{radius_m!r}" length="{length_m!r}"/>'
    sphere = f'<sphere radius="{radius_m!r}"/>'
    along_x_rad = math.pi / 2  # pitch of a cylinder, whose axis is z in URDF
    shapes = [
        (length_m / 2, along_x_rad, cylinder),
        (0.0, 0.0, sphere),
        (length_m, 0.0, sphere),
    ]
    lines: list[str] = []
    for x_m, pitch_rad, shape in shapes:
        lines += [
            f"    <{tag}>",
            f'      <origin xyz="{x_m!r} 0.0 0.0" rpy="0 {pitch_rad!r} 0"/>',
            f"      <geometry>{shape}</geometry>",
            *additional_lines,
            f"    </{tag}>",
        ]
    return lines
