"""The page: the scene in the middle, the state and the controls beside it.

All viewers see the same, except that each viewer has controls of its own.

Threads: the display loop calls `show_snapshot` and `reset_for_jump`, with one snapshot a frame. viser calls
`_on_viewer_connect` and `_on_viewer_disconnect` in threads of its own.

Each viewer gets the newest value of each thing when its page has shown the one before (`pacing`). So a slow browser
gets fewer frames, and never makes the display loop wait.
"""

import threading
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import viser

from snakesim_operator.features.console.control_token import ControlToken
from snakesim_operator.features.console.operations import PageLog, RobotOperations
from snakesim_operator.features.console.page import page_html
from snakesim_operator.features.console.page.appearance import (
    add_appearance,
    aim_phone_camera,
    set_appearance,
)
from snakesim_operator.features.console.page.commissioning_tab import CommissioningTab
from snakesim_operator.features.console.page.drive_controls import HOTKEY_BY_DRIVE_KEY
from snakesim_operator.features.console.page.robot_display import RobotDisplay, RobotTabs
from snakesim_operator.features.console.page.viewer_controls import ControlContext, format_viewer
from snakesim_operator.features.console.page.viewers import Viewers, ignore_closed_page
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import TrueSurroundings
from snakesim_operator.features.console.scene.scene_colors import LEGEND
from snakesim_operator.features.console.web.viser_server import PageServer

# Decimation: every how many frames each part of the page is renewed, at 30 frames a second.
TEXT_DECIMATION = 6
CHART_DECIMATION = 5
IMAGE_DECIMATION = 6
# Ten questions a second to the page in control, by which the age of its messages is known.
AGE_REQUEST_DECIMATION = 3

PANEL_WIDTH_PX = 490  # wide enough for all tabs in one line


class ConsolePage:
    """The page that all viewers see, and the controls of each viewer."""

    def __init__(
        self,
        server: PageServer,
        surroundings: TrueSurroundings | None,
        operations: RobotOperations | None,
        log: PageLog,
        recorded: str = "",
        robot_file: Path | None = None,
    ) -> None:
        """Lay out the page for all viewers, before a robot is known.

        Args:
            server: Server of the page.
            surroundings: The true surroundings of the robot; None if they are not known.
            operations: Sends commands to the robot; None for a recording.
            log: Lines to show in the tab "Log".
            recorded: Name of the recording; empty for a live robot.
            robot_file: The robot file on this computer with which the host was started; None disables commissioning
                from the page.
        """
        self._server = server
        self._log = log
        self._recorded = recorded
        self._control_token = ControlToken()
        self._connect_lock = threading.Lock()  # one viewer at a time gets its controls
        # What is shown.
        self._frame_count = 0
        self._snapshot: RobotSnapshot | None = None
        self._shown_log_lines: list[str] = []
        # The panel, from top to bottom.
        gui = server.gui
        set_appearance(gui, dark=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH_PX)
        self._header = gui.add_html(page_html.format_header(None), order=0)
        tabs = gui.add_tab_group(order=4)
        self._robot_display = RobotDisplay(server, surroundings, self._add_robot_tabs(tabs))
        self._viewers: Viewers | None = None  # None for a recording
        self._commissioning: CommissioningTab | None = None  # None for a recording
        if operations is not None:
            self._add_live_controls(tabs, operations, robot_file)
        with tabs.add_tab("Log"):
            self._log_text = gui.add_html("")
        gui.add_html(page_html.format_legend(LEGEND), order=3)
        server.on_client_connect(self._on_viewer_connect)
        server.on_client_disconnect(self._on_viewer_disconnect)

    # --- layout ----------------------------------------------------------------------------------------------

    def _add_robot_tabs(self, tabs: viser.GuiTabGroupHandle) -> RobotTabs:
        """Add the tabs that show joints, forces, state, signals, cameras and sensors of the robot.

        Args:
            tabs: The group to which the tabs are added.

        Returns:
            The places in the tabs that a robot display fills.
        """
        gui = self._server.gui
        with tabs.add_tab("Joints"):
            joints = gui.add_folder(None)
        with tabs.add_tab("Forces"):
            forces = gui.add_html("")
        with tabs.add_tab("State"):
            self._state_table = gui.add_html("")
            with gui.add_folder("Rates and ages", expand_by_default=False):
                self._stream_table = gui.add_html("")
        with tabs.add_tab("Signals"):
            gui.add_html(page_html.SIGNALS)
        with tabs.add_tab("Cameras"):
            cameras = gui.add_folder(None)
            with cameras:
                no_camera = gui.add_html(
                    "<div style='padding:.3em .6em;opacity:.7'>no image yet</div>"
                )
        with tabs.add_tab("Sensors"):
            sensors = gui.add_folder(None)
        return RobotTabs(joints, forces, cameras, no_camera, sensors)

    def _add_live_controls(
        self, tabs: viser.GuiTabGroupHandle, operations: RobotOperations, robot_file: Path | None
    ) -> None:
        """Add the controls of a live robot to the page: stop button, drive keys, and folders for viewers' controls.

        The folders are empty at first. Each viewer that connects gets its own buttons and inputs in them.

        Args:
            tabs: The group to which tabs for parameters and commissioning are added.
            operations: Sends commands to the robot.
            robot_file: The robot file on this computer with which the host was started; None disables commissioning
                from the page.
        """
        gui = self._server.gui
        control_folder = gui.add_folder("Control", order=2)
        with tabs.add_tab("Parameters"):
            parameters_tab = gui.add_folder(None)
        with tabs.add_tab("Commission"):
            commissioning_tab = gui.add_folder(None)
        self._commissioning = CommissioningTab(
            gui, commissioning_tab, operations.link, robot_file, self._control_token, self._log
        )
        context = ControlContext(
            token=self._control_token,
            operations=operations,
            admission=self._server.admission,
            commissioning=self._commissioning,
            get_snapshot=lambda: self._snapshot,
            on_control_changed=self._on_control_changed,
            control_folder=control_folder,
            parameters_tab=parameters_tab,
            commissioning_tab=commissioning_tab,
        )
        self._viewers = Viewers(self._server, context)
        self._add_stop_and_drive_keys(self._viewers)

    def _add_stop_and_drive_keys(self, viewers: Viewers) -> None:
        """Add the stop button and the drive keys; the thread that receives messages handles their events."""
        gui = self._server.gui
        admit = self._server.admission.admit_control
        button = gui.add_button(
            "EMERGENCY STOP  (Esc)", color="red", icon=viser.Icon.HAND_STOP, order=1
        )
        admit(button, handler=viewers.stop_robot)
        admit(gui.add_command("Emergency stop", hotkey="escape"), handler=viewers.stop_robot)
        for key_name, hotkey in HOTKEY_BY_DRIVE_KEY.items():
            command = gui.add_command(f"Drive: {key_name.lower()}", hotkey=hotkey)
            admit(command, handler=partial(viewers.on_drive_key, key_name))

    # --- viewers ---------------------------------------------------------------------------------------------

    def _on_viewer_connect(self, client: viser.ClientHandle) -> None:
        """Add a viewer's own controls to its page, which may close before this ends.

        The page shows all of it at once, so no control is shown before it can be pressed.
        """
        viewer = client.client_id
        with self._connect_lock, ignore_closed_page(self._server, client), client.atomic():
            add_appearance(client, self._server.admission, dark=self._server.prefers_dark(viewer))
            if self._viewers is not None:
                self._viewers.add(client)
            if self._snapshot is not None:
                aim_phone_camera(client, self._snapshot.robot)
            self._log.write(f"{format_viewer(viewer)} came")
        if viewer not in self._server.get_clients():
            self._forget_viewer(viewer)

    def _on_viewer_disconnect(self, client: viser.ClientHandle) -> None:
        """Forget a viewer; if it had control, any other viewer may take it now."""
        viewer = client.client_id
        self._forget_viewer(viewer)
        had_control = self._control_token.release(viewer)
        line = f"{format_viewer(viewer)} left"
        if had_control:
            line += ", and with it control"
        self._log.write(line)
        self._on_control_changed()

    def _forget_viewer(self, viewer_id: int) -> None:
        if self._viewers is not None:
            self._viewers.remove(viewer_id)
        self._server.admission.remove_viewer(viewer_id)

    def _on_control_changed(self) -> None:
        if self._viewers is not None:
            self._viewers.refresh()

    # --- each frame ------------------------------------------------------------------------------------------

    def show_snapshot(self, snapshot: RobotSnapshot | None) -> None:
        """Show a snapshot of the robot on all pages; None while there is no robot."""
        previous = self._snapshot
        self._snapshot = snapshot
        self._frame_count += 1
        if self._viewers is not None and self._frame_count % AGE_REQUEST_DECIMATION == 0:
            self._viewers.ask_for_age()
        if self._commissioning is not None:
            self._commissioning.update(snapshot)
        if snapshot is not None:
            self._show_robot(previous, snapshot)
        if self._is_due(TEXT_DECIMATION) or _get_urgent_state(previous) != _get_urgent_state(
            snapshot
        ):
            self._show_texts(snapshot)

    def reset_for_jump(self, earlier: Iterable[RobotSnapshot]) -> None:
        """Prepare for a snapshot that does not follow the last one, because a viewer jumped in a recording.

        The trail starts over, and the charts begin with the snapshots of the time before the jump's target.
        """
        self._robot_display.add_samples(earlier)
        self._robot_display.clear_trail()
        self._frame_count = 0

    def _is_due(self, decimation: int) -> bool:
        """Return whether a part of the page is renewed in this frame; all parts are in the first frame."""
        return self._frame_count % decimation == 1

    def _show_robot(self, previous: RobotSnapshot | None, snapshot: RobotSnapshot) -> None:
        """Show the scene in every frame, and charts, images and parameters in the frames in which they are due."""
        if previous is None or previous.robot is not snapshot.robot:
            self._on_control_changed()  # a simulator has controls that other robots do not have
        self._robot_display.show_scene(snapshot)
        self._robot_display.add_samples([snapshot])
        if self._is_due(CHART_DECIMATION):
            self._robot_display.redraw_charts(snapshot)
        if self._is_due(IMAGE_DECIMATION):
            self._robot_display.show_pictures(snapshot)
        parameters = snapshot.parameters
        if self._viewers is None or parameters is None:
            return
        if previous is None or parameters != previous.parameters:
            self._viewers.show_parameters(parameters)

    def _show_texts(self, snapshot: RobotSnapshot | None) -> None:
        log_lines = self._log.list_lines()
        if snapshot is not None:
            self._state_table.content = page_html.format_state_table(snapshot)
            self._stream_table.content = page_html.format_stream_table(snapshot)
            if self._commissioning is not None:
                self._commissioning.redraw(snapshot)
            log_lines = [*snapshot.log, *log_lines]
        if log_lines != self._shown_log_lines:
            self._shown_log_lines = log_lines
            self._log_text.content = page_html.format_log(log_lines)
        if self._viewers is None:
            self._header.content = page_html.format_header(snapshot, recorded=self._recorded)
        else:
            self._header.content = page_html.format_header(
                snapshot, control=self._describe_viewers()
            )

    def _describe_viewers(self) -> str:
        """Return which viewer has control, how many viewers there are, and how many of their messages were dropped."""
        viewers = _format_count(self._server.count_viewers(), "viewer")
        text = f"{format_viewer(self._control_token.holder)} has control; {viewers}"
        dropped = self._server.admission.dropped.total()
        if dropped:
            text += f"; {_format_count(dropped, 'message')} of browsers dropped"
        return text


def _format_count(count: int, noun: str) -> str:
    plural = "" if count == 1 else "s"
    return f"{count} {noun}{plural}"


def _get_urgent_state(snapshot: RobotSnapshot | None) -> tuple[object, ...] | None:
    """Return the state whose changes viewers must see at once, rather than when texts are due."""
    if snapshot is None:
        return None
    status = snapshot.status
    control = snapshot.control
    host_state = None if status is None else (status.lifecycle, status.reason, status.paused_by)
    control_state = None if control is None else control.state
    return host_state, control_state
