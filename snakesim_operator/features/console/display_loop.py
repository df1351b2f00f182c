"""The loop: take in what has arrived, show it, wait for the next frame."""

import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from snakesim_hal.base.terminal import say
from snakesim_hal.network.session import Link, open_session
from snakesim_hal.service import START_LIMIT_S
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
from snakesim_operator.features.console.web.server import SECOND_STOP, page_server

FRAMES_PER_S = 30.0


def show_live(
    link: Link,
    around: Surroundings | None,
    listening: socket.socket,
    stop: threading.Event,
    expected: RobotSnapshot | None = None,
    commission: Path | None = None,
) -> None:
    """Show a robot until `stop` is set. Raises NotConnectedError when no network is there.

    expected: what to show until there is a robot; commission: the robot file that pages may write into.
    """
    log = PageLog()
    operations = Operations(link, log)

    def report(line: str) -> None:
        log.write(line)
        say(line)

    kept = LiveSignals()
    signals = SignalsPage(kept, SECOND_STOP)
    signals.now_s = kept.now_s

    with page_server(listening, report, operations.stop, signals.answer) as (server, address):
        page = Page(server, around, operations, log, commission=commission)
        say(f"console: {address}")
        page.show(expected)
        whole = replace(link, max_bytes=MAX_IMAGE_BYTES)
        with open_session(whole, START_LIMIT_S) as session:
            operations.connect(session)
            watch, changes = LiveRobot(session), StateChangeLog(log.write)
            for _ in frames(stop):
                snapshot = watch.snapshot() or expected
                if snapshot is not None:
                    changes.note(snapshot.status)
                    changes.note(snapshot.control)
                    changes.note(snapshot.settings)
                    kept.take(snapshot)
                page.show(snapshot)


def show_recorded(folder: Path, at_s: float, listening: socket.socket, stop: threading.Event) -> int:
    """Show a run's record until `stop` is set. Returns the exit code. Raises ConfigError when the folder has none."""
    # What only recordings need would delay the page of a run that starts.
    from snakesim_operator.features.console.robot_data.recorded_run import RecordedRun
    from snakesim_operator.features.console.robot_data.recorded_signals import RecordedSignals
    from snakesim_operator.results.missing_data import exit_code

    recorded, log = RecordedRun(folder), PageLog()
    for lack in recorded.record.lacks:
        log.write(f"the record lacks {lack}")
    if recorded.heard.thinned > 1:
        log.write(f"of {recorded.heard.thinned} camera images one is kept")
    code = exit_code(folder, recorded.record.lacks)
    signals = SignalsPage(RecordedSignals(recorded))
    with page_server(listening, say, more=signals.answer) as (server, address):
        page = Page(server, Surroundings(recorded.record.config), None, log, recorded=folder.name)
        player = Player(server, recorded.span_s, at_s)
        signals.now_s, signals.go = (lambda: player.since_s), player.go
        say(f"console: {address}")
        shown_s = None
        for _ in frames(stop):
            time_s, jumped = player.turn()
            if jumped or shown_s is None:
                page.recall(recorded.before(time_s))
            if time_s != shown_s:
                page.show(recorded.at(time_s))
                shown_s = time_s
    return code


def frames(stop: threading.Event) -> Iterator[None]:
    """One turn a frame, until `stop` is set; a frame that takes too long delays the others."""
    due_s = time.monotonic()
    while not stop.is_set():
        yield
        due_s = max(due_s + 1 / FRAMES_PER_S, time.monotonic())
        stop.wait(due_s - time.monotonic())
