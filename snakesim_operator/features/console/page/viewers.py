"""The viewers of a live robot: their controls, and what they do to the robot by key or stop.

Threads: viser's threads and the display loop call the methods that change pages. The thread that receives the messages
of browsers calls `stop_robot` and `on_drive_key`, which must not wait.
"""

import contextlib
import threading
from collections.abc import Iterator
from concurrent.futures import Future
from functools import partial

import viser

from snakesim_hal.wire.messages import ControlParameters
from snakesim_operator.features.console.page.viewer_controls import (
    ControlContext,
    ViewerControls,
    format_viewer,
)
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.web.message_age import PageAction
from snakesim_operator.features.console.web.viser_server import PageServer


class Viewers:
    """The controls of each viewer."""

    def __init__(self, server: PageServer, context: ControlContext) -> None:
        """Have no viewer yet.

        Args:
            server: Server of the page.
            context: Objects that the controls of every viewer act on.
        """
        self._server = server
        self._context = context
        self._controls: dict[int, ViewerControls] = {}  # by viewer
        # Of `_controls`; viser fills a folder from one thread at a time.
        self._lock = threading.Lock()

    def add(self, client: viser.ClientHandle) -> None:
        """Give a viewer its controls."""
        with self._lock:
            controls = ViewerControls(client, self._context)
            snapshot = self._context.get_snapshot()
            if snapshot is not None and snapshot.parameters is not None:
                controls.show_parameters(snapshot.parameters)
            self._controls[client.client_id] = controls

    def remove(self, viewer_id: int) -> None:
        """Forget the controls of a viewer."""
        with self._lock:
            self._controls.pop(viewer_id, None)

    def refresh(self) -> None:
        """Show each viewer the controls that it may use now."""
        # Ask first: the page that may press something next has to have answered before its presses count.
        self.ask_for_age()
        with self._lock:
            all_controls = list(self._controls.values())
        for controls in all_controls:
            with ignore_closed_page(self._server, controls.client):
                controls.refresh()

    def show_parameters(self, parameters: ControlParameters) -> None:
        """Show every viewer the parameters of the controller."""
        with self._lock:
            for controls in self._controls.values():
                with ignore_closed_page(self._server, controls.client):
                    controls.show_parameters(parameters)

    def ask_for_age(self) -> None:
        """Send the page in control the next question by which the age of its messages is known."""
        holder = self._context.token.holder
        if holder is not None:
            self._server.ask_for_age(holder, _find_robot_time_ns(self._context.get_snapshot()))

    # --- messages of browsers --------------------------------------------------------------------------------

    def stop_robot(self, viewer_id: int, _action: PageAction) -> None:
        """Stop the robot, however old the press is, and whichever viewer has control.

        A page that cannot draw the scene has no controls, but may stop the robot.
        """
        stopped = self._context.operations.stop.request_stop(format_viewer(viewer_id))
        # Without the lock: the thread that holds it may wait for this one.
        controls = self._controls.get(viewer_id)
        if controls is not None:
            stopped.add_done_callback(partial(self._show_stop_result, controls))

    def _show_stop_result(self, controls: ViewerControls, stopped: "Future[str]") -> None:
        with ignore_closed_page(self._server, controls.client):
            error = stopped.exception()
            if error is not None:
                controls.notify("Emergency stop", str(error), bad=True)
            else:
                controls.notify("Emergency stop", stopped.result())

    def on_drive_key(self, key_name: str, viewer_id: int, action: PageAction) -> None:
        """Drive the robot by a key of a viewer."""
        controls = self._controls.get(viewer_id)  # without the lock, as in `stop_robot`
        if controls is not None:
            controls.drive_controls.on_key(key_name, action)


def _find_robot_time_ns(snapshot: RobotSnapshot | None) -> int | None:
    """Return the robot's time; None if it is not known."""
    if snapshot is None or snapshot.time_s is None:
        return None
    return round(snapshot.time_s * 1e9)


@contextlib.contextmanager
def ignore_closed_page(server: PageServer, client: viser.ClientHandle) -> Iterator[None]:
    """Ignore the errors that viser raises when a page is changed that has just been closed."""
    try:
        yield
    except (RuntimeError, KeyError):  # a KeyError comes from a control whose folder is gone
        if client.client_id in server.get_clients():
            raise
