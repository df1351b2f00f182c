"""Draws drawings with viser: each kind of thing is one node of the scene, updated in place.

All of it hangs on one frame, which moves against the snake, so that the view follows while each viewer turns and zooms
as they like.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import ArrayLike, NDArray

from snakesim_hal.base.arrays import Floats
from snakesim_hal.model.kinematics import quaternion_from_yaw
from snakesim_hal.wire.messages import Description, Obstacle
from snakesim_operator.features.console.scene.drawing import CameraFrustum, Drawing, Surroundings
from snakesim_operator.features.console.scene.meshes import Mesh, box, capsule, circle, cylinder, hoops, sphere
from snakesim_operator.results.page.palette import LIGHT

Color = tuple[int, int, int]

TRAIL_STEP_M, TRAIL_MOST = 0.02, 1000
FOLLOW_SHARE = 0.08  # of the way to the snake's center, in a frame
FURTHEST_M = 0.5  # from the view's middle
MAX_ROWS = 200  # of hills along an edge
SEE_THROUGH = 0.5  # so that no obstacle hides the snake, or a force
# To be stretched. What is perceived is drawn as hoops about where it is believed to be, so that one sees the truth too.
SQUARE = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
SHAPES: dict[str, dict[str, Mesh]] = {
    "true": {"cylinder": cylinder(1.0, 1.0), "box": box(1.0), "sphere": sphere(1.0)},
    "perceived": {
        "cylinder": hoops(circle(), 0.5, 0.13),
        "box": hoops(SQUARE, 1.0, 0.26),
        "sphere": hoops(circle(), 0.13, 0.26),
    },
}


def color(name: str) -> Color:
    """A color of the palette that reports use."""
    text = LIGHT[name]
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)


LINK, LINK_EDGE, HEAD = (52, 92, 138), (70, 112, 160), (22, 46, 84)
HINGE, LOST = (52, 58, 66), color("bad")
PROPELS = (64, 190, 255)  # against PUSHED: blue and orange, for any kind of color vision
PEG, PUSHED, AHEAD, SEEN = (176, 152, 112), (226, 88, 12), (232, 168, 56), (0, 200, 170)
DASHES = np.arange(10.0).reshape(5, 2) / 9  # shares of a dashed line: from, to
FELT, SOLVED, RESULTANT = color("measured"), color("commanded"), (20, 160, 90)


class RobotScene:
    """The 3-D scene of one robot."""

    def __init__(self, scene: viser.SceneApi, robot: Description, around: Surroundings | None) -> None:
        self._scene, self._robot, self._around = scene, robot, around
        self._thick = max(link.radius_m for link in robot.links)
        scene.configure_environment_map("warehouse", environment_intensity=0.3)
        scene.configure_default_lights(enabled=True, cast_shadow=True)
        self._world = scene.add_frame("/world", show_axes=False)
        self._middle_w: Floats | None = None
        self._trail: deque[Floats] = deque(maxlen=TRAIL_MOST)
        self._arrows: dict[str, viser.ArrowsHandle] = {}
        self._cameras: dict[str, viser.CameraFrustumHandle] = {}
        self._shapes: dict[str, viser.BatchedMeshHandle] = {}
        self._path: viser.LineSegmentsHandle | None = None
        self._path_w: Floats | None = None
        self._links = self._add_links()
        hinge = cylinder(0.5 * self._thick, 2.12 * self._thick)
        self._hinges = self._batch("snake/hinges", hinge, len(robot.joints), HINGE)
        self._contacts = scene.add_point_cloud(
            "/world/contacts/points", np.zeros((1, 3)), color("ink"), point_size=0.4 * self._thick, visible=False
        )
        self._trail_line = scene.add_line_segments(
            "/world/trail", np.zeros((1, 2, 3)), color("measured"), thickness=2.5, thickness_units="screen"
        )
        self._asked = scene.add_line_segments(
            "/world/forces/asked", np.zeros((1, 2, 3)), SOLVED, thickness=3.0, thickness_units="screen", visible=False
        )
        self._show_ground()
        if around is not None:
            self._show_obstacles("true", around.obstacles, PEG, opacity=SEE_THROUGH)

    # --- what does not change --------------------------------------------------------------------------------

    def _add_links(self) -> list[tuple[viser.BatchedMeshHandle, list[int]]]:
        """One batch for all links of one size."""
        alike: dict[tuple[float, float], list[int]] = {}
        for i, link in enumerate(self._robot.links):
            alike.setdefault((link.length_m, link.radius_m), []).append(i)
        found: list[tuple[viser.BatchedMeshHandle, list[int]]] = []
        last = len(self._robot.links) - 1
        for k, ((length_m, radius_m), numbers) in enumerate(alike.items()):
            batch = self._batch(f"snake/links_{k}", capsule(length_m, radius_m), len(numbers), LINK)
            # Neighbors share a sphere at their joint: drawn a little thinner, they do not flicker.
            batch.batched_scales = _single([[1.0, thin, thin] for thin in (1.0 - 0.012 * (i % 2) for i in numbers)])
            batch.batched_colors = _shades([HEAD if i == last else (LINK, LINK_EDGE)[i % 2] for i in numbers])
            found.append((batch, numbers))
        return found

    def _batch(self, name: str, mesh: Mesh, count: int, of: Color, **more: Any) -> viser.BatchedMeshHandle:
        return self._scene.add_batched_meshes_simple(
            f"/world/{name}",
            *mesh,
            batched_wxyzs=np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
            batched_positions=np.zeros((count, 3)),
            batched_scales=np.ones((count, 3)),
            batched_colors=_shades([of] * count),
            lod="off",
            **more,
        )

    def _show_ground(self) -> None:
        around = self._around
        lowest = -0.002
        if around is not None and (uneven := around.heights_m) is not None:
            along, heights = uneven
            step = max(1, math.ceil(len(along) / MAX_ROWS))
            along, heights = along[::step], heights[::step, ::step]
            x, y = np.meshgrid(along, along)
            n = len(along)
            corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)[None, :]).ravel()
            faces = np.concatenate(
                [
                    np.stack([corner, corner + 1, corner + n], axis=1),
                    np.stack([corner + 1, corner + n + 1, corner + n], axis=1),
                ]
            )
            vertices = np.column_stack([x.ravel(), y.ravel(), heights.ravel() - 0.003])
            self._scene.add_mesh_simple(
                "/world/hills", vertices, faces, color=(206, 198, 178), side="double", cast_shadow=False
            )
            lowest += float(heights.min())
        self._scene.add_grid(
            "/world/ground",
            infinite_grid=True,
            cell_size=0.1,
            section_size=1.0,
            cell_color=(148, 156, 166),
            cell_thickness=0.6,
            section_color=(108, 118, 130),
            fade_distance=14.0,
            position=(0.0, 0.0, lowest),
            shadow_opacity=0.25,
        )

    # --- each frame ------------------------------------------------------------------------------------------

    def show(self, drawing: Drawing) -> None:
        """Draw a snapshot."""
        for batch, numbers in self._links:
            batch.batched_positions = _single(drawing.links_w[numbers])
            batch.batched_wxyzs = _single(drawing.links_wxyz[numbers])
        self._hinges.batched_positions = _single(drawing.hinges_w)
        self._hinges.batched_wxyzs = _single(drawing.hinges_wxyz)
        self._mark_joints(drawing)
        self._contacts.visible = len(drawing.contacts_w) > 0
        if len(drawing.contacts_w):
            self._contacts.points = _single(drawing.contacts_w)
        self._show_arrows("contacts/normals", drawing.normals, (120, 130, 142), 0.10)
        self._show_arrows("contacts/tangents", drawing.tangents, (170, 178, 186), 0.08)
        self._show_arrows("forces/measured", drawing.forces, FELT, 0.22)
        self._show_arrows("forces/solved", drawing.solved, SOLVED, 0.16)
        self._show_dashes(drawing.asked)
        self._show_arrows("forces/resultant", drawing.resultant, RESULTANT, 0.30)
        self._show_path(drawing.path_w)
        hoop = {"opacity": 1.0, "grown": 1.05, "side": "double", "cast_shadow": False}
        self._show_obstacles("perceived", drawing.perceived, SEEN, **hoop)
        if self._around is not None:
            self._color_obstacles(self._around.obstacles, drawing)
        self._show_cameras(drawing.cameras)
        self._extend_trail(drawing.center_w)
        self._follow(drawing.center_w)

    def forget(self) -> None:
        """Another place in time: the trail starts over."""
        self._trail.clear()
        self._middle_w = None

    def _mark_joints(self, drawing: Drawing) -> None:
        count = len(drawing.hinges_w)
        colors = [HINGE] * count
        scales = np.ones((count, 3), dtype=np.float32)
        for i in drawing.failed:
            colors[i], scales[i] = LOST, 1.25
        if drawing.pushing is not None:
            colors[drawing.pushing], scales[drawing.pushing] = PROPELS, (1.9, 1.9, 1.25)
        self._hinges.batched_colors, self._hinges.batched_scales = _shades(colors), scales

    def _show_arrows(self, name: str, points: Floats, of: Color, thick: float) -> None:
        arrows = self._arrows.get(name)
        if arrows is None:
            if not len(points):
                return
            size = thick * self._thick
            arrows = self._arrows[name] = self._scene.add_arrows(
                f"/world/{name}",
                points,
                _shades([of])[0],
                shaft_radius=size,
                head_radius=2.2 * size,
                head_length=5 * size,
            )
        arrows.visible = len(points) > 0
        if len(points):
            arrows.points = _single(points)

    def _show_dashes(self, spans: Floats) -> None:
        """Forces that are asked for, and not there: no arrows, so that nobody takes them for contact forces."""
        start, along = spans[:, None, None, 0], spans[:, None, None, 1] - spans[:, None, None, 0]
        dashes = (start + DASHES[..., None] * along).reshape(-1, 2, 3)
        if len(dashes):
            self._asked.points = _single(dashes)
        self._asked.visible = len(dashes) > 0

    def _show_path(self, path_w: Floats) -> None:
        if len(path_w) < 2 or (self._path_w is not None and np.array_equal(path_w, self._path_w)):
            return
        self._path_w = path_w
        pieces = np.stack([path_w[:-1], path_w[1:]], axis=1)
        if self._path is None:
            self._path = self._scene.add_line_segments(
                "/world/path", pieces, (90, 100, 112), thickness=3.0, thickness_units="screen"
            )
        else:
            self._path.points = _single(pieces)

    def _show_obstacles(
        self, name: str, obstacles: Sequence[Obstacle], of: Color, *, opacity: float, grown: float = 1.0, **more: Any
    ) -> None:
        for shape in SHAPES[name]:
            these = [obstacle for obstacle in obstacles if obstacle.shape == shape]
            key = f"{name}/{shape}"
            batch = self._shapes.get(key)
            if batch is not None:
                batch.visible = bool(these)
            if not these:
                continue
            if batch is None:
                batch = self._shapes[key] = self._batch(
                    key, SHAPES[name][shape], len(these), of, opacity=opacity, **more
                )
            batch.batched_positions = _single([o.position_w for o in these])
            batch.batched_wxyzs = _single([quaternion_from_yaw(o.yaw_rad) for o in these])
            batch.batched_scales = _single(grown * np.array([_size(o) for o in these]))
            if len(batch.batched_colors) != len(these):
                batch.batched_colors = _shades([of] * len(these))
            if name == "perceived":
                batch.batched_opacities = _single([0.4 + 0.6 * o.confidence for o in these])

    def _color_obstacles(self, obstacles: Sequence[Obstacle], drawing: Drawing) -> None:
        """What the body pushes off, and what navigation expects it to."""
        for shape in SHAPES["true"]:
            batch = self._shapes.get(f"true/{shape}")
            if batch is not None:
                names = [obstacle.name for obstacle in obstacles if obstacle.shape == shape]
                of = [PUSHED if n in drawing.pushed else AHEAD if n in drawing.ahead else PEG for n in names]
                batch.batched_colors = _shades(of)

    def _show_cameras(self, cameras: Sequence[CameraFrustum]) -> None:
        for camera in cameras:
            frustum = self._cameras.get(camera.key)
            if frustum is None:
                frustum = self._cameras[camera.key] = self._scene.add_camera_frustum(
                    f"/world/cameras/{len(self._cameras)}",
                    camera.fov_rad,
                    camera.aspect,
                    scale=0.12,
                    thickness=1.5,
                    thickness_units="screen",
                    color=SEEN,
                )
            frustum.position, frustum.wxyz = camera.position_w, camera.wxyz

    def _extend_trail(self, center_w: Floats) -> None:
        on_ground = np.array([center_w[0], center_w[1], center_w[2] - 0.8 * self._thick])
        if self._trail and np.linalg.norm(on_ground - self._trail[-1]) < TRAIL_STEP_M:
            return
        self._trail.append(on_ground)
        if len(self._trail) > 1:
            line = np.array(self._trail, dtype=np.float32)
            self._trail_line.points = np.stack([line[:-1], line[1:]], axis=1)

    def _follow(self, center_w: Floats) -> None:
        middle = center_w if self._middle_w is None else self._middle_w + FOLLOW_SHARE * (center_w - self._middle_w)
        if np.linalg.norm(center_w - middle) > FURTHEST_M:
            middle = center_w
        self._middle_w = middle
        self._world.position = (-float(middle[0]), -float(middle[1]), 0.0)


def _single(values: ArrayLike) -> NDArray[np.float32]:
    """As viser sends numbers."""
    return np.asarray(values, dtype=np.float32)


def _shades(colors: Sequence[Color]) -> NDArray[np.uint8]:
    """Colours of instances, (n, 3): these viser takes as linear light, and all others as sRGB."""
    srgb = np.array(colors) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)


def _size(obstacle: Obstacle) -> tuple[float, float, float]:
    """What the unit shape is stretched by. A perceived height may be unknown: then it is drawn flat."""
    if obstacle.shape == "box":
        return obstacle.half_size_m
    if obstacle.shape == "cylinder":
        return obstacle.radius_m, obstacle.radius_m, max(obstacle.height_m, 0.01)
    return obstacle.radius_m, obstacle.radius_m, obstacle.radius_m
