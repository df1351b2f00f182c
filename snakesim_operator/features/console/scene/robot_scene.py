"""Shows drawings with viser: each kind of thing is one node of the scene, updated in place.

All nodes hang on the frame /world, which moves against the snake. So the view follows the snake, while each viewer
turns and zooms freely.
"""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np
import viser

from snakesim_hal.base.arrays import Floats
from snakesim_hal.wire.messages import RobotDescription
from snakesim_operator.features.console.scene import scene_colors
from snakesim_operator.features.console.scene.batches import add_batch, to_float32
from snakesim_operator.features.console.scene.drawing import (
    CameraFrustum,
    SnapshotDrawing,
    TrueSurroundings,
)
from snakesim_operator.features.console.scene.meshes import make_capsule, make_cylinder
from snakesim_operator.features.console.scene.obstacle_meshes import (
    PerceivedObstacles,
    TrueObstacles,
)
from snakesim_operator.features.console.scene.pipe_meshes import add_pipes
from snakesim_operator.features.console.scene.scene_colors import Color, convert_to_linear_colors

TRAIL_STEP_M = 0.02
TRAIL_MAX_POINTS = 1000
FOLLOW_FRACTION = 0.08  # of the way to the snake's center that the view moves in one frame
# A snake further than this from the view's middle has jumped: the view jumps too.
MAX_VIEW_OFFSET_M = 0.5
MAX_HEIGHTFIELD_ROWS = 200  # along an edge; a finer heightfield is thinned
HEIGHTFIELD_DROP_M = 0.003  # below the true ground, so that what lies on the ground is not hidden
# (5, 2): start and end of each dash, as fractions of the line.
DASHES = np.arange(10.0).reshape(5, 2) / 9
NO_SEGMENTS = np.zeros((1, 2, 3))  # placeholder: viser accepts no empty line


class RobotScene:
    """The 3-D scene of one robot."""

    def __init__(
        self, scene: viser.SceneApi, robot: RobotDescription, surroundings: TrueSurroundings | None
    ) -> None:
        """Add everything to the 3-D scene that does not depend on a snapshot: links, hinges, ground and obstacles.

        Args:
            scene: The scene of all viewers.
            robot: Description of the robot.
            surroundings: The true ground and obstacles; None if they are unknown.
        """
        self._scene = scene
        self._robot = robot
        self._body_radius_m = max(link.radius_m for link in robot.links)
        scene.configure_environment_map("warehouse", environment_intensity=0.3)
        scene.configure_default_lights(enabled=True, cast_shadow=True)
        self._world = scene.add_frame("/world", show_axes=False)

        # Nodes that exist from the start.
        self._links = self._add_links()
        hinge = make_cylinder(0.5 * self._body_radius_m, 2.12 * self._body_radius_m)
        self._hinges = add_batch(
            scene, "snake/hinges", hinge, len(robot.joints), scene_colors.HINGE
        )
        self._contacts = self._add_contact_points()
        self._trail_line = scene.add_line_segments(
            "/world/trail",
            NO_SEGMENTS,
            scene_colors.MEASURED_FORCE,
            thickness=2.5,
            thickness_units="screen",
        )
        self._dashed_forces = scene.add_line_segments(
            "/world/forces/without_contact",
            NO_SEGMENTS,
            scene_colors.DESIRED_FORCE,
            thickness=3.0,
            thickness_units="screen",
            visible=False,
        )

        # Nodes that are added when there is something to show.
        self._arrows: dict[str, viser.ArrowsHandle] = {}
        self._cameras: dict[str, viser.CameraFrustumHandle] = {}
        self._path: viser.LineSegmentsHandle | None = None

        # What was shown last.
        self._path_w: Floats | None = None
        self._trail: deque[Floats] = deque(maxlen=TRAIL_MAX_POINTS)
        self._view_center_w: Floats | None = None

        self._add_ground(surroundings)
        self._true_obstacles: TrueObstacles | None = None
        if surroundings is not None:
            add_pipes(scene, surroundings.pipes)
            self._true_obstacles = TrueObstacles(scene, surroundings.obstacles)
        self._perceived_obstacles = PerceivedObstacles(scene)

    # --- what does not change --------------------------------------------------------------------------------

    def _add_links(self) -> list[tuple[viser.BatchedMeshHandle, list[int]]]:
        """Add one batch for all links of one size; returns each batch with the indices of its links."""
        links_by_size: dict[tuple[float, float], list[int]] = {}
        for i, link in enumerate(self._robot.links):
            links_by_size.setdefault((link.length_m, link.radius_m), []).append(i)
        batches: list[tuple[viser.BatchedMeshHandle, list[int]]] = []
        for (length_m, radius_m), indices in links_by_size.items():
            name = f"snake/links_{len(batches)}"
            batch = add_batch(
                self._scene, name, make_capsule(length_m, radius_m), len(indices), scene_colors.LINK
            )
            batch.batched_scales = to_float32([_compute_link_scale(i) for i in indices])
            batch.batched_colors = convert_to_linear_colors(
                [self._choose_link_color(i) for i in indices]
            )
            batches.append((batch, indices))
        return batches

    def _choose_link_color(self, index: int) -> Color:
        if index == len(self._robot.links) - 1:
            return scene_colors.HEAD
        if index % 2:
            return scene_colors.LINK_ALTERNATE
        return scene_colors.LINK

    def _add_contact_points(self) -> viser.PointCloudHandle:
        return self._scene.add_point_cloud(
            "/world/contacts/points",
            np.zeros((1, 3)),
            scene_colors.palette_color("ink"),
            point_size=0.4 * self._body_radius_m,
            visible=False,
        )

    def _add_ground(self, surroundings: TrueSurroundings | None) -> None:
        """Add the ground to the scene: its heightfield, if it has one, and a grid below its lowest point.

        Args:
            surroundings: The true surroundings of the robot; None if they are not known.
        """
        grid_height_m = -0.002
        heightfield = None if surroundings is None else surroundings.heights_m
        if heightfield is not None:
            grid_height_m += self._add_heightfield(*heightfield)
        self._scene.add_grid(
            "/world/ground",
            infinite_grid=True,
            cell_size=0.1,
            section_size=1.0,
            cell_color=(148, 156, 166),
            cell_thickness=0.6,
            section_color=(108, 118, 130),
            fade_distance=14.0,
            position=(0.0, 0.0, grid_height_m),
            shadow_opacity=0.25,
        )

    def _add_heightfield(self, along_m: Floats, heights_m: Floats) -> float:
        """Add a heightfield as one mesh of triangles, and return its lowest height in m.

        Args:
            along_m: (n,) coordinates of the samples, the same along x and along y.
            heights_m: (n, n) heights in m; all samples of a row have the same y.
        """
        stride = max(1, math.ceil(len(along_m) / MAX_HEIGHTFIELD_ROWS))
        along_m = along_m[::stride]
        heights_m = heights_m[::stride, ::stride]
        row_length = len(along_m)
        x, y = np.meshgrid(along_m, along_m)
        vertices = np.column_stack([x.ravel(), y.ravel(), heights_m.ravel() - HEIGHTFIELD_DROP_M])
        # Each cell of the grid is two triangles. `corner` is the index of the cell's vertex with the smallest x and y.
        row = np.arange(row_length - 1)[:, None]
        column = np.arange(row_length - 1)[None, :]
        corner = (row * row_length + column).ravel()
        lower_triangles = np.stack([corner, corner + 1, corner + row_length], axis=1)
        upper_triangles = np.stack(
            [corner + 1, corner + row_length + 1, corner + row_length], axis=1
        )
        self._scene.add_mesh_simple(
            "/world/hills",
            vertices,
            np.concatenate([lower_triangles, upper_triangles]),
            color=scene_colors.HILLS,
            side="double",
            cast_shadow=False,
        )
        return float(heights_m.min())

    # --- each frame ------------------------------------------------------------------------------------------

    def update_nodes(self, drawing: SnapshotDrawing) -> None:
        """Update all nodes from the drawing of one snapshot."""
        self._show_snake(drawing)
        self._show_contacts(drawing)
        self._show_forces(drawing)
        self._show_path(drawing.path_w)
        self._perceived_obstacles.draw_obstacles(drawing.perceived)
        if self._true_obstacles is not None:
            self._true_obstacles.update_nodes(drawing)
        self._show_cameras(drawing.cameras)
        self._extend_trail(drawing.center_w)
        self._move_view(drawing.center_w)

    def clear_trail(self) -> None:
        """Start the trail again: the next drawing is of another place in time."""
        self._trail.clear()
        self._view_center_w = None

    def _show_snake(self, drawing: SnapshotDrawing) -> None:
        for batch, indices in self._links:
            batch.batched_positions = to_float32(drawing.links_w[indices])
            batch.batched_wxyzs = to_float32(drawing.links_wxyz[indices])
        self._hinges.batched_positions = to_float32(drawing.hinges_w)
        self._hinges.batched_wxyzs = to_float32(drawing.hinges_wxyz)
        self._mark_joints(drawing)

    def _mark_joints(self, drawing: SnapshotDrawing) -> None:
        """Color and enlarge failed joints and the propulsion joint."""
        count = len(drawing.hinges_w)
        colors: list[Color] = [scene_colors.HINGE] * count
        scales = np.ones((count, 3), dtype=np.float32)
        for i in drawing.failed_joints:
            colors[i] = scene_colors.FAILED_JOINT
            scales[i] = 1.25
        propulsion_joint = drawing.propulsion_joint
        if propulsion_joint is not None:
            colors[propulsion_joint] = scene_colors.PROPULSION_JOINT
            scales[propulsion_joint] = (1.9, 1.9, 1.25)
        self._hinges.batched_colors = convert_to_linear_colors(colors)
        self._hinges.batched_scales = scales

    def _show_contacts(self, drawing: SnapshotDrawing) -> None:
        self._contacts.visible = len(drawing.contacts_w) > 0
        if len(drawing.contacts_w):
            self._contacts.points = to_float32(drawing.contacts_w)
        self._show_arrows("contacts/normals", drawing.normals, scene_colors.CONTACT_NORMAL, 0.10)
        self._show_arrows("contacts/tangents", drawing.tangents, scene_colors.CONTACT_TANGENT, 0.08)

    def _show_forces(self, drawing: SnapshotDrawing) -> None:
        self._show_arrows(
            "forces/measured", drawing.measured_forces, scene_colors.MEASURED_FORCE, 0.22
        )
        self._show_arrows(
            "forces/desired", drawing.desired_forces, scene_colors.DESIRED_FORCE, 0.16
        )
        self._show_dashed_forces(drawing.forces_without_contact)
        self._show_arrows("forces/resultant", drawing.resultant, scene_colors.RESULTANT, 0.30)

    def _show_arrows(
        self, name: str, arrows_w: Floats, color: Color, relative_radius: float
    ) -> None:
        """Show arrows (n, 2, 3) as one node. `relative_radius` is the radius of a shaft divided by that of the body."""
        handle = self._arrows.get(name)
        if handle is not None:
            handle.visible = len(arrows_w) > 0
            if len(arrows_w):
                handle.points = to_float32(arrows_w)
        elif len(arrows_w):
            radius_m = relative_radius * self._body_radius_m
            self._arrows[name] = self._scene.add_arrows(
                f"/world/{name}",
                to_float32(arrows_w),
                convert_to_linear_colors([color])[0],
                shaft_radius=radius_m,
                head_radius=2.2 * radius_m,
                head_length=5 * radius_m,
            )

    def _show_dashed_forces(self, spans_w: Floats) -> None:
        """Show desired forces without contact as dashed lines, so that no viewer takes them for contact forces."""
        start = spans_w[:, None, None, 0]
        along = spans_w[:, None, None, 1] - start
        dashes = (start + DASHES[..., None] * along).reshape(-1, 2, 3)
        if len(dashes):
            self._dashed_forces.points = to_float32(dashes)
        self._dashed_forces.visible = len(dashes) > 0

    def _show_path(self, path_w: Floats) -> None:
        """Show the planned path, (n, 3), if it has changed."""
        is_known = self._path_w is not None and np.array_equal(path_w, self._path_w)
        if len(path_w) < 2 or is_known:
            return
        self._path_w = path_w
        segments = np.stack([path_w[:-1], path_w[1:]], axis=1)
        if self._path is None:
            self._path = self._scene.add_line_segments(
                "/world/path", segments, scene_colors.PATH, thickness=3.0, thickness_units="screen"
            )
        else:
            self._path.points = to_float32(segments)

    def _show_cameras(self, cameras: Sequence[CameraFrustum]) -> None:
        for camera in cameras:
            frustum = self._cameras.get(camera.key)
            if frustum is None:
                frustum = self._scene.add_camera_frustum(
                    f"/world/cameras/{len(self._cameras)}",
                    camera.fov_rad,
                    camera.aspect,
                    scale=0.12,
                    thickness=1.5,
                    thickness_units="screen",
                    color=scene_colors.PERCEIVED,
                )
                self._cameras[camera.key] = frustum
            frustum.position = camera.position_w
            frustum.wxyz = camera.wxyz

    def _extend_trail(self, center_w: Floats) -> None:
        """Add the body's center to the trail on the ground, once the body has moved far enough."""
        on_ground = np.array([center_w[0], center_w[1], center_w[2] - 0.8 * self._body_radius_m])
        if self._trail and np.linalg.norm(on_ground - self._trail[-1]) < TRAIL_STEP_M:
            return
        self._trail.append(on_ground)
        if len(self._trail) > 1:
            points = np.array(self._trail, dtype=np.float32)
            self._trail_line.points = np.stack([points[:-1], points[1:]], axis=1)

    def _move_view(self, center_w: Floats) -> None:
        """Let the view follow the snake smoothly, or jump with it."""
        if self._view_center_w is None:
            view_center_w = center_w
        else:
            view_center_w = self._view_center_w + FOLLOW_FRACTION * (center_w - self._view_center_w)
        if np.linalg.norm(center_w - view_center_w) > MAX_VIEW_OFFSET_M:
            view_center_w = center_w
        self._view_center_w = view_center_w
        self._world.position = (-float(view_center_w[0]), -float(view_center_w[1]), 0.0)


def _compute_link_scale(index: int) -> tuple[float, float, float]:
    """Return the scale of a link: every second one is a little thinner.

    Neighbors share a sphere at their joint, which would flicker if both drew it at the same place.
    """
    thickness = 1.0 - 0.012 * (index % 2)
    return 1.0, thickness, thickness
