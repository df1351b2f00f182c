"""Pictures of a motion by MuJoCo's renderer: the snake at given poses in its scene, without any physics.

It is the object of an entry point in the group `snakesim.films`, which `snakesim video` finds by name.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.plugins import plugin_settings
from snakesim_hal.model.scenario import RunConfig
from snakesim_sim_backend.ground import GROUND, HILLS, PLANE_GROUP
from snakesim_sim_backend.model import FOOT_GROUP, build, of_joints
from snakesim_sim_backend.sensors.rendered import opened_context
from snakesim_sim_backend.settings import SimSettings

Picture = NDArray[np.uint8]  # (height, width, 3)

AZIMUTH_DEG, ELEVATION_DEG = 60.0, -58.0
MARKS = 400  # arrows and the like in a picture
BLUE, ARROW_M = (0.0, 0.4, 0.75, 1.0), 0.012  # of arrows: color and width
BACKGROUND = (236, 240, 244)  # beyond the scene
LINK, NEXT_LINK, HEAD = (0.20, 0.36, 0.54, 1.0), (0.30, 0.48, 0.68, 1.0), (0.09, 0.18, 0.33, 1.0)
OBSTACLE, FLOOR, GRID = (0.80, 0.67, 0.47, 1.0), (0.90, 0.91, 0.93, 1.0), (0.62, 0.66, 0.72, 1.0)
CELL_M, CELLS, LINE_M = 0.5, 8, 0.006  # of the grid on flat ground, by which one sees how far the snake has come
SUN = np.array([0.45, 0.35, -0.82])  # its direction
AMBIENT, HEADLIGHT, SUNLIGHT = 0.35, 0.25, 0.55
SAMPLES = 4  # a pixel


class Film:
    """A camera that follows the snake. It must be made and used in one thread."""

    Settings = SimSettings  # of the backend, which the scene is built with

    def __init__(self, config: RunConfig, width: int, height: int) -> None:
        """Raises ConfigError when there is no OpenGL."""
        own = config.backends.get("sim", {})
        self._sim = build(config, plugin_settings(Film, own, f"run {config.name!r}", "backends.sim"))
        self._model, self._data = self._sim.model, mujoco.MjData(self._sim.model)
        view, quality = self._model.vis.global_, self._model.vis.quality
        view.offwidth, view.offheight, quality.offsamples = width, height, SAMPLES
        self._model.vis.headlight.ambient[:], self._model.vis.headlight.diffuse[:] = AMBIENT, HEADLIGHT
        self._flat = config.scene.ground.heightfield is None
        self._paint(config.robot.chain.modules)
        self._gl = opened_context(width, height, "the film")
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, self._model.ngeom + MARKS)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._option.geomgroup[:], self._option.geomgroup[FOOT_GROUP] = 1, 0
        self._option.geomgroup[PLANE_GROUP] = 1
        first, joints = self._sim.first_link_body, config.robot.chain.modules
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
        self._data.qpos[:3], self._data.qpos[3:7] = position_w, wxyz
        of_joints(self._data, len(angles_rad))[0][:] = angles_rad
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._camera.lookat[:] = look_at_w
        self._gl.make_current()
        every = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(self._model, self._data, self._option, None, self._camera, every, self._scene)
        self._add_sun(look_at_w)
        if self._flat:
            self._add_grid(look_at_w)
        for start_w, end_w in arrows_w:
            self._add(mujoco.mjtGeom.mjGEOM_ARROW, ARROW_M, start_w, end_w, BLUE)
        mujoco.mjr_render(self._frame, self._scene, self._context)
        mujoco.mjr_readPixels(self._rgb, self._depth, self._frame, self._context)
        picture = self._rgb.copy()
        picture[self._depth >= 1.0] = BACKGROUND
        return np.flipud(picture)

    def _paint(self, joints: int) -> None:
        """Colours of a film: the model's own are those that its color cameras see."""
        colors, first = self._model.geom_rgba, self._sim.first_link_body
        colors[:], head = OBSTACLE, first + joints
        for body in range(first, head + 1):
            shade = HEAD if body == head else (LINK, NEXT_LINK)[(body - first) % 2]
            colors[self._model.geom_bodyid == body] = shade
        for name in (GROUND,) if self._flat else (GROUND, HILLS):
            self._model.geom(name).rgba[:] = FLOOR

    def _add_sun(self, look_at_w: Floats) -> None:
        """A light from above the picture's left edge, for shadows: they show what stands where."""
        sun = self._scene.lights[self._scene.nlight]
        sun.type, sun.castshadow, sun.headlight, sun.texid = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, 1, 0, -1
        sun.pos[:], sun.dir[:] = look_at_w - 4.0 * SUN, SUN / np.linalg.norm(SUN)
        sun.ambient[:], sun.diffuse[:], sun.specular[:] = 0.0, SUNLIGHT, 0.1
        self._scene.nlight += 1

    def _add_grid(self, look_at_w: Floats) -> None:
        middle, reach_m = CELL_M * np.round(look_at_w[:2] / CELL_M), CELL_M * CELLS
        for along in (0, 1):
            for k in range(-CELLS, CELLS + 1):
                start, end = np.array([*middle, -0.5 * LINE_M]), np.array([*middle, -0.5 * LINE_M])  # half in the floor
                start[1 - along] += k * CELL_M
                end[1 - along] += k * CELL_M
                start[along] -= reach_m
                end[along] += reach_m
                self._add(mujoco.mjtGeom.mjGEOM_CAPSULE, LINE_M, start, end, GRID)

    def _add(self, kind: mujoco.mjtGeom, width_m: float, start_w: Floats, end_w: Floats, rgba: Sequence[float]) -> None:
        if self._scene.ngeom >= self._scene.maxgeom:
            return
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.array(rgba, np.float32))
        mujoco.mjv_connector(geom, kind, width_m, start_w, end_w)
        self._scene.ngeom += 1

    def close(self) -> None:
        """Free the renderer."""
        self._context.free()
        self._gl.free()
