"""Images drawn by MuJoCo's renderer: in color, or depth as a graphics card has it. Needs OpenGL, but no screen."""

import os
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.errors import ConfigError
from snakesim_hal.model.robot_file.sensor_model import NoSettings, SensorModel
from snakesim_hal.model.robot_file.sensors import DepthCamera
from snakesim_hal.wire.messages import ColorImage, DepthImage
from snakesim_sim_backend.model.ground import PLANE_GROUP
from snakesim_sim_backend.sensors.depth import make_depth_image
from snakesim_sim_backend.sensors.mount import SensorMount
from snakesim_sim_backend.sensors.rays import VISIBLE_GROUPS
from snakesim_sim_backend.sensors.scope import SensorScope

DEBIAN_PACKAGES = {"egl": "libegl1", "osmesa": "libosmesa6"}
NEAR_M = 0.01  # minimum and maximum distance of what is drawn
FAR_M = 100.0
AMBIENT = 0.4  # light
SAMPLES_PER_PIXEL = 4  # of a smooth picture
SPARE_GEOMS = 50  # lights and the like


class RenderedDepth(SensorModel):
    """Depth from the renderer's buffer, with its resolution."""

    message = DepthImage

    def __init__(self, camera: DepthCamera, scope: SensorScope, settings: NoSettings) -> None:
        del settings
        self._camera = camera
        self._noise = scope.noise
        self._renderer = CameraRenderer(camera, scope, smooth=False)

    def read(self, tick: int, timestamp_ns: int) -> DepthImage:
        """Return an image from the present place of the link."""
        _, depth_m = self._renderer.draw()
        flat_depth_m = depth_m.ravel().astype(np.float64)
        return make_depth_image(
            self._camera, self._renderer.mount, tick, timestamp_ns, flat_depth_m, self._noise
        )


class RenderedColor(SensorModel):
    """A color image, without noise, dropouts and range."""

    message = ColorImage

    def __init__(self, camera: DepthCamera, scope: SensorScope, settings: NoSettings) -> None:
        del settings
        self._camera = camera
        self._renderer = CameraRenderer(camera, scope, smooth=True)

    def read(self, tick: int, timestamp_ns: int) -> ColorImage:
        """Return an image from the present place of the link."""
        constant_fields = self._renderer.mount.camera_fields(self._camera)
        rgb, _ = self._renderer.draw()
        return ColorImage(
            **constant_fields, tick=tick, timestamp_ns=timestamp_ns, rgb=rgb.tobytes()
        )


class CameraRenderer:
    """Draws what a camera sees. It must be made and used in one thread."""

    def __init__(self, camera: DepthCamera, scope: SensorScope, *, smooth: bool) -> None:
        """Prepare a renderer for one camera of the robot. It must be made and used in one thread.

        Args:
            camera: Entry of the camera in the robot file.
            scope: Model and state to draw.
            smooth: Whether to use several samples for each pixel. The depth is then that of one sample, which is up to
                0.4 pixels from the middle.

        Raises:
            ConfigError: OpenGL is not available.
        """
        model = scope.sim.model
        self.mount = SensorMount(camera, scope)
        self._model = model
        self._data = scope.data
        self._focal_px = camera.focal_px
        self._hidden_geoms = frozenset(
            np.flatnonzero(model.geom_bodyid == self.mount.body).tolist()
        )

        # Quality of the pictures.
        model.vis.global_.offwidth = max(model.vis.global_.offwidth, camera.width)
        model.vis.global_.offheight = max(model.vis.global_.offheight, camera.height)
        model.vis.headlight.ambient[:] = AMBIENT
        model.vis.quality.offsamples = SAMPLES_PER_PIXEL if smooth else 0

        # Renderer.
        self._gl = open_gl_context(camera.width, camera.height, f"camera {camera.name!r}")
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        self._context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, model.ngeom + SPARE_GEOMS)
        self._free_camera = mujoco.MjvCamera()
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = VISIBLE_GROUPS
        self._option.geomgroup[PLANE_GROUP] = 1

        # Buffers.
        self._frame = mujoco.MjrRect(0, 0, camera.width, camera.height)
        self._rgb = np.zeros((camera.height, camera.width, 3), np.uint8)
        self._depth = np.zeros((camera.height, camera.width), np.float32)

    def draw(self) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Draw the scene as the camera sees it now.

        Returns:
            Colors, (height, width, 3), and distances along the optical axis in m, (height, width), rows from the top.
        """
        self._gl.make_current()
        categories = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._free_camera, categories, self._scene
        )
        self._place_cameras()
        self._hide_link()
        mujoco.mjr_render(self._frame, self._scene, self._context)
        mujoco.mjr_readPixels(self._rgb, self._depth, self._frame, self._context)
        # The buffer holds values from 0, far, to 1, near, that are linear in 1 / depth.
        depth_m = NEAR_M * FAR_M / (NEAR_M + self._depth * (FAR_M - NEAR_M))
        return np.flipud(self._rgb), np.flipud(depth_m)

    def _place_cameras(self) -> None:
        """Put both cameras of the scene, one for each eye, where the sensor is."""
        position_w, world_from_camera = self.mount.place()
        half_pixel_m = NEAR_M / self._focal_px / 2  # half a pixel's size at the near plane
        for camera in self._scene.camera:
            camera.pos = position_w
            camera.forward = world_from_camera[:, 0]
            camera.up = world_from_camera[:, 2]
            camera.frustum_center = 0.0
            camera.frustum_width = half_pixel_m * self._frame.width
            camera.frustum_bottom = -half_pixel_m * self._frame.height
            camera.frustum_top = half_pixel_m * self._frame.height
            camera.frustum_near = NEAR_M
            camera.frustum_far = FAR_M

    def _hide_link(self) -> None:
        """Hide the link that carries the camera, which would be in its way."""
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in self._hidden_geoms:
                geom.size[:] = 0.0


def open_gl_context(width: int, height: int, what: str) -> Any:
    """Open an OpenGL context without a screen: EGL, or OSMesa if the environment has MUJOCO_GL=osmesa.

    Args:
        width: Width of the images in pixels.
        height: Height of the images in pixels.
        what: What is rendered, such as "camera 'head'", for the error message.

    Raises:
        ConfigError: OpenGL is not available.
    """
    gl_library = "osmesa" if os.environ.get("MUJOCO_GL") == "osmesa" else "egl"
    try:
        if gl_library == "osmesa":
            from mujoco.osmesa import GLContext
        else:
            from mujoco.egl import GLContext
        return GLContext(width, height)
    except Exception as error:
        raise ConfigError(
            f"{what} is rendered, which needs OpenGL by {gl_library.upper()}, and that does not work here: "
            f"{type(error).__name__}: {error}. Install the Debian packages {DEBIAN_PACKAGES[gl_library]} and "
            f"libgl1-mesa-dri; or "
            f'leave out `color` and take `model = "rays"`, which need no OpenGL',
            code="simulator/no-opengl",
        ) from error
