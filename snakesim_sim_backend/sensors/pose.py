"""Measures the pose of the base, as motion capture with noise does."""

import math

import mujoco
import numpy as np

from snakesim_hal.model.robot_file.sensors import PoseSensor
from snakesim_hal.wire.messages import Pose
from snakesim_hal.wire.quantities import Quaternion
from snakesim_sim_backend.model.build import FREE_DOFS, FREE_QPOS
from snakesim_sim_backend.sensors.frames import rotate
from snakesim_sim_backend.sensors.scope import Normal


class PoseReader:
    """Measures pose and velocity of the base."""

    def __init__(self, data: mujoco.MjData, sensor: PoseSensor, noise: Normal) -> None:
        self._qpos = data.qpos[:FREE_QPOS]
        self._qvel = data.qvel[:FREE_DOFS]
        # A quaternion has half the angle.
        sigma = [sensor.position_noise_m, 0.5 * sensor.angle_noise_rad]
        self._sigma = np.repeat(sigma, 3)
        self._noise = noise if any(sigma) else None

    def read(self, tick: int, timestamp_ns: int) -> Pose:
        """Return the pose and velocity of the base as motion capture measures them. Velocities have no noise.

        Args:
            tick: Tick of the message.
            timestamp_ns: Robot time of the tick in ns.
        """
        px, py, pz, w, x, y, z = self._qpos.tolist()
        vx, vy, vz, ox, oy, oz = self._qvel.tolist()
        # MuJoCo gives a free joint's angular velocity in its own frame.
        angular_velocity_w = rotate((w, x, y, z), (ox, oy, oz))
        if self._noise is not None:
            error_x, error_y, error_z, half_roll, half_pitch, half_yaw = (
                self._sigma * self._noise(6)
            ).tolist()
            px = px + error_x
            py = py + error_y
            pz = pz + error_z
            w, x, y, z = _perturb_orientation((w, x, y, z), half_roll, half_pitch, half_yaw)
        return Pose(
            tick=tick,
            timestamp_ns=timestamp_ns,
            position_w=(px, py, pz),
            orientation_wxyz=(w, x, y, z),
            velocity_w=(vx, vy, vz),
            angular_velocity_w=angular_velocity_w,
        )


def _perturb_orientation(wxyz: Quaternion, a: float, b: float, c: float) -> Quaternion:
    """Return the unit quaternion along wxyz * (1, a, b, c): a small rotation about axes of the base is added."""
    w, x, y, z = wxyz
    w, x, y, z = (
        w - a * x - b * y - c * z,
        x + a * w + b * z - c * y,
        y + b * w + c * x - a * z,
        z + c * w + a * y - b * x,
    )
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    return w / norm, x / norm, y / norm, z / norm
