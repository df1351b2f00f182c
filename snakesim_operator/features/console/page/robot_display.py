"""What the page shows of one robot: the scene, and charts and images beside it."""

from collections.abc import Iterable
from dataclasses import dataclass

import viser

from snakesim_hal.wire.messages import RobotDescription
from snakesim_operator.features.console.page.appearance import aim_initial_camera, aim_phone_camera
from snakesim_operator.features.console.page.camera_tab import draw_picture
from snakesim_operator.features.console.page.custom_sensors import CustomSensorCharts
from snakesim_operator.features.console.page.force_polygon import (
    draw_force_polygon,
    format_push_point_table,
)
from snakesim_operator.features.console.page.joint_charts import JointCharts
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import TrueSurroundings, draw
from snakesim_operator.features.console.scene.robot_scene import RobotScene
from snakesim_operator.features.console.web.viser_server import PageServer


@dataclass(frozen=True)
class RobotTabs:
    """The places of charts and images in the panel."""

    joints: viser.GuiFolderHandle
    forces: viser.GuiHtmlHandle
    cameras: viser.GuiFolderHandle
    no_camera: viser.GuiHtmlHandle  # shown until the first image
    sensors: viser.GuiFolderHandle


class RobotDisplay:
    """The scene, charts and images of a robot. They start over when another robot appears."""

    def __init__(
        self, server: PageServer, surroundings: TrueSurroundings | None, tabs: RobotTabs
    ) -> None:
        """Show nothing yet.

        Args:
            server: Server of the page.
            surroundings: The true surroundings of the robot, if they are known.
            tabs: The places of charts and images.
        """
        self._server = server
        self._surroundings = surroundings
        self._tabs = tabs
        self._robot: RobotDescription | None = None  # the robot that scene and charts are for
        self._scene: RobotScene | None = None
        self._joint_charts: JointCharts | None = None
        self._sensor_charts: CustomSensorCharts | None = None
        self._pictures: dict[str, viser.GuiImageHandle] = {}  # by key

    def show_scene(self, snapshot: RobotSnapshot) -> None:
        """Draw the robot and what surrounds it."""
        self._prepare_for_robot(snapshot.robot)
        assert self._scene is not None
        drawing = draw(snapshot, self._surroundings)
        if drawing is not None:
            with self._server.atomic():
                self._scene.update_nodes(drawing)

    def add_samples(self, snapshots: Iterable[RobotSnapshot]) -> None:
        """Keep samples for the charts. The charts start over when time goes back."""
        for snapshot in snapshots:
            self._prepare_for_robot(snapshot.robot)
            assert self._joint_charts is not None
            self._joint_charts.add_snapshot(snapshot)
            if self._sensor_charts is not None:
                self._sensor_charts.add_snapshot(snapshot)

    def redraw_charts(self, snapshot: RobotSnapshot) -> None:
        """Draw the charts anew, from the samples that were added."""
        assert self._joint_charts is not None
        self._joint_charts.redraw(snapshot)
        self._tabs.forces.content = draw_force_polygon(snapshot) + format_push_point_table(
            snapshot.control
        )
        if self._sensor_charts is not None:
            self._sensor_charts.redraw(snapshot)

    def show_pictures(self, snapshot: RobotSnapshot) -> None:
        """Show the newest image of each camera."""
        for key, image in snapshot.images.items():
            handle = self._pictures.get(key)
            if handle is None:
                self._tabs.no_camera.visible = False
                with self._tabs.cameras:
                    self._pictures[key] = self._server.gui.add_image(draw_picture(image), label=key)
            else:
                handle.image = draw_picture(image)

    def clear_trail(self) -> None:
        """Clear the trail of the robot, so that it starts again at the robot's pose."""
        if self._scene is not None:
            self._scene.clear_trail()

    def _prepare_for_robot(self, robot: RobotDescription) -> None:
        """Replace scene and charts if they are for a robot of another layout, and aim the cameras at the new robot."""
        if self._robot is not None and self._robot.layout == robot.layout:
            return
        self._robot = robot
        scene = self._server.scene
        scene.reset()
        scene.set_up_direction("+z")
        aim_initial_camera(self._server, robot)
        for client in self._server.get_clients().values():
            aim_phone_camera(client, robot)
        self._scene = RobotScene(scene, robot, self._surroundings)
        with self._tabs.joints:
            if self._joint_charts is not None:
                self._joint_charts.remove()
            self._joint_charts = JointCharts(self._server.gui, robot)
        if self._sensor_charts is not None:
            self._sensor_charts.remove()
            self._sensor_charts = None
        if robot.custom:
            with self._tabs.sensors:
                self._sensor_charts = CustomSensorCharts(self._server.gui)
