"""Sensors in Gazebo's words, as URDF files carry them: <gazebo reference="LINK"><sensor type="..."> both ways.

IMU, contacts, depth cameras and lidars. A robot file's IMU and contact sensors are on every link, so that one of them
in the URDF stands for all. What a sensor says that a robot file has no words for is left unread, and so is reported.
"""

import math
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from snakesim_hal.base.arrays import Floats
from snakesim_hal.base.errors import short
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.sensors import DepthCamera
from snakesim_operator.features.robots.imported import Imported
from snakesim_operator.features.robots.urdf_tree import Row, rotation
from snakesim_operator.features.robots.xml_tree import Element

EVERYWHERE = {"imu": "imu", "contact": "contacts"}  # kind of Gazebo -> its section in [sensors]
DEPTH = ("depth", "depth_camera", "rgbd_camera")
RANGE = ("ray", "gpu_ray", "lidar", "gpu_lidar")
MAX_ROLL_RAD = 0.01
DEFAULT_RATE_HZ = {"imu": 100.0, "contacts": 100.0, "depth": 20.0, "range": 20.0}  # as in snakesim_hal.model.sensors


def put_sensors(found: Imported, urdf: Element, row: Row, frames: list[Floats], scale: float) -> None:
    """Put a URDF's sensors into a robot file's values. frames: link_from_root (4, 4) of every link, in m."""
    link_of = {name: i for i, body in enumerate(row.bodies) for name in body.links}
    for gazebo in urdf.all("gazebo"):
        reference = gazebo.attributes.get("reference", "")
        for sensor in gazebo.all("sensor"):
            kind = sensor.attributes.get("type", "")
            if kind in EVERYWHERE:
                gazebo.optional("reference")
                _put_everywhere(found, sensor, EVERYWHERE[kind], reference)
            elif kind in (*DEPTH, *RANGE) and reference in link_of:
                gazebo.optional("reference")
                link = link_of[reference]
                root_from_link = row.bodies[link].frames[reference]
                link_from_here = frames[link] @ _in_metres(root_from_link, scale)
                _put_mounted(found, sensor, link, link_from_here, scale)
            else:
                sensor.read = False
                known = ", ".join((*EVERYWHERE, *DEPTH, *RANGE))
                found.omissions.add(
                    f"a sensor whose `type` is {short(kind)!r}, in an element whose `reference` is "
                    f"{short(reference)!r}, left out: a robot file has {known}, on a link",
                    f"line {sensor.line}",
                    f"line {gazebo.line}",
                )


def _put_everywhere(found: Imported, sensor: Element, section: str, reference: str) -> None:
    """An IMU or a contact sensor: with one of them every link has one."""
    sensor.optional("type")
    name = sensor.optional("name") or ""
    found.changes.add(
        f"sensor {short(name)!r} of link {short(reference)!r}: in a robot file [sensors.{section}] is on every link, "
        f"and has no name",
        sensor.place,
    )
    rate_hz = _rate_hz(found, sensor, section)
    listed = found.table.values.get("sensors", {}).get(section) or {}
    found.table.put(f"sensors.{section}", listed | rate_hz, sensor.source)


def _put_mounted(found: Imported, sensor: Element, link: int, link_from_here: Floats, scale: float) -> None:
    """A camera or a lidar, at its place on a link."""
    kind = sensor.get("type")
    group = "depth" if kind in DEPTH else "range"
    name = sensor.get("name", "sensor")
    values: dict[str, Any] = _rate_hz(found, sensor, group)
    values["name"] = found.plain_name(name, "sensor", sensor)
    values["link"] = link
    pose = link_from_here @ _in_metres(_pose(sensor), scale)
    values |= _place(found, pose, sensor)
    if group == "depth":
        values |= _camera(found, sensor)
    else:
        values |= _lidar(found, sensor, values)
    listed = found.table.values.get("sensors", {}).get(group, [])
    found.table.put(f"sensors.{group}", [*listed, values], sensor.source)


def _rate_hz(found: Imported, sensor: Element, group: str) -> dict[str, Any]:
    """Its rate; without one, or with 0, that of the robot file holds, which is reported."""
    said = sensor.first("update_rate")
    rate_hz = 0.0 if said is None else said.text_numbers(1)[0]
    if rate_hz < 0:
        raise sensor.wrong(f"has <update_rate> {rate_hz:g} Hz; expected a number above 0")
    if rate_hz > 0:
        return {"rate_hz": rate_hz}
    listed = found.table.values.get("sensors", {}).get(group)
    kept = listed.get("rate_hz") if isinstance(listed, dict) else None
    shown = DEFAULT_RATE_HZ[group] if kept is None else kept
    words = "no value" if said is None else "0"
    place = sensor.line if said is None else said.line
    found.assumptions.add(f"<sensor><update_rate> has {words}: {shown:g} Hz", f"line {place}")
    return {}


def _pose(sensor: Element) -> Floats:
    element = sensor.first("pose")
    placed = np.eye(4)
    if element is None:
        sensor.note_absent("<pose>", "0 0 0 0 0 0")
        return placed
    *place, roll, pitch, yaw = element.text_numbers(6)
    placed[:3, :3] = rotation(roll, pitch, yaw)
    placed[:3, 3] = place
    return placed


def _in_metres(frame: Floats, scale: float) -> Floats:
    scaled = frame.copy()
    scaled[:3, 3] *= scale
    return scaled


def _place(found: Imported, link_from_sensor: Floats, sensor: Element) -> dict[str, Any]:
    turn = link_from_sensor[:3, :3]
    roll = math.atan2(turn[2, 1], turn[2, 2])
    if abs(roll) > MAX_ROLL_RAD:
        name = sensor.attributes.get("name", "")
        found.omissions.add(
            f"sensor {short(name)!r} is rolled by {roll:.2f} rad about its viewing direction; a robot file has no roll",
            f"line {sensor.line}",
        )
    return {
        "position_m": [round(float(x), 9) + 0.0 for x in link_from_sensor[:3, 3]],
        "yaw_rad": round(math.atan2(turn[1, 0], turn[0, 0]), 9) + 0.0,
        "pitch_rad": round(-math.asin(max(-1.0, min(1.0, float(turn[2, 0])))), 9) + 0.0,
    }


def _camera(found: Imported, sensor: Element) -> dict[str, Any]:
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
        values["width"] = _whole_number(image, "width", 160)
        values["height"] = _whole_number(image, "height", 120)
    return values | _range(camera, "clip", "near", "far", "0.1 to 5 m") | _noise(found, camera)


def _lidar(found: Imported, sensor: Element, placed: dict[str, Any]) -> dict[str, Any]:
    """placed: its values so far. A scan that is not symmetric turns the sensor, which has no angle to begin with."""
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
        beams = _whole_number(horizontal, "samples", 1)
        first_rad = horizontal.text_number("min_angle", 0.0)
        last_rad = horizontal.text_number("max_angle", 0.0)
        middle_rad = (first_rad + last_rad) / 2
        values["beams"] = beams
        values["fov_rad"] = last_rad - first_rad if beams > 1 else 0.0
        if abs(middle_rad) > 1e-9:
            values["yaw_rad"] = round(placed["yaw_rad"] + middle_rad, 9)
            found.changes.add(
                f"<min_angle> {first_rad:g} and <max_angle> {last_rad:g} rad are not symmetric: the sensor is turned "
                f"by {middle_rad:g} rad",
                f"line {horizontal.line}",
            )
        if beams == 1 and last_rad != first_rad:
            found.changes.add(
                f"<samples> 1 from {first_rad:g} to {last_rad:g} rad: one beam in the middle", f"line {horizontal.line}"
            )
    return values | _range(lidar, "range", "min", "max", "0.02 to 5 m") | _noise(found, lidar)


def _whole_number(element: Element, tag: str, default: int) -> int:
    """The number in a child. Raises ConfigError for a fraction."""
    value = element.text_number(tag, default)
    if value != int(value):
        raise element.wrong(f"has <{tag}> {value:g}; expected a whole number")
    return int(value)


def _range(owner: Element, tag: str, least: str, most: str, otherwise: str) -> dict[str, Any]:
    element = owner.first(tag)
    if element is None:
        owner.note_absent(f"<{tag}>", otherwise)
        return {}
    return {"range_min_m": element.text_number(least, 0.1), "range_max_m": element.text_number(most, 5.0)}


def _noise(found: Imported, element: Element) -> dict[str, Any]:
    noise = element.first("noise")
    if noise is None:
        element.note_absent("<noise>", "0 m")
        return {}
    kind = noise.first("type")
    said = (noise.attributes.get("type", "") if kind is None else kind.text).strip()
    if kind is not None:
        kind.read_text = True
    noise.optional("type")
    if said != "gaussian":
        line = noise.line if kind is None else kind.line
        found.changes.add(f"<noise><type> {short(said)!r} became gaussian, the one that there is", f"line {line}")
    return {"noise_m": noise.text_number("stddev", 0.0)}


def gazebo_lines(robot: RobotFile) -> list[str]:
    """The sensors of a robot file as <gazebo> elements."""
    lines: list[str] = []
    sensors, links = robot.sensors, [f"link_{i}" for i in range(robot.chain.modules + 1)]
    for kind, sensor in (("imu", sensors.imu), ("contact", sensors.contacts)):
        for link in links if sensor is not None else []:
            lines += _gazebo(link, kind, f"{kind}_{link}", sensor.rate_hz if sensor else 0.0, [])
    for sensor in (*sensors.depth, *sensors.range):
        index = robot.link_index(sensor.link)
        nose_m = (robot.link_lengths_m[index] + robot.module.radius_m, 0.0, 0.0)
        x, y, z = sensor.position_m or nose_m
        body = [f"<pose>{x!r} {y!r} {z!r} 0 {sensor.pitch_rad!r} {sensor.yaw_rad!r}</pose>"]
        ends = f"{sensor.range_min_m!r}", f"{sensor.range_max_m!r}"
        noise = f"<noise><type>gaussian</type><stddev>{sensor.noise_m!r}</stddev></noise>"
        if isinstance(sensor, DepthCamera):
            kind = "rgbd_camera" if sensor.color else "depth_camera"
            body.append(
                f"<camera><horizontal_fov>{sensor.fov_rad!r}</horizontal_fov>"
                f"<image><width>{sensor.width}</width><height>{sensor.height}</height></image>"
                f"<clip><near>{ends[0]}</near><far>{ends[1]}</far></clip>{noise}</camera>"
            )
        else:
            kind, half = "gpu_lidar", sensor.fov_rad / 2
            body.append(
                f"<lidar><scan><horizontal><samples>{sensor.beams}</samples><min_angle>{-half!r}</min_angle>"
                f"<max_angle>{half!r}</max_angle></horizontal></scan>"
                f"<range><min>{ends[0]}</min><max>{ends[1]}</max></range>{noise}</lidar>"
            )
        lines += _gazebo(links[index], kind, sensor.name, sensor.rate_hz, body)
    return lines


def _gazebo(link: str, kind: str, name: str, rate_hz: float, body: list[str]) -> list[str]:
    inner = "".join([f"<update_rate>{escape(repr(rate_hz))}</update_rate>", *body])
    return [
        f"  <gazebo reference={quoteattr(link)}>",
        f"    <sensor type={quoteattr(kind)} name={quoteattr(name)}>{inner}</sensor>",
        "  </gazebo>",
    ]
