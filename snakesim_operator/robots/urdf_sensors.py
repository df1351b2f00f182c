"""Sensors in Gazebo's words, as URDF files carry them: <gazebo reference="LINK"><sensor type="..."> both ways.

IMU, contacts, depth cameras and lidars. A robot file's IMU and contact sensors are on every link, so that one of them
in the URDF stands for all.
"""

import math
from collections.abc import Callable
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from snakesim_hal.arrays import Floats
from snakesim_hal.errors import short
from snakesim_hal.model.files import Table
from snakesim_hal.model.robot import RobotFile
from snakesim_hal.model.sensors import DepthCamera
from snakesim_operator.robots.imported import plain
from snakesim_operator.robots.urdf_tree import Row, rotation
from snakesim_operator.robots.xml_tree import Element

Warn = Callable[[str], None]

EVERYWHERE = {"imu": "imu", "contact": "contacts"}
DEPTH = ("depth", "depth_camera", "rgbd_camera")
RANGE = ("ray", "gpu_ray", "lidar", "gpu_lidar")


def put_sensors(table: Table, urdf: Element, row: Row, frames: list[Floats], scale: float, *, warn: Warn) -> None:
    """Put a URDF's sensors into a robot file's values. frames: link_from_root (4, 4) of every link, in m."""
    link_of = {name: i for i, body in enumerate(row.bodies) for name in body.links}
    for gazebo in urdf.all("gazebo"):
        reference = gazebo.get("reference", "")
        for sensor in gazebo.all("sensor"):
            kind, name = sensor.get("type", ""), sensor.get("name", "sensor")
            rate_hz = sensor.text_number("update_rate", 0.0)
            values: dict[str, Any] = {"rate_hz": rate_hz} if rate_hz > 0 else {}
            if kind in EVERYWHERE:
                listed = table.values.get("sensors", {}).get(EVERYWHERE[kind]) or {}
                table.put(f"sensors.{EVERYWHERE[kind]}", listed | values, urdf.source)
                continue
            if kind not in (*DEPTH, *RANGE) or reference not in link_of:
                sensor.read = False
                continue
            index = link_of[reference]
            root_from_link = row.bodies[index].frames[reference]
            pose = frames[index] @ _in_metres(root_from_link, scale) @ _in_metres(_pose(sensor), scale)
            values |= {"name": plain(name, "sensor"), "link": index} | _place(pose, name, warn)
            values |= _camera(sensor) if kind in DEPTH else _lidar(sensor)
            group = "depth" if kind in DEPTH else "range"
            listed = table.values.get("sensors", {}).get(group, [])
            table.put(f"sensors.{group}", [*listed, values], urdf.source)


def _pose(sensor: Element) -> Floats:
    element, placed = sensor.first("pose"), np.eye(4)
    if element is not None:
        *place, roll, pitch, yaw = element.text_numbers(6)
        placed[:3, :3], placed[:3, 3] = rotation(roll, pitch, yaw), place
    return placed


def _in_metres(frame: Floats, scale: float) -> Floats:
    scaled = frame.copy()
    scaled[:3, 3] *= scale
    return scaled


def _place(link_from_sensor: Floats, name: str, warn: Warn) -> dict[str, Any]:
    turn = link_from_sensor[:3, :3]
    roll = math.atan2(turn[2, 1], turn[2, 2])
    if abs(roll) > 0.01:
        warn(
            f"sensor {short(name)!r} is rolled by {roll:.2f} rad about its viewing direction; a robot file has no roll"
        )
    return {
        "position_m": [round(float(x), 9) + 0.0 for x in link_from_sensor[:3, 3]],
        "yaw_rad": round(math.atan2(turn[1, 0], turn[0, 0]), 9) + 0.0,
        "pitch_rad": round(-math.asin(max(-1.0, min(1.0, float(turn[2, 0])))), 9) + 0.0,
    }


def _camera(sensor: Element) -> dict[str, Any]:
    values: dict[str, Any] = {"colour": sensor.attributes["type"] == "rgbd_camera"}
    camera = sensor.first("camera")
    if camera is None:
        return values
    values["view_rad"] = camera.text_number("horizontal_fov", 1.5708)
    if (image := camera.first("image")) is not None:
        values |= {"width": int(image.text_number("width", 160)), "height": int(image.text_number("height", 120))}
    return values | _reach(camera.first("clip"), "near", "far") | _noise(camera)


def _lidar(sensor: Element) -> dict[str, Any]:
    values: dict[str, Any] = {}
    lidar = sensor.first("ray") or sensor.first("lidar")
    if lidar is None:
        return values
    scan = lidar.first("scan")
    horizontal = None if scan is None else scan.first("horizontal")
    if horizontal is not None:
        beams = int(horizontal.text_number("samples", 1))
        span = horizontal.text_number("max_angle", 0.0) - horizontal.text_number("min_angle", 0.0)
        values |= {"beams": beams, "view_rad": span if beams > 1 else 0.0}
    return values | _reach(lidar.first("range"), "min", "max") | _noise(lidar)


def _reach(element: Element | None, least: str, most: str) -> dict[str, Any]:
    if element is None:
        return {}
    return {"range_min_m": element.text_number(least, 0.1), "range_max_m": element.text_number(most, 5.0)}


def _noise(element: Element) -> dict[str, Any]:
    noise = element.first("noise")
    if noise is None:
        return {}
    noise.first("type")
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
            kind = "rgbd_camera" if sensor.colour else "depth_camera"
            body.append(
                f"<camera><horizontal_fov>{sensor.view_rad!r}</horizontal_fov>"
                f"<image><width>{sensor.width}</width><height>{sensor.height}</height></image>"
                f"<clip><near>{ends[0]}</near><far>{ends[1]}</far></clip>{noise}</camera>"
            )
        else:
            kind, half = "gpu_lidar", sensor.view_rad / 2
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
