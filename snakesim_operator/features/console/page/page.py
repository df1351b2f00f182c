"""The page: the scene in the middle, the state and the controls beside it; the same for every viewer but the controls.

The loop hands over one snapshot a frame. Each viewer gets the newest value of each thing when it has shown the one
before (`pacing`), so a slow browser gets fewer frames, and never makes the loop wait.
"""

import contextlib
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import Future
from functools import partial
from pathlib import Path

import viser

from snakesim_hal.wire.messages import ControlSettings, Description
from snakesim_hal.wire.quantities import Vector
from snakesim_operator.features.console.control_token import ControlToken
from snakesim_operator.features.console.operations import Operations, PageLog
from snakesim_operator.features.console.page import page_html
from snakesim_operator.features.console.page.camera_tab import picture
from snakesim_operator.features.console.page.commissioning_tab import Commissioning
from snakesim_operator.features.console.page.custom_sensors import CustomSensorCharts
from snakesim_operator.features.console.page.force_polygon import force_polygon, push_point_table
from snakesim_operator.features.console.page.joint_charts import JointCharts
from snakesim_operator.features.console.page.viewer_controls import (
    KEYS,
    ViewerControls,
    add_appearance,
    format_viewer,
    set_appearance,
)
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import Surroundings, draw
from snakesim_operator.features.console.scene.robot_scene import RobotScene
from snakesim_operator.features.console.scene.scene_colors import LEGEND
from snakesim_operator.features.console.web.message_age import PageAction
from snakesim_operator.features.console.web.server import PageServer

TEXT_EVERY, CHARTS_EVERY, PICTURES_EVERY = 6, 5, 6  # frames
ASK_EVERY = 3  # frames between two questions to the page in control: ten a second
PANEL_PX = 460  # wide enough for all tabs in one line
VIEW_RAD = 0.75  # vertical angle of view


class Page:
    """Everything that viewers see."""

    def __init__(
        self,
        server: PageServer,
        around: Surroundings | None,
        operations: Operations | None,
        log: PageLog,
        recorded: str = "",
        commission: Path | None = None,
    ) -> None:
        """around: the true surroundings, if known; operations: None shows a recording, which `recorded` names.

        commission: the robot file on this computer with which the host was started.
        """
        self._server, self._around, self._operations = server, around, operations
        self._log, self._recorded = log, recorded
        self._token, self._commission = ControlToken(), commission
        self._commissioning: Commissioning | None = None
        self._controls: dict[int, ViewerControls] = {}
        self._lock = threading.Lock()  # of `_controls`; viser fills a folder from one thread at a time
        self._frames = 0
        self._moment: RobotSnapshot | None = None
        self._stage: RobotScene | None = None
        self._charts: JointCharts | None = None
        self._own_sensors: CustomSensorCharts | None = None
        self._shown_log: list[str] = []
        self._pictures: dict[str, viser.GuiImageHandle] = {}
        self._lay_out()
        server.on_client_connect(self._came)
        server.on_client_disconnect(self._went)

    def _lay_out(self) -> None:
        gui = self._server.gui
        set_appearance(gui, dark=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_PX)
        self._header = gui.add_html(page_html.header(None), order=0)
        if self._operations is not None:
            # The stop, and what moves the robot while it is held, are acted on where messages are received.
            admit = self._server.admission.admit
            button = gui.add_button("EMERGENCY STOP  (Esc)", color="red", icon=viser.Icon.HAND_STOP, order=1)
            admit(button, act=self._estop)
            admit(gui.add_command("Emergency stop", hotkey="escape"), act=self._estop)
            for what, hotkey in KEYS.items():
                command = gui.add_command(f"Drive: {what.lower()}", hotkey=hotkey)
                admit(command, act=partial(self._press, what))
            self._control_folder = gui.add_folder("Control", order=2)
        tabs = gui.add_tab_group(order=4)
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
        if self._operations is not None:
            with tabs.add_tab("Settings"):
                self._settings_tab = gui.add_folder(None)
            with tabs.add_tab("Commission"):
                self._commission_tab = gui.add_folder(None)
            self._commissioning = Commissioning(
                gui, self._commission_tab, self._operations.link, self._commission, self._token, self._log
            )
        with tabs.add_tab("Log"):
            self._log_text = gui.add_html("")
        gui.add_html(page_html.legend(LEGEND), order=3)

    # --- viewers ---------------------------------------------------------------------------------------------

    def _came(self, client: viser.ClientHandle) -> None:
        """In a thread of viser's: the viewer may be gone before it ends. Nothing is shown before it can be pressed."""
        with self._of_who_is_there(client), client.atomic():
            with self._lock:
                add_appearance(client, self._server.admission, dark=self._server.prefers_dark(client.client_id))
            if self._operations is not None:
                self._give_controls(client)
            if self._moment is not None:
                _aim(client, self._moment.robot)
            self._log.write(f"{format_viewer(client.client_id)} came")
        if client.client_id not in self._server.get_clients():
            self._forget(client.client_id)

    def _give_controls(self, client: viser.ClientHandle) -> None:
        assert self._operations is not None and self._commissioning is not None
        with self._lock:
            controls = ViewerControls(
                client,
                self._control_folder,
                self._token,
                self._operations,
                lambda: self._moment,
                self._settings_tab,
                self._control_changed,
                self._server.admission,
                (self._commissioning, self._commission_tab),
            )
            if self._moment is not None and self._moment.settings is not None:
                controls.show_settings(self._moment.settings)
            self._controls[client.client_id] = controls

    def _went(self, client: viser.ClientHandle) -> None:
        """Control returns with the page that had it."""
        self._forget(client.client_id)
        had = self._token.release(client.client_id)
        self._log.write(f"{format_viewer(client.client_id)} left{', and with it control' if had else ''}")
        self._control_changed()

    def _forget(self, viewer: int) -> None:
        with self._lock:
            self._controls.pop(viewer, None)
        self._server.admission.forget_viewer(viewer)

    @contextlib.contextmanager
    def _of_who_is_there(self, client: viser.ClientHandle) -> Iterator[None]:
        """What a viewer's page shows can be changed until it closes, which may be now: then viser raises."""
        try:
            yield
        except (RuntimeError, KeyError):  # the latter of what stands in a folder that is gone
            if client.client_id in self._server.get_clients():
                raise

    def _ask_for_age(self) -> None:
        """Ask the page in control the next question by which the age of what it sends is known."""
        holder, moment = self._token.holder, self._moment
        if holder is None:
            return
        time_s = None if moment is None else moment.time_s
        self._server.ask_for_age(holder, None if time_s is None else round(time_s * 1e9))

    def _control_changed(self) -> None:
        self._ask_for_age()  # before the page shows what it may press now
        with self._lock:
            everybody = list(self._controls.values())
        for controls in everybody:
            with self._of_who_is_there(controls.client):
                controls.show()

    def _estop(self, viewer: int, _action: PageAction) -> None:
        """Stop the robot, however old the press is. A page that cannot draw the scene has no controls, but may stop."""
        assert self._operations is not None
        stopped = self._operations.stop.request(format_viewer(viewer))
        controls = self._controls.get(viewer)  # without the lock: whoever holds it may wait for this thread
        if controls is not None:
            stopped.add_done_callback(partial(self._show_stop, controls))

    def _show_stop(self, controls: ViewerControls, stopped: "Future[str]") -> None:
        with self._of_who_is_there(controls.client):
            error = stopped.exception()
            controls.tell("Emergency stop", str(error) if error else stopped.result(), bad=error is not None)

    def _press(self, key: str, viewer: int, action: PageAction) -> None:
        controls = self._controls.get(viewer)  # as above
        if controls is not None:
            controls.press(key, action)

    def recall(self, before: Iterable[RobotSnapshot]) -> None:
        """The next snapshot is not the one after this: the trail starts over, charts begin with those before it."""
        for snapshot in before:
            if self._stage is None:
                self._meet(snapshot.robot)
                self._moment = snapshot
            assert self._charts is not None
            self._charts.add_snapshot(snapshot)  # going back forgets
            if self._own_sensors is not None:
                self._own_sensors.add_snapshot(snapshot)
        if self._stage is not None:
            self._stage.clear_trail()
        self._frames = 0

    # --- each frame ------------------------------------------------------------------------------------------

    def show(self, snapshot: RobotSnapshot | None) -> None:
        """Show a snapshot; None: there is no robot yet."""
        before, self._moment = self._moment, snapshot
        self._frames += 1
        if self._frames % ASK_EVERY == 0:
            self._ask_for_age()
        if self._commissioning is not None:
            self._commissioning.turn(snapshot)
        if snapshot is not None:
            self._show_robot(before, snapshot)
        if self._frames % TEXT_EVERY == 1 or _what(before) != _what(snapshot):
            self._show_texts(snapshot)

    def _show_robot(self, before: RobotSnapshot | None, snapshot: RobotSnapshot) -> None:
        """Show the scene at once, and charts, images and settings when they are due."""
        if self._stage is None or before is None or before.robot.layout != snapshot.robot.layout:
            self._meet(snapshot.robot)
        if before is None or before.robot is not snapshot.robot:
            self._control_changed()  # a simulator has controls of its own
        drawing = draw(snapshot, self._around)
        assert self._stage is not None and self._charts is not None
        if drawing is not None:
            with self._server.atomic():
                self._stage.show(drawing)
        self._charts.add_snapshot(snapshot)
        if self._own_sensors is not None:
            self._own_sensors.add_snapshot(snapshot)
        if self._frames % CHARTS_EVERY == 1:
            self._charts.show(snapshot)
            self._forces.content = force_polygon(snapshot) + push_point_table(snapshot.control)
            if self._own_sensors is not None:
                self._own_sensors.show(snapshot)
        if self._frames % PICTURES_EVERY == 1:
            self._show_pictures(snapshot)
        if snapshot.settings is not None and (before is None or snapshot.settings != before.settings):
            self._show_settings(snapshot.settings)

    def _meet(self, robot: Description) -> None:
        """Another robot: scene and charts start over."""
        self._server.scene.reset()
        self._server.scene.set_up_direction("+z")
        camera = self._server.initial_camera
        camera.position, camera.look_at = view_of(robot, narrow=False)
        camera.fov = VIEW_RAD
        for client in self._server.get_clients().values():
            _aim(client, robot)
        self._stage = RobotScene(self._server.scene, robot, self._around)
        with self._joints_tab:
            if self._charts is not None:
                self._charts.remove()
            self._charts = JointCharts(self._server.gui, robot)
        if self._own_sensors is not None:
            self._own_sensors.remove()
            self._own_sensors = None
        if robot.own:
            with self._sensors_tab:
                self._own_sensors = CustomSensorCharts(self._server.gui)

    def _show_settings(self, settings: ControlSettings) -> None:
        with self._lock:
            for controls in self._controls.values():
                with self._of_who_is_there(controls.client):
                    controls.show_settings(settings)

    def _show_texts(self, snapshot: RobotSnapshot | None) -> None:
        if snapshot is not None:
            self._state.content = page_html.state_table(snapshot)
            self._streams.content = page_html.stream_table(snapshot)
            if self._commissioning is not None:
                self._commissioning.show(snapshot)
        lines = [*(() if snapshot is None else snapshot.log), *self._log.lines()]
        if lines != self._shown_log:
            self._shown_log = lines
            self._log_text.content = page_html.log(lines)
        if self._operations is None:
            self._header.content = page_html.header(snapshot, recorded=self._recorded)
            return
        holder = self._token.holder
        viewers = self._server.viewers()
        control = f"{format_viewer(holder)} has control; {viewers} viewer{'' if viewers == 1 else 's'}"
        if dropped := self._server.admission.dropped.total():
            control += f"; {dropped} message{'' if dropped == 1 else 's'} of browsers dropped"
        self._header.content = page_html.header(snapshot, control=control)

    def _show_pictures(self, snapshot: RobotSnapshot) -> None:
        for key, image in snapshot.images.items():
            handle = self._pictures.get(key)
            if handle is None:
                self._no_camera.visible = False
                with self._cameras_tab:
                    self._pictures[key] = self._server.gui.add_image(picture(image), label=key)
            else:
                handle.image = picture(image)


def view_of(robot: Description, *, narrow: bool) -> tuple[Vector, Vector]:
    """Where a camera stands and what it looks at, relative to the body's middle, to have the whole body in view.

    narrow: a phone, whose lower half the panel covers.
    """
    length_m = sum(link.length_m for link in robot.links)
    far_m, before_m = (1.15 * length_m, 0.7 * length_m) if narrow else (0.8 * length_m, 0.0)
    x, y = -0.49, -0.87  # where it stands
    at = x * before_m, y * before_m, 0.0
    return (at[0] + 1.3 * far_m * x, at[1] + 1.3 * far_m * y, 1.6 * far_m), at


def _aim(client: viser.ClientHandle, robot: Description) -> None:
    """Turn a phone's view; other screens have the initial one."""
    camera = client.camera
    if camera.image_width < camera.image_height:
        camera.position, camera.look_at = view_of(robot, narrow=True)


def _what(snapshot: RobotSnapshot | None) -> tuple[object, ...] | None:
    """What viewers must see at once when it changes."""
    if snapshot is None:
        return None
    status, control = snapshot.status, snapshot.control
    host_state = None if status is None else (status.lifecycle, status.why, status.paused_by)
    return host_state, None if control is None else control.state
