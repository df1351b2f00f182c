"""The page: the scene in the middle, the state and the controls beside it.

All viewers see the same, except that each viewer has controls of its own.

Threads: the display loop calls `show` and `start_over`, with one snapshot a frame. viser calls `_on_viewer_connect` and
`_on_viewer_disconnect` in threads of its own. The thread that receives the messages of browsers calls `_stop_robot` and
`_on_drive_key`, which must not wait.

Each viewer gets the newest value of each thing when its page has shown the one before (`pacing`). So a slow browser
gets fewer frames, and never makes the display loop wait.
"""

import contextlib
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path

import viser

from snakesim_hal.wire.messages import ControlParameters, Description
from snakesim_operator.features.console.control_token import ControlToken
from snakesim_operator.features.console.operations import Operations, PageLog
from snakesim_operator.features.console.page import page_html
from snakesim_operator.features.console.page.appearance import (
    add_appearance,
    aim_initial_camera,
    aim_phone_camera,
    set_appearance,
)
from snakesim_operator.features.console.page.camera_tab import draw_picture
from snakesim_operator.features.console.page.commissioning_tab import Commissioning
from snakesim_operator.features.console.page.custom_sensors import CustomSensorCharts
from snakesim_operator.features.console.page.drive_controls import DRIVE_KEYS
from snakesim_operator.features.console.page.force_polygon import force_polygon, push_point_table
from snakesim_operator.features.console.page.joint_charts import JointCharts
from snakesim_operator.features.console.page.viewer_controls import ViewerControls, format_viewer
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import Surroundings, draw
from snakesim_operator.features.console.scene.robot_scene import RobotScene
from snakesim_operator.features.console.scene.scene_colors import LEGEND
from snakesim_operator.features.console.web.message_age import PageAction
from snakesim_operator.features.console.web.viser_server import PageServer

# Decimation: every how many frames each part of the page is renewed, at 30 frames a second.
TEXT_DECIMATION = 6
CHART_DECIMATION = 5
PICTURE_DECIMATION = 6
QUESTION_DECIMATION = 3  # ten questions a second to the page in control, by which the age of its messages is known

PANEL_WIDTH_PX = 490  # wide enough for all tabs in one line


class Page:
    """The page that all viewers see, and the controls of each viewer."""

    def __init__(
        self,
        server: PageServer,
        surroundings: Surroundings | None,
        operations: Operations | None,
        log: PageLog,
        recorded: str = "",
        commission: Path | None = None,
    ) -> None:
        """Lay out the page, without a robot.

        Args:
            server: Serves the page.
            surroundings: The true surroundings of the robot, if they are known.
            operations: Sends commands to the robot; None for a recording.
            log: Lines to show.
            recorded: Name of the recording; empty for a live robot.
            commission: The robot file on this computer with which the host was started; None: pages may not change it.
        """
        # What the page is given.
        self._server = server
        self._surroundings = surroundings
        self._operations = operations
        self._log = log
        self._recorded = recorded
        self._commission = commission
        # Viewers.
        self._token = ControlToken()
        self._commissioning: Commissioning | None = None
        self._controls: dict[int, ViewerControls] = {}  # by viewer
        self._lock = threading.Lock()  # of `_controls`; viser fills a folder from one thread at a time
        # What is shown.
        self._frame_count = 0
        self._snapshot: RobotSnapshot | None = None
        self._scene: RobotScene | None = None
        self._joint_charts: JointCharts | None = None
        self._sensor_charts: CustomSensorCharts | None = None
        self._shown_log: list[str] = []
        self._pictures: dict[str, viser.GuiImageHandle] = {}  # by key
        self._lay_out()
        server.on_client_connect(self._on_viewer_connect)
        server.on_client_disconnect(self._on_viewer_disconnect)

    # --- layout ----------------------------------------------------------------------------------------------

    def _lay_out(self) -> None:
        gui = self._server.gui
        set_appearance(gui, dark=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH_PX)
        self._header = gui.add_html(page_html.format_header(None), order=0)
        if self._operations is not None:
            self._add_stop_and_drive_keys()
            self._control_folder = gui.add_folder("Control", order=2)
        tabs = gui.add_tab_group(order=4)
        self._add_robot_tabs(tabs)
        if self._operations is not None:
            self._add_command_tabs(tabs, self._operations)
        with tabs.add_tab("Log"):
            self._log_text = gui.add_html("")
        gui.add_html(page_html.format_legend(LEGEND), order=3)

    def _add_stop_and_drive_keys(self) -> None:
        """Add the stop, and the keys that drive the robot; all are handled by the thread that receives messages."""
        gui = self._server.gui
        admit = self._server.admission.admit
        button = gui.add_button("EMERGENCY STOP  (Esc)", color="red", icon=viser.Icon.HAND_STOP, order=1)
        admit(button, handler=self._stop_robot)
        admit(gui.add_command("Emergency stop", hotkey="escape"), handler=self._stop_robot)
        for key_name, hotkey in DRIVE_KEYS.items():
            command = gui.add_command(f"Drive: {key_name.lower()}", hotkey=hotkey)
            admit(command, handler=partial(self._on_drive_key, key_name))

    def _add_robot_tabs(self, tabs: viser.GuiTabGroupHandle) -> None:
        """Add the tabs that show the robot."""
        gui = self._server.gui
        with tabs.add_tab("Joints"):
            self._joints_tab = gui.add_folder(None)
        with tabs.add_tab("Forces"):
            self._forces = gui.add_html("")
        with tabs.add_tab("State"):
            self._state = gui.add_html("")
            with gui.add_folder("Rates and ages", expand_by_default=False):
                self._streams = gui.add_html("")
        with tabs.add_tab("Signals"):
            gui.add_html(page_html.SIGNALS)
        with tabs.add_tab("Cameras"):
            self._cameras_tab = gui.add_folder(None)
            with self._cameras_tab:
                self._no_camera = gui.add_html("<div style='padding:.3em .6em;opacity:.7'>no image yet</div>")
        with tabs.add_tab("Sensors"):
            self._sensors_tab = gui.add_folder(None)

    def _add_command_tabs(self, tabs: viser.GuiTabGroupHandle, operations: Operations) -> None:
        """Add the tabs with which viewers change the robot."""
        gui = self._server.gui
        with tabs.add_tab("Parameters"):
            self._parameters_tab = gui.add_folder(None)
        with tabs.add_tab("Commission"):
            self._commission_tab = gui.add_folder(None)
        self._commissioning = Commissioning(
            gui, self._commission_tab, operations.link, self._commission, self._token, self._log
        )

    # --- viewers ---------------------------------------------------------------------------------------------

    def _on_viewer_connect(self, client: viser.ClientHandle) -> None:
        """Give a viewer its controls. Its page may close before this ends.

        The page shows all of it at once, so no control is shown before it can be pressed.
        """
        viewer = client.client_id
        with self._ignore_closed_page(client), client.atomic():
            with self._lock:
                add_appearance(client, self._server.admission, dark=self._server.prefers_dark(viewer))
            if self._operations is not None:
                self._add_controls(client, self._operations)
            if self._snapshot is not None:
                aim_phone_camera(client, self._snapshot.robot)
            self._log.write(f"{format_viewer(viewer)} came")
        if viewer not in self._server.get_clients():
            self._forget_viewer(viewer)

    def _add_controls(self, client: viser.ClientHandle, operations: Operations) -> None:
        assert self._commissioning is not None
        with self._lock:
            controls = ViewerControls(
                client,
                self._control_folder,
                self._token,
                operations,
                lambda: self._snapshot,
                self._parameters_tab,
                self._on_control_changed,
                self._server.admission,
                self._commissioning,
                self._commission_tab,
            )
            if self._snapshot is not None and self._snapshot.parameters is not None:
                controls.show_parameters(self._snapshot.parameters)
            self._controls[client.client_id] = controls

    def _on_viewer_disconnect(self, client: viser.ClientHandle) -> None:
        """Forget a viewer; if it had control, any other viewer may take it now."""
        viewer = client.client_id
        self._forget_viewer(viewer)
        had_control = self._token.release(viewer)
        line = f"{format_viewer(viewer)} left"
        if had_control:
            line += ", and with it control"
        self._log.write(line)
        self._on_control_changed()

    def _forget_viewer(self, viewer: int) -> None:
        with self._lock:
            self._controls.pop(viewer, None)
        self._server.admission.forget_viewer(viewer)

    @contextlib.contextmanager
    def _ignore_closed_page(self, client: viser.ClientHandle) -> Iterator[None]:
        """Ignore the errors that viser raises when a page is changed that has just been closed."""
        try:
            yield
        except (RuntimeError, KeyError):  # a KeyError comes from a control whose folder is gone
            if client.client_id in self._server.get_clients():
                raise

    def _on_control_changed(self) -> None:
        """Show each viewer the controls that it may use now."""
        # Ask first: the page that may press something next has to have answered before its presses count.
        self._ask_for_age()
        with self._lock:
            all_controls = list(self._controls.values())
        for controls in all_controls:
            with self._ignore_closed_page(controls.client):
                controls.refresh()

    def _ask_for_age(self) -> None:
        """Send the page in control the next question by which the age of its messages is known."""
        holder = self._token.holder
        if holder is None:
            return
        snapshot = self._snapshot
        robot_ns = None
        if snapshot is not None and snapshot.time_s is not None:
            robot_ns = round(snapshot.time_s * 1e9)
        self._server.ask_for_age(holder, robot_ns)

    # --- messages of browsers --------------------------------------------------------------------------------

    def _stop_robot(self, viewer: int, _action: PageAction) -> None:
        """Stop the robot, however old the press is, and whichever viewer has control.

        A page that cannot draw the scene has no controls, but may stop the robot.
        """
        assert self._operations is not None
        stopped = self._operations.stop.request(format_viewer(viewer))
        controls = self._controls.get(viewer)  # without the lock: the thread that holds it may wait for this one
        if controls is not None:
            stopped.add_done_callback(partial(self._show_stop_result, controls))

    def _show_stop_result(self, controls: ViewerControls, stopped: "Future[str]") -> None:
        with self._ignore_closed_page(controls.client):
            error = stopped.exception()
            if error is not None:
                controls.notify("Emergency stop", str(error), bad=True)
            else:
                controls.notify("Emergency stop", stopped.result())

    def _on_drive_key(self, key_name: str, viewer: int, action: PageAction) -> None:
        controls = self._controls.get(viewer)  # without the lock, as in `_stop_robot`
        if controls is not None:
            controls.drive.on_key(key_name, action)

    # --- each frame ------------------------------------------------------------------------------------------

    def show_snapshot(self, snapshot: RobotSnapshot | None) -> None:
        """Show a snapshot; None while there is no robot."""
        previous = self._snapshot
        self._snapshot = snapshot
        self._frame_count += 1
        if self._frame_count % QUESTION_DECIMATION == 0:
            self._ask_for_age()
        if self._commissioning is not None:
            self._commissioning.update(snapshot)
        if snapshot is not None:
            self._show_robot(previous, snapshot)
        if self._is_due(TEXT_DECIMATION) or _urgent_state(previous) != _urgent_state(snapshot):
            self._show_texts(snapshot)

    def start_over(self, earlier: Iterable[RobotSnapshot]) -> None:
        """Prepare for a snapshot that does not follow the last one, because a viewer jumped in a recording.

        The trail starts over, and the charts begin with the snapshots of the time before the jump's target.
        """
        for snapshot in earlier:
            if self._scene is None:
                self._show_new_robot(snapshot.robot)
                self._snapshot = snapshot
            assert self._joint_charts is not None
            self._joint_charts.add_snapshot(snapshot)  # charts start over when time goes back
            if self._sensor_charts is not None:
                self._sensor_charts.add_snapshot(snapshot)
        if self._scene is not None:
            self._scene.clear_trail()
        self._frame_count = 0

    def _is_due(self, decimation: int) -> bool:
        """Return whether a part of the page is renewed in this frame; all parts are in the first frame."""
        return self._frame_count % decimation == 1

    def _show_robot(self, previous: RobotSnapshot | None, snapshot: RobotSnapshot) -> None:
        """Show the scene at once, and charts, images and parameters when they are due."""
        if self._scene is None or previous is None or previous.robot.layout != snapshot.robot.layout:
            self._show_new_robot(snapshot.robot)
        if previous is None or previous.robot is not snapshot.robot:
            self._on_control_changed()  # a simulator has controls that other robots do not have
        drawing = draw(snapshot, self._surroundings)
        assert self._scene is not None
        if drawing is not None:
            with self._server.atomic():
                self._scene.show(drawing)
        self._update_charts(snapshot)
        if self._is_due(PICTURE_DECIMATION):
            self._show_pictures(snapshot)
        parameters = snapshot.parameters
        if parameters is not None and (previous is None or parameters != previous.parameters):
            self._show_parameters(parameters)

    def _update_charts(self, snapshot: RobotSnapshot) -> None:
        """Keep a sample for the charts, and redraw them when they are due."""
        assert self._joint_charts is not None
        self._joint_charts.add_snapshot(snapshot)
        if self._sensor_charts is not None:
            self._sensor_charts.add_snapshot(snapshot)
        if not self._is_due(CHART_DECIMATION):
            return
        self._joint_charts.redraw(snapshot)
        self._forces.content = force_polygon(snapshot) + push_point_table(snapshot.control)
        if self._sensor_charts is not None:
            self._sensor_charts.redraw(snapshot)

    def _show_new_robot(self, robot: Description) -> None:
        """Start scene and charts over, for a robot of another layout."""
        scene = self._server.scene
        scene.reset()
        scene.set_up_direction("+z")
        aim_initial_camera(self._server, robot)
        for client in self._server.get_clients().values():
            aim_phone_camera(client, robot)
        self._scene = RobotScene(scene, robot, self._surroundings)
        with self._joints_tab:
            if self._joint_charts is not None:
                self._joint_charts.remove()
            self._joint_charts = JointCharts(self._server.gui, robot)
        if self._sensor_charts is not None:
            self._sensor_charts.remove()
            self._sensor_charts = None
        if robot.custom:
            with self._sensors_tab:
                self._sensor_charts = CustomSensorCharts(self._server.gui)

    def _show_parameters(self, parameters: ControlParameters) -> None:
        with self._lock:
            for controls in self._controls.values():
                with self._ignore_closed_page(controls.client):
                    controls.show_parameters(parameters)

    def _show_texts(self, snapshot: RobotSnapshot | None) -> None:
        log_lines = self._log.lines()
        if snapshot is not None:
            self._state.content = page_html.format_state_table(snapshot)
            self._streams.content = page_html.format_stream_table(snapshot)
            if self._commissioning is not None:
                self._commissioning.redraw(snapshot)
            log_lines = [*snapshot.log, *log_lines]
        if log_lines != self._shown_log:
            self._shown_log = log_lines
            self._log_text.content = page_html.format_log(log_lines)
        if self._operations is None:
            self._header.content = page_html.format_header(snapshot, recorded=self._recorded)
        else:
            self._header.content = page_html.format_header(snapshot, control=self._describe_viewers())

    def _describe_viewers(self) -> str:
        """Return which viewer has control, how many viewers there are, and how many of their messages were dropped."""
        viewers = _count_in_words(self._server.viewers(), "viewer")
        text = f"{format_viewer(self._token.holder)} has control; {viewers}"
        dropped = self._server.admission.dropped.total()
        if dropped:
            text += f"; {_count_in_words(dropped, 'message')} of browsers dropped"
        return text

    def _show_pictures(self, snapshot: RobotSnapshot) -> None:
        for key, image in snapshot.images.items():
            handle = self._pictures.get(key)
            if handle is None:
                self._no_camera.visible = False
                with self._cameras_tab:
                    self._pictures[key] = self._server.gui.add_image(draw_picture(image), label=key)
            else:
                handle.image = draw_picture(image)


def _count_in_words(count: int, noun: str) -> str:
    plural = "" if count == 1 else "s"
    return f"{count} {noun}{plural}"


def _urgent_state(snapshot: RobotSnapshot | None) -> tuple[object, ...] | None:
    """Return the state whose changes viewers must see at once, rather than when texts are due."""
    if snapshot is None:
        return None
    status = snapshot.status
    control = snapshot.control
    host_state = None if status is None else (status.lifecycle, status.reason, status.paused_by)
    control_state = None if control is None else control.state
    return host_state, control_state
