"""URDF -> the values of a robot file, and a report of what could not be carried over.

A robot file is a straight row of links along x, whose joints turn about z (yaw) or y (pitch). So the straight line
through the joints, at zero angles, becomes x from tail to head, and `up` becomes z. Lengths, masses, inertias, limits
and friction come from the URDF; what it has no words for from its <snakesim> elements, as `snakesim robot export`
writes them, or else from another robot file.
"""

import json
from pathlib import Path

import msgspec

from snakesim_hal.errors import ConfigError, short
from snakesim_hal.model.files import Table, read_part, shipped
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.textfiles import read_bytes
from snakesim_operator.robots.body import put_body
from snakesim_operator.robots.imported import Imported, Order, plain
from snakesim_operator.robots.joint_limits import put_limits
from snakesim_operator.robots.urdf_sensors import put_sensors
from snakesim_operator.robots.urdf_tree import row_of
from snakesim_operator.robots.xml_tree import Element, parse_xml

SECTIONS = {field.name: place for place, field in enumerate(msgspec.structs.fields(RobotFile))}


def robot_of(file: Path, order: Order) -> Imported:
    """Read a URDF. Raises ConfigError for what is no snake, and for files that are not well formed."""
    if not 1e-6 <= order.scale <= 1e3:
        raise ConfigError(f"--scale {order.scale:g}: give metres per unit of length of the file, such as 0.001 for mm")
    urdf = parse_xml(read_bytes(file), str(file))
    if urdf.tag != "robot":
        raise urdf.wrong("is no URDF; its outermost element is <robot>")
    found = Imported(_rest(urdf, order))
    row = row_of(urdf, file, tail=order.tail, warn=found.left_out.append)
    frames = put_body(found, row, order, urdf)
    found.table.put("name", plain(urdf.get("name", file.stem), "robot"), str(file))
    own = urdf.first("snakesim") is not None
    put_limits(found.table, row.joints, found.negated, str(file), found.changed.append, own=own)
    if own:  # of a <snakesim> element; the others say the same, in fewer words
        for gazebo in urdf.all("gazebo"):
            gazebo.read_all()
    else:
        put_sensors(found.table, urdf, row, frames, order.scale, warn=found.left_out.append)
        found.changed.append(
            f"not in the file, so as of robot {order.like!r}: gains, rates of change, heat, safety, noise"
        )
    found.table.values = dict(sorted(found.table.values.items(), key=lambda item: SECTIONS.get(item[0], len(SECTIONS))))
    _warn_unread(found, urdf)
    if found.table.values["name"] in shipped("robots"):
        found.left_out.append(
            f"a name of its own: it is {found.table.values['name']}, as a shipped robot is; change it, because the "
            "network and a latched stop tell robots apart by it"
        )
    found.robot  # noqa: B018 - raises for numbers that no robot file may hold
    return found


def _rest(urdf: Element, order: Order) -> Table:
    """What URDF has no words for."""
    own = urdf.all("snakesim")
    if not own:
        table = read_part(order.like, "robots")
        for of_another_body in ("links", "joints"):
            table.values.pop(of_another_body, None)
        for mounted in ("depth", "range"):  # their places fit another body
            table.values.get("sensors", {}).pop(mounted, None)
        table.put("about", f"Imported from {Path(urdf.source).name}.", urdf.source)
        return table
    table = Table({}, urdf.source)
    for element in own:
        try:
            table.put(element.get("key"), json.loads(element.get("value")), urdf.source)
        except ValueError as error:
            raise element.wrong(f"has a `value` that is not JSON: {short(str(error))}") from None
    return table


def _warn_unread(found: Imported, urdf: Element) -> None:
    """What nothing here has read, by kind, with the lines where it is."""
    lines: dict[str, list[int]] = {}
    for path, line in urdf.unread():
        lines.setdefault(path, []).append(line)
    looks = [path for path in lines if path.endswith(("<visual>", "<material>"))]
    if looks and urdf.first("snakesim") is None:  # those of an export of ours are made of its robot file
        found.left_out.append(f"looks, which change nothing in a run: {', '.join(map(short, looks))}")
    for path, where in lines.items():
        if path in looks:
            continue
        shown = ", ".join(map(str, where[:12])) + (f" and {len(where) - 12} more" if len(where) > 12 else "")
        found.left_out.append(f"{short(path)} left out: line{'s' * (len(where) > 1)} {shown}")
