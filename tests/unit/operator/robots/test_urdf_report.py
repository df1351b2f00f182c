"""No value of a URDF is dropped, changed or assumed in silence: for every attribute of every element that URDF has.

Each row of ROWS is an attribute of `urdf/every_attribute.urdf`. It is left out, set to zero, negated, made huge and
given in another unit. Then the file is refused, with its line or its field; or the value is in the robot file as it was
given; or the report has a line with that value and its line number.
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

SNAKE = (Path(__file__).parent / "urdf" / "every_attribute.urdf").read_text()

Place = Callable[[RobotFile], Any]


@dataclass(frozen=True)
class Row:
    """An attribute of the URDF, or the text of an element (no attribute), and where a robot file keeps its number."""

    path: str
    attribute: str = ""
    keeps: Place | None = None

    @property
    def name(self) -> str:
        return f"{self.path}@{self.attribute}" if self.attribute else self.path


def _joint(i: int, section: str, field: str) -> Place:
    return lambda robot: getattr(getattr(robot.joint_table[i], section), field)


KEPT: dict[str, Place] = {
    "joint[@name='j1']/limit@lower": _joint(0, "limits", "lower_rad"),
    "joint[@name='j1']/limit@upper": _joint(0, "limits", "upper_rad"),
    "joint[@name='j1']/limit@effort": _joint(0, "limits", "torque_nm"),
    "joint[@name='j1']/limit@velocity": _joint(0, "limits", "speed_rad_s"),
    "joint[@name='j3']/limit@effort": _joint(2, "limits", "torque_nm"),
    "joint[@name='j3']/limit@velocity": _joint(2, "limits", "speed_rad_s"),
    "joint[@name='j1']/dynamics@damping": _joint(0, "motor", "viscous_nm_s_per_rad"),
    "joint[@name='j1']/dynamics@friction": _joint(0, "motor", "friction_nm"),
    "joint[@name='j3']/dynamics@damping": _joint(2, "motor", "viscous_nm_s_per_rad"),
    "joint[@name='j3']/dynamics@friction": _joint(2, "motor", "friction_nm"),
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
"""Numbers that are in the robot file as they are in the URDF."""

IN_RADIANS = re.compile(r"rpy|lower|upper|velocity|fov|angle")

CHANGE_THE_BODY = re.compile(
    r"origin@|inertia@|inertial/mass@|axis@|geometry/|/pose|(min|max)_angle|sensor@type|@link"
)
"""What the robot file has in another form, such as a place in another frame: there another value is another robot."""


def _path_of(element: ET.Element, parent: ET.Element, path: str) -> str:
    """A path that finds this element alone: links and joints by name, others by their number if there are several."""
    same = [child for child in parent if child.tag == element.tag]
    step = element.tag
    if element.tag in ("link", "joint") and path == "":
        step += f"[@name='{element.get('name')}']"
    elif len(same) > 1:
        step += f"[{same.index(element) + 1}]"
    return f"{path}/{step}" if path else step


def _rows() -> list[Row]:
    """A row for each attribute and text of SNAKE."""
    root = ET.fromstring(SNAKE)
    rows = [Row("robot", name, KEPT.get(f"robot@{name}")) for name in root.attrib]

    seen: set[str] = set()

    def add(row: Row, kind: str) -> None:
        """A row for each kind of value; of one that is in the robot file as it is, every one."""
        if row.keeps is not None or kind not in seen:
            seen.add(kind)
            rows.append(row)

    def visit(element: ET.Element, parent: ET.Element, within: str, kind: str) -> None:
        path = _path_of(element, parent, within)
        kind += f"/{element.tag}"
        if element.tag == "limit":
            kind += f" of {parent.get('type')}"
        for name in element.attrib:
            add(Row(path, name, KEPT.get(f"{path}@{name}")), f"{kind}@{name}")
        if (element.text or "").strip():
            add(Row(path, "", KEPT.get(path)), kind)
        for child in element:
            visit(child, element, path, kind)

    for child in root:
        visit(child, root, "", "")
    return rows


ROWS = _rows()


@dataclass(frozen=True)
class Tried:
    """A file with one value changed: where it is, what it says, and what became of it."""

    line: int
    value: str | None  # None: left out
    error: str = ""
    found: ImportResult | None = None


def _lines(found: ImportResult) -> list[str]:
    return [line for section in found.report.values() for line in section]


def _numbers(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def _values(name: str, given: str) -> dict[str, str | None]:
    """What the attribute is set to: left out, zero, negative, huge, and in a unit that is smaller."""
    numbers = _numbers(given)
    if not numbers:
        return {
            "absent": None,
            "empty": "",
            "zero": "0",
            "negative": "-1",
            "huge": "x" * 3000,
            "other": "N·mm",
        }

    def times(factor: float) -> str:
        return " ".join(f"{factor * number:.12g}" for number in numbers)

    return {
        "absent": None,
        "zero": times(0.0),
        "negative": " ".join(f"{-abs(number) - 0.001:.12g}" for number in numbers),
        "huge": " ".join("1e30" for _ in numbers),
        "other": times(180.0 / math.pi if IN_RADIANS.search(name) else 1000.0),
    }


def _element(root: ET.Element, row: Row) -> ET.Element:
    found = root if row.path == "robot" else root.find(row.path)
    assert found is not None, row.name
    return found


def _given(row: Row) -> str:
    """What SNAKE says."""
    element = _element(ET.fromstring(SNAKE), row)
    return element.attrib[row.attribute] if row.attribute else str(element.text)


def _edit(root: ET.Element, row: Row, value: str | None) -> ET.Element:
    """Change one value. Returns the element in whose line the report has to find it."""
    element = _element(root, row)
    if row.attribute and value is None:
        del element.attrib[row.attribute]
    elif row.attribute:
        element.set(row.attribute, str(value))
    elif value is None:
        parent = next(one for one in root.iter() if element in list(one))
        parent.remove(element)
        return parent
    else:
        element.text = value
    return element


def _written(root: ET.Element, file: Path) -> Path:
    ET.indent(root)
    file.write_bytes(ET.tostring(root))
    return file


def _try(row: Row, value: str | None, file: Path) -> Tried:
    root = ET.fromstring(SNAKE)
    element = _edit(root, row, value)
    _written(root, file)
    line = _line_of(root, element)
    try:
        return Tried(line, value, found=import_urdf(file, ImportOptions()))
    except ConfigError as error:
        return Tried(line, value, str(error))


def _line_of(root: ET.Element, wanted: ET.Element) -> int:
    """The line of an element in a file that ET.indent has laid out, where each tag has a line."""
    line = 0

    def visit(element: ET.Element) -> int | None:
        nonlocal line
        line += 1
        if element is wanted:
            return line
        for child in element:
            at = visit(child)
            if at is not None:
                return at
        if len(element):
            line += 1
        return None

    at = visit(root)
    assert at is not None
    return at


def _mentions(line: str, number: int) -> bool:
    """Whether a line of the report names a line of the file."""
    return any(
        str(number) in re.findall(r"\d+", places)
        for places in re.findall(r"\blines? ([\d, ]+)", line)
    )


def _is_reported(lines: list[str], line: int, value: str) -> bool:
    """Whether the report has a line with this value and this line of the file."""
    numbers = _numbers(value)
    spellings = [value[:50], *(f"{number:g}" for number in numbers[:1])]
    return any(
        _mentions(one, line) and any(spelling in one for spelling in spellings) for one in lines
    )


def _accounted(row: Row, tried: Tried, base: RobotFile) -> bool:
    """Refused with its place, kept as it is, or reported with value and line."""
    if tried.found is None:
        return re.search(r"line \d+:|`[\w.]+`", tried.error) is not None
    robot = tried.found.robot
    if tried.value is None:
        what = row.attribute or row.path.rpartition("/")[2].partition("[")[0]
        return any(what in line and _mentions(line, tried.line) for line in _lines(tried.found))
    said = _numbers(tried.value)
    if row.keeps is not None:
        kept = row.keeps(robot)
        if kept == tried.value or (said and kept == pytest.approx(said[0], rel=1e-9)):
            return True
    elif CHANGE_THE_BODY.search(row.name) and robot != base:
        return True
    return _is_reported(_lines(tried.found), tried.line, tried.value)


def _imported(text: str, file: Path) -> ImportResult:
    return import_urdf(_written(ET.fromstring(text), file), ImportOptions())


def _unread(file: Path) -> list[Row]:
    """Rows that the import of SNAKE leaves out."""
    root = ET.fromstring(SNAKE)
    left_out = _imported(SNAKE, file).left_out
    ET.indent(root)
    rows = [row for row in ROWS if row.keeps is None]
    return [
        row
        for row in rows
        if _is_reported(left_out, _line_of(root, _element(root, row)), _given(row))
    ]


def test_whatever_is_not_read_is_reported_whatever_it_says(tmp_path: Path) -> None:
    """All of it at once, which is many times as fast; see the next test for the values that are read."""
    file = tmp_path / "robot.urdf"
    rows = _unread(file)
    base = import_urdf(file, ImportOptions()).robot
    assert len(rows) > 30
    for kind in ("zero", "negative", "huge"):
        root = ET.fromstring(SNAKE)
        places: list[tuple[Row, ET.Element, str]] = []
        for row in rows:
            value = str(_values(row.name, _given(row))[kind])
            places.append((row, _edit(root, row, value), value))
        found = import_urdf(_written(root, file), ImportOptions())
        assert found.robot == base
        for row, element, value in places:
            assert _is_reported(found.left_out, _line_of(root, element), value), (
                f"{row.name} = {value[:50]}"
            )


def _read() -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        unread = _unread(Path(folder) / "robot.urdf")
    return [row for row in ROWS if row not in unread]


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> RobotFile:
    return _imported(SNAKE, tmp_path_factory.mktemp("base") / "robot.urdf").robot


@pytest.mark.parametrize("row", _read(), ids=lambda row: row.name)
def test_every_value_that_is_read_is_kept_reported_or_refused(
    row: Row, base: RobotFile, tmp_path: Path
) -> None:
    lost: list[str] = []
    for name, value in _values(row.name, _given(row)).items():
        tried = _try(row, value, tmp_path / "robot.urdf")
        if not _accounted(row, tried, base):
            lost.append(
                f"{name} ({str(value)[:50]!r}, line {tried.line}): {tried.error or 'no line of the report'}"
            )
    assert not lost, "\n".join(lost)


def _line(text: str) -> int:
    """The line of SNAKE that holds a text."""
    [number] = [i + 1 for i, line in enumerate(SNAKE.splitlines()) if text in line]
    return number


def _edited(tmp_path: Path, *edits: tuple[str, str]) -> ImportResult:
    text = SNAKE
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    file = tmp_path / "robot.urdf"
    file.write_text(text)
    return import_urdf(file, ImportOptions())


def test_urdf_report_joint_friction_is_individual_or_absent(tmp_path: Path) -> None:
    found = _edited(tmp_path, ('<dynamics damping="0.04" friction="0.07"/>', ""))
    assert [joint.motor.friction_nm for joint in found.robot.joint_table] == [0.06, 0.06, 0.0]
    assert [joint.motor.viscous_nm_s_per_rad for joint in found.robot.joint_table] == [
        0.03,
        0.03,
        0.0,
    ]
    line = _line('name="j3"')
    said = f"<dynamics friction> has no value: 0 N·m, the URDF default for a missing value: j3 (line {line})"
    assert said in found.assumed, "the line of the joint, which has no <dynamics>"


def test_urdf_report_joint_without_motor_gets_none_from_neighbors(tmp_path: Path) -> None:
    line = _line('effort="4.7"')
    with raises_error(ConfigError, code="urdf/invalid", field="j3", value=0):
        _edited(tmp_path, ('effort="4.7"', 'effort="0"'))
    absent = _edited(tmp_path, ('effort="4.7" ', ""))
    assert absent.robot.joint_table[2].limits.torque_nm == 4.5, "not more than any other joint has"
    said = "<limit effort> has no value: 4.5 N·m, the smallest of the other joints; is there a motor in this joint?"
    assert f"{said}: j3 (line {line})" in absent.assumed


def test_urdf_report_lists_assumptions_for_all_zero_limits(tmp_path: Path) -> None:
    found = _edited(
        tmp_path, *[(f'effort="{effort}"', 'effort="0"') for effort in ("4.5", "4.6", "4.7")]
    )
    assert {joint.limits.torque_nm for joint in found.robot.joint_table} == {7.0}, "as planar13"
    said = "<limit effort> has 0: 7 N·m, from the robot of --like, because no joint has a value"
    places = [f"j{i + 1} (line {_line(f'4.{5 + i}')})" for i in range(3)]
    assert f"{said}: {', '.join(places)}" in found.assumed


@pytest.mark.parametrize(
    ("old", "new"), [('lower="-1.2"', 'lower="-90"'), ('upper="1.1"', 'upper="90"')]
)
def test_limits_in_degrees_are_refused(old: str, new: str, tmp_path: Path) -> None:
    with raises_error(ConfigError, code="urdf/invalid", field="j1"):
        _edited(tmp_path, (old, new))


def test_urdf_report_two_turns_are_cut_to_one(tmp_path: Path) -> None:
    found = _edited(tmp_path, ('lower="-1.2" upper="1.1"', 'lower="-6.28319" upper="6.28319"'))
    assert found.robot.joint_table[0].limits.upper_rad == pytest.approx(math.pi, abs=1e-5)
    cuts = [line for line in found.changed if "half a turn" in line]
    assert len(cuts) == 2
    assert all(line.endswith(f"j1 (line {_line('4.5')})") for line in cuts)
    assert cuts[1].startswith("`upper` = 6.28319 rad became 3.14159 rad")


def test_what_is_allowed_and_odd_is_to_be_checked(tmp_path: Path) -> None:
    found = _edited(tmp_path, ('effort="4.5"', 'effort="450"'), ('velocity="3.6"', 'velocity="60"'))
    assert found.robot.joint_table[0].limits.torque_nm == 450
    fast = "`velocity` = 60 rad/s is much for a snake robot; is it in degrees per second?"
    strong = "`effort` = 450 N·m is much for a snake robot; is it in N·mm?"
    assert found.doubtful == [
        f"{fast}: j2 (line {_line('4.6')})",
        f"{strong}: j1 (line {_line('4.5')})",
    ]


def test_bounds_are_those_of_a_robot_file() -> None:
    """`decode` would refuse the value too, without the line of the URDF."""
    motor = (
        "stiffness_nm_per_rad",
        "velocity_gain_nm_s_per_rad",
        "damping_nm_s_per_rad",
        "response_time_s",
    )
    good: dict[str, tuple[type[msgspec.Struct], dict[str, float]]] = {
        "limits": (
            MotionLimits,
            dict.fromkeys(("angle_rad", "acceleration_rad_s2", "torque_rate_nm_s"), 1.0),
        ),
        "motor": (JointMotor, dict.fromkeys((*motor, "armature_kg_m2"), 0.5)),
    }
    for number in JOINT_QUANTITIES:
        struct, values = good[number.section]
        values = values | {
            other.key: 0.5 for other in JOINT_QUANTITIES if other.section == number.section
        }
        msgspec.convert({**values, number.key: number.maximum}, struct)
        with pytest.raises(msgspec.ValidationError):
            msgspec.convert({**values, number.key: number.maximum * 1.001}, struct)


def test_urdf_report_edit_of_our_export_counts_or_is_listed(tmp_path: Path) -> None:
    file = tmp_path / "robot.urdf"
    text = format_urdf(decode_table(read_table_with_base("planar13_camera", "robots"), RobotFile))
    file.write_text(text)
    back = import_urdf(file, ImportOptions())
    assert not back.changed
    assert not back.assumed
    assert not back.doubtful
    assert all("a name of its own" in line for line in back.left_out), (
        "the way there and back loses nothing"
    )
    camera = text.replace("<width>160</width>", "<width>320</width>", 1)
    file.write_text(camera)
    assert any(
        "<width> left out: '320'" in line for line in import_urdf(file, ImportOptions()).left_out
    )
    file.write_text(text.replace("</robot>", '<snakesim key="chain.modules" value="3"/></robot>'))
    with raises_error(ConfigError, code="urdf/invalid"):
        import_urdf(file, ImportOptions())
    once_more = '<snakesim key="safety.action" value="&quot;passive&quot;"/></robot>'
    file.write_text(text.replace("</robot>", once_more))
    with raises_error(ConfigError, code="urdf/invalid"):
        import_urdf(file, ImportOptions())


def test_urdf_report_check_of_another_robot_does_not_count(tmp_path: Path) -> None:
    like = tmp_path / "like.toml"
    like.write_text(
        'extends = "planar13"\n[checked]\nby = "me"\non = "today"\njoints = "abc"\nbackend = "can"\n'
    )
    (tmp_path / "robot.urdf").write_text(SNAKE)
    assert import_urdf(tmp_path / "robot.urdf", ImportOptions(like=str(like))).robot.checked is None


def test_the_printed_length_is_that_of_the_whole_body(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`length_m` of a robot leaves the rounded caps of tail and head out."""
    (tmp_path / "robot.urdf").write_text(SNAKE)
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
