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
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.sensors import DepthCamera, RangeSensor
from snakesim_operator.features.robots.imported import ImportResult
from snakesim_operator.features.robots.urdf_tree import BodyChain, rotation
from snakesim_operator.features.robots.xml_tree import Element

ON_EVERY_LINK = {"imu": "imu", "contact": "contacts"}  # Gazebo's type -> its section in [sensors]
DEPTH_TYPES = ("depth", "depth_camera", "rgbd_camera")
RANGE_TYPES = ("ray", "gpu_ray", "lidar", "gpu_lidar")
MAX_ROLL_RAD = 0.01  # about the viewing direction; more is reported
POSE_DIGITS = 9  # decimals, which removes the noise of multiplying transforms
DEFAULT_RATE_HZ = {"imu": 100.0, "contacts": 100.0, "depth": 20.0, "range": 20.0}  # as in snakesim_hal.model.sensors


def put_sensors(imported: ImportResult, urdf: Element, chain: BodyChain, frames: list[Floats], scale: float) -> None:
    """Put the sensors of a URDF into the values of a robot file.

    Args:
        imported: The import, whose values and report are extended.
        urdf: The root element of the URDF.
        chain: Bodies and joints of the URDF, tail to head.
        frames: link_from_root, (4, 4) with lengths in m, of every link.
        scale: Meters per unit of length of the file.

    Raises:
        ConfigError: A value of a sensor is wrong.
    """
    link_indices = {name: i for i, body in enumerate(chain.bodies) for name in body.links}
    for gazebo in urdf.all("gazebo"):
        reference = gazebo.attributes.get("reference", "")
        for sensor in gazebo.all("sensor"):
            kind = sensor.attributes.get("type", "")
            if kind in ON_EVERY_LINK:
                gazebo.optional("reference")
                _put_on_every_link(imported, sensor, ON_EVERY_LINK[kind], reference)
            elif kind in (*DEPTH_TYPES, *RANGE_TYPES) and reference in link_indices:
                gazebo.optional("reference")
                link = link_indices[reference]
                root_from_reference = _scale_lengths(chain.bodies[link].frames[reference], scale)
                link_from_reference = frames[link] @ root_from_reference
                _put_on_one_link(imported, sensor, link, link_from_reference, scale)
            else:
                sensor.read = False
                _report_other_sensor(imported, gazebo, sensor, kind, reference)


def _report_other_sensor(imported: ImportResult, gazebo: Element, sensor: Element, kind: str, reference: str) -> None:
    known = ", ".join((*ON_EVERY_LINK, *DEPTH_TYPES, *RANGE_TYPES))
    imported.omissions.add(
        f"a sensor whose `type` is {shorten(kind)!r}, in an element whose `reference` is "
        f"{shorten(reference)!r}, left out: a robot file has {known}, on a link",
        f"line {sensor.line}",
        f"line {gazebo.line}",
    )


def _put_on_every_link(imported: ImportResult, sensor: Element, section: str, reference: str) -> None:
    """Put an IMU or a contact sensor."""
    sensor.optional("type")
    name = sensor.optional("name") or ""
    imported.changes.add(
        f"sensor {shorten(name)!r} of link {shorten(reference)!r}: in a robot file [sensors.{section}] is on "
        "every link, "
        f"and has no name",
        sensor.place,
    )
    rate = _read_rate(imported, sensor, section)
    existing = imported.table.values.get("sensors", {}).get(section) or {}
    imported.table.set_value(f"sensors.{section}", existing | rate, sensor.source)


def _put_on_one_link(
    imported: ImportResult, sensor: Element, link: int, link_from_reference: Floats, scale: float
) -> None:
    """Put a camera or a lidar at its place on a link."""
    kind = sensor.get("type")
    section = "depth" if kind in DEPTH_TYPES else "range"
    name = sensor.get("name", "sensor")
    values: dict[str, Any] = _read_rate(imported, sensor, section)
    values["name"] = imported.plain_name(name, "sensor", sensor)
    values["link"] = link
    reference_from_sensor = _scale_lengths(_read_pose(sensor), scale)
    values |= _convert_pose(imported, link_from_reference @ reference_from_sensor, sensor)
    if section == "depth":
        values |= _read_camera(imported, sensor)
    else:
        values |= _read_lidar(imported, sensor, values["yaw_rad"])
    existing = imported.table.values.get("sensors", {}).get(section, [])
    imported.table.set_value(f"sensors.{section}", [*existing, values], sensor.source)


def _read_rate(imported: ImportResult, sensor: Element, section: str) -> dict[str, Any]:
    """Return `rate_hz` of a sensor; nothing if the file gives none or 0. Then the robot file's rate is reported."""
    element = sensor.first("update_rate")
    rate_hz = 0.0 if element is None else element.text_numbers(1)[0]
    if rate_hz < 0:
        raise sensor.error(f"has <update_rate> {rate_hz:g} Hz; expected a number above 0")
    if rate_hz > 0:
        return {"rate_hz": rate_hz}
    existing = imported.table.values.get("sensors", {}).get(section)
    existing_hz = existing.get("rate_hz") if isinstance(existing, dict) else None
    assumed_hz = DEFAULT_RATE_HZ[section] if existing_hz is None else existing_hz
    if element is None:
        imported.assumptions.add(f"<sensor><update_rate> has no value: {assumed_hz:g} Hz", f"line {sensor.line}")
    else:
        imported.assumptions.add(f"<sensor><update_rate> has 0: {assumed_hz:g} Hz", f"line {element.line}")
    return {}


def _read_pose(sensor: Element) -> Floats:
    """Return the pose of a sensor in the frame of its link, (4, 4), in the file's unit of length."""
    element = sensor.first("pose")
    frame = np.eye(4)
    if element is None:
        sensor.note_absent("<pose>", "0 0 0 0 0 0")
        return frame
    *position, roll, pitch, yaw = element.text_numbers(6)
    frame[:3, :3] = rotation(roll, pitch, yaw)
    frame[:3, 3] = position
    return frame


def _scale_lengths(frame: Floats, scale: float) -> Floats:
    """Return a frame, (4, 4), with its translation in m."""
    scaled = frame.copy()
    scaled[:3, 3] *= scale
    return scaled


def _convert_pose(imported: ImportResult, link_from_sensor: Floats, sensor: Element) -> dict[str, Any]:
    """Return the pose of a sensor on its link as position, yaw and pitch, as a robot file has it.

    A roll is reported, because a robot file has none.

    Args:
        imported: The import, whose report is extended.
        link_from_sensor: (4, 4) with lengths in m.
        sensor: The <sensor> element, for the report.

    Returns:
        The values by the key of the robot file.
    """
    matrix = link_from_sensor[:3, :3]
    roll_rad = math.atan2(matrix[2, 1], matrix[2, 2])
    if abs(roll_rad) > MAX_ROLL_RAD:
        name = sensor.attributes.get("name", "")
        imported.omissions.add(
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


def _read_camera(imported: ImportResult, sensor: Element) -> dict[str, Any]:
    """Return color, field of view, size, range and noise of a depth camera."""
    values: dict[str, Any] = {"color": sensor.attributes["type"] == "rgbd_camera"}
    camera = sensor.first("camera")
    if camera is None:
        sensor.note_absent("<camera>", "160 x 120 pixels over 1.5708 rad, from 0.1 to 5 m")
        return values
    values["fov_rad"] = camera.text_number("horizontal_fov", 1.5708)
    image = camera.first("image")
    if image is None:
        camera.note_absent("<image>", "160 x 120 pixels")
    else:
        values["width"] = _read_whole_number(image, "width", 160)
        values["height"] = _read_whole_number(image, "height", 120)
    values |= _read_range(camera, "clip", "near", "far", "0.1 to 5 m")
    values |= _read_noise(imported, camera)
    return values


def _read_lidar(imported: ImportResult, sensor: Element, mounted_yaw_rad: float) -> dict[str, Any]:
    """Return beams, field of view, range and noise of a lidar.

    A robot file's scan is symmetric about the viewing direction, so another scan also changes the sensor's yaw.

    Args:
        imported: The import, whose report is extended.
        sensor: The <sensor> element.
        mounted_yaw_rad: Yaw of the sensor on its link.

    Returns:
        The values by the key of the robot file.
    """
    lidar = sensor.first("ray") or sensor.first("lidar")
    if lidar is None:
        sensor.note_absent("<lidar>", "one beam, from 0.02 to 5 m")
        return {}
    values: dict[str, Any] = {}
    scan = lidar.first("scan")
    horizontal = None if scan is None else scan.first("horizontal")
    if horizontal is None:
        lidar.note_absent("<scan><horizontal>", "one beam")
    else:
        values |= _read_scan(imported, horizontal, mounted_yaw_rad)
    values |= _read_range(lidar, "range", "min", "max", "0.02 to 5 m")
    values |= _read_noise(imported, lidar)
    return values


def _read_scan(imported: ImportResult, horizontal: Element, mounted_yaw_rad: float) -> dict[str, Any]:
    """Return beams and field of view of a scan; also the sensor's yaw if the scan is not symmetric.

    Args:
        imported: The import, whose report is extended.
        horizontal: The <horizontal> element, with the angles of the first and the last beam.
        mounted_yaw_rad: Yaw of the sensor on its link.

    Returns:
        The values by the key of the robot file.
    """
    beams = _read_whole_number(horizontal, "samples", 1)
    first_rad = horizontal.text_number("min_angle", 0.0)
    last_rad = horizontal.text_number("max_angle", 0.0)
    middle_rad = (first_rad + last_rad) / 2
    values: dict[str, Any] = {"beams": beams, "fov_rad": last_rad - first_rad if beams > 1 else 0.0}
    if abs(middle_rad) > 1e-9:
        values["yaw_rad"] = round(mounted_yaw_rad + middle_rad, POSE_DIGITS)
        imported.changes.add(
            f"<min_angle> {first_rad:g} and <max_angle> {last_rad:g} rad are not symmetric: the sensor is turned "
            f"by {middle_rad:g} rad",
            f"line {horizontal.line}",
        )
    if beams == 1 and last_rad != first_rad:
        imported.changes.add(
            f"<samples> 1 from {first_rad:g} to {last_rad:g} rad: one beam in the middle", f"line {horizontal.line}"
        )
    return values


def _read_whole_number(element: Element, tag: str, default: int) -> int:
    """Return the number in a child. Raises ConfigError for a fraction."""
    value = element.text_number(tag, default)
    if value != int(value):
        raise element.error(f"has <{tag}> {value:g}; expected a whole number")
    return int(value)


def _read_range(owner: Element, tag: str, min_tag: str, max_tag: str, default: str) -> dict[str, Any]:
    """Return the range of a sensor in m. default: words for the range that is assumed if the file gives none."""
    element = owner.first(tag)
    if element is None:
        owner.note_absent(f"<{tag}>", default)
        return {}
    return {"range_min_m": element.text_number(min_tag, 0.1), "range_max_m": element.text_number(max_tag, 5.0)}


def _read_noise(imported: ImportResult, element: Element) -> dict[str, Any]:
    """Return the standard deviation of a sensor's Gaussian noise in m, by the key of the robot file.

    Args:
        imported: The import, whose report gets a change if the file has noise of another type.
        element: The element with a <noise> element; without one, the noise is reported as 0.
    """
    noise = element.first("noise")
    if noise is None:
        element.note_absent("<noise>", "0 m")
        return {}
    # Gazebo has the type in a child, older versions in an attribute.
    type_element = noise.first("type")
    type_attribute = noise.optional("type")
    if type_element is not None:
        type_element.read_text = True
        kind = type_element.text.strip()
        line = type_element.line
    else:
        kind = (type_attribute or "").strip()
        line = noise.line
    if kind != "gaussian":
        imported.changes.add(f"<noise><type> {shorten(kind)!r} became gaussian, the one that there is", f"line {line}")
    return {"noise_m": noise.text_number("stddev", 0.0)}


def gazebo_lines(robot: RobotFile) -> list[str]:
    """Return the sensors of a robot file as lines of XML with <gazebo> elements."""
    lines: list[str] = []
    links = [f"link_{i}" for i in range(robot.chain.modules + 1)]
    for kind, sensor in (("imu", robot.sensors.imu), ("contact", robot.sensors.contacts)):
        if sensor is None:
            continue
        for link in links:
            lines += _gazebo_element(link, kind, f"{kind}_{link}", sensor.rate_hz, [])
    for sensor in (*robot.sensors.depth, *robot.sensors.range):
        index = robot.link_index(sensor.link)
        nose_m = (robot.link_lengths_m[index] + robot.module.radius_m, 0.0, 0.0)
        x, y, z = sensor.position_m or nose_m
        pose = f"<pose>{x!r} {y!r} {z!r} 0 {sensor.pitch_rad!r} {sensor.yaw_rad!r}</pose>"
        if isinstance(sensor, DepthCamera):
            kind = "rgbd_camera" if sensor.color else "depth_camera"
            body = _camera_element(sensor)
        else:
            kind = "gpu_lidar"
            body = _lidar_element(sensor)
        lines += _gazebo_element(links[index], kind, sensor.name, sensor.rate_hz, [pose, body])
    return lines


def _camera_element(sensor: DepthCamera) -> str:
    return (
        f"<camera><horizontal_fov>{sensor.fov_rad!r}</horizontal_fov>"
        f"<image><width>{sensor.width}</width><height>{sensor.height}</height></image>"
        f"<clip><near>{sensor.range_min_m!r}</near><far>{sensor.range_max_m!r}</far></clip>"
        f"{_noise_element(sensor.noise_m)}</camera>"
    )


def _lidar_element(sensor: RangeSensor) -> str:
    half_fov_rad = sensor.fov_rad / 2
    return (
        f"<lidar><scan><horizontal><samples>{sensor.beams}</samples><min_angle>{-half_fov_rad!r}</min_angle>"
        f"<max_angle>{half_fov_rad!r}</max_angle></horizontal></scan>"
        f"<range><min>{sensor.range_min_m!r}</min><max>{sensor.range_max_m!r}</max></range>"
        f"{_noise_element(sensor.noise_m)}</lidar>"
    )


def _noise_element(noise_m: float) -> str:
    return f"<noise><type>gaussian</type><stddev>{noise_m!r}</stddev></noise>"


def _gazebo_element(link: str, kind: str, name: str, rate_hz: float, body: list[str]) -> list[str]:
    content = "".join([f"<update_rate>{escape(repr(rate_hz))}</update_rate>", *body])
    return [
        f"  <gazebo reference={quoteattr(link)}>",
        f"    <sensor type={quoteattr(kind)} name={quoteattr(name)}>{content}</sensor>",
        "  </gazebo>",
    ]
