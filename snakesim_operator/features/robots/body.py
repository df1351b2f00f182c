"""A URDF's row of bodies -> chain, module and links: the line of the joints becomes x, `up` becomes z."""

import math
from typing import Any

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import Table
from snakesim_hal.model.links import capsule_inertia
from snakesim_operator.features.robots.imported import UPS, Imported, Order
from snakesim_operator.features.robots.urdf_tree import Body, Joint, Row
from snakesim_operator.features.robots.xml_tree import Element

DIGITS_M = 9  # lengths are rounded to a nanometre, which removes the noise of adding transforms
OFF_LINE = 0.05  # of the mean distance between joints: a joint further beside the line is an error
OBLIQUE = math.cos(math.radians(1.0))
MIN_TILT_RAD = 1e-5  # of an axis; less is the rounding of the file
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # ixx, iyy, izz, ixy, ixz, iyz
MIN_GAP_M, MAX_GAP_M, MIN_MASS_KG = 0.001, 2, 0.001


def _axes_of_body(row: Row, order: Order, urdf: Element) -> Floats:
    """body_from_root (3, 3): x from tail to head, z up."""
    along = row.joints[-1].origin - row.joints[0].origin
    if np.linalg.norm(along) < 1e-9:
        raise urdf.wrong("has its first and last joint at the same place, so that the chain has no direction")
    x = along / np.linalg.norm(along)
    up = np.array(UPS[order.up], dtype=np.float64)
    z = up - (up @ x) * x
    if np.linalg.norm(z) < 0.1:
        others = [name for name in UPS if abs(np.array(UPS[name]) @ x) < 0.9 and "-" not in name]
        raise urdf.wrong(f"lies along its {order.up} axis: say which one points up: --up {' or --up '.join(others)}")
    z /= np.linalg.norm(z)
    return np.vstack([x, np.cross(z, x), z])


def put_body(found: Imported, row: Row, order: Order, urdf: Element) -> list[Floats]:
    """Chain, module and links. Returns link_from_root, (4, 4) in m, of every link, tail to head."""
    turn = _axes_of_body(row, order, urdf)
    scale = order.scale
    if scale != 1.0:
        found.changes.add(
            f"--scale {scale:g}: lengths times {scale:g}, inertias times {scale**2:g}; masses in kg, effort, damping "
            f"and friction in N·m stay as they are"
        )
    places = np.array([turn @ joint.origin for joint in row.joints]) * scale
    on_line = places - [0.0, *places[0][1:]]  # x as it is; y and z from the first joint
    gap_m = float(np.mean(np.diff(on_line[:, 0])))
    if not gap_m <= MAX_GAP_M:
        widest = row.joints[1 + int(np.argmax(np.diff(on_line[:, 0])))]
        raise urdf.wrong(
            f"has joints {gap_m:g} m apart, and a link has {MAX_GAP_M} m at most; in mm? Give --scale 0.001. The "
            f"widest gap is before joint {widest.place()}"
        )
    axes = [_axis(found, joint, turn @ joint.axis) for joint in row.joints]
    for joint, axis, at in zip(row.joints, axes, on_line, strict=True):
        _check_on_line(found, joint, axis, at, gap_m)
    outlines = [_outline(body, turn, places[0], scale) for body in row.bodies]
    radius_m = _radius(outlines, gap_m, found)
    _report_shapes(found, row, radius_m, scale)
    lengths = _lengths(on_line[:, 0], outlines, radius_m, found, row)
    starts = [on_line[0, 0] - lengths[0], *on_line[:, 0]]
    frames = [_link_from_root(turn, np.array([start, *places[0][1:]])) for start in starts]
    links = [
        _link(found, i, body, frame, length, radius_m, scale)
        for i, (body, frame, length) in enumerate(zip(row.bodies, frames, lengths, strict=True))
    ]
    _put_links(found.table, links, axes, radius_m, urdf.source)
    _put_names(found, row, axes, turn)
    return frames


def _put_names(found: Imported, row: Row, axes: list[str], turn: Floats) -> None:
    """Our names and theirs, and which joints turn the other way round."""
    for i, body in enumerate(row.bodies):
        if body.links != [f"link_{i}"]:
            found.names.append(f"link_{i}: {', '.join(body.places)}")
    for i, (joint, axis) in enumerate(zip(row.joints, axes, strict=True)):
        name = f"joint_{i + 1}"
        negated = float((turn @ joint.axis)[2 if axis == "yaw" else 1]) < 0
        found.negated.append(negated)
        if joint.name != name or negated:
            found.names.append(f"{name}: {joint.place()}, {axis}{', its angle negated' if negated else ''}")


def _link_from_root(turn: Floats, start_b: Floats) -> Floats:
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = turn, -start_b
    return frame


def _axis(found: Imported, joint: Joint, axis_b: Floats) -> str:
    """Yaw or pitch. A small tilt is removed, which is reported."""
    for name, component, letter in (("yaw", 2, "z"), ("pitch", 1, "y")):
        along = abs(float(axis_b[component]))
        if along <= OBLIQUE:
            continue
        tilt_rad = float(np.linalg.norm(np.delete(axis_b, component)))
        if tilt_rad > MIN_TILT_RAD:
            found.changes.add(
                f"<axis xyz>, tilted by {math.degrees(tilt_rad):.4f}°, became {letter}", joint.place("axis")
            )
        return name
    raise joint.element.wrong(
        f"turns about ({axis_b[0]:.2f}, {axis_b[1]:.2f}, {axis_b[2]:.2f}), with x from tail to head and z up; a "
        f"snake's joints turn about z or y, within 1°. Does another axis point up (--up)?"
    )


def _check_on_line(found: Imported, joint: Joint, axis: str, at: Floats, gap_m: float) -> None:
    """Report where a joint is moved onto the line of the others. Raises ConfigError when it is far beside it."""
    across, along_axis = (at[1], at[2]) if axis == "yaw" else (at[2], at[1])
    beside_m = abs(float(across))
    if beside_m > OFF_LINE * gap_m:
        raise joint.element.wrong(
            f"is {beside_m * 1e3:.1f} mm beside the line through the first and the last joint; a robot file has all "
            f"joints on a line, at zero angles"
        )
    if beside_m > 1e-6:
        found.changes.add(
            f"<origin> moved by {beside_m * 1e3:.3g} mm, onto the line of the other joints", joint.place("origin")
        )
    if abs(along_axis) > 1e-6:
        found.changes.add(
            f"<origin> moved by {abs(float(along_axis)) * 1e3:.3g} mm along the joint's own axis, which changes no "
            f"motion",
            joint.place("origin"),
        )


def _outline(body: Body, turn: Floats, line_b: Floats, scale: float) -> Floats | None:
    """(n, 3): x along the body, y and z from the line through the joints; None when nothing is known of it."""
    if not body.points:
        return None
    return np.vstack(body.points) @ turn.T * scale - [0.0, line_b[1], line_b[2]]


def _report_shapes(found: Imported, row: Row, radius_m: float, scale: float) -> None:
    """Name every shape that became a capsule, with its sizes."""
    for body in row.bodies:
        if _is_capsule(body, radius_m / scale):
            continue
        for shape in body.shapes:
            sizes = " ".join(f"{name}={value!r}" for name, value in shape.attributes.items())
            found.changes.add(
                f"<{shape.tag} {sizes}> became a capsule of {radius_m * 1e3:.1f} mm, which encloses it",
                f"line {shape.line}",
            )


def _is_capsule(body: Body, radius: float) -> bool:
    """Whether its shapes are those of an exported capsule, a cylinder and two spheres, of this radius."""
    if sorted(shape.tag for shape in body.shapes) != ["cylinder", "sphere", "sphere"]:
        return False
    return all(math.isclose(shape.number("radius"), radius, rel_tol=1e-6) for shape in body.shapes)


def _radius(outlines: list[Floats | None], gap_m: float, found: Imported) -> float:
    """The radius of all links: of the widest one. Assumptions and changes are reported."""
    radii = [None if points is None else float(np.hypot(points[:, 1], points[:, 2]).max()) for points in outlines]
    known = [radius for radius in radii if radius is not None]
    if not known:
        assumed_m = round(0.35 * gap_m, DIGITS_M)
        found.assumptions.add(
            f"no link has geometry; its radius is taken as 0.35 of the joints' distance: {assumed_m:.3g} m"
        )
        return assumed_m
    widest = round(max(known), DIGITS_M)
    missing = [f"link_{i}" for i, radius in enumerate(radii) if radius is None]
    narrow = [f"link_{i} ({r * 1e3:.1f} mm)" for i, r in enumerate(radii) if r is not None and r < widest * 0.99]
    if missing:
        found.assumptions.add(f"{', '.join(missing)}: no geometry; the radius is the others', {widest * 1e3:.1f} mm")
    if narrow:
        found.changes.add(
            f"every link is a capsule of {widest * 1e3:.1f} mm, the widest; narrower: {', '.join(narrow)}"
        )
    return widest


def _lengths(
    joints_x: Floats, outlines: list[Floats | None], radius_m: float, found: Imported, row: Row
) -> list[float]:
    """Of every link, in m; the capsules' caps at both ends are not counted."""
    gaps = [round(float(gap), DIGITS_M) for gap in np.diff(joints_x)]
    if min(gaps) < 0:
        raise ConfigError("the joints are not in order along the chain at zero angles: it is folded")
    for i, gap in enumerate(gaps):
        if gap < MIN_GAP_M:
            found.changes.add(
                f"joint_{i + 1} and joint_{i + 2} are {gap * 1e3:.2f} mm apart; here {MIN_GAP_M * 1e3:g} mm",
                row.joints[i + 1].place("origin"),
            )
    middle = [max(gap, MIN_GAP_M) for gap in gaps]
    last = len(outlines) - 1
    tail_m = _end_length(found, 0, outlines[0], joints_x[0], -1, radius_m, middle)
    head_m = _end_length(found, last, outlines[last], joints_x[-1], 1, radius_m, middle)
    return [tail_m, *middle, head_m]


def _end_length(
    found: Imported, index: int, outline: Floats | None, joint_x: float, outward: int, radius_m: float, middle: Any
) -> float:
    """Of tail or head, from its joint to where its cap begins, in m. outward: the sign of x towards its end."""
    if outline is None:
        assumed_m = round(float(np.mean(middle)) / 2, DIGITS_M)
        found.assumptions.add(
            f"link_{index} has no geometry; its length is taken as half of the others': {assumed_m:g} m"
        )
        return assumed_m
    reach = round(float((outward * (outline[:, 0] - joint_x)).max()) - radius_m, DIGITS_M)
    if reach < MIN_GAP_M:
        found.changes.add(
            f"link_{index} ends {(reach + radius_m) * 1e3:.1f} mm from its joint, less than its cap of "
            f"{radius_m * 1e3:.1f} mm; here {(MIN_GAP_M + radius_m) * 1e3:.1f} mm"
        )
        return MIN_GAP_M
    return reach


def _link(
    found: Imported, i: int, body: Body, frame: Floats, length_m: float, radius_m: float, scale: float
) -> dict[str, Any]:
    """As in [[links]]; without what is as in its capsule. frame: link_from_root, (4, 4) in m."""
    mass_places = [mass.place for mass in body.masses]
    inertia_places = [moments.place for moments in body.inertias]
    if body.mass_kg < MIN_MASS_KG:
        found.changes.add(
            f"link_{i} has a mass of {body.mass_kg:g} kg; here {MIN_MASS_KG:g} kg, evenly in its capsule, and the "
            f"<origin> and <inertia> of its <inertial> do not count",
            *mass_places,
        )
        return {"length_m": length_m, "mass_kg": MIN_MASS_KG}
    turn = frame[:3, :3]
    center = turn @ body.center * scale + frame[:3, 3]
    inertia = turn @ body.inertia @ turn.T * scale**2
    link: dict[str, Any] = {"length_m": length_m, "mass_kg": _digits(body.mass_kg)}
    least, middle, most = np.linalg.eigvalsh(inertia).tolist()
    capsule = np.array(capsule_inertia(length_m, radius_m, link["mass_kg"]))
    dust = 1e-9 * np.abs(inertia).max()  # of turning it
    moments = np.array([inertia[at] if abs(inertia[at]) > dust else 0.0 for at in PAIRS])
    if least <= 0 or least + middle < most * (1 - 1e-6):
        found.changes.add(
            f"link_{i} has an inertia that no body has, {', '.join(f'{value:.4g}' for value in moments)} kg·m² (ixx, "
            f"iyy, izz, ixy, ixz, iyz); here that of its capsule, {', '.join(f'{value:.4g}' for value in capsule[:3])}",
            *inertia_places,
        )
        moments = capsule
    evenly = np.allclose(moments, capsule, rtol=1e-6, atol=1e-6 * capsule.max())
    if not (evenly and np.allclose(center, [length_m / 2, 0, 0], atol=1e-8)):
        link["center_m"] = [round(float(c), DIGITS_M) + 0.0 for c in center]
    if not evenly:
        link["inertia_kg_m2"] = [_digits(float(moment)) for moment in moments]
    return link


def _digits(value: float) -> float:
    return float(f"{value:.10g}")


def _put_links(table: Table, links: list[dict[str, Any]], axes: list[str], radius_m: float, source: str) -> None:
    """As [module] alone where the links are a row of equal modules, else as [[links]] too."""
    period = next(p for p in range(1, len(axes) + 1) if all(axes[i] == axes[i % p] for i in range(len(axes))))
    middle = links[1:-1]
    lengths, masses = [link["length_m"] for link in middle], [link["mass_kg"] for link in middle]
    length_m, mass_kg = (v[0] if len(set(v)) == 1 else _digits(float(np.mean(v))) for v in (lengths, masses))
    table.put("chain", {"modules": len(axes), "axes": axes[:period]}, source)
    table.put("module", {"length_m": length_m, "radius_m": radius_m, "mass_kg": mass_kg}, source)
    shares = [0.5] + [1.0] * len(middle) + [0.5]
    if not all(_is_fraction(link, share, length_m, mass_kg) for link, share in zip(links, shares, strict=True)):
        table.put("links", links, source)


def _is_fraction(link: dict[str, Any], share: float, length_m: float, mass_kg: float) -> bool:
    same = np.allclose([link["length_m"], link["mass_kg"]], [share * length_m, share * mass_kg], rtol=1e-9)
    return same and len(link) == 2
