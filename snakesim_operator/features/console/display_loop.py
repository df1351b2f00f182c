"""The display loop: take a snapshot of the robot, show it, and wait for the next frame."""

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.session import ConnectionSettings
from snakesim_hal.network.waiting import open_session_when_ready
from snakesim_hal.service import SERVICE_START_LIMIT_S
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.features.console.operations import PageLog, RobotOperations
from snakesim_operator.features.console.page.page import ConsolePage
from snakesim_operator.features.console.page.player import RecordingPlayer
from snakesim_operator.features.console.page.signals_page import SignalsPage
from snakesim_operator.features.console.page_log import StateChangeLog
from snakesim_operator.features.console.robot_data.live_robot import LiveRobot
from snakesim_operator.features.console.robot_data.signals import LiveSignals
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import TrueSurroundings
from snakesim_operator.features.console.web.added_html import SECOND_STOP
from snakesim_operator.features.console.web.serve import serve_pages

if TYPE_CHECKING:
    from snakesim_operator.features.console.robot_data.run_playback import RunPlayback

FRAME_RATE_HZ = 30.0


def run_live_display(
    connection: ConnectionSettings,
    surroundings: TrueSurroundings | None,
    listening_socket: socket.socket,
    stop_event: threading.Event,
    expected: RobotSnapshot | None = None,
    robot_file: Path | None = None,
) -> None:
    """Serve pages that show a live robot in the browser, until `stop_event` is set.

    Args:
        connection: Addresses and certificates with which the robot is reached.
        surroundings: The true surroundings of the robot, if they are known.
        listening_socket: The Unix socket at which the front server connects.
        stop_event: Set to end the console.
        expected: Snapshot to show until a robot describes itself; None for none.
        robot_file: The robot file that pages may write into; None if they may write no file.

    Raises:
        NotConnectedError: There is no network, or `stop_event` was set before there was one.
    """
    log = PageLog()
    operations = RobotOperations(connection, log)

    def report(line: str) -> None:
        log.write(line)
        print_line(line)

    signals = LiveSignals()
    signals_page = SignalsPage(signals, SECOND_STOP)
    signals_page.now_s = signals.now_s

    with serve_pages(
        listening_socket, report, signals_page.answer_request, has_stop=True
    ) as server:
        page = ConsolePage(server, surroundings, operations, log, robot_file=robot_file)
        page.show_snapshot(expected)
        link_with_images = replace(connection, max_bytes=MAX_IMAGE_BYTES)
        deadline_s = time.monotonic() + SERVICE_START_LIMIT_S

        def should_wait() -> bool:
            return not stop_event.is_set() and time.monotonic() < deadline_s

        with open_session_when_ready(link_with_images, should_wait) as session:
            operations.connect(session)
            robot = LiveRobot(session)
            state_change_log = StateChangeLog(log.write)
            for _ in iterate_frames(stop_event):
                snapshot = robot.take_snapshot() or expected
                if snapshot is not None:
                    state_change_log.log_change(snapshot.status)
                    state_change_log.log_change(snapshot.control)
                    state_change_log.log_change(snapshot.parameters)
                    signals.add_snapshot(snapshot)
                page.show_snapshot(snapshot)


def run_recording_display(
    run: "RunPlayback", start_s: float, listening_socket: socket.socket, stop_event: threading.Event
) -> int:
    """Serve pages that play the recording of a run in the browser, until `stop_event` is set.

    Args:
        run: The run.
        start_s: Time to show first, in seconds after the first instant.
        listening_socket: The Unix socket at which the front server connects.
        stop_event: Set to end the console.

    Returns:
        The exit code, which is not 0 if data is missing in the record.
    """
    # Imported here, because modules that only recordings need would delay the page of a run that starts.
    from snakesim_operator.features.console.robot_data.playback_signals import PlaybackSignals
    from snakesim_operator.results.missing_data import report_missing_data

    folder = run.record.path
    log = PageLog()
    for missing_data in run.record.missing:
        log.write(f"the record is incomplete: {missing_data}")
    if run.history.image_decimation > 1:
        log.write(f"of {run.history.image_decimation} camera images one is kept")
    run_exit_code = report_missing_data(folder, run.record.missing)
    signals_page = SignalsPage(PlaybackSignals(run))
    with serve_pages(
        listening_socket, print_line, signals_page.answer_request, has_stop=False
    ) as server:
        page = ConsolePage(
            server, TrueSurroundings(run.record.config), None, log, recorded=folder.name
        )
        player = RecordingPlayer(server, run.span_s, start_s)
        signals_page.now_s = lambda: player.elapsed_s
        signals_page.jump_to = player.jump_to
        shown_s = None
        for _ in iterate_frames(stop_event):
            time_s, has_jumped = player.advance_time()
            if has_jumped or shown_s is None:
                page.reset_for_jump(run.iterate_snapshots_before(time_s))
            if time_s != shown_s:
                page.show_snapshot(run.make_snapshot(time_s))
                shown_s = time_s
    return run_exit_code


def iterate_frames(stop_event: threading.Event) -> Iterator[None]:
    """Yield once for each frame until `stop_event` is set. A frame that takes too long delays the next ones."""
    due_s = time.monotonic()
    while not stop_event.is_set():
        yield
        due_s = max(due_s + 1 / FRAME_RATE_HZ, time.monotonic())
        stop_event.wait(due_s - time.monotonic())
