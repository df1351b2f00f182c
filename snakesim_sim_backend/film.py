"""Pictures of a motion by MuJoCo's renderer: the snake at given poses in its scene, without any physics.

It is the object of an entry point in the group `snakesim.films`, which `snakesim video` finds by name.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.model.plugins import plugin_settings
from snakesim_hal.model.scenario import RunConfig
from snakesim_sim_backend.ground import PLANE_GROUP
from snakesim_sim_backend.model import FOOT_GROUP, build
from snakesim_sim_backend.sensors.rendered import opened_context
from snakesim_sim_backend.settings import Settings

Floats = NDArray[np.float64]
Picture = NDArray[np.uint8]  # (height, width, 3)

AZIMUTH_DEG, ELEVATION_DEG = 60.0, -58.0
MARKS = 400  # arrows and the like in a picture
BLUE = (0.0, 0.4, 0.75, 1.0)
BACKGROUND = (236, 240, 244)  # beyond the scene
AMBIENT = 0.6
SAMPLES = 4  # a pixel


class Film:
    """A camera that follows the snake. It must be made and used in one thread."""

    def __init__(self, config: RunConfig, width: int, height: int) -> None:
        """Raises ConfigError when there is no OpenGL."""
        own = config.backends.get("sim", {})
        self._sim = build(config, plugin_settings(_Sim, own, f"run {config.name!r}", "backends.sim"))
        self._model, self._data = self._sim.model, mujoco.MjData(self._sim.model)
        view, quality = self._model.vis.global_, self._model.vis.quality
        view.offwidth, view.offheight, quality.offsamples = width, height, SAMPLES
        self._model.vis.headlight.ambient[:] = AMBIENT
        self._gl = opened_context(width, height, "the film")
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, self._model.ngeom + MARKS)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._option.geomgroup[:], self._option.geomgroup[FOOT_GROUP] = 1, 0
        self._option.geomgroup[PLANE_GROUP] = 1
        first, joints = self._sim.first_link_body, self._model.njnt - 1
        length_m = float(self._model.body_pos[first + 1 : first + 1 + joints, 0].sum())  # of all links but the head
        self._camera.azimuth, self._camera.elevation = AZIMUTH_DEG, ELEVATION_DEG
        self._camera.distance = 1.25 * length_m
        self._frame = mujoco.MjrRect(0, 0, width, height)
        self._rgb = np.zeros((height, width, 3), np.uint8)
        self._depth = np.zeros((height, width), np.float32)

    def picture(
        self, position_w: Floats, wxyz: Floats, angles_rad: Floats, look_at_w: Floats, arrows_w: Sequence[Floats] = ()
    ) -> Picture:
        """The snake at a pose of its tail end, seen from above and behind. arrows_w: each (2, 3), from and to."""
        joints = len(angles_rad)
        self._data.qpos[:3], self._data.qpos[3:7] = position_w, wxyz
        self._data.qpos[7 : 7 + joints] = angles_rad
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._camera.lookat[:] = look_at_w
        self._gl.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, self._data, self._option, None, self._camera, every, self._scene)
        for start_w, end_w in arrows_w[:MARKS]:
            self._add_arrow(start_w, end_w)
        mujoco.mjr_render(self._frame, self._scene, self._context)
        mujoco.mjr_readPixels(self._rgb, self._depth, self._frame, self._context)
        picture = self._rgb.copy()
        picture[self._depth >= 1.0] = BACKGROUND
        return np.flipud(picture)

    def _add_arrow(self, start_w: Floats, end_w: Floats) -> None:
        if self._scene.ngeom >= self._scene.maxgeom:
            return
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_ARROW, np.zeros(3), np.zeros(3), np.zeros(9), np.array(BLUE, np.float32)
        )
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_ARROW, 0.012, start_w, end_w)
        self._scene.ngeom += 1

    def close(self) -> None:
        """Free the renderer."""
        self._context.free()
        self._gl.free()


class _Sim:
    """Whose settings the scene is built with."""

    Settings = Settings
