"""Reads and writes the sensors of a URDF: <gazebo reference="LINK"><sensor type="...">, as Gazebo defines them.

These are IMUs, contact sensors, depth cameras and lidars. The IMU and the contact sensor of a robot file are on every
link, so one of them in the URDF stands for all. Values that a robot file cannot hold are not read, and so reported.
"""

import math
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import shorten
from snakesim_hal.model.robot_file.robot import RobotFile
from snakesim_hal.model.robot_file.sensors import DepthCamera, RangeSensor
from snakesim_operator.features.robots.imported import ImportResult
from snakesim_operator.features.robots.urdf_tree import BodyChain, make_rotation_from_rpy
from snakesim_operator.features.robots.xml_tree import XmlElement

# Gazebo's type -> its section in [sensors].
SECTION_BY_SENSOR_TYPE = {"imu": "imu", "contact": "contacts"}
DEPTH_SENSOR_TYPES = ("depth", "depth_camera", "rgbd_camera")
RANGE_SENSOR_TYPES = ("ray", "gpu_ray", "lidar", "gpu_lidar")
DEFAULT_BEAMS = "one beam"  # of a lidar without <horizontal>, as the report of the import names it
# Of a lidar without <range>, as the report of the import names it.
DEFAULT_LIDAR_RANGE = "0.02 to 5 m"
MAX_ROLL_RAD = 0.01  # about the viewing direction; more is reported
POSE_DIGITS = 9  # decimals, which removes the noise of multiplying transforms
# As in snakesim_hal.model.robot_file.sensors.
DEFAULT_RATE_HZ_BY_SECTION = {"imu": 100.0, "contacts": 100.0, "depth": 20.0, "range": 20.0}


def convert_sensors(
    result: ImportResult,
    urdf: XmlElement,
    chain: BodyChain,
    link_frames: list[Floats],
    scale: float,
) -> None:
    """Convert the sensors of a URDF into values of a robot file, and report those that a robot file cannot hold.

    Args:
        result: Result of the import, whose values and report are extended.
        urdf: The root element of the URDF.
        chain: Bodies and joints of the URDF, tail to head.
        link_frames: Transform link_from_root of every link, (4, 4) with lengths in m.
        scale: Meters per unit of length of the file.

    Raises:
        ConfigError: A value of a sensor is wrong.
    """
    link_indices = {name: i for i, body in enumerate(chain.bodies) for name in body.links}
    for gazebo in urdf.find_children("gazebo"):
        reference = gazebo.attributes.get("reference", "")
        for sensor in gazebo.find_children("sensor"):
            sensor_type = sensor.attributes.get("type", "")
            if sensor_type in SECTION_BY_SENSOR_TYPE:
                gazebo.read_optional_attribute("reference")
                _add_sensor_of_all_links(
                    result, sensor, SECTION_BY_SENSOR_TYPE[sensor_type], reference
                )
            elif (
                sensor_type in (*DEPTH_SENSOR_TYPES, *RANGE_SENSOR_TYPES)
                and reference in link_indices
            ):
                gazebo.read_optional_attribute("reference")
                link = link_indices[reference]
                root_from_reference = _scale_translation(
                    chain.bodies[link].frames[reference], scale
                )
                link_from_reference = link_frames[link] @ root_from_reference
                _add_sensor_of_one_link(result, sensor, link, link_from_reference, scale)
            else:
                sensor.read = False
                _report_unsupported_sensor(result, gazebo, sensor, sensor_type, reference)


def _report_unsupported_sensor(
    result: ImportResult, gazebo: XmlElement, sensor: XmlElement, kind: str, reference: str
) -> None:
    known = ", ".join((*SECTION_BY_SENSOR_TYPE, *DEPTH_SENSOR_TYPES, *RANGE_SENSOR_TYPES))
    result.omissions.add(
        f"a sensor whose `type` is {shorten(kind)!r}, in an element whose `reference` is "
        f"{shorten(reference)!r}, left out: a robot file has {known}, on a link",
        f"line {sensor.line}",
        f"line {gazebo.line}",
    )


def _add_sensor_of_all_links(
    result: ImportResult, sensor: XmlElement, section: str, reference: str
) -> None:
    """Add an IMU or a contact sensor, which a robot file has on every link."""
    sensor.read_optional_attribute("type")
    name = sensor.read_optional_attribute("name") or ""
    result.changes.add(
        f"sensor {shorten(name)!r} of link {shorten(reference)!r}: in a robot file [sensors.{section}] is on "
        "every link, "
        f"and has no name",
        sensor.place,
    )
    rate = _read_rate(result, sensor, section)
    existing = result.table.values.get("sensors", {}).get(section) or {}
    result.table.set_value(f"sensors.{section}", existing | rate, sensor.source)


def _add_sensor_of_one_link(
    result: ImportResult,
    sensor: XmlElement,
    link_index: int,
    link_from_reference: Floats,
    scale: float,
) -> None:
    """Convert a depth camera or a lidar with its pose on a link, and add it to the values of the robot file.

    Args:
        result: Result of the import, whose values and report are extended.
        sensor: The <sensor> element.
        link_index: Index of the link, from 0 at the tail.
        link_from_reference: Transform from the frame that the sensor is attached to, (4, 4) with lengths in m.
        scale: Meters per unit of length of the file.

    Raises:
        ConfigError: A value of the sensor is wrong.
    """
    sensor_type = sensor.read_attribute("type")
    section = "depth" if sensor_type in DEPTH_SENSOR_TYPES else "range"
    name = sensor.read_attribute("name", "sensor")
    values: dict[str, Any] = _read_rate(result, sensor, section)
    values["name"] = result.make_plain_name(name, "sensor", sensor)
    values["link"] = link_index
    reference_from_sensor = _scale_translation(_read_pose(sensor), scale)
    values |= _convert_pose(result, link_from_reference @ reference_from_sensor, sensor)
    if section == "depth":
        values |= _read_camera(result, sensor)
    else:
        values |= _read_lidar(result, sensor, values["yaw_rad"])
    existing = result.table.values.get("sensors", {}).get(section, [])
    result.table.set_value(f"sensors.{section}", [*existing, values], sensor.source)


def _read_rate(result: ImportResult, sensor: XmlElement, section: str) -> dict[str, Any]:
    """Return `rate_hz` of a sensor; nothing if the file gives none or 0. Then the robot file's rate is reported."""
    element = sensor.find_child("update_rate")
    rate_hz = 0.0 if element is None else element.read_text_numbers(1)[0]
    if rate_hz < 0:
        raise sensor.make_error(f"has <update_rate> {rate_hz:g} Hz; expected a number above 0")
    if rate_hz > 0:
        return {"rate_hz": rate_hz}
    existing = result.table.values.get("sensors", {}).get(section)
    existing_hz = existing.get("rate_hz") if isinstance(existing, dict) else None
    assumed_hz = DEFAULT_RATE_HZ_BY_SECTION[section] if existing_hz is None else existing_hz
    if element is None:
        result.assumptions.add(
            f"<sensor><update_rate> has no value: {assumed_hz:g} Hz", f"line {sensor.line}"
        )
    else:
        result.assumptions.add(
            f"<sensor><update_rate> has 0: {assumed_hz:g} Hz", f"line {element.line}"
        )
    return {}


def _read_pose(sensor: XmlElement) -> Floats:
    """Return the pose of a sensor in the frame of its link, (4, 4), in the file's unit of length."""
    element = sensor.find_child("pose")
    frame = np.eye(4)
    if element is None:
        sensor.note_absent("<pose>", "0 0 0 0 0 0")
        return frame
    *position, roll, pitch, yaw = element.read_text_numbers(6)
    frame[:3, :3] = make_rotation_from_rpy(roll, pitch, yaw)
    frame[:3, 3] = position
    return frame


def _scale_translation(frame: Floats, scale: float) -> Floats:
    """Return a frame, (4, 4), with its translation in m."""
    scaled = frame.copy()
    scaled[:3, 3] *= scale
    return scaled


def _convert_pose(
    result: ImportResult, link_from_sensor: Floats, sensor: XmlElement
) -> dict[str, Any]:
    """Convert the pose of a sensor on its link into position, yaw and pitch, as a robot file has it.

    A roll is reported, because a robot file has none.

    Args:
        result: Result of the import, whose report is extended.
        link_from_sensor: Transform from the sensor's frame to the link's, (4, 4) with lengths in m.
        sensor: The <sensor> element, for the report.

    Returns:
        The values by the key of the robot file.
    """
    matrix = link_from_sensor[:3, :3]
    roll_rad = math.atan2(matrix[2, 1], matrix[2, 2])
    if abs(roll_rad) > MAX_ROLL_RAD:
        name = sensor.attributes.get("name", "")
        result.omissions.add(
            f"sensor {shorten(name)!r} is rolled by {roll_rad:.2f} rad about its viewing direction; a robot "
            "file has no "
            f"roll",
            f"line {sensor.line}",
        )
    yaw_rad = math.atan2(matrix[1, 0], matrix[0, 0])
    sine = max(-1.0, min(1.0, float(matrix[2, 0])))  # rounding may exceed 1
    pitch_rad = -math.asin(sine)
    # Adding 0.0 turns -0.0 into 0.0.
    return {
        "position_m": [round(float(value), POSE_DIGITS) + 0.0 for value in link_from_sensor[:3, 3]],
        "yaw_rad": round(yaw_rad, POSE_DIGITS) + 0.0,
        "pitch_rad": round(pitch_rad, POSE_DIGITS) + 0.0,
    }


def _read_camera(result: ImportResult, sensor: XmlElement) -> dict[str, Any]:
    """Return color, field of view, size, range and noise of a depth camera."""
    values: dict[str, Any] = {"color": sensor.attributes["type"] == "rgbd_camera"}
    camera = sensor.find_child("camera")
    if camera is None:
        sensor.note_absent("<camera>", "160 x 120 pixels over 1.5708 rad, from 0.1 to 5 m")
        return values
    values["fov_rad"] = camera.read_child_number("horizontal_fov", 1.5708)
    image = camera.find_child("image")
    if image is None:
        camera.note_absent("<image>", "160 x 120 pixels")
    else:
        values["width"] = _read_whole_number(image, "width", 160)
        values["height"] = _read_whole_number(image, "height", 120)
    values |= _read_distance_range(camera, "clip", "near", "far", "0.1 to 5 m")
    values |= _read_noise(result, camera)
    return values


def _read_lidar(result: ImportResult, sensor: XmlElement, mounted_yaw_rad: float) -> dict[str, Any]:
    """Read beams, field of view, range and noise of a lidar.

    The scan in a robot file is symmetric about the viewing direction. An asymmetric scan is converted to a symmetric
    one by rotating the sensor's yaw.

    Args:
        result: Result of the import, whose report is extended.
        sensor: The <sensor> element.
        mounted_yaw_rad: Yaw of the sensor on its link.

    Returns:
        The values by the key of the robot file.
    """
    lidar = sensor.find_child("ray")
    if lidar is None:
        lidar = sensor.find_child("lidar")
    if lidar is None:
        sensor.note_absent("<lidar>", f"{DEFAULT_BEAMS}, from {DEFAULT_LIDAR_RANGE}")
        return {}
    values: dict[str, Any] = {}
    scan = lidar.find_child("scan")
    horizontal = None if scan is None else scan.find_child("horizontal")
    if horizontal is None:
        lidar.note_absent("<scan><horizontal>", DEFAULT_BEAMS)
    else:
        values |= _read_scan(result, horizontal, mounted_yaw_rad)
    values |= _read_distance_range(lidar, "range", "min", "max", DEFAULT_LIDAR_RANGE)
    values |= _read_noise(result, lidar)
    return values


def _read_scan(
    result: ImportResult, horizontal: XmlElement, mounted_yaw_rad: float
) -> dict[str, Any]:
    """Read beams and field of view of a scan; also the sensor's yaw if the scan is not symmetric.

    Args:
        result: Result of the import, whose report is extended.
        horizontal: The <horizontal> element, with the angles of the first and the last beam.
        mounted_yaw_rad: Yaw of the sensor on its link.

    Returns:
        The values by the key of the robot file.
    """
    beams = _read_whole_number(horizontal, "samples", 1)
    first_rad = horizontal.read_child_number("min_angle", 0.0)
    last_rad = horizontal.read_child_number("max_angle", 0.0)
    middle_rad = (first_rad + last_rad) / 2
    values: dict[str, Any] = {"beams": beams, "fov_rad": last_rad - first_rad if beams > 1 else 0.0}
    if abs(middle_rad) > 1e-9:
        values["yaw_rad"] = round(mounted_yaw_rad + middle_rad, POSE_DIGITS)
        result.changes.add(
            f"<min_angle> {first_rad:g} and <max_angle> {last_rad:g} rad are not symmetric: the sensor is turned "
            f"by {middle_rad:g} rad",
            f"line {horizontal.line}",
        )
    if beams == 1 and last_rad != first_rad:
        result.changes.add(
            f"<samples> 1 from {first_rad:g} to {last_rad:g} rad: one beam in the middle",
            f"line {horizontal.line}",
        )
    return values


def _read_whole_number(element: XmlElement, tag: str, default: int) -> int:
    """Return the number in a child. Raises ConfigError for a fraction."""
    value = element.read_child_number(tag, default)
    if value != int(value):
        raise element.make_error(f"has <{tag}> {value:g}; expected a whole number")
    return int(value)


def _read_distance_range(
    owner: XmlElement, tag: str, min_tag: str, max_tag: str, default: str
) -> dict[str, Any]:
    """Read the range of a sensor in m. `default` is the text for the range that is assumed if the file has none."""
    element = owner.find_child(tag)
    if element is None:
        owner.note_absent(f"<{tag}>", default)
        return {}
    return {
        "range_min_m": element.read_child_number(min_tag, 0.1),
        "range_max_m": element.read_child_number(max_tag, 5.0),
    }


def _read_noise(result: ImportResult, element: XmlElement) -> dict[str, Any]:
    """Read the standard deviation of a sensor's Gaussian noise in m.

    Args:
        result: Result of the import, whose report gets a change if the file has noise of another type.
        element: The element with a <noise> element; without one, the noise is reported as 0.
    """
    noise = element.find_child("noise")
    if noise is None:
        element.note_absent("<noise>", "0 m")
        return {}
    # Gazebo has the type in a child, older versions in an attribute.
    type_element = noise.find_child("type")
    type_attribute = noise.read_optional_attribute("type")
    if type_element is not None:
        type_element.read_text = True
        noise_type = type_element.text.strip()
        line = type_element.line
    else:
        noise_type = (type_attribute or "").strip()
        line = noise.line
    if noise_type != "gaussian":
        result.changes.add(
            f"<noise><type> {shorten(noise_type)!r} became gaussian, the one that there is",
            f"line {line}",
        )
    return {"noise_m": noise.read_child_number("stddev", 0.0)}


def format_gazebo_elements(robot: RobotFile) -> list[str]:
    """Format the sensors of a robot file as lines of XML with <gazebo> elements; IMU and contacts are on every link."""
    lines: list[str] = []
    link_names = [f"link_{i}" for i in range(robot.chain.modules + 1)]
    for sensor_type, sensor in (("imu", robot.sensors.imu), ("contact", robot.sensors.contacts)):
        if sensor is None:
            continue
        for link in link_names:
            lines += _format_gazebo_element(
                link, sensor_type, f"{sensor_type}_{link}", sensor.rate_hz, []
            )
    for sensor in (*robot.sensors.depth, *robot.sensors.range):
        link_index = robot.link_index(sensor.link)
        nose_m = (robot.link_lengths_m[link_index] + robot.module.radius_m, 0.0, 0.0)
        x, y, z = sensor.position_m or nose_m
        pose = f"<pose>{x!r} {y!r} {z!r} 0 {sensor.pitch_rad!r} {sensor.yaw_rad!r}</pose>"
        if isinstance(sensor, DepthCamera):
            sensor_type = "rgbd_camera" if sensor.color else "depth_camera"
            body = _format_camera_element(sensor)
        else:
            sensor_type = "gpu_lidar"
            body = _format_lidar_element(sensor)
        lines += _format_gazebo_element(
            link_names[link_index], sensor_type, sensor.name, sensor.rate_hz, [pose, body]
        )
    return lines


def _format_camera_element(sensor: DepthCamera) -> str:
    return (
        f"<camera><horizontal_fov>{sensor.fov_rad!r}</horizontal_fov>"
        f"<image><width>{sensor.width}</width><height>{sensor.height}</height></image>"
        f"<clip><near>{sensor.range_min_m!r}</near><far>{sensor.range_max_m!r}</far></clip>"
        f"{_format_noise_element(sensor.noise_m)}</camera>"
    )


def _format_lidar_element(sensor: RangeSensor) -> str:
    half_fov_rad = sensor.fov_rad / 2
    return (
        f"<lidar><scan><horizontal><samples>{sensor.beams}</samples><min_angle>{-half_fov_rad!r}</min_angle>"
        f"<max_angle>{half_fov_rad!r}</max_angle></horizontal></scan>"
        f"<range><min>{sensor.range_min_m!r}</min><max>{sensor.range_max_m!r}</max></range>"
        f"{_format_noise_element(sensor.noise_m)}</lidar>"
    )


def _format_noise_element(noise_m: float) -> str:
    return f"<noise><type>gaussian</type><stddev>{noise_m!r}</stddev></noise>"


def _format_gazebo_element(
    link: str, kind: str, name: str, rate_hz: float, body: list[str]
) -> list[str]:
    content = "".join([f"<update_rate>{escape(repr(rate_hz))}</update_rate>", *body])
    return [
        f"  <gazebo reference={quoteattr(link)}>",
        f"    <sensor type={quoteattr(kind)} name={quoteattr(name)}>{content}</sensor>",
        "  </gazebo>",
    ]
