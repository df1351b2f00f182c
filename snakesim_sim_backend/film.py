"""Renders pictures of a motion with MuJoCo: the snake at given poses in its scene, without any physics.

`FollowCamera` is the object of an entry point in the group `snakesim.films`, which `snakesim recording video` finds by
name.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.plugins import decode_plugin_settings
from snakesim_hal.model.scenario import RunConfig
from snakesim_sim_backend.model.build import FOOT_GROUP, build_sim_model, view_joint_states
from snakesim_sim_backend.model.ground import GROUND, HILLS, PLANE_GROUP
from snakesim_sim_backend.model.pipes import is_roof
from snakesim_sim_backend.sensors.rendered import open_gl_context
from snakesim_sim_backend.settings import SimSettings

Picture = NDArray[np.uint8]  # (height, width, 3)

# Camera.
AZIMUTH_DEG = 60.0
ELEVATION_DEG = -58.0
CAMERA_DISTANCE_RATIO = 1.25  # of the snake

# Colors: red, green, blue, opacity.
ARROW_COLOR = (0.0, 0.4, 0.75, 1.0)
EVEN_LINK_COLOR = (0.20, 0.36, 0.54, 1.0)
ODD_LINK_COLOR = (0.30, 0.48, 0.68, 1.0)
HEAD_COLOR = (0.09, 0.18, 0.33, 1.0)
OBSTACLE_COLOR = (0.80, 0.67, 0.47, 1.0)
ROOF_COLOR = (0.80, 0.67, 0.47, 0.15)  # of a pipe, so that the snake is seen in it
FLOOR_COLOR = (0.90, 0.91, 0.93, 1.0)
GRID_COLOR = (0.62, 0.66, 0.72, 1.0)
BACKGROUND = (236, 240, 244)  # beyond the scene, as bytes

# Arrows, and the grid on flat ground, which shows how far the snake has advanced.
ARROW_WIDTH_M = 0.012  # width
MAX_CONNECTORS = 400  # arrows and lines in a picture
GRID_CELL_M = 0.5
GRID_CELLS_PER_SIDE = 8  # to each side of the middle
GRID_LINE_WIDTH_M = 0.006  # width

# Light.
SUN = np.array([0.45, 0.35, -0.82])  # its direction
SUN_DISTANCE_FACTOR = 4.0  # in lengths of that vector
AMBIENT = 0.35
HEADLIGHT = 0.25
SUNLIGHT = 0.55
SUN_SPECULAR = 0.1
SAMPLES_PER_PIXEL = 4


class FollowCamera:
    """A camera that follows the snake. It must be made and used in one thread."""

    Settings = SimSettings  # of the backend, which the scene is built with

    def __init__(self, config: RunConfig, width: int, height: int) -> None:
        """Prepare to render the scene of a run, with a camera that follows the snake.

        Args:
            config: Configuration of the run, with robot and scene.
            width: Width of the pictures in pixels.
            height: Height of the pictures in pixels.

        Raises:
            ConfigError: The scene cannot be built, or there is no OpenGL.
        """
        section = config.backends.get("sim", {})
        settings = decode_plugin_settings(
            FollowCamera, section, f"run {config.name!r}", "backends.sim"
        )
        self._sim = build_sim_model(config, settings)
        self._model = self._sim.model
        self._data = mujoco.MjData(self._model)
        self._is_flat = config.scene.ground.heightfield is None
        self._set_visuals(width, height)
        self._set_colors(config.robot.chain.modules)

        # Renderer.
        self._gl = open_gl_context(width, height, "the film")
        self._gl.make_current()
        self._context = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(self._model, self._model.ngeom + MAX_CONNECTORS)
        self._option = mujoco.MjvOption()
        self._option.geomgroup[:] = 1
        self._option.geomgroup[FOOT_GROUP] = 0
        self._option.geomgroup[PLANE_GROUP] = 1

        # Camera.
        first_joint_body = self._sim.first_link_body + 1
        joint_bodies = slice(first_joint_body, first_joint_body + config.robot.chain.modules)
        length_m = float(self._model.body_pos[joint_bodies, 0].sum())  # of all links but the head
        self.camera = mujoco.MjvCamera()
        self.camera.azimuth = AZIMUTH_DEG
        self.camera.elevation = ELEVATION_DEG
        self.camera.distance = CAMERA_DISTANCE_RATIO * length_m

        # Buffers.
        self._frame = mujoco.MjrRect(0, 0, width, height)
        self._rgb = np.zeros((height, width, 3), np.uint8)
        self._depth = np.zeros((height, width), np.float32)

    def render_picture(
        self,
        position_w: Floats,
        wxyz: Floats,
        angles_rad: Floats,
        look_at_w: Floats,
        arrows_w: Sequence[Floats] = (),
    ) -> Picture:
        """Render the robot at a pose, seen from above and behind.

        Args:
            position_w: (3,) position of the tail end in m.
            wxyz: (4,) orientation of the tail link as a quaternion.
            angles_rad: (n_joints,) joint angles, tail to head.
            look_at_w: (3,) point in m that is in the middle of the picture.
            arrows_w: Start and end in m of each arrow to draw, (2, 3) each.

        Returns:
            (height, width, 3) colors, rows from the top.
        """
        self._data.qpos[:3] = position_w
        self._data.qpos[3:7] = wxyz
        joint_angles_rad, _ = view_joint_states(self._data, len(angles_rad))
        joint_angles_rad[:] = angles_rad
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self.camera.lookat[:] = look_at_w

        self._gl.make_current()
        categories = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self.camera, categories, self._scene
        )
        self._add_sunlight(look_at_w)
        if self._is_flat:
            self._add_grid(look_at_w)
        for start_w, end_w in arrows_w:
            self._add_connector(
                mujoco.mjtGeom.mjGEOM_ARROW, ARROW_WIDTH_M, start_w, end_w, ARROW_COLOR
            )
        mujoco.mjr_render(self._frame, self._scene, self._context)
        mujoco.mjr_readPixels(self._rgb, self._depth, self._frame, self._context)
        picture = self._rgb.copy()
        picture[self._depth >= 1.0] = BACKGROUND  # nothing was drawn there
        return np.flipud(picture)  # OpenGL's rows start at the bottom

    def _set_visuals(self, width: int, height: int) -> None:
        """Set the size of the pictures, the number of samples and the light of the model."""
        visuals = self._model.vis
        visuals.global_.offwidth = width
        visuals.global_.offheight = height
        visuals.quality.offsamples = SAMPLES_PER_PIXEL
        visuals.headlight.ambient[:] = AMBIENT
        visuals.headlight.diffuse[:] = HEADLIGHT

    def _set_colors(self, joint_count: int) -> None:
        """Set the colors of robot, obstacles and ground, which differ from those that the robot's cameras see."""
        colors = self._model.geom_rgba
        colors[:] = OBSTACLE_COLOR
        for geom in range(self._model.ngeom):
            if is_roof(self._model.geom(geom).name, int(self._model.geom_group[geom])):
                colors[geom] = ROOF_COLOR
        tail_body = self._sim.first_link_body
        head_body = tail_body + joint_count
        for body in range(tail_body, head_body + 1):
            if body == head_body:
                color = HEAD_COLOR
            elif (body - tail_body) % 2:
                color = ODD_LINK_COLOR
            else:
                color = EVEN_LINK_COLOR
            colors[self._model.geom_bodyid == body] = color
        self._model.geom(GROUND).rgba[:] = FLOOR_COLOR
        if not self._is_flat:
            self._model.geom(HILLS).rgba[:] = FLOOR_COLOR

    def _add_sunlight(self, look_at_w: Floats) -> None:
        """Add a light from above the picture's left edge: its shadows show what is where."""
        sun = self._scene.lights[self._scene.nlight]
        sun.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
        sun.castshadow = 1
        sun.headlight = 0
        sun.texid = -1
        sun.pos[:] = look_at_w - SUN_DISTANCE_FACTOR * SUN
        sun.dir[:] = SUN / np.linalg.norm(SUN)
        sun.ambient[:] = 0.0
        sun.diffuse[:] = SUNLIGHT
        sun.specular[:] = SUN_SPECULAR
        self._scene.nlight += 1

    def _add_grid(self, look_at_w: Floats) -> None:
        """Add a grid of lines that are half in the floor, and fixed in the world."""
        middle = GRID_CELL_M * np.round(look_at_w[:2] / GRID_CELL_M)
        half_length_m = GRID_CELL_M * GRID_CELLS_PER_SIDE
        for along in (0, 1):
            across = 1 - along
            for k in range(-GRID_CELLS_PER_SIDE, GRID_CELLS_PER_SIDE + 1):
                start = np.array([*middle, -0.5 * GRID_LINE_WIDTH_M])
                end = start.copy()
                start[across] += k * GRID_CELL_M
                end[across] += k * GRID_CELL_M
                start[along] -= half_length_m
                end[along] += half_length_m
                self._add_connector(
                    mujoco.mjtGeom.mjGEOM_CAPSULE, GRID_LINE_WIDTH_M, start, end, GRID_COLOR
                )

    def _add_connector(
        self,
        shape: mujoco.mjtGeom,
        width_m: float,
        start_w: Floats,
        end_w: Floats,
        rgba: Sequence[float],
    ) -> None:
        """Add an arrow or a line from one point to another, unless the picture has MAX_CONNECTORS of them."""
        if self._scene.ngeom >= self._scene.maxgeom:
            return
        geom = self._scene.geoms[self._scene.ngeom]
        mujoco.mjv_initGeom(
            geom, shape, np.zeros(3), np.zeros(3), np.zeros(9), np.array(rgba, np.float32)
        )
        mujoco.mjv_connector(geom, shape, width_m, start_w, end_w)
        self._scene.ngeom += 1

    def close(self) -> None:
        """Free the renderer."""
        self._context.free()
        self._gl.free()
