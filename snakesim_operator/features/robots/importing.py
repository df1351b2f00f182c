"""Imports a URDF: the values of a robot file, and a report on everything that was changed, assumed or left out.

A robot file is a straight row of links along x, whose joints turn about z (yaw) or y (pitch). So the straight line
through the joints, at zero angles, becomes x from tail to head, and `up` becomes z. Lengths, masses, inertias, limits
and friction come from the URDF. What URDF cannot express comes from the <snakesim> elements that `snakesim robot
export` writes, or else from another robot file.

No value of the file is dropped and none is taken from elsewhere without a line in the report. That holds by
construction: elements and attributes that no function has read are reported (`XmlElement.iterate_unused`), and so is
every default that stands in for something absent (`XmlElement.note_absent`).
"""

import json
from pathlib import Path

import msgspec

from snakesim_hal.base.errors import ConfigError, shorten
from snakesim_hal.model.files import (
    ConfigTable,
    iterate_leaves,
    list_shipped_names,
    read_table_with_base,
)
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.textfiles import read_bytes
from snakesim_operator.features.robots.body import convert_body
from snakesim_operator.features.robots.exporting import GEOMETRY_SECTIONS, MATERIAL_ELEMENT
from snakesim_operator.features.robots.imported import ImportOptions, ImportResult
from snakesim_operator.features.robots.joint_limits import convert_joint_limits
from snakesim_operator.features.robots.unused_parts import report_unused
from snakesim_operator.features.robots.urdf_sensors import convert_sensors, format_gazebo_elements
from snakesim_operator.features.robots.urdf_tree import read_body_chain
from snakesim_operator.features.robots.xml_tree import XmlElement, parse_xml

SECTION_ORDER = {field.name: place for place, field in enumerate(msgspec.structs.fields(RobotFile))}
UNSHARED_SECTIONS = ("links", "joints", "checked")  # of `--like`: they do not describe this one
SECTIONS_FROM_URDF = ("name", "description", "chain", "module")


def import_urdf(file: Path, options: ImportOptions) -> ImportResult:
    """Import a URDF as the values of a robot file.

    Args:
        file: Path of the URDF.
        options: Options of the import: tail, axis that points up, unit of length, and the similar robot.

    Returns:
        The values, and a report on what was changed, assumed and left out.

    Raises:
        ConfigError: The file is not well formed, is no snake, or has numbers that no robot file may have.
    """
    if not 1e-6 <= options.scale <= 1e3:
        raise ConfigError(
            f"--scale {options.scale:g}: give meters per unit of length of the file, such as 0.001 for mm",
            code="urdf/invalid",
        )
    urdf = parse_xml(read_bytes(file), str(file))
    if urdf.tag != "robot":
        raise urdf.make_error("is no URDF; its outermost element is <robot>")
    urdf.read = True
    # SnakeSIM exported it, with the values that URDF cannot hold.
    is_exported = urdf.find_child("snakesim") is not None
    initial_values = (
        _read_exported_values(urdf) if is_exported else _read_values_of_similar_robot(urdf, options)
    )
    result = ImportResult(initial_values)

    # Each step changes the values that are known so far, and reports what it changed.
    chain = read_body_chain(result, urdf, file, tail=options.tail)
    link_frames = convert_body(result, chain, options, urdf)
    _set_robot_name(result, urdf, file)
    convert_joint_limits(result, chain.joints, str(file), is_exported=is_exported)
    if not is_exported:
        convert_sensors(result, urdf, chain, link_frames, options.scale)
        _report_values_of_similar_robot(result, options)
    _sort_sections(result.table)
    robot = result.robot  # raises for numbers that no robot file may hold

    # Report what the URDF does not contain, and what it contains and was not read.
    if is_exported:
        _mark_exported_as_read(urdf, robot)
    for absence in urdf.absences:
        result.assumptions.add(absence.sentence, f"line {absence.element.line}")
    report_unused(result.omissions, urdf)
    _report_shipped_name(result)
    return result


def _sort_sections(table: ConfigTable) -> None:
    """Put the sections into the order of a robot file; unknown ones come last."""
    names = sorted(table.values, key=lambda name: SECTION_ORDER.get(name, len(SECTION_ORDER)))
    table.values = {name: table.values[name] for name in names}


def _set_robot_name(result: ImportResult, urdf: XmlElement, file: Path) -> None:
    """Put the name of the robot; without one, that of the file."""
    name = urdf.read_optional_attribute("name")
    if name is None:
        result.assumptions.add(
            f"<robot> without `name`: {file.stem}, as the file is called", f"line {urdf.line}"
        )
        name = file.stem
    result.table.set_value("name", result.make_plain_name(name, "robot", urdf), str(file))


def _report_shipped_name(result: ImportResult) -> None:
    """Report a name that a shipped robot has too."""
    name = result.table.values["name"]
    if name in list_shipped_names("robots"):
        result.omissions.add(
            f"a name of its own: it is {name}, as a shipped robot is; change it, because the network and a latched "
            f"stop tell robots apart by it"
        )


def _read_values_of_similar_robot(urdf: XmlElement, options: ImportOptions) -> ConfigTable:
    """Return the values of the robot file `--like`, without those that describe that robot only."""
    table = read_table_with_base(options.like, "robots")
    for section in UNSHARED_SECTIONS:
        table.values.pop(section, None)
    for mounted in ("depth", "range"):  # their places fit another body
        table.values.get("sensors", {}).pop(mounted, None)
    table.set_value("description", f"Imported from {Path(urdf.source).name}.", urdf.source)
    return table


def _read_exported_values(urdf: XmlElement) -> ConfigTable:
    """Return the values in <snakesim> elements, as an export has written them. Raises ConfigError."""
    table = ConfigTable({}, urdf.source)
    read_keys: set[str] = set()
    for element in urdf.find_children("snakesim"):
        key = element.read_attribute("key")
        if key.partition(".")[0] in GEOMETRY_SECTIONS:
            raise element.make_error(
                f"has `key` = {shorten(key)!r}, which links and joints contain; remove this element"
            )
        if key in read_keys:
            raise element.make_error(
                f"has `key` = {shorten(key)!r}, as another one has; remove one of them"
            )
        read_keys.add(key)
        try:
            table.set_value(key, json.loads(element.read_attribute("value")), urdf.source)
        except ValueError as error:
            raise element.make_error(
                f"has a `value` that is not JSON: {shorten(str(error))}"
            ) from None
    return table


def _report_values_of_similar_robot(result: ImportResult, options: ImportOptions) -> None:
    """Report every value that was taken from the robot file that the user named with `--like`.

    Args:
        result: Result of the import, whose report is extended.
        options: Options of the import, with the name of the other robot.
    """
    for section, values in result.table.values.items():
        if section in SECTIONS_FROM_URDF:
            continue
        taken_values: list[str] = []
        for key, value in iterate_leaves(values, section):
            is_from_urdf = result.table.find_origin(key) == result.table.find_origin("name")
            if not is_from_urdf and value not in ({}, []):
                taken_values.append(f"{key.removeprefix(f'{section}.')} = {value}")
        if taken_values:
            result.assumptions.add(
                f"[{section}] as of robot {options.like!r}: {', '.join(taken_values)}"
            )
    absent = [
        section
        for section in SECTION_ORDER
        if section not in result.table.values and section not in UNSHARED_SECTIONS
    ]
    if absent:
        result.assumptions.add(f"[{'], ['.join(absent)}]: the defaults of a robot file")


def _mark_exported_as_read(urdf: XmlElement, robot: RobotFile) -> None:
    """Mark as read what `snakesim robot export` derives from the same values, so that only edits are reported."""
    text = "".join(["<robot>", MATERIAL_ELEMENT, *format_gazebo_elements(robot), "</robot>"])
    exported = parse_xml(text.encode(), urdf.source)
    for child in urdf.children:
        if any(child.is_equal_to(other) for other in exported.children):
            child.mark_all_as_read()
    exported_material = exported.children[0]
    for link in urdf.children:
        if link.tag != "link":
            continue
        for visual_or_collision in link.children:
            _mark_material_as_read(visual_or_collision, exported_material)


def _mark_material_as_read(parent: XmlElement, exported: XmlElement) -> None:
    """Mark a reference to the exported material as read."""
    for child in parent.children:
        if (
            child.tag == "material"
            and child.attributes == exported.attributes
            and not child.children
        ):
            child.mark_all_as_read()
