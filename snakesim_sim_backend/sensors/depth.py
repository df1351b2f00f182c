"""A depth camera by ray casting: one ray through the middle of each pixel."""

import numpy as np
from numpy.typing import NDArray

from snakesim_hal.model.sensors import DepthCamera
from snakesim_hal.wire.messages import DepthImage
from snakesim_sim_backend.sensors.mount import Mount
from snakesim_sim_backend.sensors.rays import Rays
from snakesim_sim_backend.sensors.scope import Floats, NoSettings, Scope

SCALE_M = 0.001  # of one count
MOST = 2**16 - 1


class RayCamera:
    """Distances along the optical axis."""

    Settings, message = NoSettings, DepthImage

    def __init__(self, camera: DepthCamera, scope: Scope, _settings: NoSettings) -> None:
        self._camera, self._noise = camera, scope.noise
        self._mount = Mount(camera, scope)
        u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
        left, up = (camera.width - 1) / 2 - u, (camera.height - 1) / 2 - v
        rays_c = np.stack([np.full(u.shape, camera.focal_px), left, up], -1).reshape(-1, 3) / camera.focal_px
        self._rays = Rays(self._mount, scope, rays_c, camera.range_max_m)

    def read(self, tick: int, timestamp_ns: int) -> DepthImage:
        """An image from where the link is now."""
        return depth_image(self._camera, self._mount, tick, timestamp_ns, self._rays.cast(), self._noise)


def depth_image(
    camera: DepthCamera, mount: Mount, tick: int, timestamp_ns: int, depth_m: Floats, noise: np.random.Generator
) -> DepthImage:
    """The message. depth_m: (height * width,) along the optical axis, row by row, without noise."""
    return DepthImage(
        **mount.seen_by(camera),
        tick=tick,
        timestamp_ns=timestamp_ns,
        range_min_m=camera.range_min_m,
        range_max_m=camera.range_max_m,
        scale_m=SCALE_M,
        depth=_counts(camera, depth_m, noise).tobytes(),
    )


def _counts(camera: DepthCamera, depth_m: Floats, noise: np.random.Generator) -> NDArray[np.uint16]:
    """Noise, dropouts and range: (n,) uint16, 0 where nothing is measured."""
    seen = (depth_m >= camera.range_min_m) & (depth_m <= camera.range_max_m)
    measured_m = np.where(seen, depth_m, 0.0).astype(np.float32)
    if camera.noise_m or camera.noise_m_per_m2:
        sigma_m = np.float32(camera.noise_m) + np.float32(camera.noise_m_per_m2) * np.square(measured_m)
        measured_m += sigma_m * noise.standard_normal(len(measured_m), dtype=np.float32)
    if camera.dropout:
        seen &= noise.random(len(measured_m), dtype=np.float32) >= camera.dropout
    counts = np.clip(np.rint(measured_m / np.float32(SCALE_M)), 1, MOST)
    return np.where(seen, counts, 0).astype("<u2")
