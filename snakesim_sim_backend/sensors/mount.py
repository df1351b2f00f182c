"""The place of a sensor on its link."""

import math
from typing import Any

from snakesim_hal.model.geometry.kinematics import rotation_from_quaternion
from snakesim_hal.model.robot_file.sensors import DepthCamera, MountedSensor
from snakesim_hal.wire.quantities import Quaternion, Vector
from snakesim_sim_backend.sensors.scope import Floats, SensorScope


class SensorMount:
    """The fixed place of a sensor on a link, and its place in the world as the link moves."""

    def __init__(self, sensor: MountedSensor, scope: SensorScope) -> None:
        """Find the place of a sensor.

        Args:
            sensor: The entry of the robot file.
            scope: The model and its state.
        """
        robot = scope.config.robot
        self.link = robot.link_index(sensor.link)
        self.body = scope.sim.first_link_body + self.link
        nose_m = robot.link_lengths_m[self.link] + robot.module.radius_m
        self.position_l: Vector = sensor.position_m or (nose_m, 0.0, 0.0)
        self.orientation_l_wxyz = _compute_orientation(sensor.yaw_rad, sensor.pitch_rad)
        self.link_from_sensor: Floats = rotation_from_quaternion(self.orientation_l_wxyz)
        self._origin = scope.data.xpos[self.body]
        self._rotation = scope.data.xmat[self.body]

    def place(self) -> tuple[Floats, Floats]:
        """Return the position of the sensor in m, (3,), and world_from_sensor, (3, 3)."""
        rotation = self._rotation.reshape(3, 3)
        return self._origin + rotation @ self.position_l, rotation @ self.link_from_sensor

    def camera_fields(self, camera: DepthCamera) -> dict[str, Any]:
        """Return the fields of a camera's image that do not change with time."""
        return {
            "link": self.link,
            "position_l": self.position_l,
            "orientation_l_wxyz": self.orientation_l_wxyz,
            "width": camera.width,
            "height": camera.height,
            "fx_px": camera.focal_px,
            "fy_px": camera.focal_px,
            "cx_px": (camera.width - 1) / 2,
            "cy_px": (camera.height - 1) / 2,
        }


def _compute_orientation(yaw_rad: float, pitch_rad: float) -> Quaternion:
    """Return the orientation after a yaw about z and then a pitch about the new y."""
    cy = math.cos(yaw_rad / 2)
    sy = math.sin(yaw_rad / 2)
    cp = math.cos(pitch_rad / 2)
    sp = math.sin(pitch_rad / 2)
    return (cy * cp, -sy * sp, cy * sp, sy * cp)
