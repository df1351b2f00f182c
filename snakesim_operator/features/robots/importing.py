"""Imports a URDF: the values of a robot file, and a report on everything that was changed, assumed or left out.

A robot file is a straight row of links along x, whose joints turn about z (yaw) or y (pitch). So the straight line
through the joints, at zero angles, becomes x from tail to head, and `up` becomes z. Lengths, masses, inertias, limits
and friction come from the URDF. What URDF cannot express comes from the <snakesim> elements that `snakesim robot
export` writes, or else from another robot file.

No value of the file is dropped and none is taken from elsewhere without a line in the report. That holds by
construction: elements and attributes that no function has read are reported (`Element.unused`), and so is every default
that stands in for something absent (`Element.note_absent`).
"""

import json
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import Table, leaves, list_shipped, read_part
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.textfiles import read_bytes
from snakesim_operator.features.robots.body import put_body
from snakesim_operator.features.robots.exporting import GEOMETRY, LOOK
from snakesim_operator.features.robots.imported import ImportOptions, ImportResult
from snakesim_operator.features.robots.joint_limits import put_limits
from snakesim_operator.features.robots.unused_parts import report_unused
from snakesim_operator.features.robots.urdf_sensors import gazebo_lines, put_sensors
from snakesim_operator.features.robots.urdf_tree import read_body_chain
from snakesim_operator.features.robots.xml_tree import Element, parse_xml

SECTIONS = {field.name: place for place, field in enumerate(msgspec.structs.fields(RobotFile))}
OF_ANOTHER_ROBOT = ("links", "joints", "checked")  # of `--like`: they do not describe this one
FROM_URDF = ("name", "about", "chain", "module")


def import_urdf(file: Path, order: ImportOptions) -> ImportResult:
    """Read a URDF as the values of a robot file.

    Args:
        file: Path of the URDF.
        order: How to read it.

    Returns:
        The values, and a report on what was changed, assumed and left out.

    Raises:
        ConfigError: The file is not well formed, is no snake, or has numbers that no robot file may have.
    """
    if not 1e-6 <= order.scale <= 1e3:
        raise ConfigError(
            f"--scale {order.scale:g}: give meters per unit of length of the file, such as 0.001 for mm",
            code="urdf/invalid",
        )
    urdf = parse_xml(read_bytes(file), str(file))
    if urdf.tag != "robot":
        raise urdf.error("is no URDF; its outermost element is <robot>")
    urdf.read = True
    is_exported = urdf.first("snakesim") is not None  # SnakeSIM exported it, with the values that URDF cannot hold
    initial_values = _exported_values(urdf) if is_exported else _values_of_other(urdf, order)
    imported = ImportResult(initial_values)

    # Each step changes the values that are known so far, and reports what it changed.
    chain = read_body_chain(imported, urdf, file, tail=order.tail)
    frames = put_body(imported, chain, order, urdf)
    _put_name(imported, urdf, file)
    put_limits(imported, chain.joints, str(file), is_exported=is_exported)
    if not is_exported:
        put_sensors(imported, urdf, chain, frames, order.scale)
        _report_values_of_other(imported, order)
    _sort_sections(imported.table)
    robot = imported.robot  # raises for numbers that no robot file may hold

    # Report what the URDF does not contain, and what it contains and was not read.
    if is_exported:
        _mark_exported(urdf, robot)
    for absence in urdf.absences:
        imported.assumptions.add(absence.sentence, f"line {absence.element.line}")
    report_unused(imported.omissions, urdf)
    _report_shipped_name(imported)
    return imported


def _sort_sections(table: Table) -> None:
    """Put the sections into the order of a robot file; unknown ones come last."""
    names = sorted(table.values, key=lambda name: SECTIONS.get(name, len(SECTIONS)))
    table.values = {name: table.values[name] for name in names}


def _put_name(imported: ImportResult, urdf: Element, file: Path) -> None:
    """Put the name of the robot; without one, that of the file."""
    name = urdf.optional("name")
    if name is None:
        imported.assumptions.add(f"<robot> without `name`: {file.stem}, as the file is called", f"line {urdf.line}")
        name = file.stem
    imported.table.set_value("name", imported.plain_name(name, "robot", urdf), str(file))


def _report_shipped_name(imported: ImportResult) -> None:
    """Report a name that a shipped robot has too."""
    name = imported.table.values["name"]
    if name in list_shipped("robots"):
        imported.omissions.add(
            f"a name of its own: it is {name}, as a shipped robot is; change it, because the network and a latched "
            f"stop tell robots apart by it"
        )


def _values_of_other(urdf: Element, order: ImportOptions) -> Table:
    """Return the values of the robot file `--like`, without those that describe that robot only."""
    table = read_part(order.like, "robots")
    for section in OF_ANOTHER_ROBOT:
        table.values.pop(section, None)
    for mounted in ("depth", "range"):  # their places fit another body
        table.values.get("sensors", {}).pop(mounted, None)
    table.set_value("about", f"Imported from {Path(urdf.source).name}.", urdf.source)
    return table


def _exported_values(urdf: Element) -> Table:
    """Return the values in <snakesim> elements, as an export has written them. Raises ConfigError."""
    table = Table({}, urdf.source)
    read_keys: set[str] = set()
    for element in urdf.all("snakesim"):
        key = element.get("key")
        if key.partition(".")[0] in GEOMETRY:
            raise element.error(f"has `key` = {shorten(key)!r}, which links and joints contain; remove this element")
        if key in read_keys:
            raise element.error(f"has `key` = {shorten(key)!r}, as another one has; remove one of them")
        read_keys.add(key)
        try:
            table.set_value(key, json.loads(element.get("value")), urdf.source)
        except ValueError as error:
            raise element.error(f"has a `value` that is not JSON: {shorten(str(error))}") from None
    return table


def _report_values_of_other(imported: ImportResult, order: ImportOptions) -> None:
    """Report every value that was taken from the robot of `--like`."""
    for section, values in imported.table.values.items():
        if section in FROM_URDF:
            continue
        taken_values: list[str] = []
        for key, value in leaves(values, section):
            is_from_urdf = imported.table.origin_of(key) == imported.table.origin_of("name")
            if not is_from_urdf and value not in ({}, []):
                taken_values.append(f"{key.removeprefix(f'{section}.')} = {value}")
        if taken_values:
            imported.assumptions.add(f"[{section}] as of robot {order.like!r}: {', '.join(taken_values)}")
    absent = [
        section for section in SECTIONS if section not in imported.table.values and section not in OF_ANOTHER_ROBOT
    ]
    if absent:
        imported.assumptions.add(f"[{'], ['.join(absent)}]: the defaults of a robot file")


def _mark_exported(urdf: Element, robot: RobotFile) -> None:
    """Mark as read what `snakesim robot export` derives from the same values, so that only edits are reported."""
    text = "".join(["<robot>", LOOK, *gazebo_lines(robot), "</robot>"])
    exported = parse_xml(text.encode(), urdf.source)
    for child in urdf.children:
        if any(child.equals(other) for other in exported.children):
            child.read_all()
    exported_material = exported.children[0]
    for link in urdf.children:
        if link.tag != "link":
            continue
        for visual_or_collision in link.children:
            _mark_material(visual_or_collision, exported_material)


def _mark_material(parent: Element, exported: Element) -> None:
    """Mark a reference to the exported material as read."""
    for child in parent.children:
        if child.tag == "material" and child.attributes == exported.attributes and not child.children:
            child.read_all()
