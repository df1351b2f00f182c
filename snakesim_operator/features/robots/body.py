"""Converts the bodies of a URDF into the chain, module and links of a robot file.

In the robot file's body frame the line through the joints is x, from tail to head, and the direction `up` is z.
"""

import math
from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import ConfigTable
from snakesim_hal.model.robot_file.links import compute_capsule_inertia
from snakesim_operator.features.robots.imported import (
    VECTOR_BY_UP_AXIS,
    ImportOptions,
    ImportResult,
)
from snakesim_operator.features.robots.urdf_tree import BodyChain, UrdfBody, UrdfJoint
from snakesim_operator.features.robots.xml_tree import XmlElement

# Lengths are rounded to a nanometer, which removes the noise of adding transforms.
LENGTH_DIGITS = 9
VALUE_DIGITS = 10  # significant digits of masses and inertias
# Of a joint from the line of all joints, relative to the mean distance between joints.
MAX_OFFSET_RATIO = 0.05
MIN_AXIS_COSINE = math.cos(math.radians(1.0))  # a joint's axis may be tilted by 1 degree
MIN_REPORTED_TILT_RAD = 1e-5  # of an axis; less is the rounding of the file
MIN_REPORTED_OFFSET_M = 1e-6  # of a joint; less is the rounding of the file
# Radius of a link without geometry, relative to the mean distance between joints.
ASSUMED_RADIUS_RATIO = 0.35
MIN_LENGTH_M = 0.001
MAX_JOINT_DISTANCE_M = 2
MIN_MASS_KG = 0.001
MOMENT_INDICES = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # ixx, iyy, izz, ixy, ixz, iyz


def convert_body(
    result: ImportResult, chain: BodyChain, options: ImportOptions, urdf: XmlElement
) -> list[Floats]:
    """Convert the bodies of a URDF into chain, module and links of a robot file.

    Args:
        result: Result of the import, whose values and report are extended.
        chain: Bodies and joints of the URDF, tail to head.
        options: Options of the import, with the axis that points up and the unit of length.
        urdf: The root element of the URDF.

    Returns:
        For every link, tail to head, its transform link_from_root, (4, 4) with lengths in m.

    Raises:
        ConfigError: The joints are not on a line, or turn about another axis than y or z.
    """
    body_from_root = _find_body_axes(chain, options, urdf)
    scale = options.scale
    if scale != 1.0:
        result.changes.add(
            f"--scale {scale:g}: lengths times {scale:g}, inertias times {scale**2:g}; masses in kg, effort, damping "
            f"and friction in N·m stay as they are"
        )

    # Joints, in the body frame.
    positions_b = np.array([body_from_root @ joint.origin for joint in chain.joints]) * scale
    # Y and z of the line are those of the first joint.
    line_b = np.array([0.0, *positions_b[0][1:]])
    on_line = positions_b - line_b
    joints_x = on_line[:, 0]
    joint_distance_m = float(np.mean(np.diff(joints_x)))
    _validate_joint_distance(chain, joints_x, joint_distance_m, urdf)
    axis_names = [
        _classify_joint_axis(result, joint, body_from_root @ joint.axis) for joint in chain.joints
    ]
    for joint, axis, offset_m in zip(chain.joints, axis_names, on_line, strict=True):
        _validate_joint_on_line(result, joint, axis, offset_m, joint_distance_m)

    # Outlines, from which the capsules follow.
    outlines = [_transform_outline(body, body_from_root, line_b, scale) for body in chain.bodies]
    radius_m = _choose_common_radius(outlines, joint_distance_m, result)
    _report_shapes(result, chain, radius_m, scale)
    lengths = _measure_link_lengths(joints_x, outlines, radius_m, result, chain)

    # Links.
    starts_x = [joints_x[0] - lengths[0], *joints_x]
    link_frames = [
        _make_link_frame(body_from_root, np.array([x, *positions_b[0][1:]])) for x in starts_x
    ]
    links: list[dict[str, Any]] = []
    for i, body in enumerate(chain.bodies):
        links.append(_convert_link(result, i, body, link_frames[i], lengths[i], radius_m, scale))
    _set_links(result.table, links, axis_names, radius_m, urdf.source)
    _report_renamed_parts(result, chain, axis_names, body_from_root)
    return link_frames


def _find_body_axes(chain: BodyChain, options: ImportOptions, urdf: XmlElement) -> Floats:
    """Return body_from_root, (3, 3): x from tail to head, z up. Raises ConfigError."""
    along = chain.joints[-1].origin - chain.joints[0].origin
    if np.linalg.norm(along) < 1e-9:
        raise urdf.make_error(
            "has its first and last joint at the same place, so that the chain has no direction"
        )
    x = along / np.linalg.norm(along)
    up = np.array(VECTOR_BY_UP_AXIS[options.up], dtype=np.float64)
    z = up - (up @ x) * x
    if np.linalg.norm(z) < 0.1:
        others = [
            name
            for name in VECTOR_BY_UP_AXIS
            if abs(np.array(VECTOR_BY_UP_AXIS[name]) @ x) < 0.9 and "-" not in name
        ]
        raise urdf.make_error(
            f"lies along its {options.up} axis: choose which one points up: --up {' or --up '.join(others)}"
        )
    z /= np.linalg.norm(z)
    return np.vstack([x, np.cross(z, x), z])


def _validate_joint_distance(
    chain: BodyChain, joints_x: Floats, gap_m: float, urdf: XmlElement
) -> None:
    """Raise ConfigError when the joints are so far apart that the unit of length must be wrong."""
    if gap_m <= MAX_JOINT_DISTANCE_M:
        return
    widest = chain.joints[1 + int(np.argmax(np.diff(joints_x)))]
    raise urdf.make_error(
        f"has joints {gap_m:g} m apart, and a link has {MAX_JOINT_DISTANCE_M} m at most; in mm? Give --scale 0.001. "
        f"The widest gap is before joint {widest.format_place()}"
    )


def _report_renamed_parts(
    result: ImportResult, chain: BodyChain, axes: list[str], body_from_root: Floats
) -> None:
    """Report the new names of links and joints, and keep which joints turn the other way round."""
    for i, body in enumerate(chain.bodies):
        if body.links != [f"link_{i}"]:
            result.names.append(f"link_{i}: {', '.join(body.link_places)}")
    for i, (joint, axis) in enumerate(zip(chain.joints, axes, strict=True)):
        name = f"joint_{i + 1}"
        axis_b = body_from_root @ joint.axis
        component = 2 if axis == "yaw" else 1
        negated = float(axis_b[component]) < 0
        result.is_negated.append(negated)
        if joint.name != name or negated:
            note = ", its angle negated" if negated else ""
            result.names.append(f"{name}: {joint.format_place()}, {axis}{note}")


def _make_link_frame(body_from_root: Floats, start_b: Floats) -> Floats:
    """Return the frame, (4, 4), of a link that begins at `start_b`."""
    frame = np.eye(4)
    frame[:3, :3] = body_from_root
    frame[:3, 3] = -start_b
    return frame


def _classify_joint_axis(result: ImportResult, joint: UrdfJoint, axis_b: Floats) -> str:
    """Return "yaw" or "pitch". A small tilt is removed and reported. Raises ConfigError for an oblique axis."""
    for name, component, letter in (("yaw", 2, "z"), ("pitch", 1, "y")):
        cosine = abs(float(axis_b[component]))
        if cosine <= MIN_AXIS_COSINE:
            continue
        tilt_rad = float(np.linalg.norm(np.delete(axis_b, component)))
        if tilt_rad > MIN_REPORTED_TILT_RAD:
            result.changes.add(
                f"<axis xyz>, tilted by {math.degrees(tilt_rad):.4f}°, became {letter}",
                joint.format_place("axis"),
            )
        return name
    raise joint.element.make_error(
        f"turns about ({axis_b[0]:.2f}, {axis_b[1]:.2f}, {axis_b[2]:.2f}), with x from tail to head and z up; a "
        f"snake's joints turn about z or y, within 1°. Does another axis point up (--up)?"
    )


def _validate_joint_on_line(
    result: ImportResult, joint: UrdfJoint, axis: str, offset_m: Floats, joint_distance_m: float
) -> None:
    """Check that a joint is on the line of the other joints, and report a small offset, which is removed.

    Args:
        result: Result of the import, whose report is extended.
        joint: The joint.
        axis: "yaw" or "pitch".
        offset_m: (3,) position of the joint in the body frame; y and z are relative to the line.
        joint_distance_m: Mean distance between joints.

    Raises:
        ConfigError: The joint is too far away from the line.
    """
    if axis == "yaw":
        across_line = offset_m[1]
        along_joint_axis = offset_m[2]
    else:
        across_line = offset_m[2]
        along_joint_axis = offset_m[1]
    across_m = abs(float(across_line))
    along_axis_m = abs(float(along_joint_axis))
    if across_m > MAX_OFFSET_RATIO * joint_distance_m:
        raise joint.element.make_error(
            f"is {across_m * 1e3:.1f} mm beside the line through the first and the last joint; a robot file has all "
            f"joints on a line, at zero angles"
        )
    if across_m > MIN_REPORTED_OFFSET_M:
        result.changes.add(
            f"<origin> moved by {across_m * 1e3:.3g} mm, onto the line of the other joints",
            joint.format_place("origin"),
        )
    if along_axis_m > MIN_REPORTED_OFFSET_M:
        result.changes.add(
            f"<origin> moved by {along_axis_m * 1e3:.3g} mm along the joint's own axis, which changes no motion",
            joint.format_place("origin"),
        )


def _transform_outline(
    body: UrdfBody, body_from_root: Floats, line_b: Floats, scale: float
) -> Floats | None:
    """Return the outline of a body, (n, 3): x along the robot, y and z from the line through the joints.

    None means that the body has no geometry.
    """
    if not body.points:
        return None
    return np.vstack(body.points) @ body_from_root.T * scale - line_b


def _report_shapes(result: ImportResult, chain: BodyChain, radius_m: float, scale: float) -> None:
    """Report every shape that became a capsule, with its sizes."""
    for body in chain.bodies:
        if _is_capsule(body, radius_m / scale):
            continue
        for shape in body.shapes:
            sizes = " ".join(f"{name}={value!r}" for name, value in shape.attributes.items())
            result.changes.add(
                f"<{shape.tag} {sizes}> became a capsule of {radius_m * 1e3:.1f} mm, which encloses it",
                f"line {shape.line}",
            )


def _is_capsule(body: UrdfBody, radius: float) -> bool:
    """Return whether the shapes of a body are an exported capsule of this radius: a cylinder and two spheres."""
    if sorted(shape.tag for shape in body.shapes) != ["cylinder", "sphere", "sphere"]:
        return False
    return all(
        math.isclose(shape.read_number("radius"), radius, rel_tol=1e-6) for shape in body.shapes
    )


def _choose_common_radius(
    outlines: list[Floats | None], joint_distance_m: float, result: ImportResult
) -> float:
    """Choose a common radius of all links in m, that of the widest link, and report what that changes.

    Args:
        outlines: For each link, (n, 3) points in m in the body frame; None if the link has no geometry.
        joint_distance_m: Mean distance between joints, from which a radius is assumed if no link has geometry.
        result: Result of the import, whose report gets assumptions and changes.
    """
    radii_m: dict[str, float] = {}
    links_without_geometry: list[str] = []
    for link_index, outline in enumerate(outlines):
        if outline is None:
            links_without_geometry.append(f"link_{link_index}")
        else:
            radii_m[f"link_{link_index}"] = _measure_radius(outline)
    if not radii_m:
        assumed_m = round(ASSUMED_RADIUS_RATIO * joint_distance_m, LENGTH_DIGITS)
        result.assumptions.add(
            f"no link has geometry; its radius is taken as {ASSUMED_RADIUS_RATIO} of the joints' distance: "
            f"{assumed_m:.3g} m"
        )
        return assumed_m
    widest_m = round(max(radii_m.values()), LENGTH_DIGITS)
    widest_mm = f"{widest_m * 1e3:.1f} mm"
    if links_without_geometry:
        result.assumptions.add(
            f"{', '.join(links_without_geometry)}: no geometry; the radius is the others', {widest_mm}"
        )
    narrower_links: list[str] = []
    for name, radius_m in radii_m.items():
        if radius_m < widest_m * 0.99:  # a difference of 1 % is not reported
            narrower_links.append(f"{name} ({radius_m * 1e3:.1f} mm)")
    if narrower_links:
        result.changes.add(
            f"every link is a capsule of {widest_mm}, the widest; narrower: {', '.join(narrower_links)}"
        )
    return widest_m


def _measure_radius(points: Floats) -> float:
    """Return the largest distance of points, (n, 3), from the x axis."""
    return float(np.hypot(points[:, 1], points[:, 2]).max())


def _measure_link_lengths(
    joints_x: Floats,
    outlines: list[Floats | None],
    radius_m: float,
    result: ImportResult,
    chain: BodyChain,
) -> list[float]:
    """Measure the length of every link in m, tail to head, without the rounded caps of its capsule.

    Args:
        joints_x: (joints,) x of each joint in the body frame in m, tail to head.
        outlines: For each link, (n, 3) points in m in the body frame; None if the link has no geometry.
        radius_m: Radius of all links.
        result: Result of the import, whose report is extended.
        chain: Bodies and joints of the URDF, tail to head.

    Raises:
        ConfigError: The robot is folded at zero angles.
    """
    gaps_m = [round(float(gap), LENGTH_DIGITS) for gap in np.diff(joints_x)]
    if min(gaps_m) < 0:
        raise ConfigError(
            "the joints are not in order along the chain at zero angles: it is folded",
            code="urdf/invalid",
        )
    inner_lengths_m: list[float] = []  # of the links between tail and head
    for i, gap_m in enumerate(gaps_m):
        if gap_m < MIN_LENGTH_M:
            result.changes.add(
                f"joint_{i + 1} and joint_{i + 2} are {gap_m * 1e3:.2f} mm apart; here {MIN_LENGTH_M * 1e3:g} mm",
                chain.joints[i + 1].format_place("origin"),
            )
        inner_lengths_m.append(max(gap_m, MIN_LENGTH_M))
    head_index = len(outlines) - 1
    tail_m = _measure_end_link_length(
        result, 0, outlines[0], joints_x[0], -1, radius_m, inner_lengths_m
    )
    head_m = _measure_end_link_length(
        result, head_index, outlines[head_index], joints_x[-1], 1, radius_m, inner_lengths_m
    )
    return [tail_m, *inner_lengths_m, head_m]


def _measure_end_link_length(
    result: ImportResult,
    index: int,
    outline: Floats | None,
    joint_x: float,
    outward: int,
    radius_m: float,
    inner_lengths_m: list[float],
) -> float:
    """Measure the length in m of the tail or head link, from its joint to where its rounded cap begins.

    Args:
        result: Result of the import, whose report is extended.
        index: Index of the link.
        outline: (n, 3) points of the link in the body frame; None if it has no geometry.
        joint_x: X of its joint in the body frame.
        outward: Sign of x towards the end of the robot: -1 at the tail, 1 at the head.
        radius_m: Radius of all links.
        inner_lengths_m: Lengths of the links between tail and head.
    """
    if outline is None:
        assumed_m = round(float(np.mean(inner_lengths_m)) / 2, LENGTH_DIGITS)
        result.assumptions.add(
            f"link_{index} has no geometry; its length is taken as half of the others': {assumed_m:g} m"
        )
        return assumed_m
    extent_m = float((outward * (outline[:, 0] - joint_x)).max())
    length_m = round(extent_m - radius_m, LENGTH_DIGITS)
    if length_m < MIN_LENGTH_M:
        result.changes.add(
            f"link_{index} ends {(length_m + radius_m) * 1e3:.1f} mm from its joint, less than its cap of "
            f"{radius_m * 1e3:.1f} mm; here {(MIN_LENGTH_M + radius_m) * 1e3:.1f} mm"
        )
        return MIN_LENGTH_M
    return length_m


def _convert_link(
    result: ImportResult,
    index: int,
    body: UrdfBody,
    frame: Floats,
    length_m: float,
    radius_m: float,
    scale: float,
) -> dict[str, Any]:
    """Convert a body into the entry of a link in [[links]] of the robot file.

    Center of mass and inertia are left out if they are those of an evenly filled capsule, which are the defaults.

    Args:
        result: Result of the import, whose report is extended.
        index: Index of the link.
        body: Mass, center of mass and inertia, in the root's frame and the file's unit of length.
        frame: Link_from_root, (4, 4) with lengths in m.
        length_m: Length of the link.
        radius_m: Radius of the link.
        scale: Meters per unit of length of the file.
    """
    if body.mass_kg < MIN_MASS_KG:
        result.changes.add(
            f"link_{index} has a mass of {body.mass_kg:g} kg; here {MIN_MASS_KG:g} kg, evenly in its capsule, and the "
            f"<origin> and <inertia> of its <inertial> do not count",
            *[mass.place for mass in body.masses],
        )
        return {"length_m": length_m, "mass_kg": MIN_MASS_KG}
    rotation = frame[:3, :3]
    center_m = rotation @ body.center * scale + frame[:3, 3]
    inertia_kg_m2 = rotation @ body.inertia @ rotation.T * scale**2
    mass_kg = _round_value(body.mass_kg)
    capsule_moments = np.array(compute_capsule_inertia(length_m, radius_m, mass_kg))
    moments_kg_m2 = _list_moments(inertia_kg_m2)
    if not _is_possible_inertia(inertia_kg_m2):
        result.changes.add(
            f"link_{index} has an inertia that no body has, {_join_values(moments_kg_m2)} kg·m² (ixx, "
            f"iyy, izz, ixy, ixz, iyz); here that of its capsule, {_join_values(capsule_moments[:3])}",
            *[element.place for element in body.inertias],
        )
        moments_kg_m2 = capsule_moments

    link: dict[str, Any] = {"length_m": length_m, "mass_kg": mass_kg}
    has_capsule_inertia = np.allclose(
        moments_kg_m2, capsule_moments, rtol=1e-6, atol=1e-6 * capsule_moments.max()
    )
    is_centered = np.allclose(center_m, [length_m / 2, 0, 0], atol=1e-8)
    if not (has_capsule_inertia and is_centered):
        # Adding 0.0 turns -0.0 into 0.0.
        link["center_m"] = [round(float(value), LENGTH_DIGITS) + 0.0 for value in center_m]
    if not has_capsule_inertia:
        link["inertia_kg_m2"] = [_round_value(float(moment)) for moment in moments_kg_m2]
    return link


def _list_moments(inertia: Floats) -> Floats:
    """Return ixx, iyy, izz, ixy, ixz, iyz of a matrix, (3, 3); the noise of rotating it becomes 0."""
    noise = 1e-9 * np.abs(inertia).max()
    return np.array(
        [inertia[index] if abs(inertia[index]) > noise else 0.0 for index in MOMENT_INDICES]
    )


def _is_possible_inertia(inertia: Floats) -> bool:
    """Return whether a body can have this inertia, (3, 3).

    Its principal moments must be positive, and the largest is at most the sum of the two others.
    """
    smallest, middle, largest = np.linalg.eigvalsh(inertia).tolist()
    return smallest > 0 and smallest + middle >= largest * (1 - 1e-6)


def _join_values(values: Floats) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _round_value(value: float) -> float:
    """Return a number with VALUE_DIGITS significant digits."""
    return float(f"{value:.{VALUE_DIGITS}g}")


def _set_links(
    table: ConfigTable, links: list[dict[str, Any]], axes: list[str], radius_m: float, source: str
) -> None:
    """Put [chain] and [module]; [[links]] follow unless the links are a row of equal modules."""
    inner = links[1:-1]
    length_m = _find_common_value([link["length_m"] for link in inner])
    mass_kg = _find_common_value([link["mass_kg"] for link in inner])
    table.set_value(
        "chain", {"modules": len(axes), "axes": axes[: _find_axes_period(axes)]}, source
    )
    table.set_value(
        "module", {"length_m": length_m, "radius_m": radius_m, "mass_kg": mass_kg}, source
    )
    fractions = [0.5] + [1.0] * len(inner) + [0.5]  # tail and head are half a module each
    for link, fraction in zip(links, fractions, strict=True):
        if not _is_fraction_of_module(link, fraction, length_m, mass_kg):
            table.set_value("links", links, source)
            return


def _find_axes_period(axes: list[str]) -> int:
    """Return the number of joints after which the order of their axes repeats."""
    for period in range(1, len(axes)):
        if all(axes[i] == axes[i % period] for i in range(len(axes))):
            return period
    return len(axes)


def _find_common_value(values: list[float]) -> float:
    """Return the value that all have, or else their mean."""
    if len(set(values)) == 1:
        return values[0]
    return _round_value(float(np.mean(values)))


def _is_fraction_of_module(
    link: dict[str, Any], fraction: float, length_m: float, mass_kg: float
) -> bool:
    """Return whether a link is this fraction of a module, and has no other values of its own."""
    is_same = np.allclose(
        [link["length_m"], link["mass_kg"]], [fraction * length_m, fraction * mass_kg], rtol=1e-9
    )
    return is_same and len(link) == 2
