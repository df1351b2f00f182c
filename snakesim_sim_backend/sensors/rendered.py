"""Images drawn by MuJoCo's renderer: in color, or depth as a graphics card has it. Needs OpenGL, but no screen."""

import os
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.sensors import DepthCamera
from snakesim_hal.wire.messages import ColorImage, DepthImage
from snakesim_sim_backend.ground import PLANE_GROUP
from snakesim_sim_backend.sensors.depth import depth_image
from snakesim_sim_backend.sensors.mount import Mount
from snakesim_sim_backend.sensors.rays import SEEN
from snakesim_sim_backend.sensors.scope import NoSettings, Scope

PACKAGES = {"egl": "libegl1", "osmesa": "libosmesa6"}  # of Debian
NEAREST_M, FURTHEST_M = 0.01, 100.0  # of what is drawn
AMBIENT = 0.4  # light
SAMPLES = 4  # a pixel
SPARE_GEOMS = 50  # lights and the like


class RenderedDepth:
    """Depth from the renderer's buffer, with its resolution."""

    Settings, message = NoSettings, DepthImage

    def __init__(self, camera: DepthCamera, scope: Scope, _settings: NoSettings) -> None:
        self._camera, self._noise = camera, scope.noise
        self._view = View(camera, scope, smooth=False)

    def read(self, tick: int, timestamp_ns: int) -> DepthImage:
        """An image from where the link is now."""
        depth_m = self._view.draw()[1].ravel().astype(np.float64)
        return depth_image(self._camera, self._view.mount, tick, timestamp_ns, depth_m, self._noise)


class RenderedColor:
    """A color image, without noise, dropouts and range."""

    Settings, message = NoSettings, ColorImage

    def __init__(self, camera: DepthCamera, scope: Scope, _settings: NoSettings) -> None:
        self._camera = camera
        self._view = View(camera, scope, smooth=True)

    def read(self, tick: int, timestamp_ns: int) -> ColorImage:
        """An image from where the link is now."""
        fixed = self._view.mount.seen_by(self._camera)
        return ColorImage(**fixed, tick=tick, timestamp_ns=timestamp_ns, rgb=self._view.draw()[0].tobytes())


class View:
    """What a camera sees. It must be made and used in one thread."""

    def __init__(self, camera: DepthCamera, scope: Scope, *, smooth: bool) -> None:
        """Raises ConfigError when there is no OpenGL.

        smooth: several samples a pixel; then depth is that of one of them, up to 0.4 pixels from the middle.
        """
        self.mount = Mount(camera, scope)
        model, self._data = scope.sim.model, scope.data
        self._model, self._focal_px = model, camera.focal_px
        self._own = frozenset(np.flatnonzero(model.geom_bodyid == self.mount.body).tolist())
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, camera.width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, camera.height)
        model.vis.headlight.ambient[:] = AMBIENT
        model.vis.quality.offsamples = SAMPLES if smooth else 0
        self._gl = opened_context(camera.width, camera.height, f"camera {camera.name!r}")
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, model.ngeom + SPARE_GEOMS)
        self._option, self._free = mujoco.MjvOption(), mujoco.MjvCamera()
        self._option.geomgroup[:] = SEEN
        self._option.geomgroup[PLANE_GROUP] = 1
        self._frame = mujoco.MjrRect(0, 0, camera.width, camera.height)
        self._rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._buffer = np.zeros((camera.height, camera.width), np.float32)

    def draw(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colours, (height, width, 3), and distances along the optical axis, (height, width), from the top."""
        self._gl.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, self._data, self._option, None, self._free, every, self._scene)
        self._look()
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in self._own:
                geom.size[:] = 0.0  # the camera is not in its own way
        mujoco.mjr_render(self._frame, self._scene, self._context)
        mujoco.mjr_readPixels(self._rgb, self._buffer, self._frame, self._context)
        near, far = NEAREST_M, FURTHEST_M
        depth_m = near * far / (near + self._buffer * (far - near))  # the buffer goes from 0, far, to 1, near
        return np.flipud(self._rgb), np.flipud(depth_m)

    def _look(self) -> None:
        """Put the eyes of the scene where the camera is."""
        position_w, world_from_camera = self.mount.place()
        half = NEAREST_M / self._focal_px / 2
        for eye in self._scene.camera:
            eye.pos, eye.forward, eye.up = position_w, world_from_camera[:, 0], world_from_camera[:, 2]
            eye.frustum_center, eye.frustum_width = 0.0, half * self._frame.width
            eye.frustum_bottom, eye.frustum_top = -half * self._frame.height, half * self._frame.height
            eye.frustum_near, eye.frustum_far = NEAREST_M, FURTHEST_M


def opened_context(width: int, height: int, what: str) -> Any:
    """An OpenGL context without a screen: EGL, or OSMesa if the environment says MUJOCO_GL=osmesa.

    what: is drawn with it, for the ConfigError that is raised when there is no OpenGL.
    """
    kind = "osmesa" if os.environ.get("MUJOCO_GL") == "osmesa" else "egl"
    try:
        if kind == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco.egl import GLContext
        return GLContext(width, height)
    except Exception as error:
        raise ConfigError(
            f"{what} is rendered, which needs OpenGL by {kind.upper()}, and that does not work here: "
            f"{type(error).__name__}: {error}. Install the Debian packages {PACKAGES[kind]} and libgl1-mesa-dri; or "
            f'leave out `color` and take `model = "rays"`, which need no OpenGL'
        ) from error
