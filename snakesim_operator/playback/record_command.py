"""`snakesim record`: writes everything that a robot publishes into one MCAP file, beside whatever else runs there."""

import signal
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from snakesim_hal.base.process import on_stop_signal, stop_signals
from snakesim_hal.base.terminal import print_line
from snakesim_hal.wire.codec import MAX_IMAGE_BYTES
from snakesim_operator.base.targets import RobotSelection, only_robot
from snakesim_operator.recording.live import LiveServer
from snakesim_operator.recording.recorder_process import record_to_file
from snakesim_operator.recording.stamps import Stamps


def record_robot(
    where: RobotSelection,
    out: Path | None,
    duration_s: float | None,
    foxglove_port: int | None = None,
    foxglove_origins: Sequence[str] = (),
    *,
    raw_only: bool = False,
    stamps: Stamps = "robot",
) -> int:
    """Record a robot until Ctrl-C, or for a time.

    Args:
        where: Which robot to address.
        out: The file; None: named after the robot and the time, in the working folder.
        duration_s: Wall time; None: until Ctrl-C.
        foxglove_port: Serve viewers on this port meanwhile; None: serve none.
        foxglove_origins: Origins of web pages that may be such viewers.
        raw_only: Write a file without topics for viewers.
        stamps: The clock of the times in the file.

    Returns:
        The exit code: 1 if the disk was full.
    """
    link = replace(only_robot(where, "record"), max_bytes=MAX_IMAGE_BYTES)
    path = out or Path(f"{link.namespace}-{datetime.now():%Y%m%d-%H%M%S}.mcap")
    path.parent.mkdir(parents=True, exist_ok=True)
    stopped: list[bool] = []
    on_stop_signal(lambda: stopped.append(True))
    began = time.monotonic()

    def should_continue() -> bool:
        return not stopped and (duration_s is None or time.monotonic() < began + duration_s)

    try:
        with (
            nullcontext()
            if foxglove_port is None
            else LiveServer(link.namespace or "robot", foxglove_port, foxglove_origins, print_line) as live
        ):
            end = "" if duration_s else "; Ctrl-C ends it"
            print_line(f"recording {link.namespace} on {link.endpoint} into {path}{end}")
            show = None
            if live is not None:
                print_line(f"Foxglove: open connection {live.address}")
                show = live.send
            recorder = record_to_file(link, path, should_continue, show, raw_only=raw_only, stamps=stamps)
    finally:
        for number in stop_signals():
            signal.signal(number, signal.SIG_DFL)
    messages = recorder.recording.counts.total()
    size_bytes = path.stat().st_size
    print_line(f"{messages} messages in {time.monotonic() - began:.1f} s, {size_bytes / 1e6:.1f} MB: {path}")
    return 1 if recorder.recording.failure else 0
