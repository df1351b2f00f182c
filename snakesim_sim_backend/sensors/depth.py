"""A depth camera by ray casting: one ray through the middle of each pixel."""

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.model.robot_file.sensor_model import NoSettings, SensorModel
from snakesim_hal.model.robot_file.sensors import DepthCamera
from snakesim_hal.wire.messages import DepthImage
from snakesim_sim_backend.sensors.mount import SensorMount
from snakesim_sim_backend.sensors.rays import RayBundle
from snakesim_sim_backend.sensors.scope import Floats, SensorScope

SCALE_M = 0.001  # of one count
MAX_COUNT = 2**16 - 1


class RayCamera(SensorModel):
    """Distances along the optical axis."""

    message = DepthImage

    def __init__(self, camera: DepthCamera, scope: SensorScope, settings: NoSettings) -> None:
        del settings
        self._camera = camera
        self._noise = scope.noise
        self._mount = SensorMount(camera, scope)
        # Rays in the camera's frame (x forward, y left, z up), of length 1 along the optical axis.
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        forward = np.full(u.shape, camera.focal_px)
        left = (camera.width - 1) / 2 - u
        up = (camera.height - 1) / 2 - v
        rays_c = np.stack([forward, left, up], -1).reshape(-1, 3) / camera.focal_px
        self._rays = RayBundle(self._mount, scope, rays_c, camera.range_max_m)

    def read(self, tick: int, timestamp_ns: int) -> DepthImage:
        """Return an image from the present place of the link."""
        return make_depth_image(
            self._camera, self._mount, tick, timestamp_ns, self._rays.cast(), self._noise
        )


def make_depth_image(
    camera: DepthCamera,
    mount: SensorMount,
    tick: int,
    timestamp_ns: int,
    depth_m: Floats,
    noise: np.random.Generator,
) -> DepthImage:
    """Make the message of a depth image from exact distances, with the noise, dropouts and range of a camera.

    Args:
        camera: Entry of the camera in the robot file.
        mount: Place of the camera on its link.
        tick: Tick of the image.
        timestamp_ns: Robot time of the image in ns.
        depth_m: (height * width,) distances along the optical axis, row by row, without noise.
        noise: Random generator of the camera.
    """
    return DepthImage(
        **mount.camera_fields(camera),
        tick=tick,
        timestamp_ns=timestamp_ns,
        range_min_m=camera.range_min_m,
        range_max_m=camera.range_max_m,
        scale_m=SCALE_M,
        depth=_apply_sensor_errors(camera, depth_m, noise).tobytes(),
    )


def _apply_sensor_errors(
    camera: DepthCamera, depth_m: Floats, noise: np.random.Generator
) -> NDArray[np.uint16]:
    """Return distances in counts of SCALE_M with noise and dropouts, (n,) uint16; 0 where nothing is measured."""
    is_measured = (depth_m >= camera.range_min_m) & (depth_m <= camera.range_max_m)
    measured_m = np.where(is_measured, depth_m, 0.0).astype(np.float32)
    if camera.noise_m or camera.noise_m_per_m2:
        sigma_m = np.float32(camera.noise_m) + np.float32(camera.noise_m_per_m2) * np.square(
            measured_m
        )
        measured_m += sigma_m * noise.standard_normal(len(measured_m), dtype=np.float32)
    if camera.dropout:
        is_measured &= noise.random(len(measured_m), dtype=np.float32) >= camera.dropout
    counts = np.clip(np.rint(measured_m / np.float32(SCALE_M)), 1, MAX_COUNT)
    return np.where(is_measured, counts, 0).astype("<u2")
