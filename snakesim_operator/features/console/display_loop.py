"""The display loop: take a snapshot of the robot, show it, and wait for the next frame."""

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from snakesim_hal.base.terminal import print_line
from snakesim_hal.network.session import Link
from snakesim_hal.network.waiting import open_session_when_ready
from snakesim_hal.service import SERVICE_START_LIMIT_S
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.features.console.operations import Operations, PageLog
from snakesim_operator.features.console.page.page import Page
from snakesim_operator.features.console.page.player import Player
from snakesim_operator.features.console.page.signals_page import SignalsPage
from snakesim_operator.features.console.page_log import StateChangeLog
from snakesim_operator.features.console.robot_data.live_robot import LiveRobot
from snakesim_operator.features.console.robot_data.signals import LiveSignals
from snakesim_operator.features.console.robot_data.snapshot import RobotSnapshot
from snakesim_operator.features.console.scene.drawing import Surroundings
from snakesim_operator.features.console.web.added_html import SECOND_STOP
from snakesim_operator.features.console.web.serve import serve_pages

if TYPE_CHECKING:
    from snakesim_operator.features.console.robot_data.run_playback import RunPlayback

FRAMES_PER_S = 30.0


def show_live(
    link: Link,
    surroundings: Surroundings | None,
    listening: socket.socket,
    stop: threading.Event,
    expected: RobotSnapshot | None = None,
    commission: Path | None = None,
) -> None:
    """Show a live robot until `stop` is set.

    Args:
        link: How to connect to the robot.
        surroundings: The true surroundings of the robot, if they are known.
        listening: The Unix socket at which the front server connects.
        stop: Set to end the console.
        expected: Shown until a robot describes itself.
        commission: The robot file that pages may write into; None: none.

    Raises:
        NotConnectedError: There is no network, or `stop` was set before there was one.
    """
    log = PageLog()
    operations = Operations(link, log)

    def report(line: str) -> None:
        log.write(line)
        print_line(line)

    signals = LiveSignals()
    signals_page = SignalsPage(signals, SECOND_STOP)
    signals_page.now_s = signals.now_s

    with serve_pages(listening, report, signals_page.answer, has_stop=True) as server:
        page = Page(server, surroundings, operations, log, commission=commission)
        page.show_snapshot(expected)
        link_with_images = replace(link, max_bytes=MAX_IMAGE_BYTES)
        give_up_s = time.monotonic() + SERVICE_START_LIMIT_S

        def keeps_waiting() -> bool:
            return not stop.is_set() and time.monotonic() < give_up_s

        with open_session_when_ready(link_with_images, keeps_waiting) as session:
            operations.connect(session)
            robot = LiveRobot(session)
            changes = StateChangeLog(log.write)
            for _ in wait_for_frames(stop):
                snapshot = robot.take_snapshot() or expected
                if snapshot is not None:
                    changes.note(snapshot.status)
                    changes.note(snapshot.control)
                    changes.note(snapshot.parameters)
                    signals.add_snapshot(snapshot)
                page.show_snapshot(snapshot)


def show_recorded(run: "RunPlayback", start_s: float, listening: socket.socket, stop: threading.Event) -> int:
    """Show the record of a run until `stop` is set.

    Args:
        run: The run.
        start_s: Where to begin, in seconds after the first instant.
        listening: The Unix socket at which the front server connects.
        stop: Set to end the console.

    Returns:
        The exit code: it reports data that the record should have and has not.
    """
    # Imported here, because modules that only recordings need would delay the page of a run that starts.
    from snakesim_operator.features.console.robot_data.playback_signals import PlaybackSignals
    from snakesim_operator.results.missing_data import exit_code

    folder = run.record.folder
    log = PageLog()
    for missing in run.record.missing:
        log.write(f"the record is incomplete: {missing}")
    if run.history.image_decimation > 1:
        log.write(f"of {run.history.image_decimation} camera images one is kept")
    code = exit_code(folder, run.record.missing)
    signals_page = SignalsPage(PlaybackSignals(run))
    with serve_pages(listening, print_line, signals_page.answer, has_stop=False) as server:
        page = Page(server, Surroundings(run.record.config), None, log, recorded=folder.name)
        player = Player(server, run.span_s, start_s)
        signals_page.now_s = lambda: player.since_begin_s
        signals_page.jump_to = player.jump_to
        shown_s = None
        for _ in wait_for_frames(stop):
            time_s, has_jumped = player.advance()
            if has_jumped or shown_s is None:
                page.start_over(run.iterate_snapshots_before(time_s))
            if time_s != shown_s:
                page.show_snapshot(run.snapshot_at(time_s))
                shown_s = time_s
    return code


def wait_for_frames(stop: threading.Event) -> Iterator[None]:
    """Yield once for each frame until `stop` is set. A frame that takes too long delays the next ones."""
    due_s = time.monotonic()
    while not stop.is_set():
        yield
        due_s = max(due_s + 1 / FRAMES_PER_S, time.monotonic())
        stop.wait(due_s - time.monotonic())
