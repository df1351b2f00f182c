"""Checks that an import never drops, changes or assumes a value of a URDF without a line in its report.

Each item of URDF_VALUES is an attribute or a text of `urdf/every_attribute.urdf`. The tests leave it out, set it to
zero, negate it, make it huge and give it in another unit. One of three things must follow:

* the import refuses the file and names its line or field;
* the robot file contains the value unchanged;
* the report contains the value and its line number.
"""

import math
import re
import tempfile
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import pytest

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.files import decode_table, read_table_with_base
from snakesim_hal.model.robot_file.joints import JointMotor, MotionLimits
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_operator.features.robots.command import import_robot
from snakesim_operator.features.robots.exporting import format_urdf
from snakesim_operator.features.robots.imported import ImportOptions, ImportResult
from snakesim_operator.features.robots.importing import import_urdf
from snakesim_operator.features.robots.joint_limits import JOINT_QUANTITIES
from snakesim_testing.messages import raises_error

SNAKE_URDF = (Path(__file__).parent / "urdf" / "every_attribute.urdf").read_text()

ReadField = Callable[[RobotFile], Any]


@dataclass(frozen=True)
class UrdfValue:
    """An attribute of the URDF, or the text of an element, and the field of a robot file with the same number."""

    path: str  # of the element
    attribute: str = ""  # empty: the text of the element
    read_field: ReadField | None = None  # None: no field has the same number

    @property
    def name(self) -> str:
        return f"{self.path}@{self.attribute}" if self.attribute else self.path


def _make_joint_reader(joint: int, section: str, field: str) -> ReadField:
    """Return a function that reads this field of a joint."""
    return lambda robot: getattr(getattr(robot.joint_table[joint], section), field)


UNCHANGED_FIELDS: dict[str, ReadField] = {
    "joint[@name='j1']/limit@lower": _make_joint_reader(0, "limits", "lower_rad"),
    "joint[@name='j1']/limit@upper": _make_joint_reader(0, "limits", "upper_rad"),
    "joint[@name='j1']/limit@effort": _make_joint_reader(0, "limits", "torque_nm"),
    "joint[@name='j1']/limit@velocity": _make_joint_reader(0, "limits", "speed_rad_s"),
    "joint[@name='j3']/limit@effort": _make_joint_reader(2, "limits", "torque_nm"),
    "joint[@name='j3']/limit@velocity": _make_joint_reader(2, "limits", "speed_rad_s"),
    "joint[@name='j1']/dynamics@damping": _make_joint_reader(0, "motor", "viscous_nm_s_per_rad"),
    "joint[@name='j1']/dynamics@friction": _make_joint_reader(0, "motor", "friction_nm"),
    "joint[@name='j3']/dynamics@damping": _make_joint_reader(2, "motor", "viscous_nm_s_per_rad"),
    "joint[@name='j3']/dynamics@friction": _make_joint_reader(2, "motor", "friction_nm"),
    "link[@name='b']/inertial/mass@value": lambda robot: robot.links[1].mass_kg,
    "robot@name": lambda robot: robot.name,
    "gazebo[1]/sensor@name": lambda robot: robot.sensors.depth[0].name,
    "gazebo[1]/sensor/update_rate": lambda robot: robot.sensors.depth[0].rate_hz,
    "gazebo[1]/sensor/camera/horizontal_fov": lambda robot: robot.sensors.depth[0].fov_rad,
    "gazebo[1]/sensor/camera/image/width": lambda robot: robot.sensors.depth[0].width,
    "gazebo[1]/sensor/camera/image/height": lambda robot: robot.sensors.depth[0].height,
    "gazebo[1]/sensor/camera/clip/near": lambda robot: robot.sensors.depth[0].range_min_m,
    "gazebo[1]/sensor/camera/clip/far": lambda robot: robot.sensors.depth[0].range_max_m,
    "gazebo[1]/sensor/camera/noise/stddev": lambda robot: robot.sensors.depth[0].noise_m,
    "gazebo[2]/sensor@name": lambda robot: robot.sensors.range[0].name,
    "gazebo[2]/sensor/update_rate": lambda robot: robot.sensors.range[0].rate_hz,
    "gazebo[2]/sensor/ray/scan/horizontal/samples": lambda robot: robot.sensors.range[0].beams,
    "gazebo[2]/sensor/ray/range/min": lambda robot: robot.sensors.range[0].range_min_m,
    "gazebo[2]/sensor/ray/range/max": lambda robot: robot.sensors.range[0].range_max_m,
    "gazebo[3]/sensor/update_rate": lambda robot: robot.sensors.imu and robot.sensors.imu.rate_hz,
}
"""Fields of the robot file that contain the same number as the URDF, by path and attribute."""

IN_RADIANS = re.compile(r"rpy|lower|upper|velocity|fov|angle")

BODY_VALUES = re.compile(
    r"origin@|inertia@|inertial/mass@|axis@|geometry/|/pose|(min|max)_angle|sensor@type|@link"
)
"""Values that the robot file has in another form, such as a place in another frame; a new value changes the robot."""


def _make_path(element: ET.Element, parent: ET.Element, parent_path: str) -> str:
    """Return a path that finds only this element.

    It names links and joints, and numbers other elements if there are several with one tag.
    """
    same = [child for child in parent if child.tag == element.tag]
    step = element.tag
    if element.tag in ("link", "joint") and parent_path == "":
        step += f"[@name='{element.get('name')}']"
    elif len(same) > 1:
        step += f"[{same.index(element) + 1}]"
    return f"{parent_path}/{step}" if parent_path else step


def _list_values() -> list[UrdfValue]:
    """List the attributes and texts of the URDF: one of each kind, and every one with an unchanged field."""
    root = ET.fromstring(SNAKE_URDF)
    values = [
        UrdfValue("robot", name, UNCHANGED_FIELDS.get(f"robot@{name}")) for name in root.attrib
    ]
    listed_kinds: set[str] = set()

    def add(value: UrdfValue, kind: str) -> None:
        """Add a value, unless one of its kind is in the list and no field contains its number."""
        if value.read_field is not None or kind not in listed_kinds:
            listed_kinds.add(kind)
            values.append(value)

    def visit(element: ET.Element, parent: ET.Element, parent_path: str, kind: str) -> None:
        """Add the values of an element and of all elements in it."""
        path = _make_path(element, parent, parent_path)
        kind += f"/{element.tag}"
        if element.tag == "limit":
            kind += f" of {parent.get('type')}"
        for name in element.attrib:
            field = UNCHANGED_FIELDS.get(f"{path}@{name}")
            add(UrdfValue(path, name, field), f"{kind}@{name}")
        if (element.text or "").strip():
            add(UrdfValue(path, "", UNCHANGED_FIELDS.get(path)), kind)
        for child in element:
            visit(child, element, path, kind)

    for child in root:
        visit(child, root, "", "")
    return values


URDF_VALUES = _list_values()


@dataclass(frozen=True)
class ChangedImport:
    """The import of a URDF in which one value was changed."""

    line: int  # of the change in the file
    text: str | None  # the changed value; None: left out
    error: str = ""  # of an import that refused the file
    result: ImportResult | None = None  # None: the import refused the file


def _list_report_lines(result: ImportResult) -> list[str]:
    """List the lines of all sections of an import report."""
    return [line for section in result.report.values() for line in section]


def _parse_numbers(text: str) -> list[float]:
    """Return the numbers of a text, or none if it contains anything else."""
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def _make_changes(name: str, original: str) -> dict[str, str | None]:
    """Make the changed texts of a value: left out, zero, negative, huge, and in a smaller unit."""
    numbers = _parse_numbers(original)
    if not numbers:
        return {
            "absent": None,
            "empty": "",
            "zero": "0",
            "negative": "-1",
            "huge": "x" * 3000,
            "other": "N·mm",
        }

    def scale(factor: float) -> str:
        """Return the numbers times a factor."""
        return " ".join(f"{factor * number:.12g}" for number in numbers)

    return {
        "absent": None,
        "zero": scale(0.0),
        "negative": " ".join(f"{-abs(number) - 0.001:.12g}" for number in numbers),
        "huge": " ".join("1e30" for _ in numbers),
        "other": scale(180.0 / math.pi if IN_RADIANS.search(name) else 1000.0),
    }


def _find_element(root: ET.Element, value: UrdfValue) -> ET.Element:
    """Find the element that contains this value."""
    element = root if value.path == "robot" else root.find(value.path)
    assert element is not None, value.name
    return element


def _read_original(value: UrdfValue) -> str:
    """Return the text of a value in the unchanged URDF."""
    element = _find_element(ET.fromstring(SNAKE_URDF), value)
    return element.attrib[value.attribute] if value.attribute else str(element.text)


def _change_value(root: ET.Element, value: UrdfValue, text: str | None) -> ET.Element:
    """Change one value, and return the element whose line the report must name."""
    element = _find_element(root, value)
    if value.attribute and text is None:
        del element.attrib[value.attribute]
    elif value.attribute:
        element.set(value.attribute, str(text))
    elif text is None:
        parent = next(candidate for candidate in root.iter() if element in list(candidate))
        parent.remove(element)
        return parent
    else:
        element.text = text
    return element


def _write_urdf(root: ET.Element, file: Path) -> Path:
    """Write a URDF with one tag in each line."""
    ET.indent(root)
    file.write_bytes(ET.tostring(root))
    return file


def _import_changed(value: UrdfValue, text: str | None, file: Path) -> ChangedImport:
    """Import the URDF with one value changed."""
    root = ET.fromstring(SNAKE_URDF)
    element = _change_value(root, value, text)
    _write_urdf(root, file)
    line = _find_line(root, element)
    try:
        return ChangedImport(line, text, result=import_urdf(file, ImportOptions()))
    except ConfigError as error:
        return ChangedImport(line, text, str(error))


def _find_line(root: ET.Element, wanted: ET.Element) -> int:
    """Return the line of an element in a file that `_write_urdf` wrote."""
    line = 0

    def visit(element: ET.Element) -> int | None:
        """Count the lines up to the wanted element; return None if it is not in this element."""
        nonlocal line
        line += 1
        if element is wanted:
            return line
        for child in element:
            found_line = visit(child)
            if found_line is not None:
                return found_line
        if len(element):
            line += 1
        return None

    wanted_line = visit(root)
    assert wanted_line is not None
    return wanted_line


def _names_line(report_line: str, number: int) -> bool:
    """Return whether a line of the report names a line of the file."""
    return any(
        str(number) in re.findall(r"\d+", numbers)
        for numbers in re.findall(r"\blines? ([\d, ]+)", report_line)
    )


def _is_reported(report_lines: list[str], line: int, text: str) -> bool:
    """Return whether the report has a line with this value and this line of the file."""
    numbers = _parse_numbers(text)
    spellings = [text[:50], *(f"{number:g}" for number in numbers[:1])]
    return any(
        _names_line(report_line, line) and any(spelling in report_line for spelling in spellings)
        for report_line in report_lines
    )


def _is_refused_with_place(changed: ChangedImport) -> bool:
    """Return whether the import refused the file, and names a line or a field."""
    return re.search(r"line \d+:|`[\w.]+`", changed.error) is not None


def _is_kept(value: UrdfValue, changed: ChangedImport, base: RobotFile) -> bool:
    """Return whether the robot file contains the changed value.

    A value that a robot file has in another form is kept if it changes the robot.

    Args:
        value: The value that was changed.
        changed: The import of the URDF with the change.
        base: The robot of the unchanged URDF.
    """
    if changed.result is None or changed.text is None:
        return False
    robot = changed.result.robot
    if value.read_field is None:
        return BODY_VALUES.search(value.name) is not None and robot != base
    field = value.read_field(robot)
    numbers = _parse_numbers(changed.text)
    return field == changed.text or (
        len(numbers) > 0 and field == pytest.approx(numbers[0], rel=1e-9)
    )


def _is_in_report(value: UrdfValue, changed: ChangedImport) -> bool:
    """Return whether a line of the report names the line of the change, and the value or what is missing."""
    if changed.result is None:
        return False
    report_lines = _list_report_lines(changed.result)
    if changed.text is not None:
        return _is_reported(report_lines, changed.line, changed.text)
    missing_name = value.attribute or value.path.rpartition("/")[2].partition("[")[0]
    return any(missing_name in line and _names_line(line, changed.line) for line in report_lines)


def _import_text(text: str, file: Path) -> ImportResult:
    """Write a URDF with one tag in each line, and import it."""
    return import_urdf(_write_urdf(ET.fromstring(text), file), ImportOptions())


def _list_unread_values(file: Path) -> list[UrdfValue]:
    """List the values that an import of the unchanged URDF does not read; the URDF is written to this file."""
    root = ET.fromstring(SNAKE_URDF)
    left_out = _import_text(SNAKE_URDF, file).left_out
    ET.indent(root)
    return [
        value
        for value in URDF_VALUES
        if value.read_field is None
        and _is_reported(
            left_out, _find_line(root, _find_element(root, value)), _read_original(value)
        )
    ]


def test_urdf_report_lists_every_unread_value(tmp_path: Path) -> None:
    """One import contains all changes of a kind, because an import for each value would be slow."""
    file = tmp_path / "robot.urdf"
    unread = _list_unread_values(file)
    base = import_urdf(file, ImportOptions()).robot
    assert len(unread) > 30, "the URDF must have values of many kinds that no import reads"

    for kind in ("zero", "negative", "huge"):
        root = ET.fromstring(SNAKE_URDF)
        changes: list[tuple[UrdfValue, ET.Element, str]] = []
        for value in unread:
            text = str(_make_changes(value.name, _read_original(value))[kind])
            changes.append((value, _change_value(root, value, text), text))

        result = import_urdf(_write_urdf(root, file), ImportOptions())

        assert result.robot == base, f"an unread value changed the robot: {kind}"
        for value, element, text in changes:
            assert _is_reported(result.left_out, _find_line(root, element), text), (
                f"{value.name} = {text[:50]}"
            )


def _list_read_values() -> list[UrdfValue]:
    """List the values that an import of the unchanged URDF reads."""
    with tempfile.TemporaryDirectory() as folder:
        unread = _list_unread_values(Path(folder) / "robot.urdf")
    return [value for value in URDF_VALUES if value not in unread]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> RobotFile:
    """The robot of the unchanged URDF."""
    return _import_text(SNAKE_URDF, tmp_path_factory.mktemp("base") / "robot.urdf").robot


@pytest.mark.parametrize("value", _list_read_values(), ids=lambda value: value.name)
def test_urdf_read_value_is_kept_reported_or_refused(
    value: UrdfValue, base: RobotFile, tmp_path: Path
) -> None:
    """Change one value in each of several ways. No change may vanish without a word to the user."""
    vanished: list[str] = []
    for change_name, text in _make_changes(value.name, _read_original(value)).items():
        changed = _import_changed(value, text, tmp_path / "robot.urdf")

        is_accounted_for = (
            _is_refused_with_place(changed)
            or _is_kept(value, changed, base)
            or _is_in_report(value, changed)
        )
        if not is_accounted_for:
            outcome = changed.error or "accepted, but neither in the robot file nor in the report"
            vanished.append(f"{change_name} ({str(text)[:50]!r}, line {changed.line}): {outcome}")

    assert not vanished, f"changes of {value.name} that vanished:\n" + "\n".join(vanished)


def _find_text_line(text: str) -> int:
    """Return the number of the line of the unchanged URDF that contains a text."""
    [number] = [i + 1 for i, line in enumerate(SNAKE_URDF.splitlines()) if text in line]
    return number


def _import_with_edits(tmp_path: Path, *edits: tuple[str, str]) -> ImportResult:
    """Import the URDF after texts, each of which occurs once, were replaced."""
    text = SNAKE_URDF
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    return import_urdf(file, ImportOptions())


def test_urdf_report_joint_friction_is_individual_or_absent(tmp_path: Path) -> None:
    without_dynamics_of_j3 = ('<dynamics damping="0.04" friction="0.07"/>', "")

    result = _import_with_edits(tmp_path, without_dynamics_of_j3)

    assert [joint.motor.friction_nm for joint in result.robot.joint_table] == [0.06, 0.06, 0.0]
    assert [joint.motor.viscous_nm_s_per_rad for joint in result.robot.joint_table] == [
        0.03,
        0.03,
        0.0,
    ]
    line = _find_text_line('name="j3"')
    expected = f"<dynamics friction> has no value: 0 N·m, the URDF default for a missing value: j3 (line {line})"
    assert expected in result.assumed, "it names the line of the joint, which has no <dynamics>"


def test_urdf_report_joint_without_motor_gets_none_from_neighbors(tmp_path: Path) -> None:
    """The effort 4.7 Nm of j3 is replaced by zero, which is refused, or left out, which assumes the smallest other."""
    line = _find_text_line('effort="4.7"')
    with raises_error(ConfigError, code="urdf/invalid", field="j3", value=0):
        _import_with_edits(tmp_path, ('effort="4.7"', 'effort="0"'))

    absent = _import_with_edits(tmp_path, ('effort="4.7" ', ""))
    assert absent.robot.joint_table[2].limits.torque_nm == 4.5, "no more than any other joint"
    expected = "<limit effort> has no value: 4.5 N·m, the smallest of the other joints; is there a motor in this joint?"
    assert f"{expected}: j3 (line {line})" in absent.assumed


def test_urdf_report_lists_assumptions_for_all_zero_limits(tmp_path: Path) -> None:
    result = _import_with_edits(
        tmp_path, *[(f'effort="{effort}"', 'effort="0"') for effort in ("4.5", "4.6", "4.7")]
    )
    assert {joint.limits.torque_nm for joint in result.robot.joint_table} == {7.0}, "as planar13"
    expected = "<limit effort> has 0: 7 N·m, from the robot of --like, because no joint has a value"
    places = [f"j{i + 1} (line {_find_text_line(f'4.{5 + i}')})" for i in range(3)]
    assert f"{expected}: {', '.join(places)}" in result.assumed


@pytest.mark.parametrize(
    ("old", "new"), [('lower="-1.2"', 'lower="-90"'), ('upper="1.1"', 'upper="90"')]
)
def test_urdf_import_limits_in_degrees_are_refused(old: str, new: str, tmp_path: Path) -> None:
    with raises_error(ConfigError, code="urdf/invalid", field="j1"):
        _import_with_edits(tmp_path, (old, new))


def test_urdf_report_two_turns_are_cut_to_one(tmp_path: Path) -> None:
    result = _import_with_edits(
        tmp_path, ('lower="-1.2" upper="1.1"', 'lower="-6.28319" upper="6.28319"')
    )
    assert result.robot.joint_table[0].limits.upper_rad == pytest.approx(math.pi, abs=1e-5)
    cuts = [line for line in result.changed if "half a turn" in line]
    assert len(cuts) == 2
    assert all(line.endswith(f"j1 (line {_find_text_line('4.5')})") for line in cuts)
    assert cuts[1].startswith("`upper` = 6.28319 rad became 3.14159 rad")


def test_urdf_report_asks_to_check_unusual_values(tmp_path: Path) -> None:
    result = _import_with_edits(
        tmp_path, ('effort="4.5"', 'effort="450"'), ('velocity="3.6"', 'velocity="60"')
    )
    assert result.robot.joint_table[0].limits.torque_nm == 450
    fast = "`velocity` = 60 rad/s is much for a snake robot; is it in degrees per second?"
    strong = "`effort` = 450 N·m is much for a snake robot; is it in N·mm?"
    assert result.doubtful == [
        f"{fast}: j2 (line {_find_text_line('4.6')})",
        f"{strong}: j1 (line {_find_text_line('4.5')})",
    ]


def test_urdf_import_bounds_equal_those_of_robot_file() -> None:
    """The decoder of a robot file refuses such a value, too, but without the line of the URDF."""
    motor_gains = (
        "stiffness_nm_per_rad",
        "velocity_gain_nm_s_per_rad",
        "damping_nm_s_per_rad",
        "response_time_s",
    )
    valid_values: dict[str, tuple[type[msgspec.Struct], dict[str, float]]] = {
        "limits": (
            MotionLimits,
            dict.fromkeys(("angle_rad", "acceleration_rad_s2", "torque_rate_nm_s"), 1.0),
        ),
        "motor": (JointMotor, dict.fromkeys((*motor_gains, "armature_kg_m2"), 0.5)),
    }
    for quantity in JOINT_QUANTITIES:
        struct, values = valid_values[quantity.section]
        values = values | {
            other.key: 0.5 for other in JOINT_QUANTITIES if other.section == quantity.section
        }
        msgspec.convert({**values, quantity.key: quantity.maximum}, struct)
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert({**values, quantity.key: quantity.maximum * 1.001}, struct)


def test_urdf_report_edited_export_is_refused_or_listed(tmp_path: Path) -> None:
    file = tmp_path / "robot.urdf"
    text = format_urdf(decode_table(read_table_with_base("planar13_camera", "robots"), RobotFile))
    file.write_text(text)

    reimported = import_urdf(file, ImportOptions())
    assert not reimported.changed
    assert not reimported.assumed
    assert not reimported.doubtful
    assert all("a name of its own" in line for line in reimported.left_out), (
        "an export and its import lose nothing"
    )

    wider_image = text.replace("<width>160</width>", "<width>320</width>", 1)
    file.write_text(wider_image)
    assert any(
        "<width> left out: '320'" in line for line in import_urdf(file, ImportOptions()).left_out
    )

    file.write_text(text.replace("</robot>", '<snakesim key="chain.modules" value="3"/></robot>'))
    with raises_error(ConfigError, code="urdf/invalid"):
        import_urdf(file, ImportOptions())

    repeated_key = '<snakesim key="safety.action" value="&quot;passive&quot;"/></robot>'
    file.write_text(text.replace("</robot>", repeated_key))
    with raises_error(ConfigError, code="urdf/invalid"):
        import_urdf(file, ImportOptions())


def test_urdf_import_never_copies_check_of_another_robot(tmp_path: Path) -> None:
    like = tmp_path / "like.toml"
    like.write_text(
        'extends = "planar13"\n[checked]\nby = "me"\non = "today"\njoints = "abc"\nbackend = "can"\n'
    )
    (tmp_path / "robot.urdf").write_text(SNAKE_URDF)

    robot = import_urdf(tmp_path / "robot.urdf", ImportOptions(like=str(like))).robot

    assert robot.checked is None, "a person has checked another robot"


def test_urdf_import_prints_length_of_whole_body(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The field `length_m` of a robot excludes the rounded caps of tail and head, so the text adds them."""
    (tmp_path / "robot.urdf").write_text(SNAKE_URDF)
    import_robot(tmp_path / "robot.urdf", ImportOptions(), tmp_path / "robot.toml")
    printed = capsys.readouterr().out
    robot = import_urdf(tmp_path / "robot.urdf", ImportOptions()).robot
    assert (
        f"3 joints (yaw), {robot.length_m + 2 * robot.module.radius_m:.3f} m, 1.260 kg" in printed
    )
    assert "<material><color rgba>" not in printed, "values of looks are in the file only"
    assert (
        "<material><color rgba> left out: '0.5 0.6 0.7 1' (line 3)"
        in (tmp_path / "robot.toml").read_text()
    )
