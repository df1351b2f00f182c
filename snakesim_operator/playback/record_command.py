"""`snakesim record`: records all messages of a robot into one MCAP file, next to any other recorder."""

import signal
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from snakesim_hal.base.process import call_on_stop_signals, list_stop_signals
from snakesim_hal.base.terminal import print_line
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.base.targets import RobotSelection, find_single_robot
from snakesim_operator.recording.foxglove_messages.live_server import FoxgloveLiveServer
from snakesim_operator.recording.log_clock import LogTimeClock
from snakesim_operator.recording.recorder_process import record_to_file


def record_robot(
    selection: RobotSelection,
    out: Path | None,
    duration_s: float | None,
    foxglove_port: int | None = None,
    foxglove_origins: Sequence[str] = (),
    *,
    raw_only: bool = False,
    stamps: LogTimeClock = "robot",
) -> int:
    """Record a robot until Ctrl-C or for a duration, and print the size of the recording.

    Args:
        selection: The robot to record.
        out: Path of the recording; None for a file in the working folder, named after the robot and the time.
        duration_s: Duration in wall time, in s; None to record until Ctrl-C.
        foxglove_port: Port on which viewers are served meanwhile; None to serve none.
        foxglove_origins: Origins of web pages that may connect as viewers.
        raw_only: Whether the recording contains no topics for viewers.
        stamps: Clock of the timestamps in the file.

    Returns:
        The exit code: 1 if the disk was full, otherwise 0.
    """
    link = replace(find_single_robot(selection, "record"), max_bytes=MAX_IMAGE_BYTES)
    path = out or Path(f"{link.namespace}-{datetime.now():%Y%m%d-%H%M%S}.mcap")
    path.parent.mkdir(parents=True, exist_ok=True)
    # A list, because the signal handler cannot assign a local variable.
    stop_requests: list[bool] = []
    call_on_stop_signals(lambda: stop_requests.append(True))
    start_s = time.monotonic()

    def should_continue() -> bool:
        return not stop_requests and (duration_s is None or time.monotonic() < start_s + duration_s)

    try:
        with (
            nullcontext()
            if foxglove_port is None
            else FoxgloveLiveServer(
                link.namespace or "robot", foxglove_port, foxglove_origins, print_line
            ) as live
        ):
            end_hint = "" if duration_s else "; Ctrl-C ends it"
            print_line(f"recording {link.namespace} on {link.endpoint} into {path}{end_hint}")
            show_message = None
            if live is not None:
                print_line(f"Foxglove: open connection {live.address}")
                show_message = live.send
            recorder = record_to_file(
                link, path, should_continue, show_message, raw_only=raw_only, log_time_clock=stamps
            )
    finally:
        for number in list_stop_signals():
            signal.signal(number, signal.SIG_DFL)
    message_count = recorder.writer.counts.total()
    size_bytes = path.stat().st_size
    print_line(
        f"{message_count} messages in {time.monotonic() - start_s:.1f} s, {size_bytes / 1e6:.1f} MB: {path}"
    )
    return 1 if recorder.writer.failure else 0
